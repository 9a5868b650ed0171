"""Who could have answered a frame: network, modes, draws; which answer is scored, and how far it is off."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.geometry.camera import PointCloud
from mereo.geometry.metrics import Scores
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.atomic_files import write_json
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.scenes.random_states import state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import State
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view
from mereo_learning.cases import Evaluation, RegistrationErrors, seen_points
from mereo_learning.scoring import EvaluationConfig, evaluate
from mereo_learning.tables import markdown_table, metrics

SEED = 1_000_021


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model("engine")


@pytest.fixture(scope="module")
def view() -> View:
    return sample_view(load_scene("engine").for_seed(SEED), GenerateConfig(), example_rng(SEED, 0))


def test_a_registration_is_as_far_off_as_its_points_are(model: Model, view: View) -> None:
    statistical = model.statistical_model
    assert statistical is not None
    state = State(view.mesh.transformed(view.T_world_camera), view.deformations)
    truth = state_points(state, statistical.nodes, statistical.node_labels)
    truth = transform_points(inverse_rigid(view.T_world_camera), truth)
    cloud = view.depth.to_points()
    found = Registrar.of(model, "modes").fit_modes(CloudToFit(cloud.points, scene_unit=1.0)).registration()
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
    np.testing.assert_allclose(large.distances, shifted.distances)


@pytest.mark.slow
def test_an_evaluation_compares_all_who_could_answer(model: Model, tmp_path: Path) -> None:
    found = evaluate(model, EvaluationConfig("engine", 2, SEED, cells=24))
    values = metrics(found, {})
    assert sum(values["chosen"].values()) == pytest.approx(1.0)
    only = {name for name, share in values["chosen"].items() if share == 1.0}
    if only:  # then the scored answer is one of the three
        same = values["network" if only == {"network"} else "modes" if only == {"modes"} else "full"]
        assert (values["iou"], values["miou"]) == (same["iou"], same["miou"])
    assert values["modes"]["miou"] > values["network"]["miou"] and values["full"]["seconds"] > 0
    assert 0 <= values["registration_error"]["hidden"]["median"] <= values["registration_error"]["hidden"]["p95"]
    assert values["registration_error"]["seen"]["median_mm"] is None  # the engine has no true size
    write_json(tmp_path / "metrics.json", values)
    assert json.loads((tmp_path / "metrics.json").read_text())["chosen"] == values["chosen"]
    assert "modes alone" in markdown_table(found)
    off = evaluate(model, EvaluationConfig("engine", 2, SEED, cells=24, method="network"))
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
