"""Rules of who owns a point that several segments hold, and what a sampler asks of an object.

Where segments overlap, the first one owns the point (``Shape.label``): nested ones are declared, and the inner one
comes first. ``owner_labels`` is the rule of the authors' later work, which needs no declaration.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8


@runtime_checkable
class Shape(Protocol):
    """Questions that a sampler asks of an object; ``geometry.solids.Solids`` answers them, as do polygons.

    Points are [n, d] in the object's frame, distances are in its units.
    """

    count: int
    """Number of segments."""

    nesting: tuple[tuple[int, int], ...]
    """Indices (inner, outer) of segments declared to lie one inside the other; the inner one comes first."""

    def boxes(self) -> Float[np.ndarray, "s 2 d"]:
        """Lower and upper corner of each segment's axis-aligned box."""

    def label(self, points: Float[np.ndarray, "n d"]) -> UInt8[np.ndarray, " n"]:
        """Label of each point: 0 in empty space, else index + 1 of the first segment that holds it."""

    def inside(self, index: int, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Whether each point lies in segment ``index``."""

    def segment_distance(self, index: int, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Unsigned distance of each point to the surface of segment ``index``."""


def owner_labels(shape: Shape, points: Float[np.ndarray, "n d"]) -> UInt8[np.ndarray, " n"]:
    """Label of each point where solids may overlap, an organ inside an organ: the nearest surface's segment owns it.

    Only segments that hold the point compete. The nearest surface of all may belong to one that does not: just outside
    the innermost of three nested balls, it is the innermost ball's. Where one segment lies wholly inside another this
    is the inner one, as in ``Shape.label``: the way to the outer surface meets the inner one first.
    """
    holds = np.stack([shape.inside(index, points) for index in range(shape.count)])
    labels = np.where(holds.any(axis=0), holds.argmax(axis=0) + 1, 0).astype(np.uint8)
    shared = np.flatnonzero(holds.sum(axis=0) > 1)
    distance = np.full((shape.count, len(shared)), np.inf)
    for index in np.flatnonzero(holds[:, shared].any(axis=1)):
        mine = holds[index, shared]
        distance[index, mine] = shape.segment_distance(int(index), points[shared[mine]])
    if len(shared):
        labels[shared] = distance.argmin(axis=0) + 1
    return labels
