"""Uncertainty of registrations: theorems on the posterior, and what users are told in units."""

import base64
import copy
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from answers import answer_to, fit_cloud
from fit_cases import SCENE, seen, shown
from folder_contents import read_json
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mereo.cli.stream import FrameAnswer, Outcome, line
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking import Tracker
from mereo.fitting.uncertainty import (
    UNCALIBRATED,
    ModesOptimum,
    Posterior,
    Uncertainty,
    radius95,
)
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import owned_centroids, owned_gradients
from mereo.io.config import FilesConfig
from mereo.models.calibration import Calibration
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.sample_views import load_view
from mereo.visualization.reconstruction_report import UNEXPLAINED, explain_centroids, point_marks
from mereo.visualization.result_files import write_answer
from mereo_learning.cases import RegistrationErrors, seen_points


@pytest.fixture(scope="module")
def material(model: StatisticalModel) -> ndarray:
    return shown(model, 0.5)[1]


@pytest.fixture(scope="module")
def found(model: StatisticalModel, material: ndarray) -> Registration:
    registration = fit_cloud(seen(model.mesh(material)), model, material)
    assert registration.method == "modes" and registration.explained > 0.95
    return registration


@pytest.fixture(scope="module")
def sure(found: Registration) -> Uncertainty:
    return found.uncertainty


def test_the_radius_holds_95_percent_of_a_gaussian() -> None:
    one = np.diag([4.0, 0.0, 0.0])
    three = 4.0 * np.eye(3)
    assert_allclose(radius95(np.stack([one, three])), 2.0 * np.sqrt(chi2.ppf(0.95, [1, 3])), rtol=1e-9)
    rng = default_rng(0)
    for spread in ([1.0, 0.5, 0.1], [1.0, 1.0, 0.0], [1.0, 0.2, 0.2]):
        turn = Rotation.random(random_state=1).as_matrix()
        points = rng.normal(size=(200_000, 3)) * spread @ turn.T
        radius = radius95((turn @ np.diag(np.square(spread)) @ turn.T)[None])[0]
        assert (norm(points, axis=1) <= radius).mean() == pytest.approx(0.95, abs=0.005)


def test_the_posterior_of_a_linear_problem_is_its_closed_form() -> None:
    """The pose is held; the prior is N(0, 1), measured is ``m_i z + noise``."""
    rng = default_rng(0)
    modes = rng.normal(size=(7, 3, 1)).astype(np.float32)
    sigma = 0.3
    held = NormalEquations.prior(np.zeros(1), np.zeros(1), np.eye(1), 0.0, 1e-6)
    matrix = held.matrix + np.diag([1e12] * 6 + [0.0, 0.0])
    jacobian = np.zeros((21, POSE + 1))
    jacobian[:, POSE] = modes.ravel()
    normal = NormalEquations(matrix, held.gradient).add(jacobian, np.zeros(21), np.full(21, sigma**-2))
    turn = Rotation.random(random_state=2).as_matrix()
    posed = Posed(turn, np.array([3.0, -2.0, 50.0]), np.zeros(1))
    posterior = Posterior.of(normal, posed, rng.normal(size=(7, 3)), modes)
    variance = 1.0 / (1.0 + float((modes.astype(float) ** 2).sum()) / sigma**2)
    lengths = norm(modes[..., 0], axis=1)
    assert_allclose(posterior.radii().radii(), lengths * np.sqrt(variance * chi2.ppf(0.95, 1)), rtol=1e-3)


def test_the_gradients_of_volumes_and_centroids_are_their_differences() -> None:
    mesh = SCENE.rest
    nested = SegmentedMesh((mesh.segments[3], replace(mesh.segments[0], name="around")), (("ball", "around"),))
    rng = default_rng(0)
    gradients = owned_gradients(nested)
    for _ in range(3):
        change = rng.normal(size=gradients.shape[2:])
        ends = [len(nested.segments[0].vertices)]

        def at(step: float, change: ndarray = change, ends: list[int] = ends) -> tuple[ndarray, ndarray]:
            moves = np.split(step * change, ends)
            parts = [s.vertices + move for s, move in zip(nested.segments, moves, strict=True)]
            moved = nested.with_vertices(parts)
            return moved.owned_volumes, owned_centroids(moved)

        (more, center), (less, other) = at(1e-5), at(-1e-5)
        said = np.einsum("sqvi,vi->sq", gradients, change)
        assert_allclose(said[:, 0], (more - less) / 2e-5, rtol=1e-5)
        assert_allclose(said[:, 1:], (center - other) / 2e-5, rtol=1e-3, atol=1e-5)


def test_radii_are_in_the_unit_of_the_input(model: StatisticalModel, material: ndarray, sure: Uncertainty) -> None:
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    points = seen(model.mesh(material))
    for unit in (0.001, 25.0):
        again = fit_cloud(unit * points @ turn.T, model, material @ turn.T, unit)
        assert_allclose(again.uncertainty.material, unit * sure.material, rtol=0.02)
        for one, first in zip(again.uncertainty.segments, sure.segments, strict=True):
            assert one.centroid_radius95 == pytest.approx(unit * first.centroid_radius95, rel=0.02)
            assert one.volume95 == pytest.approx([unit**3 * value for value in first.volume95], rel=0.02)


def test_a_calibration_scales_radii_and_intervals(found: Registration, sure: Uncertainty) -> None:
    """Without one, radii of clean frames are as they are, and those of noisy ones wider."""
    assert sure.factor == 1.0
    optimum = sure.optimum
    assert isinstance(optimum, ModesOptimum)
    noisy = replace(optimum, problem=optimum.problem.with_noise(0.3))
    assert replace(sure, optimum=noisy).factor == UNCALIBRATED
    wide = replace(found, radius_scale=3.0).uncertainty
    assert wide is not None and wide.calibrated and not sure.calibrated
    assert_allclose(wide.material, 3.0 * sure.material)
    for one, other in zip(wide.segments, sure.segments, strict=True):
        assert one.centroid_radius95 == pytest.approx(3.0 * other.centroid_radius95)
        assert np.ptp(one.volume95) == pytest.approx(3.0 * np.ptp(other.volume95), rel=1e-6)
    assert wide.summary()["calibrated"]
    assert wide.summary()["median"] == pytest.approx(3 * sure.summary()["median"])


def test_radii_reach_other_states_that_explain_the_frame_alike_and_no_farther(sure: Uncertainty) -> None:
    optimum = sure.optimum
    way = np.array([3.0, -4.0, 12.0])
    assert isinstance(optimum, ModesOptimum)
    moved = replace(sure, optimum=replace(optimum, others=(sure.posterior.material + way,)))
    assert_allclose(moved.material, sure.material + 13.0 * optimum.unit, rtol=1e-5)
    for one, other in zip(moved.segments, sure.segments, strict=True):
        assert one.centroid_radius95 == pytest.approx(other.centroid_radius95 + 13.0 * optimum.unit, rel=1e-3)


def test_the_expected_iou_is_that_of_balls_at_random_places(model: StatisticalModel, sure: Uncertainty) -> None:
    """Of two equal balls it is known how much they share."""
    rest = model.rest_points
    radius = np.cbrt(0.75 / np.pi * model.rest.segments[3].volume)
    shifts = norm(default_rng(0).normal(size=(20_000, 3)), axis=1)
    for std in (0.0, 0.1, 0.2, 100.0):
        both = np.maximum(1.0 - std * shifts / 2, 0.0) ** 2 * (1.0 + std * shifts / 4)
        moved = replace(sure, optimum=replace(sure.optimum))
        factor = np.diag([0.0] * 3 + [std * radius] * 3 + [0.0] * (model.count + 1))
        vars(moved.optimum)["posterior"] = replace(sure.posterior, material=rest, factor=factor, residue=0.0)
        assert moved.segments[3].expected_iou == pytest.approx((both / (2.0 - both)).mean(), abs=0.02)


def test_a_surface_that_may_be_elsewhere_is_doubted(found: Registration) -> None:
    far = (2.0 * found.optimum.posterior.material,)
    elsewhere = replace(found, optimum=replace(found.optimum, others=far), alike=2)
    assert found.doubt is None and elsewhere.expected_iou == pytest.approx(found.expected_iou / 2)
    assert re.search(r"expected to be 0\.4\d .*; 1 other state would do so too\)", elsewhere.doubt)


def test_the_interval_of_a_volume_is_around_it_and_not_far_from_the_true_one(
    found: Registration, sure: Uncertainty, material: ndarray
) -> None:
    """The true one may be outside once in twenty times, but not by as much again."""
    here = found.mesh.owned_volumes
    truth = found.model.mesh(material).owned_volumes
    for told, volume, true in zip(sure.segments, here, truth, strict=True):
        low, high = told.volume95
        assert (low + high) / 2 == pytest.approx(volume, rel=1e-5)
        assert 0 < high - low < 0.2 * true and abs(true - volume) < high - low


def test_the_scale_is_that_which_holds_95_percent(found: Registration, sure: Uncertainty, material: ndarray) -> None:
    shown = seen_points(material, PointCloud(seen(found.model.mesh(material))), 1.0)
    sure, found = replace(sure, scale=1.0), replace(found, radius_scale=1.0)
    one = RegistrationErrors.of(found, material, shown, 1.0)
    assert_array_equal(one.seen, shown)
    calibrated = RegistrationErrors.of(replace(found, radius_scale=7.0), material, shown, 1.0)
    assert_allclose(calibrated.radii, 7.0 * one.radii)
    off = norm(found.material - material, axis=1)
    assert_array_equal(calibrated.ratios <= 1.0, off <= calibrated.radii)
    assert_array_equal(one.ratios <= 1.0, off <= sure.material)
    both = RegistrationErrors.together([one, one])
    scale = both.scale()
    said = both.scaled(scale).coverage(unit_mm=2.0)
    assert said["all"] == pytest.approx(0.95, abs=1e-3)
    assert both.scaled(None).coverage()["all"] == pytest.approx((one.ratios <= 1).mean())
    assert said["radius_seen"] == pytest.approx(scale * np.median(one.gaussian[shown]))
    assert said["radius_hidden_mm"] == pytest.approx(2.0 * scale * np.median(one.gaussian[~shown]))


def test_a_registration_from_a_file_has_no_radii(found: Registration, material: ndarray) -> None:
    read = replace(found, optimum=None)
    assert read.uncertainty is None and read.radius95([[0.0, 0.0, 0.0]], at="rest") is None
    with pytest.raises(ValueError, match="fit its frame again"):
        RegistrationErrors.of(read, material, np.ones(len(material), dtype=bool), 1.0)


def test_the_shares_of_all_evidence_sum_to_one(found: Registration) -> None:
    """And hidden points are unsure by what was known of the states, not by the points' noise, more than seen ones."""
    shown = seen_points(found.material, PointCloud(seen(found.model.mesh(found.material))), 1.0)
    shares = []
    for part in (shown, ~shown):
        each = [found.explain(place, at="rest") for place in found.model.rest_points[part][::60]]
        for one in each:
            assert sum(one.shares.values()) == pytest.approx(1.0, abs=1e-3) and min(one.shares.values()) > -1e-6
            assert one.weights.sum() == pytest.approx(1.0) and (one.weights >= 0).all()
        shares.append(np.mean([one.shares["states"] for one in each if one is not None]))
    assert shares[1] > 1.1 * shares[0]


def test_an_influence_is_how_far_a_moved_point_moves_the_place(found: Registration) -> None:
    optimum = found.optimum
    row = 40
    one = found.explain(found.material[row])
    best = int(one.weights.argmax())
    jacobian, residual, weight, _ = optimum.terms.cloud
    change = np.zeros(len(residual))
    change[best] = -1e-3  # the observed point moves outward, so that the model is farther inside
    total = optimum.terms.total
    step = np.linalg.solve(total.matrix, -(jacobian * weight[:, None]).T.astype(float) @ change)
    moved = optimum.posed.moved(step)
    before, after = optimum.posterior.material[row], moved.place(found.model.material(moved.z))[row]
    assert_allclose((after - before) / 1e-3, one.influence[best], rtol=0.05, atol=1e-3)


def test_segments_are_explained_by_name(found: Registration) -> None:
    name = found.model.rest.names[0]
    one = found.explain(name)
    assert_allclose(one.place, owned_centroids(found.mesh)[0])
    with pytest.raises(ValueError, match=r"there is no segment 'nose'; the segments are box_0, .*: name one of them"):
        found.explain("nose")
    with pytest.raises(ValueError, match="x, y, z"):
        found.explain([1.0, 2.0])
    assert replace(found, optimum=None).explain(name) is None


@pytest.fixture(scope="module")
def liver() -> Model:
    return replace(load_model("liver"), calibration=None)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return load_view("liver").depth.to_points()


@pytest.fixture(scope="module")
def answer(liver: Model, cloud: PointCloud) -> Answer:
    return answer_to(cloud, liver, Registrar.of(liver, "modes"), 24)


@pytest.fixture(scope="module")
def folder(answer: Answer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sure")
    files = FilesConfig(("glb", "ply", "npz", "vti", "json"), millimetres=True)
    said = replace(answer.seen, frame=replace(answer.seen.frame, unit_m=0.5))
    write_answer(path, replace(answer, seen=said), files)
    return path


@pytest.fixture(scope="module")
def told(answer: Answer) -> Uncertainty:
    return answer.registered.uncertainty


@pytest.fixture(scope="module")
def radii(told: Uncertainty) -> ndarray:
    return np.concatenate(told.vertices)


def test_a_registration_says_that_it_cannot_be_sent(found: Registration) -> None:
    with pytest.raises(TypeError, match="a registration cannot be pickled or copied.*save_state"):
        copy.copy(found)


def test_a_ply_has_the_radius_of_each_vertex_in_its_unit(answer: Answer, radii: ndarray, folder: Path) -> None:
    """With --millimetres, of a frame whose unit is half a metre."""
    data = (folder / "segments.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    assert b"property uchar label\nproperty float radius95\n" in head
    assert b"comment radius95 is in the unit of x, y, z; it is not calibrated\n" in head
    kinds = [*((axis, "<f4") for axis in "xyz"), ("color", "u1", 3), ("label", "u1"), ("radius95", "<f4")]
    vertices = np.frombuffer(body, np.dtype(kinds), count=len(radii))
    assert_allclose(vertices["radius95"], 500.0 * radii, rtol=1e-5)
    assert_allclose(vertices["x"], 500.0 * answer.registered.material[: len(vertices), 0], rtol=1e-4)


def test_a_glb_has_the_radius_of_each_vertex_and_says_its_unit(answer: Answer, radii: ndarray, folder: Path) -> None:
    scene = trimesh.load_scene(folder / "segments.glb", process=False)
    rows = np.split(np.arange(len(radii)), np.cumsum(answer.registered.model.vertex_counts)[:-1])
    for mesh, part in zip(scene.geometry.values(), rows, strict=True):
        assert mesh.metadata["radius95"] == {"unit_m": 0.5, "calibrated": False} and mesh.visual.kind != "vertex"
        # vertices that are one place are written once
        away, same = cKDTree(answer.registered.material[part]).query(mesh.vertices)
        assert away.max() < 1e-4 and len(mesh.vertices) > 0.99 * len(part)
        assert_allclose(mesh.vertex_attributes["_RADIUS95"][:, 0], radii[part][same], rtol=1e-3)


def test_label_volumes_have_the_radius_of_each_voxel(radii: ndarray, folder: Path) -> None:
    with np.load(folder / "labels.npz") as values:
        labels = values["labels"]
        found = values["radius95"]
    assert found.shape == labels.shape and found.dtype == np.float32
    assert_array_equal(np.isfinite(found), labels > 0)
    assert radii.min() * 0.9 < np.nanmedian(found) < radii.max()
    text = (folder / "labels.vti").read_text()
    array = re.search(r'Name="radius95" format="binary">([^<]+)<', text)
    assert array is not None and 'type="Float32"' in text
    packed = base64.b64decode(array[1][44:])  # after the head of 32 bytes
    told = np.frombuffer(zlib.decompress(packed), "<f4").reshape(labels.shape, order="F")
    assert_allclose(told, 500.0 * found, rtol=1e-5)


def test_the_summary_tells_centroids_volumes_and_the_whole(told: Uncertainty, radii: ndarray, folder: Path) -> None:
    summary = read_json(folder / "summary.json")
    lengths = {"median": pytest.approx(np.median(radii)), "max": pytest.approx(radii.max())}
    assert summary["radius95"] == {**lengths, "calibrated": False, "unit_m": 0.5}
    assert [*summary, *summary["registration"]][-1] == "coefficients" and list(summary)[-1] == "registration"
    for row, one in zip(summary["segments"], told.segments, strict=True):
        assert row["centroid_radius95"] == pytest.approx(one.centroid_radius95)
        assert row["volume95"] == pytest.approx(list(one.volume95))
        assert row["volume95"][0] < row["volume"] < row["volume95"][1]


def test_points_that_the_model_does_not_explain_are_red(liver: Model, cloud: PointCloud) -> None:
    lump = cloud.points[:40] - [0.0, 0.0, 0.12 * np.ptp(cloud.points, axis=0).max()]
    points = np.concatenate([cloud.points, lump])
    registration = answer_to(points, liver, Registrar.of(liver, "modes"), 16, keep_all=True).registered
    one = registration.explain("liver")
    assert one is not None and len(one.unexplained)
    marks = point_marks(one, points)
    assert (marks[-40:] == UNEXPLAINED).mean() > 0.8 and (marks[:-40] == UNEXPLAINED).mean() < 0.1
    assert tuple(explain_centroids(registration)) == liver.names


def test_a_stream_says_it_of_the_whole_and_of_segments_where_it_is_asked_to(liver: Model, cloud: PointCloud) -> None:
    tracker = Tracker(Registrar.of(liver, "modes"))
    followed = [tracker.follow(observe(cloud), 0.05 * number) for number in range(2)]
    assert followed[1].tracked
    silent, told = FrameAnswer.of(followed[1]), FrameAnswer.of(followed[1], True)
    words = line(Outcome("frame", 0.0, told, "", 0.0, 0.0, 0))
    assert silent.facts["radius95"] == words["radius95"]  # of the whole, in each line
    assert "radius95" not in FrameAnswer.of(followed[1], radius=False).facts
    assert set(words["radius95"]) == {"median", "max", "calibrated"} and words["radius95"]["median"] > 0
    for name in liver.names:
        assert "volume95" not in silent.facts["segments"][name]
        low, high = words["segments"][name]["volume95"]
        assert low < words["segments"][name]["volume"] < high and words["segments"][name]["centroid_radius95"] > 0


def test_a_calibration_comes_from_the_weights(liver: Model, cloud: PointCloud) -> None:
    known = replace(liver, calibration=Calibration(seed=1, views=2, radius_scale=2.5))
    tracker = Tracker(Registrar.of(known, "modes"))
    for number in range(2):
        found = tracker.follow(observe(cloud), 0.05 * number).registration
        assert found is not None and found.uncertainty is not None and found.uncertainty.scale == 2.5


def test_the_viewer_colours_it_and_says_it_of_a_place(answer: Answer, server: object) -> None:
    pytest.importorskip("viser", reason="viser (extra `view`) is not installed")
    from mereo_viewer.result_page import SURE, ResultPage, content_of_answer

    page = ResultPage(server, content_of_answer(replace(answer, seen=observe(answer.seen.cloud, unit_m=1.0))))
    colors, scale = page.content.colorings[SURE]()
    mesh = page.content.mesh
    assert [len(part) for part in colors] == [len(s.vertices) for s in mesh.segments]
    assert scale is not None and "mm" in scale.words[-1]
    page.probe(mesh.segments[0].vertices[0])
    assert re.search(r"± [\d.]+ mm \(95\s%\)", page.facts.content)
