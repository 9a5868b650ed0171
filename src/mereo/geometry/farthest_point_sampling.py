"""Farthest-point order (PointNet++, section 3.2), computed once in preprocessing.

The order is greedy, so its first m points are the farthest-point sample of size m for every m: each level of the
encoder is a prefix, and nothing is sampled while training.
"""

import numpy as np
from jaxtyping import Float, Int, Real


def farthest_point_order(
    points: Real[np.ndarray, "n 3"], count: int, start: int | None = None
) -> Int[np.ndarray, " m"]:
    """Rows of ``points`` such that each next point is the farthest from all before it; ``m = min(n, count)`` of them.

    Deterministic: distances are computed in single precision with one fixed order of operations. Ties go to the point
    with the smaller x, then y, then z, so the sequence of points does not depend on the order in which they came.
    Points that coincide with an earlier one come last.

    Args:
        points: finite, any unit.
        count: how many rows are wanted.
        start: the first row; by default the point farthest from the middle of the bounding box.

    Returns:
        Distinct rows of ``points``.
    """
    m = min(count, len(points))
    if m <= 0:
        return np.empty(0, dtype=np.int64)
    rank = np.lexsort(points.T[::-1])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    # about the middle, so that single precision is spent on the shape and not on where it is
    xyz = np.ascontiguousarray((points[rank] - middle).T, dtype=np.float32)
    first = _farthest_from_origin(xyz) if start is None else int(np.flatnonzero(rank == start)[0])
    return rank[_greedy(xyz, first, m)]


def _farthest_from_origin(xyz: Float[np.ndarray, "3 n"]) -> int:
    return int(np.add.reduce(xyz * xyz, axis=0).argmax())


def _greedy(xyz: Float[np.ndarray, "3 n"], first: int, m: int) -> Int[np.ndarray, " m"]:
    """The loop; buffers are reused and every operation is one pass, because m passes over n points dominate."""
    order = np.empty(m, dtype=np.int64)
    difference, square = np.empty_like(xyz), np.empty_like(xyz[0])
    distance = np.full(xyz.shape[1], np.inf, dtype=np.float32)
    current = first
    for i in range(m):
        order[i] = current
        np.subtract(xyz, xyz[:, current : current + 1], out=difference)
        np.multiply(difference, difference, out=difference)
        np.add.reduce(difference, axis=0, out=square)
        np.minimum(distance, square, out=distance)
        distance[current] = -1.0  # below any distance: a point is taken once, after its distinct rivals
        current = int(distance.argmax())
    return order
