"""The fit of the object's own model: theorems on frames whose truth is known."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from answers import fit_cloud, fit_modes
from fit_cases import IN_FRONT, SCENE, seen, shown
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mereo.fitting.config import FitConfig
from mereo.fitting.draws.fit import DrawsFit, DrawsProblem, Shape, approach, fit_draws, lay_on_shape, secant, start_near
from mereo.fitting.draws.fit import narrowing as narrowing_of_draws
from mereo.fitting.draws.playback import Drawn, DrawnStates
from mereo.fitting.modes import fit_from_far, narrowing, total_misfit, turned
from mereo.fitting.problem.evidence import UNDECIDED, Evidence
from mereo.fitting.problem.gauss_newton import POSE, Posed, along
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import Prior, are_near
from mereo.fitting.registration.recognition import recognize
from mereo.fitting.registration.register import ModesFit, is_drawn
from mereo.fitting.registration.registration import Registration
from mereo.fitting.search import Trail
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.scenes.random_states import build_model, interior_nodes, sample_states, state_points
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import View, sample_view
from mereo_learning.scoring import true_material

CLEAN = replace(GenerateConfig(), noise_std=0.0)


@pytest.fixture(scope="module")
def view() -> View:
    return sample_view(SCENE, CLEAN, example_rng(5, 0))


@pytest.fixture(scope="module")
def registration(model: StatisticalModel, view: View) -> Registration:
    return fit_cloud(view.depth.to_points().points, model, true_material(view, model))


@pytest.mark.parametrize(("index", "method"), [*((index, "modes") for index in range(4)), (1, "draws")])
def test_a_known_state_is_found(model: StatisticalModel, index: int, method: str) -> None:
    view = sample_view(SCENE, CLEAN, example_rng(5, index))
    fitted = fit_modes(view.depth.to_points().points, model, 1.0, true_material(view, model))
    found = fitted.registration
    if method == "draws":
        found = fitted.with_draws(DrawnStates.of(SCENE, model, 100, 1000))
    assert found.method == method
    assert np.median(norm(found.material - true_material(view, model), axis=1)) < 0.05
    assert found.accepted and found.explained > 0.99 and found.beyond_states < 0.05


def test_what_the_frame_rules_out_is_told(model: StatisticalModel, view: View, registration: Registration) -> None:
    assert registration.ruled_out == 0.0 and recognize(registration).known is True
    points = view.depth.to_points().points
    left = points[points[:, 0] < np.median(points[:, 0])]
    past = replace(UNDECIDED, other_lines="past")
    half = fit_modes(left, model, 1.0, true_material(view, model), past).registration
    assert half.ruled_out is not None and half.ruled_out > 0.1
    said = recognize(half)
    assert said.known is not True and said.reason is not None
    assert "lies where the frame shows none of it" in said.reason


def test_to_rest_undoes_to_camera(registration: Registration) -> None:
    points = default_rng(0).uniform([-17, -5, -4], [17, 5, 4], size=(200, 3))
    labels = registration.rest_solids.label(points)
    points = points[labels > 0]
    labels = labels[labels > 0]
    moved = registration.to_camera(points)
    assert_allclose(registration.to_rest(moved, labels), points, atol=1e-3)


def test_queries_agree_with_the_mesh(registration: Registration) -> None:
    low, high = registration.mesh.bounds
    points = default_rng(0).uniform(low, high, size=(500, 3))
    found = registration.query(points)
    assert_array_equal(found.label, registration.solids.label(points))
    assert_array_equal(found.distance < 0, found.label > 0)
    registration.mesh.check()


def test_derivatives_are_those_of_differences(model: StatisticalModel) -> None:
    rng = default_rng(0)
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
        assert_allclose(found[:, number], (moved * direction).sum(axis=1) / 2e-2, rtol=2e-3, atol=2e-2)


@pytest.mark.parametrize(("noise", "unit"), [(0.0, 1.0), (0.1, 1.0), (0.1, 0.004)])
def test_an_object_at_rest_is_found_to_be_at_rest(model: StatisticalModel, noise: float, unit: float) -> None:
    material = transform_points(IN_FRONT, model.rest_points)
    points = seen(model.rest.transformed(IN_FRONT))
    points = points + default_rng(0).normal(scale=noise, size=points.shape)
    found = fit_cloud(unit * points, model, material, unit)
    assert found.method == "rest" and found.accepted and found.optimum.posterior.residue == 0.0
    # a rigid motion of the rest model, and the right one
    apart = [norm(np.diff(places[::50], axis=0), axis=1) for places in (found.material / unit, material)]
    assert_allclose(*apart, atol=1e-6)
    assert norm(found.material / unit - material, axis=1).max() < 0.05 + noise / 2
    assert_allclose(found.z, model.rest_z)


@pytest.mark.parametrize("excess", [0.1, 0.3, 1.0])
def test_a_bent_object_is_not(model: StatisticalModel, excess: float) -> None:
    points, material = shown(model, excess)
    assert fit_cloud(points, model, material).method == "modes"


def test_under_noise_draws_are_asked_too_and_an_object_at_rest_stays_at_rest(model: StatisticalModel) -> None:
    points = seen(model.rest.transformed(IN_FRONT))
    material = transform_points(IN_FRONT, model.rest_points)
    clean = fit_modes(points, model, 1.0, material)
    noisy = replace(clean, problem=clean.problem.with_noise(0.2))
    assert noisy.may_take_draws and not clean.may_take_draws
    found = noisy.with_draws(DrawnStates.of(SCENE, model, 30))
    assert found.method == "rest" and found.seconds > clean.seconds


@pytest.fixture(scope="module")
def states(model: StatisticalModel) -> DrawnStates:
    return DrawnStates.of(SCENE, model, 30, 1000)


@pytest.fixture(scope="module")
def fitted(model: StatisticalModel) -> ModesFit:
    points, material = shown(model, 0.5)
    return fit_modes(points, model, 1.0, material)


@pytest.fixture(scope="module")
def problem(fitted: ModesFit, states: DrawnStates) -> DrawsProblem:
    return DrawsProblem.of(fitted.problem, states)


@pytest.fixture(scope="module")
def drawn(problem: DrawsProblem, fitted: ModesFit) -> DrawsFit:
    return fit_draws(problem, fitted.posed)


def test_a_secant_agrees_with_the_step_and_only_there() -> None:
    rng = default_rng(0)
    motion = rng.normal(size=(5, 3, 4)).astype(np.float32)
    step = rng.normal(size=4)
    moved = rng.normal(size=(5, 3))
    across = np.array([step[1], -step[0], 0.0, 0.0])
    found = secant(motion, step, moved)
    assert_allclose(found @ step, moved, atol=1e-5)
    assert_allclose(found @ across, motion @ across, atol=1e-5)


def test_the_approach_reaches_a_state_of_the_scene(model: StatisticalModel, states: DrawnStates) -> None:
    points = states.places[7].astype(np.float64) @ np.diag([-1.0, -1.0, 1.0]) + 5.0
    shape = Shape(points, 0.04 * model.half, 1.0)
    drawn = Drawn.of(SCENE, states.seeds[3])
    start = lay_on_shape(states, shape, drawn, drawn.z)
    near = start
    for _ in range(3):
        near = approach(states, shape, near)
    apart = [norm(n.placed - points, axis=1) for n in (start, near)]
    assert near.misfit < start.misfit
    assert np.median(apart[1]) < 0.3 * np.median(apart[0])


def test_states_approach_a_shape_until_two_are_alike(
    problem: DrawsProblem, fitted: ModesFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = Mock(wraps=approach)
    monkeypatch.setattr("mereo.fitting.draws.fit.approach", count)
    assert start_near(problem, fitted.posed) is not None
    assert 3 <= count.call_count < problem.config.approaching
    monkeypatch.setattr("mereo.fitting.draws.fit.rms_distance", lambda offset: np.full(len(offset), np.inf))
    start_near(problem, fitted.posed)
    assert count.call_count > problem.config.approaching, "of none alike each approaches it"


def test_the_simpler_description_is_preferred_by_its_evidence(
    problem: DrawsProblem, fitted: ModesFit, drawn: DrawsFit
) -> None:
    """Draws are taken where their misfit is lower, or higher by less than what the modes' more free numbers buy."""
    modes = problem.last.misfit(fitted.posed).total
    for motion in (drawn.motion, np.zeros_like(drawn.motion)):  # what is moved by nothing is not narrowed
        described = replace(drawn, motion=motion)
        bought = max(narrowing(problem.base, fitted.posed) - narrowing_of_draws(problem, described), 0.0)
        for gain, taken in ((-5.0, True), (bought - 0.1, True), (bought + 0.1, False)):
            assert is_drawn(problem, replace(described, misfit=modes + gain), fitted.posed) == taken
    assert bought > 1.0


def test_a_frame_that_says_nothing_narrows_no_state_whatever_distances_are_kept(fitted: ModesFit) -> None:
    problem = fitted.problem
    shown = narrowing(fitted.problem, fitted.posed)
    silent = problem.changed(config=replace(problem.config, cloud_weight=0.0, silhouette_weight=0.0))
    assert shown > 10.0 and len(problem.model.pairs) > 0
    assert narrowing(silent, fitted.posed) == pytest.approx(0.0, abs=1e-6)


def test_modes_reproduce_states_they_were_not_built_from(model: StatisticalModel) -> None:
    for index in range(5):
        state = state_points(SCENE.sample_state(example_rng(7, index)), model.nodes, model.node_labels)
        T, z = model.project(state)
        found = model.material(z) @ T[:3, :3].T + T[:3, 3]
        assert norm(found - state, axis=1).max() < 0.15
        assert np.abs(z).max() < 5
    assert 0 < model.residue < 0.01 * model.half  # that of held-out states


def test_a_model_needs_two_states_whose_poses_do_not_matter() -> None:
    rng = default_rng(0)
    nodes, labels = interior_nodes(SCENE.rest)
    states = sample_states(SCENE, nodes, labels, 60, 3)
    turned = np.stack([s @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3) * 50 for s in states])
    plain = build_model(SCENE.rest, nodes, labels, states)
    posed = build_model(SCENE.rest, nodes, labels, turned.astype(np.float32))
    assert plain.count == posed.count
    assert_allclose(plain.mean, posed.mean, atol=0.02)
    assert_allclose(plain.motion, posed.motion, rtol=0.02)
    with pytest.raises(ValueError, match="cannot be made of 1 states; it needs 2 or more: record more states"):
        build_model(SCENE.rest, nodes, labels, states[:1])


def test_draws_that_move_nothing_narrow_nothing(problem: DrawsProblem, drawn: DrawsFit) -> None:
    one_moves = drawn.motion.copy()
    none_moves = np.zeros_like(drawn.motion)
    one_moves[:, :, 1:] = 0.0
    narrowed = [narrowing_of_draws(problem, replace(drawn, motion=motion)) for motion in (one_moves, none_moves)]
    assert narrowed[0] > 1.0
    assert narrowed[1] == pytest.approx(0.0, abs=1e-6)


# --- fits in a wrong optimum ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def robot() -> StatisticalModel:
    """Model of a robot, whose joints make many optima."""
    return load_model("robot").statistical_model


def test_a_fit_with_another_side_of_the_object_there_is_turned_back(rope: Model) -> None:
    model = rope.statistical_model
    z = model.library[2].astype(float)
    right = Posed(np.eye(3), np.array([12.0, -7.0, 150.0]) - model.material(z).mean(axis=0), z)
    points = seen(model.mesh(right.place(model.material(z))))
    problem = Problem(model, Evidence.of(points), KNOWN_SCALE_STD, FitConfig())
    wrong = max((fit_from_far(problem, posed) for posed in turned(problem, right)), key=total_misfit)
    trail = Trail(problem, fitted=[wrong])
    trail.turn()
    assert total_misfit(trail.best) < 0.2 * total_misfit(wrong)


def test_states_near_one_tell_of_it_where_they_lie_on_a_curved_set_and_not_where_each_is_by_itself(
    robot: StatisticalModel,
) -> None:
    """By states that are left out: a track follows under the prior that tells more of them."""
    assert are_near(robot)
    scattered = default_rng(0).standard_normal(robot.library.shape).astype(np.float32)
    assert not are_near(replace(robot, library=scattered))
    nearest = Prior.near(robot, robot.library[7].astype(np.float64), 0).center
    assert np.abs(Prior.near(robot, robot.library[7].astype(np.float64), 1).center - nearest).max() > 0
