"""Fit a scene's own draws to a frame: Gauss and Newton's method on states that the scene really has.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes, with the same residuals. The scene is played with the draws that fit best there, and so on, from several starts.
"""

from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.sparse import csr_array

from mereo.deformation.moving_least_squares import PointWeights, spread
from mereo.fitting.config import DrawsConfig
from mereo.fitting.draws.playback import (
    Drawn,
    DrawnStates,
    as_sparse,
    material_moved,
    unmoving,
)
from mereo.fitting.modes import robust_poses
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, geman_mcclure, in_space
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import (
    ROBUST,
    Surface,
    Terms,
    add_silhouette,
    cloud_rows,
    robust_square,
    silhouette_losses,
)
from mereo.fitting.problem.segments import rms_distance
from mereo.geometry.mesh import barycentric
from mereo.geometry.transforms import best_rotations
from mereo.scenes.statistical_model import StatisticalModel

# --- a frame, and states compared with it -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DrawsProblem:
    """A frame to be explained by the states of a scene.

    Attributes:
        base: the same frame, explained by modes, with the weights that the draws are fitted by.
        by_sight: whether observed points are compared with what their lines of sight meet, or with the nearest points.
    """

    base: Problem
    states: DrawnStates
    config: DrawsConfig
    by_sight: bool = False

    @property
    def model(self) -> StatisticalModel:
        """Statistical model of the object."""
        return self.base.model

    @property
    def last(self) -> Problem:
        """``base`` with the points of the last descent."""
        return self.base.by_every_point

    @classmethod
    def of(cls, base: Problem, states: DrawnStates, config: DrawsConfig = DrawsConfig()) -> "DrawsProblem":  # noqa: B008 (frozen)
        """Problem with the weights that the draws are fitted by."""
        fit_config = replace(base.config, cloud_weight=config.cloud_weight)
        return cls(replace(base, config=fit_config), states, config)


@dataclass(frozen=True, eq=False)
class DrawsFit:
    """A played state, by its draws, compared with the frame.

    Attributes:
        posed: rigid pose; its ``z`` is empty.
        material: material points, unposed.
        base: frame, ``Problem.cleared`` by the surface.
        distance, face, position: of what each observed sample is compared with.
        misfit: with the prior of the draws, the cloud by its last sigma.
        motion: of the played points for a standard deviation of each draw, where it is known.
    """

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    posed: Posed
    material: Float[np.ndarray, "m 3"]
    surface: Surface
    base: Problem
    distance: Float[np.ndarray, " p"]
    face: Int[np.ndarray, " p"]
    position: Float[np.ndarray, "p 3"]
    misfit: float
    motion: Float32[np.ndarray, "a 3 d"] | None = None


def simulate(problem: DrawsProblem, drawn: Drawn, z: Float[np.ndarray, " d"], posed: Posed) -> DrawsFit | None:
    """Simulate the state of these draws and score it; None where the scene refuses it or no face of it is seen."""
    z = drawn.normalized(z)
    deformations = drawn.deformations(problem.states.scene, z)
    if deformations is None:
        return None
    material = material_moved(problem.states.scene, problem.model, deformations)
    rigid = replace(posed, z=np.empty(0))
    surface = Surface.through(problem.model, rigid.place(material), problem.base.evidence.shows)
    if len(surface.facing) == 0:
        return None
    base = problem.base.cleared(surface)
    met = base.met(surface) if problem.by_sight else base.nearest(surface)
    fit = DrawsFit(drawn, z, rigid, material, surface, base, *met, np.inf)
    return replace(fit, misfit=misfit(problem, fit, problem.base.cloud_sigma))


def misfit(problem: DrawsProblem, fit: DrawsFit, sigma: float) -> float:
    """Misfit as ``Problem.misfit`` counts it, by any sigma of the cloud, without looking for observed samples again."""
    base = fit.base
    cloud = base.config.cloud_weight * float(robust_square(fit.distance, sigma).mean())
    losses = silhouette_losses(fit.surface.material[base.model.silhouette_vertices], base.evidence, sigma)
    outside = base.config.silhouette_weight * float(losses.sum())
    return (
        cloud + base.network_misfit(fit.surface) + outside + float(fit.z @ fit.z) + base.evidence.shared_errors.square
    )


by_misfit = attrgetter("misfit")


def narrowing(problem: DrawsProblem, fit: DrawsFit) -> float:
    """``NormalEquations.narrowing`` of the draws that move something."""
    assert fit.motion is not None
    equations = terms(problem, fit, fit.motion, problem.base.cloud_sigma).total
    return equations.narrowing() - int(unmoving(fit.motion).sum()) * float(np.log(HELD))


def terms(problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float) -> Terms:
    """Terms of the fit of the modes, for changes of pose and draws: the played points' ``motion`` is that of modes."""
    base, posed, config, surface = fit.base, fit.posed, fit.base.config, fit.surface
    samples = base.evidence.observed_samples
    spread = problem.states.played.spread
    count = len(fit.z)
    flat = motion.reshape(len(motion), -1)
    vertices = base.model.silhouette_vertices

    def modes_of(follow: csr_array) -> Float32[np.ndarray, "n 3 d"]:
        return (follow @ flat).reshape(-1, 3, count)

    corners = surface.model.faces[surface.facing[fit.face]]
    within = PointWeights(corners, barycentric(surface.material[corners], fit.position))
    planes = fit.position, surface.normals[fit.face], modes_of(as_sparse(within, spread.shape[0]) @ spread)
    return Terms(
        known=prior_of_draws(fit.z, motion, posed.log_scale, base.scale_std),
        cloud=cloud_rows(posed, samples, planes, sigma, config.cloud_weight, base.evidence.sample_errors, base.alike),
        observed_samples=samples,
        ruled_out=add_silhouette(
            NormalEquations.nothing(POSE + count),
            posed,
            surface.material[vertices],
            lambda rows: modes_of(spread[vertices[rows]]),
            base.evidence,
            sigma,
            config.silhouette_weight,
        ),
    )


HELD = 1e6
"""Precision of draws that move nothing at a state: they stay."""


def prior_of_draws(
    z: Float[np.ndarray, " d"], motion: Float32[np.ndarray, "a 3 d"], log_scale: float, scale_std: float
) -> NormalEquations:
    """Normal equations of draws that are N(0, 1) each; those that move nothing stay where they are."""
    still = unmoving(motion)
    precision = np.diag(np.where(still, HELD, 1.0))
    return NormalEquations.prior(np.where(still, 0.0, z), np.zeros(len(z)), precision, log_scale, scale_std)


def secant(
    motion: Float32[np.ndarray, "a 3 d"], step: Float[np.ndarray, " d"], moved: Float[np.ndarray, "a 3"]
) -> Float32[np.ndarray, "a 3 d"]:
    """Derivatives that agree with what a step has really moved, otherwise changed least (Broyden's rule)."""
    with np.errstate(invalid="ignore"):  # OpenBLAS raises the flag for lanes that it loads beyond a short row
        missed = (moved - motion @ step.astype(np.float32)).astype(np.float32)
    return motion + missed[..., None] * (step / max(float(step @ step), 1e-12)).astype(np.float32)


# --- the state of a given shape ---------------------------------------------------------------------------------------

# Levenberg and Marquardt's method on few points, without looking at the frame. A fit of the modes is dense and smooth,
# so the draws of a state like it are found from far away; one set of differences serves for several steps.

SHAPE_WEIGHT = 500.0
"""How many independent points a shape is worth."""

ENOUGH = 0.02
"""Relative gain of a step below which nothing more is tried."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape to be met: positions of the played points, in any pose, with their standard deviation.

    Attributes:
        weight: inverse variance of a point: together they are worth as many as ``SHAPE_WEIGHT``.
    """

    points: Float[np.ndarray, "a 3"]
    std: float
    weight: float

    @classmethod
    def of_material(cls, problem: DrawsProblem, material: Float[np.ndarray, "m 3"]) -> "Shape":
        """Shape of material points, unposed: dense and smooth."""
        points = material[problem.states.played.index]
        std = 0.04 * problem.model.half
        return cls(points, std, SHAPE_WEIGHT / (len(points) * std**2))


@dataclass(frozen=True, eq=False)
class StateOnShape:
    """A state of a scene, by its draws, compared with a shape.

    Attributes:
        points: its played points.
        rotation, translation: rigid motion onto the shape.
        misfit: how badly it meets the shape, with the prior of the draws.
        motion: as ``DrawsFit.motion``.
    """

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    points: Float[np.ndarray, "a 3"]
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    misfit: float
    motion: Float32[np.ndarray, "a 3 d"] | None = None

    @property
    def placed(self) -> Float[np.ndarray, "a 3"]:
        """The points on the shape."""
        return self.points @ self.rotation.T + self.translation


def lay_on_shape(states: DrawnStates, shape: Shape, drawn: Drawn, z: Float[np.ndarray, " d"]) -> StateOnShape | None:
    """Lay the state of these draws robustly onto the shape; None where the scene refuses it."""
    z = drawn.normalized(z)
    deformations = drawn.deformations(states.scene, z)
    if deformations is None:
        return None
    points = states.played.moved(deformations)
    weight = np.ones(len(points))
    for _ in range(3):
        share = weight / weight.sum()
        center, goal = share @ points, share @ shape.points
        rotation = best_rotations(((points - center) * share[:, None]).T @ (shape.points - goal))
        translation = goal - rotation @ center
        distance = np.linalg.norm(points @ rotation.T + translation - shape.points, axis=1)
        weight = geman_mcclure(distance, ROBUST * max(shape.std, float(np.median(distance))))
    squared = distance**2
    apart = shape.weight * float((squared / (1.0 + squared / (2 * ROBUST * shape.std) ** 2)).sum())
    return StateOnShape(drawn, z, points, rotation, translation, apart + float(z @ z))


def approach(states: DrawnStates, shape: Shape, state: StateOnShape) -> StateOnShape:
    """Approach the shape from a state, by one set of differences."""
    motion = states.derivatives(state.drawn, state.z, state.points)
    damping = 0.1
    for _ in range(6):
        nearer, motion, damping = _step(states, shape, state, motion, damping)
        gain = state.misfit - nearer.misfit
        state = nearer
        if gain < ENOUGH * state.misfit:
            break
    return replace(state, motion=motion)


def _step(
    states: DrawnStates, shape: Shape, state: StateOnShape, motion: Float32[np.ndarray, "a 3 d"], damping: float
) -> tuple[StateOnShape, Float32[np.ndarray, "a 3 d"], float]:
    """Take Levenberg and Marquardt's step of the draws, the pose free; returns as ``lower`` does."""
    posed = Posed(state.rotation, state.translation, np.zeros(len(state.z)))
    points = state.placed
    offset = points - shape.points
    weight = shape.weight * geman_mcclure(np.linalg.norm(offset, axis=1), 2 * ROBUST * shape.std)
    for _ in range(5):
        normal = prior_of_draws(state.z, motion, 0.0, 1e-6)
        jacobian = in_space(posed, points, motion)
        step = normal.add(jacobian, offset.ravel(), np.repeat(weight, 3)).step(damping)[POSE:]
        tried = lay_on_shape(states, shape, state.drawn, state.z + step)
        if tried is not None:
            motion = secant(motion, step, tried.points - state.points)
            if tried.misfit < state.misfit:
                return tried, motion, max(damping / 4.0, 1e-3)
        damping *= 5.0
    return state, motion, damping


# --- the fit ----------------------------------------------------------------------------------------------------------

GAIN = 0.003
"""Relative gain of a step below which nothing more is tried."""


def fit_draws(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """Fit the draws from a state like a fit of the modes; None where the scene plays none of them back."""
    start = start_near(problem, modes)
    return None if start is None else refine_by_sight(problem, descend(problem, start, problem.config.last_rounds))


def start_near(problem: DrawsProblem, modes: Posed) -> DrawsFit | None:
    """State of the scene that is like a fit of the modes, and explains the frame best; None without any.

    The states most like it approach its shape, until two of them are alike; that which explains the frame best, again.
    """
    states = problem.states
    shape = Shape.of_material(problem, problem.model.material(modes.z))
    laid = (lay_on_shape(states, shape, start, start.z) for start in similar_states(problem, shape))
    starts = sorted((state for state in laid if state is not None), key=by_misfit)
    ends = list[StateOnShape]()
    for start in starts[: problem.config.approaching]:
        ends.append(approach(states, shape, start))
        places = np.stack([end.placed for end in ends])
        nearest = places[np.argmin([end.misfit for end in ends])]
        if np.count_nonzero(rms_distance(places - nearest) < shape.std) > 1:
            break
    fits = [(fit, end) for end in ends if (fit := in_frame(problem, modes, end))]
    best = min(fits, key=lambda pair: by_misfit(pair[0]), default=None)
    return best and in_frame(problem, modes, approach(states, shape, best[1]))


def in_frame(problem: DrawsProblem, modes: Posed, state: StateOnShape) -> DrawsFit | None:
    """Compare a state on the shape of the modes with the frame; None where no face of it is seen."""
    translation = modes.place(state.translation[None])[0]
    posed = Posed(modes.rotation @ state.rotation, translation, np.empty(0), modes.log_scale)
    fit = simulate(problem, state.drawn, state.z, posed)
    return fit and replace(fit, motion=state.motion)


def refine_by_sight(problem: DrawsProblem, fit: DrawsFit) -> DrawsFit:
    """Refine a state by what the lines of sight meet, with every observed point, over which noise averages out.

    The fit has the observed samples of all other states, but its misfit by every point: those it was fitted to.
    """
    sighted = replace(problem, by_sight=True)
    dense = replace(sighted, base=problem.last)
    start = simulate(dense, fit.drawn, fit.z, fit.posed)
    if start is None:
        return fit
    fit = descend(dense, replace(start, motion=fit.motion), 1)
    end = simulate(sighted, fit.drawn, fit.z, fit.posed)
    assert end is not None  # it was played before
    return replace(end, motion=fit.motion, misfit=fit.misfit)


def settled(problem: DrawsProblem, fit: DrawsFit) -> tuple[DrawsProblem, DrawsFit]:
    """Fit a noisy frame again with as many independent points as its cloud is worth."""
    if not problem.base.shares_noise:
        return problem, fit
    worth = replace(problem, base=problem.base.worth(fit.surface), by_sight=True)
    start = simulate(worth, fit.drawn, fit.z, fit.posed)
    assert start is not None  # it was played before
    fit = descend(worth, replace(start, motion=fit.motion), 1)
    return replace(worth, base=fit.base), fit


def similar_states(problem: DrawsProblem, shape: Shape) -> list[Drawn]:
    """Random states most like a shape."""
    states = problem.states
    some = spread(shape.points, 150)
    goal = shape.points[some].astype(np.float32)
    cost = robust_poses(states.places[:, some], goal, problem.base.first_sigma)[0]
    return [states.drawn(states.seeds[row]) for row in np.argsort(cost)[: problem.config.starts]]


def descend(problem: DrawsProblem, fit: DrawsFit, fresh: int) -> DrawsFit:
    """Descend by Levenberg and Marquardt's method, with ``fresh`` sets of differences after that of the fit."""
    assert fit.motion is not None
    config, least, motion = problem.config, problem.base.cloud_sigma, fit.motion
    index = problem.states.played.index
    sigma = max(0.03 * problem.model.half, least)  # at first
    damping = 0.03
    for number in range(1 + fresh):
        if number:
            motion = problem.states.derivatives(fit.drawn, fit.z, fit.material[index])
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
    """Return a state of lower misfit, or the same; what was learnt of the motion; the next damping."""
    index = problem.states.played.index
    least = misfit(problem, fit, sigma)
    for _ in range(3):
        step = terms(problem, fit, motion, sigma).total.step(damping)
        tried = simulate(problem, fit.drawn, fit.z + step[POSE:], fit.posed.moved(step[:POSE]))
        if tried is not None:
            motion = secant(motion, step[POSE:], (tried.material - fit.material)[index])
            if misfit(problem, tried, sigma) < least:
                return tried, motion, max(damping / 6.0, 1e-3)
        damping *= 6.0
    return fit, motion, damping
