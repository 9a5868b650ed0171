"""Search for the pose and the state of an object in a frame, without a network.

    cloud, lines of sight, statistical model -search-> the state that explains the frame, and how many explain it alike

1. Rotations, evenly over all, of the mean state, with its visible side on the cloud; rigid steps draw each towards the
   frame (``screening``).
2. The best that differ are bent towards the frame by few points, from wide to narrow.
3. The best of these are fitted as a frame always is, as long as they may be better or as good.
4. While the frame is not explained, the same again from other states of the library, more and more of them.
"""

from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.fitting.modes.fit import ScoredFit, explored, fit_cloud, fit_wide, refined
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.joints import corner_positions
from mereo.fitting.problem.problem import UNEXPLAINED, Problem
from mereo.fitting.problem.residuals import Prior
from mereo.fitting.search.screening import Poses, Screen, tables_of


@dataclass(frozen=True)
class SearchRound:
    """One round of the search.

    Attributes:
        states: medoids of the library that are tried; 0 tries the mean state.
        rotations: tried with each of them.
        bent: candidates that are bent towards the frame by few points.
        fitted: how many of these are fitted at most.
    """

    states: int
    rotations: int
    bent: int
    fitted: int


ROUNDS = (SearchRound(0, 400, 12, 4), SearchRound(12, 200, 24, 6), SearchRound(40, 150, 40, 8))
"""Rounds of the search, one after the other while the frame is not explained."""

SIGMAS = (
    *((0.15, 1.0), (0.15, 0.7), (0.12, 0.6), (0.1, 0.6), (0.08, 0.6), (0.06, 0.7)),
    *((0.05, 1.0), (0.05, 1.0), (0.05, 1.0)),
)
"""The cloud's standard deviation in each rigid step, in half lengths, and which share of the poses go on after it."""

APART = 0.15
"""Distance between two poses' samples, as a share of the half length, up to which they are one."""

BENT_APART = 0.05
"""The same of candidates that are bent already."""

BENDING = ((0.12, 5, 0.05), (0.05, 8, 0.02))
"""First sigma, steps, and the sigma of the choice, of the two stages in which few points bend a candidate."""

RIVAL = 1.5
"""Misfit by few points, in misfits of the best, up to which a candidate may still be as good.

Of 65 candidates with more, of 25 training views that others explain, none ended lower by a cloud's misfit of .01."""

NOISY_FITS = 4
"""Candidates that are fitted again where a frame is noisy."""

ALIKE = 0.05
"""Difference of the cloud's misfit up to which two states explain a frame alike."""

WHOLE = 150.0
"""Misfit by which an object that is seen whole may be explained worse than one that something hides in part.

The silhouette only adds to the misfit, so the hypothesis without it has a lower one: by more than this on 4 of 40 whole
training views, and on all of 40 of which 30 % are hidden."""


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Outcome of a search.

    Attributes:
        problem: the frame, with the constants of its noise.
        best: the candidate that explains the frame best.
        alike: number of candidates that explain it alike and differ from each other, the best included.
        tried: number of candidates that were fitted.
    """

    problem: Problem
    best: ScoredFit
    alike: int
    tried: int


def rotations(count: int) -> Float[np.ndarray, "n 3 3"]:
    """Rotations, evenly over all (super-Fibonacci spirals; Alexa, CVPR 2022)."""
    step = np.arange(count) + 0.5
    inner, outer = np.sqrt(step / count), np.sqrt(1 - step / count)
    first, second = 2 * np.pi * step / np.sqrt(2), 2 * np.pi * step / 1.533751168755204288118041
    spiral = (inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second))
    matrices: Float[np.ndarray, "n 3 3"] = Rotation.from_quat(np.stack(spiral, axis=1)).as_matrix()
    return matrices


@dataclass(eq=False)
class _Trail:
    """Search under one hypothesis of what the lines of sight beside the cloud say, as far as it has come."""

    problem: Problem
    handicap: float = 0.0
    fitted: list[ScoredFit] = field(default_factory=list)

    @property
    def best(self) -> ScoredFit:
        return min(self.fitted, key=_total)

    @property
    def is_explained(self) -> bool:
        return is_explained(self.problem, self.best)

    def go_on(self, stage: SearchRound) -> None:
        self.fitted += fit_candidates(self.problem, candidates(self.problem, stage), stage.fitted)
        if not self.is_explained:
            self.fitted.append(explored(self.problem, self.best))

    def as_noisy(self) -> "_Trail | None":
        """The same with the constants for what the best fit leaves over, where that is noise and not its own error.

        Each pixel's own, or shared by neighbours. Not before other states were tried: a wrong state may leave over
        what looks like noise.
        """
        states = [scored.posed for scored in sorted(self.fitted, key=_total)]
        for is_shared in (False, True):
            noisy = self.problem.as_noisy_as(self.best.surface, is_shared)
            if noisy is None:
                continue
            rows = differing(noisy, states, BENT_APART)[:NOISY_FITS]
            trail = _Trail(noisy, 0.0, [explored(noisy, refined(noisy, fit_wide(noisy, states[row]))) for row in rows])
            if noisy.leaves_noise(trail.best.surface, is_shared):
                return trail
        return None

    def outcome(self) -> SearchOutcome:
        best = self.best
        rivals = [scored for scored in self.fitted if scored.misfit.cloud < best.misfit.cloud + ALIKE]
        alike = differing(self.problem, [scored.posed for scored in sorted(rivals, key=_total)], APART)
        return SearchOutcome(self.problem, best, len(alike), len(self.fitted))


def search(whole: Problem, partial: Problem | None = None) -> SearchOutcome:
    """Search for the state that explains a frame.

    Args:
        whole: the frame, without correspondences.
        partial: the same where it is open whether the object is seen whole: with nothing known beside the cloud. It is
            taken where it explains the frame better by more than ``WHOLE``.
    """
    trails = [_Trail(whole)] if partial is None else [_Trail(whole), _Trail(partial, WHOLE)]
    for number, stage in enumerate(ROUNDS[: whole.config.search_rounds]):
        for trail in trails:
            trail.go_on(stage)
        for trail, other in permutations(trails, 2):  # either may have found what the other has missed
            trail.fitted.append(refined(trail.problem, other.best.posed))
        chosen = min(trails, key=lambda trail: trail.best.misfit.total + trail.handicap)
        if chosen.is_explained or (number > 0 and chosen.best.misfit.cloud < UNEXPLAINED):
            break
        if number > 0:
            noisy = chosen.as_noisy()
            if noisy is not None:
                return noisy.outcome()
            trails = [chosen]
    return chosen.outcome()


def _total(scored: ScoredFit) -> float:
    return scored.misfit.total


def is_explained(problem: Problem, scored: ScoredFit) -> bool:
    """Whether a state explains the cloud, noise aside."""
    return problem.explained(scored.misfit.cloud, scored.surface, problem.config.explained)


def fit_candidates(problem: Problem, candidates: list[tuple[float, Posed]], most: int) -> list[ScoredFit]:
    """Fits of candidates that may be the best, of those given with their misfits by few points, the lowest first."""
    fitted: list[ScoredFit] = []
    for cost, posed in candidates[:most]:
        if fitted and cost > RIVAL * candidates[0][0] and is_explained(problem, min(fitted, key=_total)):
            break
        fitted.append(refined(problem, fit_wide(problem, posed)))
    return fitted


def candidates(problem: Problem, stage: SearchRound) -> list[tuple[float, Posed]]:
    """Candidates of a round with their misfits by few points, the lowest first."""
    coarse, whole = problem.coarse, Prior.whole(problem.model)
    bent, cost = screen_poses(problem, stage), list[float]()
    for start, steps, sigma in BENDING:
        bent = [fit_cloud(coarse, posed, whole, start, steps, problem.config.pair_slack) for posed in bent]
        cost = [coarse.screen(posed, sigma * problem.model.half).without_network for posed in bent]
        order = np.argsort(cost)
        bent, cost = [bent[index] for index in order], [cost[index] for index in order]
        rows = differing(problem, bent, BENT_APART)[: max(stage.fitted, len(bent) // 2)]
        bent, cost = [bent[row] for row in rows], [cost[row] for row in rows]
    return list(zip(cost, bent, strict=True))


def differing(problem: Problem, states: list[Posed], apart: float) -> list[int]:
    """Rows of the states of which each differs from all before it by ``apart`` half lengths in the mean."""
    return _first_of_each(corner_positions(problem.model, states), apart * problem.model.half)


def _first_of_each(positions: Float[np.ndarray, "n p 3"], apart: float) -> list[int]:
    """Rows of which each is farther than ``apart`` from all before it, in the root mean square."""
    kept: list[int] = []
    for row, place in enumerate(positions):
        if not kept or np.sqrt(((positions[kept] - place) ** 2).sum(axis=2).mean(axis=1)).min() > apart:
            kept.append(row)
    return kept


def screen_poses(problem: Problem, stage: SearchRound) -> list[Posed]:
    """Poses that are worth bending, which differ from each other."""
    tables = tables_of(problem.model, stage.states)
    screen = Screen.of(tables, problem.evidence, problem.model.half, problem.is_scale_open)
    poses = screen.starts(rotations(stage.rotations))
    for sigma, share in SIGMAS:
        poses = screen.aligned(poses, sigma)
        count = max(round(share * len(poses)), 2 * stage.bent)
        poses = poses if count >= len(poses) else poses.rows(np.argpartition(poses.cost, count)[:count])
    poses = screen.scored(poses, SIGMAS[-1][0])
    poses = poses.rows(np.argsort(poses.cost))
    positions = poses.place(tables.place[poses.state, ::16])
    return [_posed(screen, poses, row) for row in _first_of_each(positions, APART * problem.model.half)[: stage.bent]]


def _posed(screen: Screen, poses: Poses, row: int) -> Posed:
    z = screen.tables.z[poses.state[row]].astype(np.float64)
    rotation = Rotation.from_matrix(poses.rotation[row]).as_matrix()
    return Posed(rotation, poses.translation[row].astype(np.float64), z, float(poses.log_scale[row]))
