"""The network asked again with the camera turned, where a fit does not explain what is seen.

A camera that turns about its own centre sees the same points along the same lines of sight, so the answer may only turn
along with it. A network's does so where it understands what it sees; where it does not, each turn is another guess, and
the fit tells which is right.
"""

from collections.abc import Iterator
from itertools import islice

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.fitting.modes.fit import Judged, explored, fit_whole, refine
from mereo.fitting.modes.understood import Ask, Understood
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.problem import UNEXPLAINED, Problem
from mereo.geometry.transforms import rotation_along

ROLL = np.pi / 4
"""Between one turn and the next about the line of sight to the object, rad."""

TILTS = np.deg2rad([0.0, 15.0, 15.0, 25.0])
"""Of the camera away from the object, one after the other for all rolls, rad."""

TILTED = 2.0
"""Angle between the directions of one tilt and the next."""

ROUND = 8
"""Turns that are tried at once; the best of them are fitted."""

FITTED = 2
"""How many."""


def turns(axis: Float[np.ndarray, "3"]) -> Iterator[Float[np.ndarray, "3 3"]]:
    """Rotations of the camera frame: rolls about a line of sight, without and with tilts away from it."""
    axis = axis / np.linalg.norm(axis)
    across = rotation_along(axis)[:, :2]
    count = round(2 * np.pi / ROLL)
    for number in range(1, count * len(TILTS)):
        toward = TILTED * number
        tilt = across @ np.array([np.cos(toward), np.sin(toward)]) * TILTS[number // count]
        yield (Rotation.from_rotvec(tilt) * Rotation.from_rotvec(number * ROLL * axis)).as_matrix()


def with_turns(start: Understood, ask: Ask | None) -> Understood:
    """A fit as it is, or where much is unexplained the best of it and of those with the camera turned.

    Args:
        start: the frame as it is.
        ask: the network, in scene units.
    """
    problem, _, modes = start
    if ask is None or not problem.config.turned or not problem.wants_turns(modes.misfit.cloud, modes.surface):
        return start
    points, anyway = problem.evidence.points, problem.config.turned_anyway
    best, waiting = start, turns(points.mean(axis=0))
    while rounds := list(islice(waiting, ROUND)):
        for problem, found in likely([seen_turned(start[0], points, turn, ask) for turn in rounds]):
            modes = Judged.of(problem, refine(problem, fit_whole(problem)))
            if modes.misfit.without_network < best[2].misfit.without_network:
                best = problem, found, modes
        if best[2].misfit.cloud < UNEXPLAINED or (anyway and best[0].leaves_noise(best[2].surface)):
            break
    return best if best is start else (best[0], best[1], explored(best[0], best[2]))


def seen_turned(
    problem: Problem, points: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "3 3"], ask: Ask
) -> tuple[Problem, Correspondences]:
    """The frame with what the network states when the camera is turned, turned back."""
    found = ask(points @ turn.T).turned(turn.T)
    return problem.with_network(found), found


def likely(frames: list[tuple[Problem, Correspondences]]) -> list[tuple[Problem, Correspondences]]:
    """Those whose fit by few points explains the frame best."""
    costs = []
    for problem, _ in frames:
        coarse = problem.coarse
        posed = refine(coarse, fit_whole(coarse), 2.0, problem.config.screen_steps)
        costs.append(problem.screen(posed, problem.config.cloud_sigma).without_network)
    return [frames[index] for index in np.argsort(costs)[:FITTED]]
