"""Farthest-point order (PointNet++, section 3.2), computed once in preprocessing."""

import numpy as np
from jaxtyping import Float, Int


def farthest_point_order(points: Float[np.ndarray, "n 3"], count: int, start: int = 0) -> Int[np.ndarray, " m"]:
    """Greedy order in which each next point is the farthest from all before it."""
    xyz = np.ascontiguousarray(points.T, dtype=np.float32)
    m = min(count, len(points))
    order = np.empty(m, dtype=np.int64)
    distance = np.full(len(points), np.inf, dtype=np.float32)
    current = start
    for i in range(m):
        order[i] = current
        d = (xyz[0] - xyz[0, current]) ** 2 + (xyz[1] - xyz[1, current]) ** 2 + (xyz[2] - xyz[2, current]) ** 2
        np.minimum(distance, d, out=distance)
        current = int(distance.argmax())
    return order
