"""Draws whose state has a given shape: Levenberg and Marquardt's method on few points, without looking at the frame.

The fit of the modes is dense and smooth, so the draws of a state like it are found from far away. Playing few
points of a state costs milliseconds; one set of differences serves for several steps (Broyden's rule).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_array

from mereo.fitting.draws.playback import Drawn, DrawnStates
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, geman_mcclure, in_space
from mereo.geometry.transforms import best_rotations

ROBUST = 2.5
"""Points farther off than this many standard deviations count for little."""

DIFFERENCE = 0.02
"""Step of finite differences, in standard deviations of a draw."""

STEPS = 6
"""Steps at most with one set of differences."""

TRIES = 5
"""Dampings at most in one step."""

ENOUGH = 0.02
"""Relative gain of a step below which nothing more is tried."""

HELD = 1e6
"""Precision of draws that move nothing here: they stay."""

SAME = 1e-4
"""Distance, in scene units, below which two plays are of one state; rest points are in single precision."""

STILL = 1e-9
"""Motion, in scene units for a standard deviation, below which a draw moves nothing."""


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
        worth: float,
        confidence: Float[np.ndarray, " n"],
        follow: csr_array | None = None,
    ) -> "Shape":
        """Shape worth ``worth`` points."""
        return cls(points, std, confidence / confidence.sum() * (worth / std**2), follow)

    def at(self, played: Float[np.ndarray, "a *c"]) -> Float[np.ndarray, "n *c"]:
        """Values at the points, from values at the played points."""
        if self.follow is None:
            return played
        result: np.ndarray = self.follow @ played.reshape(len(played), -1)
        return result.reshape(-1, *played.shape[1:])


@dataclass(frozen=True, eq=False)
class Near:
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


def near(states: DrawnStates, shape: Shape, drawn: Drawn, z: Float[np.ndarray, " d"]) -> Near | None:
    """The state of these draws, laid robustly onto the shape; None where the scene refuses it."""
    deformations = drawn.deformations(states.scene, z)
    if deformations is None:
        return None
    played = states.played.moved(deformations)
    points, weight = shape.at(played), shape.weight
    for _ in range(3):
        share = weight / weight.sum()
        center, goal = share @ points, share @ shape.points
        rotation = best_rotations(((points - center) * share[:, None]).T @ (shape.points - goal))
        translation = goal - rotation @ center
        distance = np.linalg.norm(points @ rotation.T + translation - shape.points, axis=1)
        weight = shape.weight * geman_mcclure(distance, ROBUST * max(shape.std, float(np.median(distance))))
    squared = distance**2
    apart = float(shape.weight @ (squared / (1.0 + squared / (2 * ROBUST * shape.std) ** 2)))
    return Near(drawn, z, played, rotation, translation, apart + float(z @ z))


def derivatives(
    states: DrawnStates, drawn: Drawn, z: Float[np.ndarray, " d"], here: Float[np.ndarray, "a 3"]
) -> Float32[np.ndarray, "a 3 d"]:
    """Motion of the played points, which are ``here``, for a standard deviation of each draw.

    Neighbours are played without the scene's own test where this state is the same without it: it is not where a scene
    refuses and draws again in a way that ``Drawn`` does not see through.
    """
    change = np.zeros((*here.shape, len(z)), dtype=np.float32)
    untested = drawn.deformations(states.scene, z, checked=False)
    checked = untested is None or float(np.abs(states.played.moved(untested) - here).max()) > SAME
    for number in np.flatnonzero(drawn.smooth):
        step = DIFFERENCE * (-1.0 if z[number] > 0 else 1.0)
        other = z.copy()
        other[number] += step
        moved = drawn.deformations(states.scene, other, checked)
        if moved is not None:
            change[:, :, number] = (states.played.moved(moved) - here) / step
    return change


def unmoving(motion: Float32[np.ndarray, "a 3 d"]) -> Bool[np.ndarray, " d"]:
    """Which draws move nothing here."""
    return np.asarray(np.abs(motion).max(axis=(0, 1)) < STILL)


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
    missed = (moved - motion @ step.astype(np.float32)).astype(np.float32)
    return motion + missed[..., None] * (step / max(float(step @ step), 1e-12)).astype(np.float32)


def approach(states: DrawnStates, shape: Shape, here: Near, fresh: int) -> Near:
    """The state near the shape, by ``fresh`` sets of differences."""
    damping = 0.1
    for _ in range(fresh):
        motion = derivatives(states, here.drawn, here.z, here.points)
        before = here.misfit
        for _ in range(STEPS):
            nearer, motion, damping = _step(states, shape, here, motion, damping)
            gain, here = here.misfit - nearer.misfit, nearer
            if gain < ENOUGH * here.misfit:
                break
        here = replace(here, motion=motion)
        if before - here.misfit < 2 * ENOUGH * before:
            break
    return here


def _step(
    states: DrawnStates, shape: Shape, here: Near, motion: Float32[np.ndarray, "a 3 d"], damping: float
) -> tuple[Near, Float32[np.ndarray, "a 3 d"], float]:
    """The next state, or the same; what was learnt of the motion; the next damping."""
    for _ in range(TRIES):
        step = _solved(shape, here, motion, damping)
        tried = near(states, shape, here.drawn, here.z + step)
        if tried is not None:
            motion = secant(motion, step, tried.points - here.points)
            if tried.misfit < here.misfit:
                return tried, motion, max(damping / 4.0, 1e-3)
        damping *= 5.0
    return here, motion, damping


def _solved(shape: Shape, here: Near, motion: Float32[np.ndarray, "a 3 d"], damping: float) -> Float[np.ndarray, " d"]:
    """Levenberg and Marquardt's step of the draws, the pose free."""
    normal = prior_of_draws(here.z, motion, 0.0, 1e-6)
    posed = Posed(here.rotation, here.translation, np.zeros(len(here.z)))
    points = posed.place(shape.at(here.points))
    offset = points - shape.points
    weight = shape.weight * geman_mcclure(np.linalg.norm(offset, axis=1), 2 * ROBUST * shape.std)
    jacobian = in_space(posed, points, shape.at(motion))
    return normal.add(jacobian, offset.ravel(), np.repeat(weight, 3)).step(damping)[POSE:]
