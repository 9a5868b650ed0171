"""The fit of the object's own model: theorems on frames whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from answers import fit_correspondences
from scipy.spatial.transform import Rotation
from toy_scene import toy_scene

from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.gauss_newton import POSE, Posed, along
from mereo.fitting.registration.recognition import recognize
from mereo.fitting.registration.registration import Registration
from mereo.geometry.transforms import inverse_rigid, rigid, transform_points
from mereo.scenes.random_states import state_points
from mereo.scenes.scene import State
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view

SCENE = toy_scene()
CLEAN = replace(GenerateConfig(), noise_std=0.0)


@pytest.fixture(scope="module")
def model(toy_model: StatisticalModel) -> StatisticalModel:
    return toy_model


def true_material(model: StatisticalModel, view: View) -> np.ndarray:
    """Material points of the state that a view shows, camera frame."""
    state = State(view.mesh.transformed(view.T_world_camera), view.deformations)
    points = state_points(state, model.nodes, model.node_labels)
    return transform_points(inverse_rigid(view.T_world_camera), points)


def told(model: StatisticalModel, view: View, error: float = 0.0) -> Correspondences:
    """What a network might say: 200 material points, wrong by ``error`` units."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(model.labels), 200, replace=False)
    rest = model.rest_points[chosen] + rng.normal(scale=max(error, 1e-12), size=(200, 3))
    observed = np.arange(200) < 100
    return Correspondences(true_material(model, view)[chosen], rest, model.labels[chosen], np.ones(200), observed)


@pytest.fixture(scope="module")
def view() -> View:
    return sample_view(SCENE, CLEAN, example_rng(5, 0))


@pytest.fixture(scope="module")
def registration(model: StatisticalModel, view: View) -> Registration:
    return fit_correspondences(view.depth.to_points().points, told(model, view, 1.0), model, 1.0)


@pytest.mark.parametrize("index", range(4))
def test_a_known_state_is_found(model: StatisticalModel, index: int) -> None:
    view = sample_view(SCENE, CLEAN, example_rng(5, index))
    found = fit_correspondences(view.depth.to_points().points, told(model, view), model, 1.0)
    error = np.linalg.norm(found.material - true_material(model, view), axis=1)
    assert np.median(error) < 0.05
    assert found.accepted and found.explained > 0.99 and found.beyond_states < 0.05


def test_the_fit_turns_with_the_frame(model: StatisticalModel, view: View, registration: Registration) -> None:
    """Everything is turned about the camera: so is the answer."""
    T = rigid(Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.zeros(3))
    found = told(model, view, 1.0)
    turned = replace(found, points=transform_points(T, found.points))
    again = fit_correspondences(transform_points(T, view.depth.to_points().points), turned, model, 1.0)
    np.testing.assert_allclose(again.material, registration.moved(T).material, atol=0.05)


@pytest.mark.parametrize("known", [True, False])
def test_the_unit_changes_nothing(model: StatisticalModel, view: View, registration: Registration, known: bool) -> None:
    unit = 0.006
    points, found = view.depth.to_points().points, told(model, view, 1.0)
    scaled = fit_correspondences(points * unit, found.scaled(unit), model, unit if known else None)
    assert scaled.scene_unit == pytest.approx(unit, rel=0.01)
    free = registration if known else fit_correspondences(points, found, model)
    np.testing.assert_allclose(scaled.material / unit, free.material, atol=0.05)


def test_what_the_frame_rules_out_is_told(model: StatisticalModel, view: View, registration: Registration) -> None:
    """Nothing of a right fit; half of a cloud leaves the model's other half where nothing of it was seen."""
    assert registration.ruled_out == 0.0 and recognize(registration).known is True
    points = view.depth.to_points().points
    half = fit_correspondences(points[points[:, 0] < np.median(points[:, 0])], told(model, view), model, 1.0)
    assert half.ruled_out is not None and half.ruled_out > 0.1
    said = recognize(half)
    assert said.known is not True and said.reason is not None
    assert "lies where the frame shows none of it" in said.reason


def test_to_rest_undoes_to_camera(registration: Registration) -> None:
    points = np.random.default_rng(0).uniform([-17, -5, -4], [17, 5, 4], size=(200, 3))
    labels = registration.rest_solids.label(points)
    points, labels = points[labels > 0], labels[labels > 0]
    moved = registration.to_camera(points)
    np.testing.assert_allclose(registration.to_rest(moved, labels), points, atol=1e-3)


def test_queries_agree_with_the_mesh(registration: Registration) -> None:
    low, high = registration.mesh.bounds
    points = np.random.default_rng(0).uniform(low, high, size=(500, 3))
    found = registration.query(points)
    np.testing.assert_array_equal(found.label, registration.solids.label(points))
    np.testing.assert_array_equal(found.distance < 0, found.label > 0)
    registration.mesh.check()


def test_derivatives_are_those_of_differences(model: StatisticalModel) -> None:
    rng = np.random.default_rng(0)
    posed = Posed(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 10, rng.normal(size=model.count), 0.1)
    chosen = rng.choice(len(model.labels), 10)
    direction = rng.normal(size=(10, 3))
    here = posed.place(model.material(posed.z))[chosen]
    found = along(posed, here, model.modes[chosen].astype(np.float64), direction)
    for number in range(POSE + model.count):
        step = np.zeros(POSE + model.count)
        step[number] = 1e-2
        there, back = posed.moved(step), posed.moved(-step)
        moved = there.place(model.material(there.z))[chosen] - back.place(model.material(back.z))[chosen]
        np.testing.assert_allclose(found[:, number], (moved * direction).sum(axis=1) / 2e-2, rtol=2e-3, atol=2e-2)


def test_vertices_in_front_or_beside_are_pushed_back(view: View) -> None:
    points = view.depth.to_points().points
    evidence = Evidence.of(points)
    middle = points[np.argmin(np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=1))]
    direction, amount = evidence.violations(np.stack([middle * 0.9, middle + np.array([60.0, 0.0, 0.0])]), 0.5)
    assert (amount > 1).all()
    assert direction[0] @ middle > 0 and direction[1, 0] < 0


# --- draws ------------------------------------------------------------------------------------------------------------


def test_draws_find_a_state_of_the_scene(model: StatisticalModel) -> None:
    view = sample_view(SCENE, CLEAN, example_rng(5, 1))
    states = DrawnStates.of(SCENE, model, 100, 1000)
    found = fit_correspondences(view.depth.to_points().points, told(model, view, 0.5), model, 1.0, states)
    assert found.method == "draws"
    error = np.linalg.norm(found.material - true_material(model, view), axis=1)
    assert np.median(error) < 0.05
