"""Length of a scene unit in a frame's unit, as the network's correspondences tell it."""

import numpy as np

from mereo.fitting.problem.correspondences import Correspondences

UNIT_TOLERANCE = 0.15
"""Difference of a stated unit from the correspondences' own up to which it is believed: they are off by less in 258 of
264 training views, and no two units that are mistaken for each other are nearer than a factor of 2.5."""

SCALE_PAIRS = 4000
"""Pairs of correspondences whose distances, there and at rest, tell an unknown unit."""


def agree(one: float, other: float) -> bool:
    """Whether two units differ by no more than ``UNIT_TOLERANCE``."""
    return abs(float(np.log(one / other))) < float(np.log1p(UNIT_TOLERANCE))


def estimate_unit(found: Correspondences) -> float:
    """Length of a scene unit in the unit of the correspondences: distances within a segment hardly change."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(found.labels), size=(2, SCALE_PAIRS))
    rest = np.linalg.norm(found.rest[first] - found.rest[second], axis=1)
    seen = np.linalg.norm(found.points[first] - found.points[second], axis=1)
    usable = (found.labels[first] == found.labels[second]) & (rest > np.median(rest[rest > 0]) / 4)
    if not usable.any():
        raise ValueError(
            f"the network finds only {len(found.labels)} points of the object, too few to tell its size: name the "
            "unit with scene_unit, or isolate the object first"
        )
    return float(np.median(seen[usable] / rest[usable]))
