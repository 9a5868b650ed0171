"""Segments that look alike turned: found where states make turns, ruled out by what is seen, and turned together."""

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from answers import fit_modes
from fit_cases import IN_FRONT, seen
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from shapes import box

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Compose, Deformation, Identity, Rigid
from mereo.fitting.draws.fit import (
    DrawsFit,
    DrawsProblem,
    refine_by_sight,
    simulate,
)
from mereo.fitting.draws.playback import Drawn, DrawnStates, material_moved
from mereo.fitting.problem.evidence import OBSERVED_SAMPLES
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.segments import ANGLES, find_segment_turns, left_open
from mereo.fitting.uncertainty import Posterior, covariance_factor
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.scenes.random_states import scene_model
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.statistical_model import StatisticalModel


def moves(way: float, spin: float, lean: float) -> tuple[Deformation, ...]:
    """The block is moved along x, the wheel turned about z and leant about x around its middle."""
    turn = Rotation.from_euler("zx", [spin, lean]).as_rotvec()
    return Rigid(np.zeros(3), way * X, np.zeros(3)), Rigid(turn, np.zeros(3), np.array([0.0, 0.0, 8.0]))


def free(rng: Generator) -> tuple[Deformation, ...]:
    """The wheel spins, whatever else."""
    spin, lean, way = (named(rng, name).uniform(-1, 1) for name in ("spin", "lean", "way"))
    return moves(0.5 * way, np.pi * spin, 0.05 * lean)


def coupled(rng: Generator) -> tuple[Deformation, ...]:
    """The wheel spins only as it leans."""
    spin = named(rng, "spin").uniform(-1, 1)
    return moves(0.0, np.pi * spin, 2.5 * spin)


def held(rng: Generator) -> tuple[Deformation, ...]:
    return moves(0.0, 0.0, 0.1 * named(rng, "lean").uniform(-1, 1))


def rest_mesh(sides: int, peg: float) -> SegmentedMesh:
    """A block, and on it a wheel of so many sides; one of its corners is longer by ``peg``."""
    wheel = trimesh.creation.cylinder(radius=6.0, height=5.0, sections=sides).subdivide().subdivide()
    vertices = np.asarray(wheel.vertices)
    corner = np.array([6.0, 0.0])
    near = np.exp(-((norm(vertices[:, :2] - corner, axis=1) / 1.5) ** 2))
    vertices = vertices + peg * near[:, None] * np.array([1.0, 0.0, 0.0]) + np.array([0.0, 0.0, 8.0])
    segment = Segment("wheel", (200, 60, 60), vertices, np.asarray(wheel.faces, dtype=np.int32))
    block = box((-9, -7, -5), (8, 6, 5), "block", 0)
    corners = block.vertices * np.where((block.vertices[:, :2] > 0).all(axis=1), 1.5, 1.0)[:, None]
    return SegmentedMesh((replace(block, vertices=corners), segment))


@cache
def model_of(move: object, sides: int = 36, peg: float = 0.0) -> StatisticalModel:
    scene = Scene("wheel", rest_mesh(sides, peg), move, Workspace())  # type: ignore[arg-type]
    return scene_model(scene, count=80)


def test_a_smooth_wheel_that_spins_may_be_turned_anyhow() -> None:
    (turn,) = find_segment_turns(model_of(free))
    assert turn.label == 2 and len(turn.angles) == len(ANGLES)
    assert abs(turn.axis[2]) > 0.999 and turn.plausible.min() > 0.5


def test_of_a_wheel_of_six_sides_only_sixths_look_alike() -> None:
    (turn,) = find_segment_turns(model_of(free, sides=6))
    degrees = np.rad2deg(turn.angles).round()
    assert np.isin([60, 120, 180, 240, 300], degrees).all() and not np.isin([30, 90, 150, 210, 270, 330], degrees).any()


def test_turns_that_no_state_makes_by_themselves_or_after_which_nothing_is_alike_do_not_count() -> None:
    spinning = model_of(free)
    without_states = spinning.around(spinning.mean, np.zeros((len(spinning.mean), 3, 0), dtype=np.float32))
    for model in (model_of(held), without_states, model_of(free, peg=6.0)):
        assert find_segment_turns(model) == ()
    for turn in find_segment_turns(model_of(coupled)):  # it may stand on its head
        assert abs(turn.axis[2]) < 0.01


def test_what_is_left_open_has_the_second_moments_of_the_turns() -> None:
    """Where nothing of the wheel is seen, every turn counts by how often states make it; the block stays."""
    model = model_of(free, sides=6)
    material = transform_points(IN_FRONT, model.rest_points)
    block = material[model.rest_points[:, 2] < 0.0]
    motion = left_open(model, material, block, 0.2, 1500.0).astype(np.float64)
    (turn,) = find_segment_turns(model)
    weight = np.append(turn.plausible, 1.0)
    squared = np.zeros(len(material))
    wheel = model.labels == 2
    for angle, share in zip(turn.angles, weight / weight.sum(), strict=False):
        moved = Rotation.from_rotvec(angle * turn.axis).apply(model.rest_points[wheel] - turn.center) + turn.center
        squared[wheel] += share * ((moved - model.rest_points[wheel]) ** 2).sum(axis=1)
    assert_allclose((motion**2).sum(axis=(1, 2)), squared, rtol=1e-4, atol=1e-8)


def test_a_peg_that_is_seen_leaves_no_turn_open() -> None:
    model = model_of(free, sides=6, peg=0.6)
    assert len(find_segment_turns(model)) == 1
    material = transform_points(IN_FRONT, model.rest_points)
    wheel = np.flatnonzero(model.labels[: sum(model.vertex_counts)] == 2)
    vertices = material[wheel]
    rest = model.rest_points[wheel]
    on_peg = rest[:, 0] > 6.1
    assert on_peg.sum() > 3
    shown, hidden = (left_open(model, material, vertices[rows], 0.2, 1500.0) for rows in (on_peg, rest[:, 0] < 0.0))
    farthest = [np.sqrt((motion**2).sum(axis=(1, 2))).max() for motion in (shown, hidden)]
    assert farthest[0] < 0.1 and farthest[1] > 2.0


def test_radii_hold_what_is_left_open() -> None:
    model = model_of(free, sides=6)
    material = transform_points(IN_FRONT, model.rest_points)
    turns = left_open(model, material, material[model.rest_points[:, 2] < 0.0], 0.2, 1500.0)
    posed = Posed(IN_FRONT[:3, :3], IN_FRONT[:3, 3], np.zeros(model.count))
    factor = 1e-3 * np.eye(7 + model.count)
    nothing = np.empty((len(material), 3, 0), dtype=np.float32)
    without = Posterior(posed, material, model.modes, factor, 0.0, nothing, nothing)
    alone = without.radii()
    parts = replace(without, open=turns).radii()
    radii = parts.radii()
    assert_allclose(parts.gaussian, alone.gaussian)
    assert not alone.open.any()
    wheel = model.labels == 2
    assert_allclose(radii[~wheel], alone.radii()[~wheel])
    rim = wheel & (norm(model.rest_points[:, :2], axis=1) > 5.5)
    assert radii[rim].min() > 8.0 and radii[rim].max() < 20.0
    follow = model.weights(model.rest_points[:5], model.labels[:5])
    assert_allclose(replace(without, open=turns).radii(follow).radii(), radii[:5], rtol=0.2)
    assert_allclose(parts.radii(1e-9)[rim], parts.open[rim])  # how far a turn goes no calibration scales
    assert_allclose(parts.radii(2.0) ** 2, 4 * parts.gaussian**2 + parts.open**2)


def test_a_covariance_that_rounding_has_spoilt_is_as_unsure_as_rounding_tells() -> None:
    """Single precision may leave a sum of squares a little below zero, as of a unit that nobody knows."""
    rng = default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    precision = axes @ np.diag([10.0, 5.0, 3.0, 2.0, 1.0, -1e-7]) @ axes.T
    covariance = covariance_factor(precision) @ covariance_factor(precision).T
    assert np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[-1] > 1e4


X, Y, WRIST = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([6.0, 0.0, 0.0])
POSE = Posed(IN_FRONT[:3, :3], IN_FRONT[:3, 3], np.empty(0))


def arm(rng: Generator) -> tuple[Deformation, ...]:
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


def moved(z: ndarray) -> ndarray:
    return material_moved(scene(), model(), Drawn.of(scene(), 1000).deformations(scene(), z))


def problem_of(z: ndarray, points: int = 4000) -> DrawsProblem:
    material = transform_points(IN_FRONT, moved(z))
    cloud = seen(model().mesh(material))
    fitted = fit_modes(cloud[:: max(1, len(cloud) // points)], model(), 1.0, material)
    return DrawsProblem.of(fitted.problem, states())


def state(problem: DrawsProblem, z: ndarray) -> DrawsFit:
    fit = simulate(problem, Drawn.of(scene(), 1000), z, POSE)
    assert fit is not None
    motion = states().derivatives(fit.drawn, fit.z, fit.material[states().played.index])
    return replace(fit, motion=motion)


TRUTH = np.array([0.3, 0.9, -0.5])


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
    assert problem.last is not problem.base
