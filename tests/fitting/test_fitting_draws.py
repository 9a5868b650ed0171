"""The fit of a scene's own draws: what is played, its derivatives, and the approach to a shape."""

from dataclasses import replace

import numpy as np
import pytest
from fit_cases import said, shown
from toy_scene import toy_scene

from mereo.fitting.draws.fit import DrawsProblem, Shape, approach, derivatives, fit_draws, lay_on_shape, secant
from mereo.fitting.draws.fit import narrowing as draws_narrowing
from mereo.fitting.draws.playback import Drawn, DrawnStates, material_moved
from mereo.fitting.modes import narrowing as modes_narrowing
from mereo.fitting.problem.correspondences import nothing
from mereo.fitting.problem.residuals import NetworkTerm
from mereo.fitting.registration.register import CloudToFit, ModesFit, is_drawn
from mereo.scenes.statistical_model import StatisticalModel

SCENE = toy_scene()


@pytest.fixture(scope="module")
def model(toy_model: StatisticalModel) -> StatisticalModel:
    return toy_model


@pytest.fixture(scope="module")
def states(model: StatisticalModel) -> DrawnStates:
    return DrawnStates.of(SCENE, model, 30, 1000)


def test_all_points_follow_the_played_ones(model: StatisticalModel, states: DrawnStates) -> None:
    drawn = Drawn.of(SCENE, 1004)
    deformations = drawn.deformations(SCENE, drawn.z)
    assert deformations is not None
    followed = states.played.spread @ states.played.moved(deformations).astype(np.float32)
    error = np.linalg.norm(followed - material_moved(SCENE, model, deformations), axis=1)
    assert np.quantile(error, 0.95) < 0.02 * model.half


def test_derivatives_predict_a_small_step(states: DrawnStates) -> None:
    drawn = Drawn.of(SCENE, 1005)
    here = drawn.deformations(SCENE, drawn.z)
    step = np.where(drawn.smooth, 0.02 * np.cos(np.arange(len(drawn.z))), 0.0)
    there = drawn.deformations(SCENE, drawn.z + step)
    assert here is not None and there is not None
    points = states.played.moved(here)
    moved = states.played.moved(there) - points
    predicted = derivatives(states, drawn, drawn.z, points) @ step
    assert np.abs(predicted - moved).max() < 0.1 * np.abs(moved).max()


def test_a_secant_agrees_with_the_step_and_only_there() -> None:
    rng = np.random.default_rng(0)
    motion, step = rng.normal(size=(5, 3, 4)).astype(np.float32), rng.normal(size=4)
    moved, across = rng.normal(size=(5, 3)), np.array([step[1], -step[0], 0.0, 0.0])
    found = secant(motion, step, moved)
    np.testing.assert_allclose(found @ step, moved, atol=1e-5)
    np.testing.assert_allclose(found @ across, motion @ across, atol=1e-5)


def test_the_approach_reaches_a_state_of_the_scene(model: StatisticalModel, states: DrawnStates) -> None:
    """From another state, to the shape of one whose draws are known, in any pose."""
    points = states.material[7][states.played.index].astype(np.float64) @ np.diag([-1.0, -1.0, 1.0]) + 5.0
    shape = Shape.of(points, 0.04 * model.half, np.ones(len(points)))
    drawn = Drawn.of(SCENE, states.seeds[3])
    start = lay_on_shape(states, shape, drawn, drawn.z)
    assert start is not None
    found = approach(states, shape, start, 3)
    apart = [np.linalg.norm(n.points @ n.rotation.T + n.translation - points, axis=1) for n in (start, found)]
    assert found.misfit < start.misfit
    assert np.median(apart[1]) < 0.3 * np.median(apart[0])


def test_the_simpler_description_is_preferred_by_its_evidence(model: StatisticalModel, states: DrawnStates) -> None:
    """Draws are taken where their misfit is lower, or higher by less than what the modes' more free numbers buy."""
    points, material = shown(model, 0.5)
    fitted = ModesFit.of(CloudToFit(points, 1.0), said(model, material), model)
    problem = DrawsProblem.of(fitted.problem, states, fitted.correspondences)
    drawn = fit_draws(problem, fitted.posed)
    assert drawn is not None
    modes = problem.last.misfit(fitted.posed).total
    bought = modes_narrowing(problem.base, fitted.posed) - draws_narrowing(problem, drawn)
    assert bought > 1.0
    for gain, taken in ((-5.0, True), (0.9 * bought, True), (1.1 * bought, False)):
        assert is_drawn(problem, replace(drawn, misfit=modes + gain), fitted.posed) == taken


def test_draws_that_move_nothing_narrow_nothing(model: StatisticalModel, states: DrawnStates) -> None:
    points, material = shown(model, 0.5)
    fitted = ModesFit.of(CloudToFit(points, 1.0), said(model, material), model)
    problem = DrawsProblem.of(fitted.problem, states, fitted.correspondences)
    drawn = fit_draws(problem, fitted.posed)
    assert drawn is not None and drawn.motion is not None
    one_moves, none_moves = drawn.motion.copy(), np.zeros_like(drawn.motion)
    one_moves[:, :, 1:] = 0.0
    narrowed = [draws_narrowing(problem, replace(drawn, motion=motion)) for motion in (one_moves, none_moves)]
    assert narrowed[0] > 1.0
    assert narrowed[1] == pytest.approx(0.0, abs=1e-6)


def test_a_second_pass_follows_where_the_first_has_failed(
    model: StatisticalModel, states: DrawnStates, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modes that are wrong and a single step leave the cloud unexplained; a pass from there comes nearer."""
    points, material = shown(model, 0.5)
    fitted = ModesFit.of(CloudToFit(points, 1.0), said(model, material), model)
    problem = DrawsProblem.of(fitted.problem, states, fitted.correspondences)
    wrong = replace(fitted.posed, z=np.full(model.count, 2.0))
    poor = replace(problem.config, starts=1, sieve=((1, 1),), kept=1, last_rounds=0, steps=1, hopeless=0.0)
    poor = replace(poor, jumps=0, network_start=False)
    once, twice = (fit_draws(replace(problem, config=replace(poor, passes=n)), wrong) for n in (0, 1))
    assert once is not None and twice is not None and twice.misfit < 0.9 * once.misfit
    monkeypatch.setattr("mereo.fitting.draws.fit.refine", None)  # not called where the first explains the cloud
    assert fit_draws(replace(problem, config=replace(problem.config, passes=1, hopeless=9.0)), fitted.posed) is not None


def test_after_a_search_nobody_is_asked_about_a_frame_that_is_not_explained(
    model: StatisticalModel, states: DrawnStates
) -> None:
    """A search has no correspondences, and draws are fitted all the same."""
    points, material = shown(model, 0.5)
    fitted = ModesFit.of(CloudToFit(points, 1.0), said(model, material), model)
    base = replace(fitted.problem, network=NetworkTerm.none(model))
    problem = DrawsProblem.of(base, states, nothing())
    strict = replace(problem, config=replace(problem.config, explained=0.0, jumps=0))
    assert strict.config.network_start
    assert fit_draws(strict, fitted.posed) is not None
