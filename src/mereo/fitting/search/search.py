"""Search for the pose and the state of an object in a frame, without a network.

    cloud, lines of sight, statistical model -search_modes-> ModesFit, and how many candidates explain the frame alike

1. Rotations, evenly over all, of the mean state, with its visible side on the cloud; rigid steps draw each towards the
   frame (``screening``).
2. The best that differ are bent towards the frame by few points, from wide to narrow.
3. The best of these are fitted as a frame always is, until one explains the frame and its rivals are worse.
4. While none does, the same again from other states of the library, more and more of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.fitting.modes.fit import Judged, explored, fit_cloud, refine
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.priors import Prior
from mereo.fitting.problem.problem import UNEXPLAINED, Problem
from mereo.fitting.search.screening import Poses, Screen
from mereo.fitting.search.shape_tables import tables_of


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


ROUNDS = (SearchRound(0, 600, 24, 6), SearchRound(12, 300, 40, 6), SearchRound(40, 300, 60, 8))
"""Rounds of the search, one after the other while the frame is not explained."""

SIGMAS = (0.15, 0.15, 0.12, 0.1, 0.08)
"""The cloud's standard deviations in the rigid steps of all poses, as shares of the object's half length."""

KEPT = 100
"""Poses that are drawn nearer."""

LAST_SIGMAS = (0.06, 0.05, 0.05, 0.05)
"""The same of these."""

APART = 0.15
"""Distance between two candidates' samples, as a share of the half length, up to which they are one."""

BENDING = ((0.12, 5, 0.05), (0.05, 8, 0.02))
"""First sigma, steps, and the sigma of the choice, of the two stages in which few points bend a candidate."""


@dataclass(frozen=True, eq=False)
class Found:
    """Outcome of a search.

    Attributes:
        best: the candidate that explains the frame best.
        alike: number of candidates that explain it as well and differ from each other, itself included.
        tried: number of candidates that were fitted.
    """

    best: Judged
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


def search(problem: Problem) -> Found:
    """Search for the state that explains a frame; the problem has no correspondences."""
    best: Judged | None = None
    fitted: list[Judged] = []
    for stage in ROUNDS:
        for posed in candidates(problem, stage):
            judged = _fitted(problem, posed)
            fitted.append(judged)
            if best is None or judged.misfit.total < best.misfit.total:
                best = judged
        assert best is not None
        if is_explained(problem, best):
            break
    best = explored(problem, best)
    return Found(best, 1, len(fitted))


def is_explained(problem: Problem, judged: Judged) -> bool:
    """Whether a state explains the cloud, noise aside."""
    return judged.misfit.cloud < UNEXPLAINED


def candidates(problem: Problem, stage: SearchRound) -> Iterator[Posed]:
    """Candidates of a round, the likeliest first."""
    bent = screened(problem, stage)
    coarse, whole = problem.coarse, Prior.whole(problem.model)
    for start, steps, sigma in BENDING:
        bent = [fit_cloud(coarse, posed, whole, start, steps, problem.config.pair_slack) for posed in bent]
        cost = [coarse.screen(posed, sigma * problem.model.half).without_network for posed in bent]
        bent = [bent[index] for index in np.argsort(cost)[: max(stage.fitted, len(bent) // 2)]]
    yield from bent[: stage.fitted]


def screened(problem: Problem, stage: SearchRound) -> list[Posed]:
    """Poses that are worth bending, which differ from each other."""
    tables = tables_of(problem.model, stage.states)
    screen = Screen.of(tables, problem.evidence, problem.model.half)
    turns = rotations(stage.rotations)
    poses = screen.aligned(screen.starts(turns, False), np.array(SIGMAS), False)
    poses = screen.judged(poses, LAST_SIGMAS[0])
    poses = poses.rows(np.argsort(poses.cost)[: max(KEPT, 2 * stage.bent)])
    poses = screen.judged(screen.aligned(poses, np.array(LAST_SIGMAS), False), LAST_SIGMAS[-1])
    return [_posed(screen, poses, row) for row in _differing(screen, poses, stage.bent)]


def _posed(screen: Screen, poses: Poses, row: int) -> Posed:
    z = screen.tables.z[poses.state[row]].astype(np.float64)
    rotation = Rotation.from_matrix(poses.rotation[row]).as_matrix()
    return Posed(rotation, poses.translation[row].astype(np.float64), z, float(poses.log_scale[row]))


def _differing(screen: Screen, poses: Poses, count: int) -> list[int]:
    """Rows of the best poses, each of which differs from all before it."""
    few = screen.tables.place[poses.state, ::16]
    size = np.exp(poses.log_scale)[:, None, None]
    place = size * np.matmul(few, poses.rotation.transpose(0, 2, 1)) + poses.translation[:, None]
    kept: list[int] = []
    for row in np.argsort(poses.cost):
        apart = np.sqrt(((place[kept] - place[row]) ** 2).sum(axis=2).mean(axis=1))
        if not len(kept) or apart.min() > APART * screen.half:
            kept.append(int(row))
        if len(kept) == count:
            break
    return kept


def _fitted(problem: Problem, posed: Posed) -> Judged:
    """Fit of a candidate, as a frame's fit ends."""
    config = problem.config
    whole = Prior.whole(problem.model)
    posed = fit_cloud(problem, posed, whole, config.start_sigma, config.last_steps, config.pair_slack)
    return Judged.of(problem, posed).better(problem, refine(problem, posed))
