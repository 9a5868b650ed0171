"""Fit pose and coefficients of the statistical model to a frame.

1. Cloud, silhouette and free space, from wide to narrow.
2. The same again under the Gaussian of the library's states near the answer: states lie on curved sets, of which it is
   the tangent.
3. From where another state lies, with another side of the object there.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.problem.correspondences import fit_places
from mereo.fitting.problem.gauss_newton import DAMPING, Posed
from mereo.fitting.problem.problem import Misfit, Problem
from mereo.fitting.problem.residuals import PlacesTerm, Prior, Surface
from mereo.fitting.problem.segments import corner_positions, diverse_rows, principal_axes, rms_distance
from mereo.geometry.transforms import best_rotations, fit_rigid
from mereo.scenes.statistical_model import StatisticalModel

REFINE_SIGMA = 0.02
"""The cloud's first standard deviation in a refinement, as all sigmas of this module a share of ``half``."""

PAIR_SLACK = 0.05
"""How far the kept distances may be off at first; it falls in each step."""


def fit_from_far(problem: Problem, posed: Posed) -> "ScoredFit":
    """Fit from a state that may be far off, first under the prior of all states."""
    prior = Prior.whole(problem.model)
    return refined(problem, fit_cloud(problem, posed, prior, problem.config.start_sigma, 15, PAIR_SLACK))


def refined(problem: Problem, posed: Posed) -> "ScoredFit":
    """Return the better of a state and its refinement under the prior of the library's 50 states nearest to it."""
    near = fit_cloud(problem, posed, Prior.near(problem.model, posed.z), REFINE_SIGMA, 10, 0.0)
    return min((ScoredFit.of(problem, each) for each in (posed, near)), key=total_misfit)


TURNS = 6
"""Turns about each axis of the rest pose, evenly over a whole one, of which the first is none."""


@lru_cache(maxsize=4)
def turns_at_rest(model: StatisticalModel) -> Int[np.ndarray, "t p"]:
    """Material points that are nearest to where few of them are after turns of the rest pose."""
    rest = model.rest_points
    center, axes = principal_axes(rest, model.faces)
    angles = 2 * np.pi * np.arange(1, TURNS) / TURNS
    turns = Rotation.from_rotvec(np.concatenate(np.multiply.outer(angles, axes))).as_matrix()
    return cKDTree(rest).query(center + (rest[model.sparse] - center) @ turns)[1]


def turned(problem: Problem, posed: Posed) -> list[Posed]:
    """States that lie where one lies, bent alike, with another side of the object there."""
    model = problem.model
    material = posed.place(model.material(posed.z))
    few = PointWeights(model.sparse[:, None], np.ones((len(model.sparse), 1)))
    terms = [PlacesTerm(material[rows], few, few.weight[:, 0]) for rows in turns_at_rest(model)]
    return [fit_places(problem, term, posed.z, posed.log_scale) for term in terms]


BENDING = ((0.12, 5, 0.05), (0.05, 8, 0.02))
"""First sigma, steps, and the sigma of the choice, of the two stages in which few points bend a candidate."""

BENT_APART = 0.05
"""Distance between two candidates' material points, as a share of ``half``, up to which they are one."""


def bend_by_few(problem: Problem, states: list[Posed], kept: int) -> list[tuple[float, Posed]]:
    """Bend states towards the frame by few points, and return those that differ with their misfits, the lowest first.

    Half of them after each stage, and ``kept`` at least.
    """
    coarse = problem.coarse
    whole = Prior.whole(problem.model)
    cost = list[float]()
    for start, steps, sigma in BENDING:
        states = [fit_cloud(coarse, posed, whole, start, steps, PAIR_SLACK) for posed in states]
        cost = [coarse.screen(posed, sigma * problem.model.half).total for posed in states]
        order = np.argsort(cost)
        states, cost = [states[index] for index in order], [cost[index] for index in order]
        rows = differing(problem, states, BENT_APART)[: max(kept, len(states) // 2)]
        states, cost = [states[row] for row in rows], [cost[row] for row in rows]
    return list(zip(cost, states, strict=True))


def differing(problem: Problem, states: list[Posed], apart: float) -> list[int]:
    """Rows of the states of which each differs from all before it by ``apart`` half lengths in the mean."""
    return diverse_rows(corner_positions(problem.model, states), apart * problem.model.half, rms_distance)


@dataclass(frozen=True, eq=False)
class ScoredFit:
    """A state, its misfit and its surface, and the problem ``Problem.cleared`` by that."""

    posed: Posed
    misfit: Misfit
    surface: Surface
    problem: Problem

    @classmethod
    def of(cls, problem: Problem, posed: Posed) -> "ScoredFit":
        """Score a state."""
        surface = problem.surface(posed)
        problem = problem.cleared(surface)
        return cls(posed, problem.misfit(posed, surface), surface, problem)


total_misfit = attrgetter("misfit.total")


def fit_cloud(problem: Problem, posed: Posed, prior: Prior, start: float, steps: int, slack: float) -> Posed:
    """Fit everything that the frame shows; ``start`` (the cloud's first sigma) and ``slack`` are shares of ``half``."""
    config, half = problem.config, problem.model.half
    for step in range(steps):
        sigma = max(start * half * 0.75**step, problem.cloud_sigma)
        normal = problem.known(posed, prior, slack * half * 0.7**step)
        exact = steps - step <= config.exact_steps and sigma <= 2 * problem.cloud_sigma
        posed = posed.moved(problem.seen(normal, posed, sigma, exact).step(DAMPING))
    return posed


# --- poses of many shapes at once -------------------------------------------------------------------------------------


def robust_poses(
    states: Float32[np.ndarray, "n p 3"], target: Float32[np.ndarray, "p 3"], sigma: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Fit robust rigid poses of many shapes at once to the same points: cost in 0..1, rotations, translations."""
    equal = np.full(len(target), 1 / len(target), dtype=np.float32)
    share = np.broadcast_to(equal, states.shape[:2])
    for _ in range(4):
        center = np.matmul(share[:, None], states)
        goal = (share @ target)[:, None]
        covariance = np.matmul((states - center).transpose(0, 2, 1) * share[:, None], target - goal)
        rotation = best_rotations(covariance)
        squared = ((np.matmul(states - center, rotation.transpose(0, 2, 1)) + goal - target) ** 2).sum(axis=2)
        scale = np.maximum(np.median(squared, axis=1, keepdims=True), sigma**2)
        share = 1.0 / (1.0 + squared / scale)
        share = share / share.sum(axis=1, keepdims=True)
    cost = squared / (sigma**2 + squared) @ equal
    translation = goal - np.matmul(center, rotation.transpose(0, 2, 1))
    return cost, rotation.astype(np.float64), translation[:, 0].astype(np.float64)


# --- the object at rest -----------------------------------------------------------------------------------------------

# Modes can imitate noise, so their misfit is always lower; the hypothesis that nothing is bent is right when the
# difference is smaller than what their freedom buys. By Laplace's approximation (MacKay, Neural Computation 1992) that
# is the logarithm of how much the frame narrows the coefficients: ``log det`` of their posterior precision, less that
# of what is known without the frame, N(0, 1) each and the distances that the states keep.


def fit_rest(problem: Problem, modes: Posed) -> ScoredFit:
    """Fit the rest model's pose from that of the modes; its ``posed.z`` is empty."""
    model = problem.model
    rest = of_rest(problem)
    T = fit_rigid(model.rest_points, modes.place(model.material(modes.z)))
    start = Posed(T[:3, :3], T[:3, 3], np.empty(0), modes.log_scale)
    return lowered(rest, fit_cloud(rest, start, Prior.whole(rest.model), REFINE_SIGMA, 10, 0.0))


def of_rest(problem: Problem) -> Problem:
    """Return the problem of the rest model's pose alone."""
    model = problem.model
    rigid = model.around(model.rest_points, np.zeros((len(model.rest_points), 3, 0), dtype=np.float32))
    return replace(problem, model=rigid)


def resting(problem: Problem, modes: ScoredFit) -> ScoredFit | None:
    """Fit of the rest model where its evidence is greater than that of the modes; a rigid object is always at rest.

    None where the rest pose is none of the object's states.
    """
    if not problem.model.rests:
        return None
    rest = fit_rest(problem, modes.posed)
    is_rigid = problem.model.count == 0
    is_better = is_rigid or rest.misfit.total - modes.misfit.total < narrowing(problem, modes.posed)
    return rest if is_better else None


def narrowing(problem: Problem, modes: Posed) -> float:
    """``NormalEquations.narrowing`` of the modes at a state, beyond that by the distances that the states keep."""
    known = problem.known(modes, Prior.whole(problem.model), 0.0)
    return problem.seen(known, modes, problem.cloud_sigma, True).narrowing() - known.narrowing()


# --- noisy frames -----------------------------------------------------------------------------------------------------


def settled(problem: Problem, posed: Posed) -> ScoredFit:
    """Fit a noisy frame again, twice, with as many independent points as the fit shows that its cloud is worth."""
    first = settled_once(problem, posed)
    return settled_once(first.problem, first.posed)


@lru_cache(maxsize=2)  # a search has settled the state that it ends with, to see whether that explains the frame
def settled_once(problem: Problem, posed: Posed) -> ScoredFit:
    """Fit a noisy frame again as ``settled``, once."""
    return lowered(problem.worth(problem.surface(posed)), posed)


GAIN = 1.0
"""What a step must lower the misfit by for another one like it."""


def lowered(problem: Problem, posed: Posed) -> ScoredFit:
    """Descend by steps that lower the misfit (Levenberg and Marquardt)."""
    best = ScoredFit.of(problem, posed)
    prior = Prior.whole(problem.model)
    for damping in (DAMPING, 30.0 * DAMPING):
        gain = np.inf
        while gain > GAIN:
            known = problem.known(best.posed, prior, 0.0)
            normal = best.problem.seen(known, best.posed, problem.cloud_sigma, True, best.surface)
            other = ScoredFit.of(problem, best.posed.moved(normal.step(damping)))
            gain = best.misfit.total - other.misfit.total
            best = min(best, other, key=total_misfit)
    return best
