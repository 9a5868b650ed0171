"""Fit a scene's own draws to a frame: Gauss and Newton's method on states that the scene really has.

Around a state the scene is linear in its draws (``draws.problem``); it is played with the draws that fit best there,
and so on, from several starts.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import igl
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from mereo.deformation.moving_least_squares import spread
from mereo.fitting.draws.playback import Drawn, shares_of
from mereo.fitting.draws.problem import (
    DrawsFit,
    DrawsProblem,
    Shape,
    StateOnShape,
    approach,
    derivatives,
    lay_on_shape,
    misfit,
    normal_equations,
    secant,
    simulate,
    try_material,
)
from mereo.fitting.modes import refine, robust_poses
from mereo.fitting.problem.gauss_newton import POSE, Posed
from mereo.fitting.problem.residuals import robust_square
from mereo.fitting.problem.segments import Symmetry, branches, find_symmetries
from mereo.scenes.draw_recorder import SMOOTH, Call, OutOfDraws, Recorder
from mereo.scenes.parameters import play, played_back
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

GAIN = 0.003
"""Relative gain of a step below which nothing more is tried."""


def fit_draws(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """Fit the draws from several starts, and improve the best; None where the scene plays none of them back."""
    fits: list[DrawsFit] = []
    for start in (fit_near_modes, *(fit_from_end,) * problem.config.passes, fit_like_network):
        fits += start(problem, modes, fits)
    best = min(fits, key=by_misfit, default=None)
    for improve in (try_symmetric_states, try_jumps, refine_by_sight):
        best = None if best is None else improve(problem, best)
    return best


def refine_by_sight(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """Refine a state by what the lines of sight meet, with every observed point.

    Nearest points lead there from afar, and noise takes them a little beside it; over more points it averages out. The
    fit has the observed samples of all other states, but its misfit by every point: those it was fitted to.
    """
    sighted = replace(problem, by_sight=True)
    dense = replace(sighted, base=problem.last)
    start = simulate(dense, fit.drawn, fit.z, fit.posed)
    if start is None:
        return fit
    fit = descend(dense, start, problem.config.last_rounds)
    if dense.base is sighted.base:
        return fit
    end = simulate(sighted, fit.drawn, fit.z, fit.posed)
    assert end is not None  # it was played before
    return replace(end, motion=fit.motion, misfit=fit.misfit)


def fit_near_modes(
    problem: DrawsProblem, modes: Posed, fits: list[DrawsFit], others: Sequence[Drawn] = ()
) -> list[DrawsFit]:
    """Fit from states like a fit of the modes, and from ``others``."""
    guess = problem.states.guess(modes.z, problem.model.motion)
    return fit_from_shape(problem, modes, shape_of(problem, problem.model.material(modes.z)), [guess, *others])


def fit_from_end(problem: DrawsProblem, modes: Posed, fits: list[DrawsFit]) -> list[DrawsFit]:
    """Fit from the modes' fit to where the draws ended, if far off: it may lie in another basin than their first."""
    if not fits or explains_cloud(problem, fits, problem.config.hopeless):
        return []
    best = min(fits, key=by_misfit)
    pose, z = problem.model.project(best.placed())
    scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
    modes = refine(problem.base, Posed(pose[:3, :3] / scale, pose[:3, 3], z, float(np.log(scale))))
    return fit_near_modes(problem, modes, fits, [replace(best.drawn, z=best.z)])


def fit_like_network(problem: DrawsProblem, modes: Posed, fits: list[DrawsFit]) -> list[DrawsFit]:
    """Fit from states like the network's shape, if the cloud is not explained; a search has no correspondences."""
    config, matches = problem.config, problem.correspondences
    if not config.network_start or not len(matches.points) or explains_cloud(problem, fits, config.explained):
        return []
    camera = Posed(np.eye(3), np.zeros(3), np.empty(0), modes.log_scale)
    points, sigma = matches.points * np.exp(-modes.log_scale), problem.base.network_sigma
    shape = Shape.of(points, sigma, matches.confidence, problem.following_played)
    return fit_from_shape(problem, camera, shape, [])


def explains_cloud(problem: DrawsProblem, fits: list[DrawsFit], most: float) -> bool:
    """Whether one of the states explains the cloud: ``Problem.explained``."""
    sigma = problem.base.config.cloud_sigma
    misfits = [float(robust_square(fit.distance, sigma).mean()) for fit in fits]
    if not misfits:
        return False
    best = fits[int(np.argmin(misfits))]
    return problem.base.explained(min(misfits), best.surface, most)


def shape_of(problem: DrawsProblem, material: Float[np.ndarray, "m 3"]) -> Shape:
    """Shape of material points, unposed: dense and smooth."""
    few = problem.states.played.index
    return Shape.of(material[few], 0.04 * problem.model.half, np.ones(len(few)))


def fit_from_shape(problem: DrawsProblem, frame: Posed, shape: Shape, guesses: list[Drawn]) -> list[DrawsFit]:
    """Fit from starts like a shape, which ``frame`` poses in the camera frame; the next ones while that is hopeless."""
    config, states = problem.config, problem.states
    drawn = [states.drawn(seed) for seed in similar_states(problem, shape)] + guesses
    near_shape = [lay_on_shape(states, shape, start, start.z) for start in drawn]
    starts = sorted((start for start in near_shape if start is not None), key=by_misfit)
    batch, fits = config.sieve[0][1], list[DrawsFit]()
    for number in range(config.batches):
        fits += descend_best(problem, frame, shape, starts[number * batch : (number + 1) * batch])
        if explains_cloud(problem, fits, config.hopeless):
            break
    return fits


def descend_best(problem: DrawsProblem, frame: Posed, shape: Shape, starts: list[StateOnShape]) -> list[DrawsFit]:
    """Descend from the best of some starts."""
    config, states = problem.config, problem.states
    for fresh, keep in config.sieve:
        starts = [approach(states, shape, start, fresh) for start in sorted(starts, key=by_misfit)[:keep]]
        starts += find_other_choices(problem, shape, min(starts, key=by_misfit, default=None))
    fits = [(simulate(problem, start.drawn, start.z, pose_on_shape(frame, start)), start.motion) for start in starts]
    best = sorted(((fit, motion) for fit, motion in fits if fit is not None), key=lambda pair: pair[0].misfit)
    return [descend(problem, fit, config.last_rounds, motion) for fit, motion in best[: config.kept]]


def find_other_choices(problem: DrawsProblem, shape: Shape, best: StateOnShape | None) -> list[StateOnShape]:
    """Find states near a shape that ``best`` does not meet, made from that one by other discrete draws."""
    config, states = problem.config, problem.states
    if best is None or best.misfit < 100.0:
        return []
    others = redraw_choices(states.scene, replace(best.drawn, z=best.z), config.choices)
    states_near = [lay_on_shape(states, shape, other, other.z) for other in others]
    # a choice may come out the same again
    new = [near for near in states_near if near is not None and np.abs(near.points - best.points).max() > shape.std]
    return [approach(states, shape, state, 1) for state in sorted(new, key=by_misfit)[:4]]


def by_misfit(state: StateOnShape | DrawsFit) -> float:
    """Misfit, as a key to sort by."""
    return state.misfit


def similar_states(problem: DrawsProblem, shape: Shape) -> list[int]:
    """Seeds of the random states most like a shape."""
    states = problem.states
    some = spread(shape.points, 150)
    library, goal = states.material[:, states.played.index], shape.points[some].astype(np.float32)
    if shape.follow is None:
        compared = library[:, some]
    else:
        compared = np.stack([shape.follow[some] @ played for played in library])
    cost = robust_poses(compared, goal, shape.weight[some].astype(np.float32), problem.base.network_sigma)[0]
    return [states.seeds[row] for row in np.argsort(cost)[: problem.config.starts]]


def try_symmetric_states(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """Try states with segments turned that look alike turned, as a forearm by half a turn; return the best.

    Only where the shape, stiffly turned, explains the frame nearly as well.
    """
    config = problem.config
    few = replace(problem, config=replace(config, sieve=((1, 4), (1, 1)), kept=1, batches=1))
    for together in symmetric_groups(problem.model):
        material = turn_segments(problem.model, fit.material, together)
        stiff = try_material(problem, fit.drawn, fit.z, fit.posed, material)
        if stiff is not None and stiff.misfit < fit.misfit + config.turned_worse:
            fit = min([fit, *fit_from_shape(few, fit.posed, shape_of(problem, material), [])], key=by_misfit)
    return fit


def pose_on_shape(frame: Posed, state: StateOnShape) -> Posed:
    """Pose in the camera frame of a state that lies on a shape whose own pose there is ``frame``."""
    translation = frame.place(state.translation[None])[0]
    return Posed(frame.rotation @ state.rotation, translation, np.empty(0), frame.log_scale)


def try_jumps(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """Try single draws anywhere in their range, as a wheel by half a turn, while the cloud is not explained."""
    config = problem.config
    sigma = first_sigma(problem)
    for _ in range(config.jumps):
        if explains_cloud(problem, [fit], config.explained):
            break
        each = [find_jumps(problem, fit, int(number), sigma) for number in draws_that_may_jump(problem, fit)]
        best_first = sorted((jump for jumps in each for jump in jumps), key=lambda jump: jump[0])
        fits = [descend(problem, other, config.first_rounds) for _, other in best_first[: config.kept + 1]]
        best = min(fits, key=by_misfit, default=fit)
        if best.misfit >= fit.misfit:
            break
        fit = descend(problem, best, config.first_rounds)
    return fit


def find_jumps(problem: DrawsProblem, fit: DrawsFit, number: int, sigma: float) -> list[tuple[float, DrawsFit]]:
    """Simulate one draw at other positions of its range: all, or the best where draws are many, with misfits."""
    config, candidates = problem.config, list[tuple[float, DrawsFit]]()
    for turn in range(1, config.jump_steps):
        z = fit.z.copy()
        z[number] = ndtri(np.clip((ndtr(z[number]) + turn / config.jump_steps) % 1.0, 1e-4, 1 - 1e-4))
        other = simulate(problem, fit.drawn, z, fit.posed)
        if other is not None:
            candidates.append((misfit(problem, other, sigma), other))
    return sorted(candidates, key=lambda candidate: candidate[0])[: config.jumps_kept]


def draws_that_may_jump(problem: DrawsProblem, fit: DrawsFit) -> Int[np.ndarray, " n"]:
    """Choose draws that may jump: of many, those that move a part along its own surface, as a ring on its post.

    Only then a state far away may look nearly the same, so that no small step leads there.
    """
    smooth = np.flatnonzero(fit.drawn.smooth)
    if problem.config.sliding >= 1.0 or fit.motion is None:
        return smooth
    model, index = problem.model, problem.states.played.index
    surface = index < sum(model.vertex_counts)
    motion = fit.motion[surface][:, :, smooth].astype(np.float64)
    normal = igl.per_vertex_normals(fit.material[: sum(model.vertex_counts)], model.faces)[index[surface]]
    moved, off = (motion**2).sum(axis=(0, 1)), (np.einsum("ac,acd->ad", normal, motion) ** 2).sum(axis=0)
    farthest = np.sqrt((motion**2).sum(axis=1).max(axis=0, initial=0.0))
    return smooth[(off < problem.config.sliding * moved) & (farthest > 0.03 * model.half)]


# --- descent on simulated states --------------------------------------------------------------------------------------

# DrawsFit -derivatives-> motion of the played points -normal_equations-> a step of pose and draws -played-> DrawsFit


def first_sigma(problem: DrawsProblem) -> float:
    """The cloud's first standard deviation, scene units."""
    return max(0.03 * problem.model.half, problem.base.config.cloud_sigma)


def descend(
    problem: DrawsProblem, fit: DrawsFit, fresh: int, motion: Float32[np.ndarray, "a 3 d"] | None = None
) -> DrawsFit:
    """Descend by Levenberg and Marquardt's method, with ``fresh`` sets of differences after the given one."""
    config, least = problem.config, problem.base.config.cloud_sigma
    index, sigma, damping = problem.states.played.index, first_sigma(problem), 0.03
    for number in range(fresh + (motion is not None)):
        if number or motion is None:
            motion = derivatives(problem.states, fit.drawn, fit.z, fit.material[index])
        start = fit.misfit
        for _ in range(config.steps):
            before = misfit(problem, fit, sigma)
            fit, motion, damping = lower(problem, fit, motion, sigma, damping)
            gain = before - misfit(problem, fit, sigma)
            if gain == 0 or (gain < GAIN * before and sigma <= least):
                break
            sigma = max(sigma * 0.6, least)
        if sigma <= least and start - fit.misfit < GAIN * start:
            break
        damping = min(damping, 1.0)
    return replace(fit, motion=motion)


def lower(
    problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float, damping: float
) -> tuple[DrawsFit, Float32[np.ndarray, "a 3 d"], float]:
    """A state of lower misfit, or the same; what was learnt of the motion; the next damping."""
    index, least = problem.states.played.index, misfit(problem, fit, sigma)
    for _ in range(3):
        step = normal_equations(problem, fit, motion, sigma).step(damping)
        tried = simulate(problem, fit.drawn, fit.z + step[POSE:], fit.posed.moved(step[:POSE]))
        if tried is not None:
            motion = secant(motion, step[POSE:], (tried.material - fit.material)[index])
            if misfit(problem, tried, sigma) < least:
                return tried, motion, max(damping / 6.0, 1e-3)
        damping *= 6.0
    return fit, motion, damping


# --- other discrete choices -------------------------------------------------------------------------------------------

# Discrete draws are such as how many corners of a sheet are folded, and which.
#
# Derivatives do not reach across them, and random states hold one combination too seldom to be near everything else.
# So a state that is right but for such a choice keeps all other draws; the choice, and what depends on it, is redrawn.


def redraw_choices(scene: Scene, drawn: Drawn, count: int) -> list[Drawn]:
    """Redraw some of the discrete draws of a state, and what depends on them; fewer than ``count`` where refused.

    Nothing where the scene has no discrete draws. The same state gives the same ones.
    """
    calls = played_back(scene, drawn.seed, shares_of(drawn.z, drawn.sizes)).calls
    discrete = [number for number, call in enumerate(calls) if call.kind not in SMOOTH]
    if not discrete:
        return []
    rng = np.random.default_rng(drawn.seed)
    redrawn = [_redraw(scene, calls, _some(discrete, rng), int(rng.integers(2**31))) for _ in range(count)]
    return [drawn for drawn in redrawn if drawn is not None]


def _some(numbers: Sequence[int], rng: np.random.Generator) -> set[int]:
    """At least one of them, each with probability one half or more."""
    taken = rng.random(len(numbers)) < 0.5
    taken[rng.integers(len(numbers))] = True
    return {number for number, take in zip(numbers, taken, strict=True) if take}


def _redraw(scene: Scene, calls: Sequence[Call], left_out: set[int], seed: int) -> Drawn | None:
    given = {call.key: call.shares for number, call in enumerate(calls) if number not in left_out}
    # a scene that asks for more calls than these has thrown its first attempt away
    recorder = Recorder(seed, given, len(calls) + 12)
    try:
        play(scene, recorder)
    except (OutOfDraws, ValueError):
        return None
    return Drawn.recorded(recorder.calls, seed)


# --- segments turned by their symmetries ------------------------------------------------------------------------------

# An arm looks the same with the forearm half a turn round, the wrist bent the other way and the hand turned back. No
# small step leads there, and no jump of one draw: several change at once. But the shape is known, so that the draws can
# be drawn towards it as towards that of the modes. Lengths are scene units.
#
# Notation: m material points.

Twins = tuple[tuple[Symmetry, float], ...]
"""Segments that hang on each other, and the angle by which each is turned."""


@lru_cache(maxsize=8)
def symmetric_groups(model: StatisticalModel) -> tuple[Twins, ...]:
    """Groups of two segments or more that hang on each other and each look alike in exactly one other turn.

    A segment that spins, or looks alike in many turns, is left to single draws, which slide along its surface.
    """
    single = {
        turn.label - 1: (turn, angle) for turn, angle in map(_only_angle, find_symmetries(model)) if angle is not None
    }
    if len(single) < 2:
        return ()
    touch = np.zeros((len(model.anchors),) * 2, dtype=bool)
    for a, b, _ in branches(model):
        touch[a, b] = a in single and b in single
    count, group = connected_components(touch, directed=False)
    members = [
        [single[label] for label in np.flatnonzero(group == number).tolist() if label in single]
        for number in range(count)
    ]
    return tuple(tuple(some) for some in members if len(some) > 1)


def _only_angle(turn: Symmetry) -> tuple[Symmetry, float | None]:
    """The middle of a turn's angles, which are 10 degrees apart, where these are one run of two or three; else None."""
    middle = float(turn.angles.mean())
    return turn, middle if np.abs(turn.angles - middle).max() <= np.deg2rad(15.0) else None


def turn_segments(
    model: StatisticalModel, material: Float[np.ndarray, "m 3"], together: Twins
) -> Float[np.ndarray, "m 3"]:
    """Material points of a state with some segments turned, each stiffly about its own axis."""
    moved = material.copy()
    for turn, angle in together:
        rows, center, axis = turn.posed(model, material)
        moved[rows] = Rotation.from_rotvec(angle * axis).apply(material[rows] - center) + center
    return moved
