"""Shapes in which segments that look alike turned are turned together, as a target for the draws.

    rest shapes, joints -own_turns-> OwnTurn -twins-> groups -turned-> a shape -fit-> another state

An arm looks the same with the forearm half a turn round, the wrist bent the other way and the hand turned back. No
small step leads there, and no jump of one draw: several change at once. But the shape is known, so that the draws can
be drawn towards it as towards that of the modes. Lengths are scene units.

Notation: m material points.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from mereo.fitting.problem.joints import branches
from mereo.fitting.problem.own_turns import OwnTurn, own_turns
from mereo.geometry.transforms import fit_rigid
from mereo.scenes.statistical_model import StatisticalModel

NEXT = np.deg2rad(15.0)
"""Turns that are no farther apart than this are one: the angles asked about are 10 degrees apart."""

Twins = tuple[tuple[OwnTurn, float], ...]
"""Segments that hang on each other, and the angle by which each is turned."""


@lru_cache(maxsize=8)
def twins(model: StatisticalModel) -> tuple[Twins, ...]:
    """Groups of two segments or more that hang on each other and each look alike in exactly one other turn.

    A segment that spins, or looks alike in many turns, is left to single draws, which slide along its surface.
    """
    single = {turn.label - 1: (turn, angle) for turn, angle in map(_only_angle, own_turns(model)) if angle is not None}
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


def _only_angle(turn: OwnTurn) -> tuple[OwnTurn, float | None]:
    """The middle of a turn's angles where these are one run no wider than ``NEXT`` on either side, else None."""
    middle = float(turn.angles.mean())
    return turn, middle if np.abs(turn.angles - middle).max() <= NEXT else None


def turned(model: StatisticalModel, material: Float[np.ndarray, "m 3"], together: Twins) -> Float[np.ndarray, "m 3"]:
    """Material points of a state with some segments turned, each stiffly about its own axis."""
    moved = material.copy()
    for turn, angle in together:
        rows = np.flatnonzero(model.labels == turn.label)
        T = fit_rigid(model.rest_points[rows], material[rows])
        center, axis = T[:3, :3] @ turn.center + T[:3, 3], T[:3, :3] @ turn.axis
        moved[rows] = Rotation.from_rotvec(angle * axis).apply(material[rows] - center) + center
    return moved
