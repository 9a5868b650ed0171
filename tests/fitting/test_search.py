"""The search for pose and state without a network: what its tables hold, and what it finds."""

from copy import copy
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from fit_cases import seen
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from mereo.fitting.config import FitConfig
from mereo.fitting.modes import ScoredFit, fit_from_far
from mereo.fitting.problem.evidence import (
    MOST_POINTS,
    OBSERVED_SAMPLES,
    Directions,
    Evidence,
    SurfaceEvidence,
    signed,
    without_sign,
)
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.problem import OPEN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration.answer_frame import check_size, search_modes
from mereo.fitting.registration.register import CloudToFit
from mereo.fitting.search import ALIKE, WHOLE, SightTable, Trail, likelier, medoids, rotations
from mereo.geometry.camera import PointCloud, SharedNoise, SightLines
from mereo.geometry.mesh import SegmentedMesh, area_vectors, surface_points
from mereo.geometry.symmetry import Symmetry
from mereo.geometry.transforms import unit_rows
from mereo.models.weights import load_model
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.pipeline import encode_frame
from mereo.scenes.statistical_model import StatisticalModel

FAR = np.array([12.0, -7.0, 150.0])


@pytest.fixture(scope="module")
def model() -> StatisticalModel:
    """Model of a lobe with a core inside and a tip that lies on it, which bends."""
    return load_model("tests/golden/lump.safetensors").statistical_model


def state(model: StatisticalModel, index: int) -> Posed:
    turn = rotations(97)[(31 * index + 7) % 97]
    return Posed(turn, FAR - turn @ model.mean.mean(axis=0), model.library[index].astype(np.float64))


def view(model: StatisticalModel, posed: Posed) -> ndarray:
    return seen(model.mesh(posed.place(model.material(posed.z))))


def cut(points: ndarray, share: float) -> tuple[ndarray, ndarray]:
    """Points that are left where something on the right hides a share of them, and the lines of sight to that."""
    slope = points[:, 0] / points[:, 2]
    limit = np.quantile(slope, 1 - share)
    x, y = np.meshgrid(np.arange(limit, limit + 0.6, 0.006), np.arange(-0.5, 0.5, 0.006))
    return points[slope < limit], 50.0 * np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


def off(model: StatisticalModel, material: ndarray, posed: Posed) -> float:
    true = posed.place(model.material(posed.z))
    return float(np.sqrt(((material - true) ** 2).sum(axis=1).mean()) / model.half)


def test_points_far_off_are_named_before_the_unit(model: StatisticalModel) -> None:
    """A pixel at 65 m spoils the size of a frame whose unit is right; of one whose unit is wrong all points do."""
    points = view(model, state(model, 0))
    far = np.concatenate([points, 100 * points[:1]])
    for cloud, cure in (
        (far, "leave out of the cloud .*, or correct the unit"),
        (1e3 * points, "correct the unit .*, or le"),
    ):
        frame = encode_frame(Reading.of_all(PointCloud(cloud)), None)
        with pytest.raises(ValueError, match=f"a view shows from 5% to 300% of it: {cure}"):
            check_size(frame, model, 1.0)
    check_size(encode_frame(Reading.of_all(PointCloud(points)), None), model, 1.0)


def test_rotations_are_even() -> None:
    turns = rotations(600)
    assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    trace = np.einsum("nij,mij->nm", turns, turns)
    np.fill_diagonal(trace, -1.0)
    nearest = np.degrees(np.arccos(np.clip((trace.max(axis=1) - 1) / 2, -1, 1)))
    assert nearest.min() > 15 and nearest.max() < 32  # as far apart as 600 can be, about 25 degrees


def test_medoids_are_states_that_stand_for_all(model: StatisticalModel) -> None:
    rows = medoids(model, 8)
    assert len(set(rows)) == len(rows) <= 8
    shape = model.library * model.motion
    spread = np.sqrt(((shape[:, None] - shape[rows]) ** 2).sum(axis=2)).min(axis=1).mean()
    rng = default_rng(0)
    others = [rng.choice(len(shape), 8, replace=False) for _ in range(20)]
    random = [np.sqrt(((shape[:, None] - shape[other]) ** 2).sum(axis=2)).min(axis=1).mean() for other in others]
    assert spread < np.min(random)


def test_a_table_of_sight_rules_out_what_the_evidence_does(model: StatisticalModel) -> None:
    posed = state(model, 3)
    points, unknown = cut(view(model, posed), 0.3)
    evidence = Evidence.of(points, lines=SightLines(np.empty((0, 3)), unknown, "past"))
    places = posed.place(model.material(posed.z)) + default_rng(0).normal(scale=4.0, size=model.mean.shape)
    _, exact = evidence.violations(places, 0.5)
    _, looked_up = SightTable.of(evidence).violations(places[None].astype(np.float32), 0.5)
    # up to a cell's width, which is a few pixels here
    assert np.mean((exact > 0) == (looked_up[0] > 0)) > 0.85
    assert_allclose(np.median(np.abs(exact - looked_up[0])), 0.0, atol=0.1)


@pytest.mark.parametrize("index", [0, 5])
@pytest.mark.parametrize("unit", [1.0, None])
def test_a_view_is_found_from_nothing(model: StatisticalModel, index: int, unit: float | None) -> None:
    posed = state(model, index)
    scale = 1.0 if unit else 0.0021
    fitted = search_modes(CloudToFit(scale * view(model, posed), unit), model)
    found = fitted.registration
    assert found.accepted and off(model, found.material / scale, posed) < 0.05
    assert found.scene_unit == pytest.approx(scale, rel=0.02)
    assert fitted.problem.evidence.other_lines == "past"  # seen whole, and taken for that


def test_a_view_of_which_a_half_is_hidden_is_found_as_one(model: StatisticalModel) -> None:
    posed = state(model, 4)
    points, unknown = cut(view(model, posed), 0.4)
    told = search_modes(CloudToFit(points, 1.0, lines=SightLines(np.empty((0, 3)), unknown, "past")), model)
    open_ = search_modes(CloudToFit(points, 1.0), model)
    wrong = search_modes(CloudToFit(points, 1.0, lines=SightLines.of_cloud("past")), model)
    apart = [off(model, fitted.registration.material, posed) for fitted in (told, open_, wrong)]
    assert max(apart[:2]) < 0.1 < apart[2]
    assert open_.problem.evidence.other_lines == "unknown"


@pytest.mark.parametrize("patched", [False, True])
def test_noise_is_told_from_a_wrong_state(
    model: StatisticalModel, patched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also that of a stereo camera that matches windows: each patch is off by one amount."""
    searched = list[Problem]()
    fit = Trail.fit

    def counted(trail: Trail, poses: list[Posed]) -> None:
        searched.append(trail.problem)
        fit(trail, poses)

    monkeypatch.setattr(Trail, "fit", counted)
    posed = state(model, 1)
    points = view(model, posed)
    rows = slice(None)
    if patched:
        cells = (points[:, :2] / points[:, 2:] // 0.012).astype(int)
        rows = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    noisy = points * (1 + default_rng(0).normal(scale=0.5, size=len(points))[rows] / norm(points, axis=1))[:, None]
    fitted = search_modes(CloudToFit(noisy, 1.0, lines=SightLines.of_cloud("past")), model)
    assert fitted.problem.is_noisy and fitted.registration.accepted
    assert off(model, fitted.registration.material, posed) < 0.1 and len(searched) == 1
    searched.clear()
    monkeypatch.setattr(Evidence, "noise", 0.3)  # as edges may look
    assert patched or not search_modes(CloudToFit(points, 1.0), model).problem.is_noisy
    assert len(searched) == 1 - patched, "what explains a clean cloud as the whole is not searched as a part"


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_under_noise_a_part_is_hidden_where_it_is_by_the_noises_constants_too(
    model: StatisticalModel, share: float
) -> None:
    posed = state(model, 3)
    points = cut(view(model, posed), share)[0]
    points = points * (1 + default_rng(0).normal(scale=0.5 / 150.0, size=(len(points), 1)))
    evidence = Evidence.of(points)
    whole = Problem(model, evidence, OPEN_SCALE_STD, FitConfig()).with_noise(evidence.noise)
    partial = whole.changed(evidence=replace(evidence, other_lines="unknown"))
    trails = [Trail(each, handicap, [fit_from_far(each, posed)]) for each, handicap in ((whole, 0.0), (partial, WHOLE))]
    assert whole.is_noisy and likelier(trails).problem is (partial if share else whole)


def test_a_noisy_frame_is_explained_where_neighbours_share_as_much_as_they_do_around_it(
    model: StatisticalModel,
) -> None:
    posed = state(model, 3)
    rng = default_rng(0)
    points = view(model, posed)
    waves = 0.5 * np.sqrt(2) * np.sin(4 / model.half * points @ [0.6, 0.8, 0.0])
    seen = points * (1 + (waves + rng.normal(scale=0.05, size=len(points)))[:, None] / 150.0)
    for share, is_explained in ((np.inf, False), (0.1, False), (0.5, True)):
        evidence = replace(Evidence.of(seen), shared_noise=SharedNoise(share))
        problem = Problem(model, evidence, OPEN_SCALE_STD, FitConfig(), noise=0.5)
        assert problem.explained(problem.surface(posed)) is is_explained


def test_others_explain_a_frame_alike_where_their_misfit_is_hardly_greater(
    model: StatisticalModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that differ, and not by a turn after which the object looks the same."""
    posed = state(model, 3)
    problem = Problem(model, Evidence.of(view(model, posed)), OPEN_SCALE_STD, FitConfig())
    first = ScoredFit.of(problem, posed)
    turned = replace(posed, rotation=posed.rotation @ Rotation.from_euler("y", np.pi).as_matrix())
    others = [ScoredFit.of(problem, each) for each in (turned, posed)]

    def said(share: float) -> int:
        misfit = replace(first.misfit, total=(1.0 + share * (ALIKE - 1.0)) * first.misfit.total)
        fits = [first, *(replace(other, misfit=misfit) for other in others)]
        return len(Trail(problem, 0.0, fits).others)

    assert (said(0.9), said(1.1)) == (1, 0)
    half_turn = Symmetry(np.eye(4), np.pi, np.array([0.0, 1.0, 0.0]), (0,))
    monkeypatch.setitem(vars(model), "symmetries", (half_turn,))
    assert said(0.9) == 1  # where it is bent, it does not look the same
    others[0] = replace(others[0], surface=first.surface)
    assert said(0.9) == 0


def all_around(model: StatisticalModel, posed: Posed, std: float = 0.05) -> tuple[ndarray, ndarray]:
    """Noisy points of a state's whole outside, as stitched scans have it, and its normals there."""
    mesh = model.mesh(posed.place(model.material(posed.z)))
    vertices, faces, _ = SegmentedMesh(mesh.segments[1:]).merged()  # without the core inside
    points, face = surface_points(vertices, faces, 1500)
    return points + default_rng(0).normal(scale=std, size=points.shape), unit_rows(area_vectors(vertices, faces)[face])


@pytest.mark.parametrize("kind", ["whole", "half", "unknown unit", "without normals"])
def test_a_surface_that_no_camera_saw_is_found(model: StatisticalModel, kind: str) -> None:
    """From all sides, or from the half of them that faces no camera; the origin lies inside of it."""
    posed = state(model, 2)
    points, normals = all_around(model, posed)
    keep = normals @ FAR > -0.2 * 150 if kind == "half" else np.ones(len(points), dtype=bool)
    scale = 0.01 if kind == "unknown unit" else 1.0
    shift = points.mean(axis=0)
    cloud = CloudToFit(
        scale * (points - shift)[keep],
        None if kind == "unknown unit" else 1.0,
        lines=SightLines.of_cloud("none"),
        normals=None if kind == "without normals" else normals[keep],
    )
    fitted = search_modes(cloud, model)
    found = fitted.registration
    assert found.accepted and found.ruled_out == 0.0 and fitted.problem.evidence.other_lines == "none"
    assert off(model, found.material / scale + shift, posed) < 0.05
    assert found.scene_unit == pytest.approx(scale, rel=0.02)


def test_a_surface_inside_out_is_explained_by_nothing(model: StatisticalModel) -> None:
    """Normals decide: turned round, the same points are those of a hollow, which the object has not."""
    points, normals = all_around(model, state(model, 2))
    lines = SightLines.of_cloud("none")
    assert not search_modes(CloudToFit(points, 1.0, lines=lines, normals=-normals), model).registration.accepted


def test_surfaces_without_a_camera_rule_nothing_out_and_show_all_faces(model: StatisticalModel) -> None:
    posed = state(model, 2)
    points, normals = all_around(model, posed)
    evidence = SurfaceEvidence.of(points, normals=normals)
    direction, amount = evidence.violations(10.0 * points, 0.5)
    assert not direction.any() and not amount.any() and evidence.unseen(points[None, :3]) == 0.0
    assert evidence.is_open and evidence.hidden_edge == 1.0 and 0.02 < evidence.roughness < 0.3
    surface = Surface.of(model, posed, evidence.shows)
    assert len(surface.facing) == len(model.faces) > len(Surface.of(model, posed).facing)
    corners = surface.material[model.faces]
    assert evidence.area == pytest.approx(norm(area_vectors(surface.material, model.faces), axis=1).sum() / 2, rel=0.5)
    assert corners.shape[0] and len(evidence.few(7).alike(1.0).lifted) == 7 == len(evidence.few(7).observed_samples)
    dense = SurfaceEvidence.of(np.tile(points, (5, 1)) + np.repeat(np.arange(5), len(points))[:, None] * 1e-3)
    assert len(dense.points) <= MOST_POINTS and len(dense.with_more_samples.sample_normals) > OBSERVED_SAMPLES


def test_points_of_a_sheet_are_compared_with_the_side_whose_normals_are_theirs(model: StatisticalModel) -> None:
    """The nearest place of a thin sheet is on its other side, where a point's normal says that it is not."""
    sheet = np.array(
        [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 1.0], [9.0, 0.0, 1.0], [0.0, 9.0, 1.0]]
    )
    faces = np.array([[0, 2, 1], [3, 4, 5]])
    up = np.array([[0.0, 0.0, 1.0]])
    flat = copy(model)
    vars(flat)["faces"] = faces
    surface = Surface(flat, sheet, np.arange(2), np.concatenate([-up, up]))
    point = np.array([[2.0, 2.0, 0.1]])
    for normal, lift, distance, face in ((up, signed, 0.9, 1), (-up, signed, 0.1, 0), (up, without_sign, 0.1, 0)):
        found = surface.alike(point, Directions(lift, lift(normal), 2.0))
        assert (found[0][0], found[1][0]) == (pytest.approx(distance), face)
        assert_allclose(found[2], [[2.0, 2.0, float(face)]])
    across = np.array([[1.0, 0.0, 0.0]])  # a normal that no place has: the distance counts it
    assert surface.alike(point, Directions(signed, across, 2.0))[0][0] > 2.0


@pytest.mark.slow
def test_a_bank_keeps_every_candidate_and_a_chooser_by_todays_rules_names_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``benchmarks/bank.py``, on which numbers and rules of the fit are judged: a rigid mug, and another thing."""
    monkeypatch.syspath_prepend("benchmarks")
    bank, choosers = import_module("bank"), import_module("bank_choosers")
    (tmp_path / "mug").mkdir()
    assert bank.make("mug", "tool30", 0, tmp_path).startswith("made")
    assert bank.make("mug", "tool30", 0, tmp_path) == "kept"
    assert bank.make("mug", "other", 0, tmp_path).startswith("made")
    thing, own = choosers.frames_of(tmp_path, ["mug"], ["tool30", "other"])
    assert own.is_judged and not thing.is_judged and thing.facts["kind"] == "thing"
    stages = {row["stage"] for row in own.facts["candidates"]}
    assert {"truth", "from truth", "screened", "bent", "fitted", "rest"} <= stages
    answer, best, truth = (chooser(own) for chooser in (choosers.answered, choosers.best, choosers.from_truth))
    assert choosers.today(own) == answer and own.facts["answer"]["known"] is True
    assert own.miou[best] >= own.miou[answer] > 0.95 and own.miou[truth] > 0.95
    offsets = own.offsets(own.rows[answer])
    assert len(offsets) == own.problem(own.rows[answer])["points"] and np.median(np.abs(offsets)) < 0.1
    assert len(list(choosers.table([own], choosers.CHOOSERS, "condition"))) == 2 + 2 * len(choosers.CHOOSERS)
