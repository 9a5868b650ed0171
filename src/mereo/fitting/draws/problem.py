"""Explain a frame by states of a scene: simulate them, score them, and linearize around them.

Around a state the material points are linear in the draws, so its neighbourhood is a linear model like that of the
modes; the residuals are those of the modes' fit.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import csr_array

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.config import FEW_DRAWS, MANY_DRAWS, DrawsConfig
from mereo.fitting.draws.playback import Drawn, DrawnStates, as_sparse, material_moved
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, geman_mcclure, in_space
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import (
    SILHOUETTE_WEIGHT,
    NetworkTerm,
    Surface,
    Terms,
    add_silhouette,
    cloud_rows,
    robust_square,
    silhouette_losses,
)
from mereo.geometry.mesh import barycentric
from mereo.geometry.transforms import best_rotations
from mereo.scenes.statistical_model import StatisticalModel


@dataclass(frozen=True, eq=False)
class DrawsProblem:
    """A frame to be explained by the states of a scene.

    Attributes:
        base: the same frame, explained by modes, with the weights that the draws are fitted by.
        states: random states of the scene.
        correspondences: correspondences, scene units.
        weights: how their rest positions follow the material points.
        config: constants.
        by_sight: whether observed points are compared with what their lines of sight meet, or with the nearest points.
    """

    base: Problem
    states: DrawnStates
    correspondences: Correspondences
    weights: PointWeights
    config: DrawsConfig
    by_sight: bool = False

    @property
    def model(self) -> StatisticalModel:
        """Statistical model of the object."""
        return self.base.model

    @property
    def last(self) -> Problem:
        """``base`` with the points of the last descent."""
        return self.base.by_every_point if self.config.every_point else self.base

    @classmethod
    def of(
        cls, base: Problem, states: DrawnStates, correspondences: Correspondences, config: DrawsConfig | None = None
    ) -> "DrawsProblem":
        """Problem with the constants for as many draws as the scene has, where none are given."""
        model = base.model
        if config is None:
            config = DrawsConfig() if states.z.shape[1] <= FEW_DRAWS else MANY_DRAWS
        network_weight = config.network_weight, config.network_weight
        fit_config = replace(base.config, cloud_weight=config.cloud_weight, network_weight=network_weight)
        base = replace(base, config=fit_config)
        return cls(base, states, correspondences, model.weights(correspondences.rest, correspondences.labels), config)

    def network(self, fit: "DrawsFit", modes: Float32[np.ndarray, "n 3 d"] | None = None) -> NetworkTerm:
        """Correspondences in the neighbourhood of a state."""
        modes = np.zeros((len(self.correspondences.labels), 3, 0), dtype=np.float32) if modes is None else modes
        return NetworkTerm(
            self.correspondences.points, self.weights(fit.material), modes, self.correspondences.confidence
        )

    @cached_property
    def following_played(self) -> csr_array:
        """How the rest positions of the correspondences follow the played points."""
        return as_sparse(self.weights, len(self.model.rest_points)) @ self.states.played.spread


@dataclass(frozen=True, eq=False)
class DrawsFit:
    """A played state beside the frame.

    Attributes:
        drawn, z: the state by its draws.
        posed: rigid pose; its ``z`` is empty.
        material: material points, unposed.
        surface: the posed surface.
        distance, face, position: of what each observed sample is compared with.
        misfit: with the prior of the draws, the cloud by its last sigma.
        motion: of the played points for a standard deviation of each draw, where it is known.
    """

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    posed: Posed
    material: Float[np.ndarray, "m 3"]
    surface: Surface
    distance: Float[np.ndarray, " p"]
    face: Int[np.ndarray, " p"]
    position: Float[np.ndarray, "p 3"]
    misfit: float
    motion: Float32[np.ndarray, "a 3 d"] | None = None

    def placed(self) -> Float[np.ndarray, "m 3"]:
        """Material points in the camera frame."""
        return self.surface.material


def simulate(problem: DrawsProblem, drawn: Drawn, z: Float[np.ndarray, " d"], posed: Posed) -> DrawsFit | None:
    """Simulate the state of these draws and score it; None where the scene refuses it."""
    deformations = drawn.deformations(problem.states.scene, z)
    if deformations is None:
        return None
    material = material_moved(problem.states.scene, problem.model, deformations)
    return try_material(problem, drawn, z, posed, material)


def try_material(
    problem: DrawsProblem,
    drawn: Drawn,
    z: Float[np.ndarray, " d"],
    posed: Posed,
    material: Float[np.ndarray, "m 3"],
) -> DrawsFit | None:
    """Score material points as those of a state; None where no face of them is seen."""
    rigid = replace(posed, z=np.empty(0))
    surface = Surface.through(problem.model, rigid.place(material))
    if len(surface.facing) == 0:
        return None
    observed_samples = problem.base.evidence.observed_samples
    met = problem.base.met(surface) if problem.by_sight else surface.nearest(observed_samples)
    fit = DrawsFit(drawn, z, rigid, material, surface, *met, np.inf)
    return replace(fit, misfit=misfit(problem, fit, problem.base.config.cloud_sigma))


def misfit(problem: DrawsProblem, fit: DrawsFit, sigma: float) -> float:
    """Misfit as ``Problem.misfit`` counts it, by any sigma of the cloud, without looking for observed samples again."""
    base = problem.base
    cloud = base.config.cloud_weight * float(robust_square(fit.distance, sigma).mean())
    network = base.config.network_weight[1] * problem.network(fit).energy(fit.posed, base.network_sigma)
    losses = silhouette_losses(fit.surface.material[base.model.silhouette_vertices], base.evidence, sigma)
    return cloud + network + SILHOUETTE_WEIGHT * float(losses.sum()) + float(fit.z @ fit.z)


def narrowing(problem: DrawsProblem, fit: DrawsFit) -> float:
    """``NormalEquations.narrowing`` of the draws that move something."""
    assert fit.motion is not None
    equations = normal_equations(problem, fit, fit.motion, problem.base.config.cloud_sigma)
    return equations.narrowing() - int(unmoving(fit.motion).sum()) * float(np.log(HELD))


def normal_equations(
    problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float
) -> NormalEquations:
    """Of everything that the frame shows, for changes of pose and draws, whose motion of the played points is given."""
    return terms(problem, fit, motion, sigma).total


def terms(problem: DrawsProblem, fit: DrawsFit, motion: Float32[np.ndarray, "a 3 d"], sigma: float) -> Terms:
    """Terms of ``normal_equations``: those of the modes, with the played points' motion in the place of modes."""
    base, posed, config, surface = problem.base, fit.posed, problem.base.config, fit.surface
    samples, spread, count = base.evidence.observed_samples, problem.states.played.spread, len(fit.z)
    flat, vertices = motion.reshape(len(motion), -1), base.model.silhouette_vertices

    def modes_of(follow: csr_array) -> Float32[np.ndarray, "n 3 d"]:
        return (follow @ flat).reshape(-1, 3, count)

    nothing, state = NormalEquations.nothing(POSE + count), replace(posed, z=np.zeros(count))
    network = problem.network(fit, modes_of(problem.following_played))
    planes = fit.position, surface.normals[fit.face], modes_of(surface_weights(fit, spread.shape[0]) @ spread)
    return Terms(
        known=prior_of_draws(fit.z, motion, posed.log_scale, base.scale_std),
        network=network.add_to(nothing, state, base.network_sigma, config.network_weight[1], robust=True),
        cloud=cloud_rows(posed, samples, planes, sigma, config.cloud_weight),
        observed_samples=samples,
        ruled_out=add_silhouette(
            nothing,
            posed,
            surface.material[vertices],
            lambda rows: modes_of(spread[vertices[rows]]),
            base.evidence,
            sigma,
        ),
    )


def surface_weights(fit: DrawsFit, count: int) -> csr_array:
    """Weights of all ``count`` material points by which the positions on the surface follow them."""
    corners = fit.surface.model.faces[fit.surface.facing[fit.face]]
    within = barycentric(fit.surface.material[corners], fit.position).astype(np.float32)
    rows = np.repeat(np.arange(len(corners)), 3)
    return csr_array((within.ravel(), (rows, corners.ravel())), shape=(len(corners), count))


# --- the state of a given shape ---------------------------------------------------------------------------------------

# Draws whose state has a given shape: Levenberg and Marquardt's method on few points, without looking at the frame.
#
# The fit of the modes is dense and smooth, so the draws of a state like it are found from far away. Playing few
# points of a state costs milliseconds; one set of differences serves for several steps (Broyden's rule).

SHAPE_WEIGHT = 500.0
"""How many independent points a shape is worth."""

SHAPE_ROBUST = 2.5
"""Points farther off than this many standard deviations count for little."""

ENOUGH = 0.02
"""Relative gain of a step below which nothing more is tried."""

HELD = 1e6
"""Precision of draws that move nothing at a state: they stay."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape to be met: positions of some points, in any pose.

    Attributes:
        points: the positions.
        std: standard deviation of each.
        weight: inverse variances, together worth as many points as the shape is.
        follow: how the points follow the played points of a state; they are these where None.
    """

    points: Float[np.ndarray, "n 3"]
    std: float
    weight: Float[np.ndarray, " n"]
    follow: csr_array | None = None

    @classmethod
    def of(
        cls,
        points: Float[np.ndarray, "n 3"],
        std: float,
        confidence: Float[np.ndarray, " n"],
        follow: csr_array | None = None,
    ) -> "Shape":
        """Shape worth ``SHAPE_WEIGHT`` points."""
        return cls(points, std, confidence / confidence.sum() * (SHAPE_WEIGHT / std**2), follow)

    def at(self, values: Float[np.ndarray, "a *c"]) -> Float[np.ndarray, "n *c"]:
        """Values at the points, from values at the played points."""
        if self.follow is None:
            return values
        result: np.ndarray = self.follow @ values.reshape(len(values), -1)
        return result.reshape(-1, *values.shape[1:])


@dataclass(frozen=True, eq=False)
class StateOnShape:
    """A state of a scene beside a shape.

    Attributes:
        drawn, z: the state by its draws.
        points: its played points.
        rotation, translation: rigid motion onto the shape.
        misfit: how badly it meets the shape, with the prior of the draws.
        motion: of the played points for a standard deviation of each draw, where it is known.
    """

    drawn: Drawn
    z: Float[np.ndarray, " d"]
    points: Float[np.ndarray, "a 3"]
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    misfit: float
    motion: Float32[np.ndarray, "a 3 d"] | None = None


def lay_on_shape(states: DrawnStates, shape: Shape, drawn: Drawn, z: Float[np.ndarray, " d"]) -> StateOnShape | None:
    """Lay the state of these draws robustly onto the shape; None where the scene refuses it."""
    deformations = drawn.deformations(states.scene, z)
    if deformations is None:
        return None
    positions = states.played.moved(deformations)
    points, weight = shape.at(positions), shape.weight
    for _ in range(3):
        share = weight / weight.sum()
        center, goal = share @ points, share @ shape.points
        rotation = best_rotations(((points - center) * share[:, None]).T @ (shape.points - goal))
        translation = goal - rotation @ center
        distance = np.linalg.norm(points @ rotation.T + translation - shape.points, axis=1)
        weight = shape.weight * geman_mcclure(distance, SHAPE_ROBUST * max(shape.std, float(np.median(distance))))
    squared = distance**2
    apart = float(shape.weight @ (squared / (1.0 + squared / (2 * SHAPE_ROBUST * shape.std) ** 2)))
    return StateOnShape(drawn, z, positions, rotation, translation, apart + float(z @ z))


def derivatives(
    states: DrawnStates, drawn: Drawn, z: Float[np.ndarray, " d"], positions: Float[np.ndarray, "a 3"]
) -> Float32[np.ndarray, "a 3 d"]:
    """Motion of the played points, which are ``positions``, for a standard deviation of each draw.

    Neighbours are played without the scene's own test where this state is the same without it: it is not where a scene
    refuses and draws again in a way that ``Drawn`` does not see through.
    """
    change = np.zeros((*positions.shape, len(z)), dtype=np.float32)
    untested = drawn.deformations(states.scene, z, checked=False)
    checked = (
        untested is None or float(np.abs(states.played.moved(untested) - positions).max()) > 1e-4
    )  # rest points are in single precision
    for number in np.flatnonzero(drawn.smooth):
        step = 0.02 * (-1.0 if z[number] > 0 else 1.0)
        other = z.copy()
        other[number] += step
        moved = drawn.deformations(states.scene, other, checked)
        if moved is not None:
            change[:, :, number] = (states.played.moved(moved) - positions) / step
    return change


def unmoving(motion: Float32[np.ndarray, "a 3 d"]) -> Bool[np.ndarray, " d"]:
    """Which draws move nothing here."""
    return np.asarray(np.abs(motion).max(axis=(0, 1)) < 1e-9)  # scene units


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


def approach(states: DrawnStates, shape: Shape, state: StateOnShape, fresh: int) -> StateOnShape:
    """Approach the shape from a state, by ``fresh`` sets of differences."""
    damping = 0.1
    for _ in range(fresh):
        motion = derivatives(states, state.drawn, state.z, state.points)
        before = state.misfit
        for _ in range(6):
            nearer, motion, damping = _step(states, shape, state, motion, damping)
            gain, state = state.misfit - nearer.misfit, nearer
            if gain < ENOUGH * state.misfit:
                break
        state = replace(state, motion=motion)
        if before - state.misfit < 2 * ENOUGH * before:
            break
    return state


def _step(
    states: DrawnStates, shape: Shape, state: StateOnShape, motion: Float32[np.ndarray, "a 3 d"], damping: float
) -> tuple[StateOnShape, Float32[np.ndarray, "a 3 d"], float]:
    """Take Levenberg and Marquardt's step of the draws, the pose free.

    Returns the next state, or the same; what was learnt of the motion; the next damping.
    """
    posed = Posed(state.rotation, state.translation, np.zeros(len(state.z)))
    points = posed.place(shape.at(state.points))
    offset = points - shape.points
    weight = shape.weight * geman_mcclure(np.linalg.norm(offset, axis=1), 2 * SHAPE_ROBUST * shape.std)
    for _ in range(5):
        normal = prior_of_draws(state.z, motion, 0.0, 1e-6)
        jacobian = in_space(posed, points, shape.at(motion))
        step = normal.add(jacobian, offset.ravel(), np.repeat(weight, 3)).step(damping)[POSE:]
        tried = lay_on_shape(states, shape, state.drawn, state.z + step)
        if tried is not None:
            motion = secant(motion, step, tried.points - state.points)
            if tried.misfit < state.misfit:
                return tried, motion, max(damping / 4.0, 1e-3)
        damping *= 5.0
    return state, motion, damping
