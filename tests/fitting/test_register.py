"""The registered model as a reconstruction: the rest mesh's own segments, in the input's frame."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import jaxtyping
import numpy as np
import pytest
from analytic import untrained
from answers import answer_to, reconstruct
from folder_contents import read_json
from numpy.testing import assert_allclose, assert_array_equal
from trimesh.remesh import subdivide

from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.registration import register
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame, search_modes
from mereo.fitting.registration.register import (
    ChangedSceneWarning,
    CloudToFit,
    ModesFit,
    Registrar,
    registrar_for,
    statistical_model_of,
)
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking import Tracker
from mereo.geometry.camera import SCANNER_TO_CAMERA, PointCloud
from mereo.geometry.conventions import NoFit
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.metrics import Scores, confusion_matrix, intersection_over_union
from mereo.geometry.solids import Solids
from mereo.io.atomic_files import write_json
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import Reconstruction
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import AssetUnavailable
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view
from mereo.synthesis.sample_views import SampleView, load_view
from mereo_learning.cases import Evaluation, RegistrationErrors, seen_points
from mereo_learning.scoring import EvaluationConfig, evaluate, true_material
from mereo_learning.tables import markdown_table, metrics


@pytest.fixture(scope="module")
def model(rope: Model) -> Model:
    return rope


@pytest.fixture(scope="module")
def view() -> SampleView:
    return load_view("rope")


@pytest.fixture(scope="module")
def network(model: Model, view: SampleView) -> Reconstruction:
    return reconstruct(view.depth.to_points(), model, resolution=48, label_points=True)


@pytest.fixture(scope="module")
def found(model: Model, view: SampleView) -> Answer:
    return answer_to(view.depth.to_points(), model, Registrar.of(model, "modes"), 48, label_points=True, scene_unit=1.0)


def iou(view: SampleView, result: Reconstruction) -> float:
    grid = view.truth.grid
    kept = view.truth.kept
    points = grid.positions(np.argwhere(kept))
    labels = Solids(result.surfaces).label(points)
    return intersection_over_union(confusion_matrix(grid.labels[kept], labels, len(grid.names) + 1)).miou


def test_the_answer_is_the_model_itself(found: Answer, model: Model, view: SampleView) -> None:
    result = found.reconstruction
    rest = statistical_model_of(model).rest
    assert result.surfaces.names == rest.names
    for segment, at_rest in zip(result.surfaces.segments, rest.segments, strict=True):
        assert_array_equal(segment.faces, at_rest.faces)
    assert iou(view, result) > 0.5  # .70 to .77, as the last bits of the search fall


def test_labels_are_those_of_the_segments(network: Reconstruction, found: Answer) -> None:
    result = found.reconstruction
    grid = found.reconstruction.labels
    index = np.argwhere(np.ones(grid.labels.shape, dtype=bool))
    agree = Solids(result.surfaces).label(grid.positions(index)) == grid.labels.reshape(-1)
    assert agree.mean() > 0.999 and not grid.touched_sides().any()
    assert grid.spacing[0] == pytest.approx(np.ptp(result.surfaces.bounds, axis=0).max() / 48)
    assert result.observed.labels.min() >= 1 and len(result.observed.labels) == len(network.observed.labels)


def test_a_scanners_frame_gets_its_answer_in_that_frame(model: Model, view: SampleView) -> None:
    points = view.depth.to_points().points @ SCANNER_TO_CAMERA.T
    result = answer_to(PointCloud(points), model, Registrar.of(model, "modes"), 48, "scanner").reconstruction
    assert np.median(Solids(result.surfaces).nearest(points).distance) < 0.02 * np.ptp(points, axis=0).max()
    for one in result.segments:
        inside = result.labels.positions(np.argwhere(result.labels.labels == one.label)).mean(axis=0)
        assert_allclose(one.centroid, inside, atol=1e-9)


def test_a_scene_is_the_weights_own_or_is_given(model: Model) -> None:
    other = replace(model, provenance={"scene": "mine"})
    assert Registrar.of(other).scene is None and Registrar.of(other, scene="rope").scene is not None
    with pytest.raises(ValueError, match="the scene 'engine' has other segments or meshes than the weights' own model"):
        _ = Registrar.of(other, scene="engine").scene


def test_a_scene_that_has_changed_since_is_said_and_not_played(
    model: Model, view: SampleView, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene("rope")
    base, *pieces = scene.rest.segments
    finer = Segment(base.name, base.color, *subdivide(base.vertices, base.faces))
    changed = replace(scene, rest=SegmentedMesh((finer, *pieces)))
    counts = rf"has {len(finer.vertices)} vertices, theirs {len(base.vertices)}"
    said = rf"'rope' has other .* \(its segment 'base' {counts}\)"
    fitted = search_modes(CloudToFit(view.depth.to_points().points), statistical_model_of(model))
    monkeypatch.setattr(register, "load_scene", lambda name: changed)
    for registrar in (Registrar.of(model), Registrar.of(model, scene=changed)):
        with pytest.warns(ChangedSceneWarning, match=f"{said}: it has changed since .* only the modes .* train them"):
            assert registrar.finish(fitted).method == "modes"
        assert registrar.states_or_none is None  # said once
    with pytest.raises(ValueError, match=f"{said}, so its draws .* or use --method modes"):  # as that of other weights
        assert Registrar.of(replace(model, provenance={"scene": "mine"}), scene=changed).states_or_none
    with pytest.raises(ValueError, match=f"{said}, so places cannot be compared: .* with --method network"):
        evaluate(model, EvaluationConfig(changed, 1, method="modes"))
    assert evaluate(model, EvaluationConfig(changed, 1, cells=12, method="network")).sources == ("network",)


def test_auto_plays_the_scene_where_it_is_at_hand(
    model: Model, view: SampleView, few_rope_states: DrawnStates, few_states: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit of its draws takes long, and is the command's above; here it is asked for, and with what."""
    registrar = Registrar.of(model)
    fitted = search_modes(CloudToFit(view.depth.to_points().points), registrar.model)
    assert fitted.rest is None
    modes = replace(registrar, method="modes")
    assert modes.finish(fitted).method == "modes" and "states_or_none" not in vars(modes)
    foreign = replace(registrar, network=replace(model, provenance={"scene": "mine"}))
    assert foreign.finish(fitted).method == "modes" and foreign.states_or_none is None
    with_draws = Mock(return_value=fitted.registration)
    monkeypatch.setattr(ModesFit, "with_draws", with_draws)
    registrar.finish(fitted)
    with_draws.assert_called_once_with(few_rope_states)
    assert registrar.states_or_none is few_rope_states


def test_without_its_mesh_the_modes_are_fitted(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(register, "load_scene", Mock(side_effect=AssetUnavailable("the mesh is not here")))
    assert Registrar.of(model).states_or_none is None


def test_a_registration_that_explains_too_little_is_the_answer_and_not_known(model: Model, view: SampleView) -> None:
    stretched = view.depth.to_points().points * np.array([1.0, 2.5, 1.0])
    without_scene = replace(model, provenance={"scene": "mine"})
    found = answer_to(stretched, model, Registrar.of(without_scene), 32)
    assert found.registration is not None and not found.registration.accepted and found.recognition.known is not True
    assert found.surfaces is found.registered.mesh


def test_where_no_fit_can_start_it_says_why_with_weights_too(model: Model, view: SampleView) -> None:
    cloud = PointCloud(view.depth.to_points().points / 1000.0)
    with pytest.raises(NoFit, match="correct the unit of the frame"):
        answer_to(cloud, model, Registrar.of(model), 32, scene_unit=1.0)


MOTION = "the pose is .* must be 4 x 4 finite numbers: a rotation and a translation"
REFUSED: dict[str, tuple[Callable[[Registration], object], str]] = {
    "pairs": (lambda r: r.to_camera([[0.0, 1.0]]), r"have the shape \(1, 2\); they must be rows of x, y, z"),
    "NaN": (lambda r: r.to_camera([[np.nan, 0, 0], [0, 0, 0]]), "1 of 2 points are NaN, infinite or beyond 1e"),
    "complex": (lambda r: r.to_rest(np.ones((2, 3)) * 1j), "has values of type complex128; they must be real numbers"),
    "a place": (lambda r: r.radius95([0, 0, 0], at="Rest"), "at is 'Rest'; it must be one of camera, rest"),
    "a shear": (lambda r: r.moved(np.eye(4) + np.eye(4, k=1)), MOTION),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_place_or_motion_is_refused(case: str, found: Answer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the check of types that tests put before it
    call, sentence = REFUSED[case]
    with pytest.raises(ValueError, match=sentence):
        call(found.registration)


@pytest.mark.parametrize("scene_unit", [-1.0, 0.0, np.nan, np.inf])
def test_a_scene_unit_is_a_length(scene_unit: float, view: SampleView, model: Model) -> None:
    seen = observe(view.depth.to_points())
    registrar = Registrar.of(model, "modes")
    sentence = "scene_unit is .*; it must be greater than 0"
    with pytest.raises(ValueError, match=sentence):
        answer_frame(seen, model, registrar, scene_unit=scene_unit)
    with Tracker(registrar) as tracker:
        with pytest.raises(ValueError, match=sentence):
            tracker.follow(seen, 0.0, scene_unit=scene_unit)
        with pytest.raises(ValueError, match="time_s is nan; it must be a finite number"):
            tracker.follow(seen, np.nan)


def test_without_a_model_in_the_weights_auto_asks_the_network_and_others_say_what_to_do(model: Model) -> None:
    other = replace(untrained(("a", "b")), provenance={"scene": "mine"})
    with pytest.raises(ValueError, match="the weights of a, b carry no statistical model .* or use --method network"):
        statistical_model_of(other)
    assert registrar_for(replace(model, statistical_model=None), "auto") is None
    assert registrar_for(model, "network") is None and registrar_for(model, "auto") is not None


SEED = 1_000_021


@pytest.fixture(scope="module")
def engine() -> Model:
    return load_model("engine")


@pytest.fixture(scope="module")
def engine_view() -> View:
    return sample_view(load_scene("engine").for_seed(SEED), GenerateConfig(), example_rng(SEED, 0))


def test_a_registration_is_as_far_off_as_its_points_are(engine: Model, engine_view: View) -> None:
    statistical = engine.statistical_model
    truth = true_material(engine_view, statistical)
    cloud = engine_view.depth.to_points()
    found = search_modes(CloudToFit(cloud.points, scene_unit=1.0), statistical).registration
    shown = seen_points(truth, cloud, 1.0)
    exact = RegistrationErrors.of(replace(found, material=truth), truth, shown, 1.0)
    assert exact.distances.max() == 0.0 and len(exact.distances) == len(truth) and 0 < exact.seen.sum() < len(truth)
    shifted = RegistrationErrors.of(replace(found, material=truth + np.array([0.0, 3.0, 0.0])), truth, shown, 1.0)
    parts = shifted.summary(unit_mm=2.0)
    for part in ("seen", "hidden"):
        assert parts[part] == pytest.approx({"median": 3.0, "p95": 3.0, "median_mm": 6.0, "p95_mm": 6.0})
    # the same in another unit of length
    large_shown = seen_points(5 * truth, PointCloud(5 * cloud.points), 5.0)
    moved = replace(found, material=5 * truth + np.array([0.0, 15.0, 0.0]))
    large = RegistrationErrors.of(moved, 5 * truth, large_shown, 5.0)
    assert_allclose(large.distances, shifted.distances)


@pytest.mark.slow
def test_an_evaluation_compares_the_answer_with_the_network_alone(engine: Model, tmp_path: Path) -> None:
    found = evaluate(engine, EvaluationConfig("engine", 2, SEED, cells=24))
    values = metrics(found, {})
    assert sum(values["chosen"].values()) == pytest.approx(1.0)
    assert values["miou"] > values["network"]["miou"] and values["seconds"] > 0
    assert 0 <= values["registration_error"]["hidden"]["median"] <= values["registration_error"]["hidden"]["p95"]
    seen = values["registration_error"]["seen"]
    assert seen["median_mm"] == pytest.approx(10.0 * seen["median"])  # a unit of the engine is a centimetre
    write_json(tmp_path / "metrics.json", values)
    assert read_json(tmp_path / "metrics.json")["chosen"] == values["chosen"]
    assert "| network alone, " in markdown_table(found)
    off = evaluate(engine, EvaluationConfig("engine", 2, SEED, cells=24, method="network"))
    assert (off.scores.iou, off.scores.miou) == (values["network"]["iou"], values["network"]["miou"])
    assert "alone" not in markdown_table(off) and metrics(off, {})["registration_error"] is None
    assert found.known == (True, True) and off.known == ()


def test_frames_are_counted_by_whether_they_are_said_to_show_the_object() -> None:
    scores = Scores(0.9, 0.8, np.array([0.8]))
    one = Evaluation(("a",), np.array([[9, 1], [1, 9]]), {str(number): scores for number in range(4)})
    assert metrics(one, {})["known"] is None and "Said to show" not in markdown_table(one)
    said = replace(one, known=(True, "unsure", True, False))
    assert metrics(said, {})["known"] == {"true": 0.5, "unsure": 0.25, "false": 0.25}
    assert "Said to show the object: 50.0%; unsure 25.0%, not 25.0%." in markdown_table(said)
