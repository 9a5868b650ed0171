"""Segments that look alike turned, turned together: the shape is a state's, and its draws are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_cases import IN_FRONT, said, seen
from scipy.special import ndtr, ndtri
from shapes import box

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Compose, Deformation, Identity, Rigid
from mereo.fitting.draws.fit import (
    DrawsFit,
    DrawsProblem,
    descend,
    lower,
    refine_by_sight,
    simulate,
    symmetric_groups,
    try_symmetric_states,
    turn_segments,
)
from mereo.fitting.draws.playback import Drawn, DrawnStates, material_moved
from mereo.fitting.problem.evidence import OBSERVED_SAMPLES
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.registration.register import CloudToFit, ModesFit
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.scenes.random_states import scene_model
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.statistical_model import StatisticalModel

X, Y, WRIST = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([6.0, 0.0, 0.0])
POSE = Posed(IN_FRONT[:3, :3], IN_FRONT[:3, 3], np.empty(0))


def arm(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """A forearm that rolls, a wrist that bends, a hand that spins: half a roll, bent back, half a spin is the same."""
    roll, pitch, spin = (named(rng, name).uniform(-1, 1) for name in ("roll", "pitch", "spin"))
    rolled = Rigid(np.pi * roll * X, np.zeros(3), WRIST)
    bent, spun = Rigid(1.2 * pitch * Y, np.zeros(3), WRIST), Rigid(np.pi * spin * X, np.zeros(3), WRIST)
    return Identity(), rolled, Compose((bent, rolled)), Compose((spun, bent, rolled))


@cache
def scene() -> Scene:
    """Base and hand are lopsided, forearm and wrist look alike turned by half about x."""
    base, hand = box((-16, -6, -5), (-8, 5, 7), "base", 0), box((10, -4, -2), (17, 4, 3), "hand", 3)
    lopsided = [
        replace(part, vertices=part.vertices * np.where((part.vertices[:, 1:] > 0).all(axis=1), 1.4, 1.0)[:, None])
        for part in (base, hand)
    ]
    forearm, wrist = box((-7, -3, -1.5), (4, 3, 1.5), "forearm", 1), box((5, -2.5, -1), (9, 2.5, 1), "wrist", 2)
    return Scene("arm", SegmentedMesh((lopsided[0], forearm, wrist, lopsided[1])), arm, Workspace())


@cache
def model() -> StatisticalModel:
    return scene_model(scene(), count=200)


@cache
def states() -> DrawnStates:
    return DrawnStates.of(scene(), model(), 80, 1000)


def flipped(z: np.ndarray) -> np.ndarray:
    """Draws of the state that looks alike: roll and spin half a turn on, the pitch reversed."""
    roll, pitch, spin = ndtr(z)
    return ndtri(np.array([(roll + 0.5) % 1.0, 1.0 - pitch, (spin + 0.5) % 1.0]))


def moved(z: np.ndarray) -> np.ndarray:
    drawn = Drawn.of(scene(), 1000)
    deformations = drawn.deformations(scene(), z)
    assert deformations is not None
    return material_moved(scene(), model(), deformations)


def problem_of(z: np.ndarray, points: int = 4000) -> DrawsProblem:
    material = transform_points(IN_FRONT, moved(z))
    cloud = seen(model().mesh(material))
    fitted = ModesFit.of(CloudToFit(cloud[:: max(1, len(cloud) // points)], 1.0), said(model(), material), model())
    return DrawsProblem.of(fitted.problem, states(), fitted.correspondences)


def state(problem: DrawsProblem, z: np.ndarray) -> DrawsFit:
    fit = simulate(problem, Drawn.of(scene(), 1000), z, POSE)
    assert fit is not None
    return fit


TRUTH = np.array([0.3, 0.9, -0.5])


def test_an_arm_has_one_group_of_forearm_and_wrist() -> None:
    (together,) = symmetric_groups(model())
    assert [turn.label for turn, _ in together] == [2, 3]
    assert all(angle == pytest.approx(np.pi) and abs(turn.axis[0]) > 0.999 for turn, angle in together)


def test_the_turned_shape_is_that_of_other_draws() -> None:
    """Exactly, as the segments lie on the axis of the roll; and twice turned is the same."""
    (together,) = symmetric_groups(model())
    there = turn_segments(model(), moved(TRUTH), together)
    assert np.abs(there - moved(TRUTH)).max() > 4.0
    np.testing.assert_allclose(there, moved(flipped(TRUTH)), atol=0.02)
    np.testing.assert_allclose(turn_segments(model(), there, together), moved(TRUTH), atol=1e-6)


def test_a_state_that_is_turned_so_is_found() -> None:
    """What it is told from is the correspondences alone; a right state stays what it is."""
    problem = problem_of(TRUTH)
    right, wrong = state(problem, TRUTH), descend(problem, state(problem, flipped(TRUTH)), 1)
    assert np.abs(wrong.surface.material - right.surface.material).max() > 4.0
    many = replace(problem, config=replace(problem.config, turned_worse=np.inf))
    found = try_symmetric_states(many, wrong)
    assert found.misfit < wrong.misfit
    assert np.abs(found.surface.material - right.surface.material).max() < 0.2
    assert try_symmetric_states(many, found).misfit <= found.misfit
    assert try_symmetric_states(replace(many, config=replace(many.config, turned_worse=-np.inf)), wrong) is wrong


def test_a_step_never_leads_up() -> None:
    problem = problem_of(TRUTH)
    start = state(problem, TRUTH + np.array([0.15, -0.2, 0.2]))
    motion = descend(problem, start, 1).motion
    assert motion is not None
    for damping in (1e-3, 0.1, 10.0):
        assert lower(problem, start, motion, 0.2, damping)[0].misfit <= start.misfit


def test_the_answer_is_fitted_to_every_point_and_judged_by_them() -> None:
    problem = problem_of(TRUTH)
    assert len(problem.base.evidence.points) > OBSERVED_SAMPLES
    dense = problem.base.by_every_point
    assert len(dense.evidence.observed_samples) == len(problem.base.evidence.points) and dense.by_every_point is dense
    found = refine_by_sight(problem, state(problem, TRUTH + 0.02))
    again = simulate(replace(problem, by_sight=True, base=dense), found.drawn, found.z, found.posed)
    assert again is not None and found.misfit == again.misfit and len(found.distance) == OBSERVED_SAMPLES
    assert found.motion is not None
    few = problem_of(TRUTH, points=300)
    assert few.base.by_every_point is few.base
    sparing = replace(problem, config=replace(problem.config, every_point=False))
    assert sparing.last is problem.base and problem.last is not problem.base
