"""The registered model as a reconstruction: the rest mesh's own segments, in the input's frame."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained

from mereo import __main__ as command_line
from mereo.evaluation.metrics import confusion_matrix, intersection_over_union
from mereo.evaluation.sample_views import SampleView, load_view
from mereo.fitting.register import register, registered, statistical_model_of
from mereo.fitting.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.scanner_axes import SCANNER_TO_CAMERA
from mereo.geometry.solids import Solids
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene


@pytest.fixture(scope="module")
def model() -> Model:
    return replace(load_model("rope"), statistical_model=scene_model(load_scene("rope"), 300))


@pytest.fixture(scope="module")
def view() -> SampleView:
    return load_view("rope")


@pytest.fixture(scope="module")
def network(model: Model, view: SampleView) -> Reconstruction:
    return reconstruct(view.depth.to_points(), model, resolution=48, label_points=True)


@pytest.fixture(scope="module")
def found(network: Reconstruction, model: Model, view: SampleView) -> Registration:
    return register(network, view.depth.to_points(), model)


def iou(view: SampleView, result: Reconstruction) -> float:
    grid, kept = view.truth.grid, view.truth.kept
    points = grid.positions(np.argwhere(kept))
    labels = Solids(result.surfaces).label(points)
    return intersection_over_union(confusion_matrix(grid.labels[kept], labels, len(grid.names) + 1)).miou


def test_the_answer_is_the_model_itself(
    network: Reconstruction, found: Registration, model: Model, view: SampleView
) -> None:
    answer = registered(network, found, model)
    rest = statistical_model_of(model).rest
    assert found.accepted and answer.surfaces.names == rest.names
    for segment, at_rest in zip(answer.surfaces.segments, rest.segments, strict=True):
        np.testing.assert_array_equal(segment.faces, at_rest.faces)
    assert iou(view, answer) > iou(view, network) + 0.05


def test_labels_are_those_of_the_segments(network: Reconstruction, found: Registration, model: Model) -> None:
    answer = registered(network, found, model)
    grid = answer.labels
    index = np.argwhere(np.ones(grid.labels.shape, dtype=bool))
    agree = Solids(answer.surfaces).label(grid.positions(index)) == grid.labels.reshape(-1)
    assert agree.mean() > 0.999 and not grid.touched_sides().any()
    np.testing.assert_allclose(grid.spacing, network.labels.spacing)
    assert answer.observed is not None and network.observed is not None
    assert answer.observed.labels.min() >= 1 and len(answer.observed.labels) == len(network.observed.labels)


def test_a_scanners_frame_gets_its_answer_in_that_frame(model: Model, view: SampleView) -> None:
    points = view.depth.to_points().points @ SCANNER_TO_CAMERA.T
    network = reconstruct(PointCloud(points), model, resolution=48, frame="scanner")
    answer = registered(network, register(network, points, model), model, "scanner")
    assert np.median(Solids(answer.surfaces).nearest(points).distance) < 0.02 * np.ptp(points, axis=0).max()
    for one in answer.segments:
        inside = answer.labels.positions(np.argwhere(answer.labels.labels == one.label)).mean(axis=0)
        np.testing.assert_allclose(one.centroid, inside, atol=1e-9)


def test_weights_without_states_say_what_to_do() -> None:
    other = replace(untrained(("a", "b")), provenance={"scene": "mine"})
    with pytest.raises(ValueError, match="the weights of a, b carry no statistical model .* or leave out --fit"):
        statistical_model_of(other)


def test_the_command_says_which_answer_it_is(model: Model, view: SampleView, tmp_path: Path) -> None:
    save_model(model, tmp_path / "rope.safetensors")
    np.save(tmp_path / "cloud.npy", view.depth.to_points().points)
    arguments = ["reconstruct", str(tmp_path / "cloud.npy"), "--weights", str(tmp_path / "rope.safetensors")]
    arguments += ["--output", str(tmp_path / "out"), "--resolution", "32", "--fit", "auto"]
    assert command_line.main(arguments) == 0
    facts = json.loads((tmp_path / "out/summary.json").read_text())["registration"]
    assert facts["answer"] == "registration" and facts["method"] == "modes" and facts["explained"] > 0.95


def test_full_needs_a_built_in_scene(network: Reconstruction, model: Model, view: SampleView) -> None:
    with pytest.raises(
        ValueError, match="trained on 'mine', which is no built-in scene; --fit full plays .* --fit modes"
    ):
        register(network, view.depth.to_points(), replace(model, provenance={"scene": "mine"}), "full")
