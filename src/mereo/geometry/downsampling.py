"""Fewer points of a cloud: at random, evenly in space, or means of neighbours."""

from math import inf

import numpy as np
from jaxtyping import Float, Real, Shaped
from numpy import ndarray
from numpy.linalg import norm, svd
from numpy.random import default_rng
from scipy.spatial import cKDTree

from mereo.geometry.transforms import Indices, Points, Subset, Values, longest_side

MAX_POINTS = 50_000
"""Many times what any network is trained on; comparing neighbours takes a fraction of a second."""

STEEPEST = 4.0
"""Gap in range, in widths of a cell there, from which on there are two surfaces: one would be seen at 76 degrees."""


def random_subset(rows: Shaped[ndarray, "n *r"], limit: int) -> Shaped[ndarray, "m *r"]:
    """At most ``limit`` of the rows, drawn at random but always the same; all, in their order, where they are few."""
    if len(rows) <= limit:
        return rows
    return rows[default_rng(0).choice(len(rows), limit, replace=False)]


def thin_to_grid(points: Points, limit: int) -> Subset:
    """Rows of at most ``limit`` of the points, one per cell of a cubic grid, in their order; all where they are few.

    Single measurements are kept, not means of cells: a mean of both sides of an edge would lie on neither. The first
    point of a cell stands for it. Cells are made larger until few enough are occupied, so between half of ``limit`` and
    ``limit`` points stay, unless many coincide.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    low = points.min(axis=0)
    side = longest_side(points)
    if side == 0:
        return np.arange(limit)
    # a surface through a cube of c^3 cells occupies about c^2 of them
    cell = side / np.sqrt(limit)
    while len(rows := first_in_cell(points - low, cell)) > limit:
        cell *= np.sqrt(len(rows) / limit) * 1.02
    while True:
        finer = cell / np.sqrt(limit / max(len(rows), 1)) * 1.05
        if len(rows) >= 0.5 * limit or finer < side * 1e-6:
            return rows
        more = first_in_cell(points - low, finer)
        if len(more) > limit:
            return rows
        cell, rows = finer, more


def means_along_sight(points: Points, limit: int) -> Float[ndarray, "m 3"]:
    """At most ``limit`` points, each the mean of neighbours on one surface; the cloud itself where it has no more.

    Neighbours are seen from the origin within one cell of a grid of lines of sight, the smallest cells that suffice; a
    gap in range parts surfaces. So the noise of a dense cloud averages out, and no mean lies between two surfaces.
    ``points`` are seen from the origin (camera frame), in any unit, within 90 degrees of their middle.
    """
    if len(points) <= limit:
        return points
    points = random_subset(points, max(limit, MAX_POINTS))
    distance = norm(points, axis=1)
    sight = points / distance[:, None]
    ahead = sight.mean(axis=0)
    across = svd(ahead[None])[2][1:]
    flat = sight @ across.T * (norm(ahead) / (sight @ ahead))[:, None]
    flat -= flat.min(axis=0)
    # an extent, as a slope, of a tenth of a millimetre in a hundred metres counts as none
    cell = max(float(np.ptp(flat, axis=0).max()), 1e-6) / np.sqrt(limit)
    while (count := (group := _surfaces_in_cells(flat, distance, cell)).max() + 1) > limit:
        cell *= np.sqrt(count / limit) * 1.02
    total = np.stack([np.bincount(group, points[:, axis]) for axis in range(3)], axis=1)
    return total / np.bincount(group)[:, None]


def _surfaces_in_cells(flat: Float[ndarray, "n 2"], distance: Values, cell: float) -> Indices:
    """Number of the group of each point: those of one cell without a gap in distance."""
    index = np.floor(flat / cell).astype(np.int64)
    key = index[:, 0] * (index[:, 1].max() + 1) + index[:, 1]
    order = np.lexsort((distance, key))
    starts = np.ones(len(flat), bool)
    gap = np.diff(distance[order]) > STEEPEST * cell * distance[order][:-1]
    starts[1:] = (np.diff(key[order]) != 0) | gap
    group = np.empty(len(flat), np.int64)
    group[order] = np.cumsum(starts) - 1
    return group


def first_in_cell(offsets: Points, cell: float) -> Subset:
    """Rows of the first point in each occupied cell of a grid, in their order; ``offsets`` are not negative."""
    index = np.floor(offsets / cell).astype(np.int64)
    counts = index.max(axis=0) + 1
    key = (index[:, 0] * counts[1] + index[:, 1]) * counts[2] + index[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


def spacing(points: Points) -> float:
    """Median distance from a point to its nearest neighbour at another place; 0 where all coincide."""
    sample = points[:: max(1, len(points) // 1000)]  # whose median is good to a few percent
    distance = cKDTree(points).query(sample, k=min(8, len(points)))[0].reshape(len(sample), -1)
    apart = np.where(distance > 0, distance, inf).min(axis=1)
    return float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else 0.0


# --- farthest points --------------------------------------------------------------------------------------------------

# The order (PointNet++, section 3.2) is computed once, in preprocessing. It is greedy, so its first m points are the
# farthest-point sample of size m for every m: each level of the encoder is a prefix, and nothing is sampled while
# training.


def farthest_point_order(points: Real[ndarray, "n 3"], count: int) -> Subset:
    """Rows of ``points`` such that each next point is the farthest from all before it; ``m = min(n, count)`` of them.

    Deterministic: distances are computed in single precision with one fixed order of operations. Ties go to the point
    with the smaller x, then y, then z, so the sequence of points does not depend on the order in which they came.
    Points that coincide with an earlier one come last.

    The rows are distinct; the first is the point farthest from the middle of the bounding box.
    """
    m = min(count, len(points))
    if m <= 0:
        return np.empty(0, np.int64)
    rank = np.lexsort(points.T[::-1])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    # about the middle, so that single precision is spent on the shape and not on where it is
    xyz = np.ascontiguousarray((points[rank] - middle).T, np.float32)
    current = int(np.add.reduce(xyz * xyz, axis=0).argmax())
    # buffers are reused and every operation is one pass, because m passes over n points dominate
    order = np.empty(m, np.int64)
    difference, square = np.empty_like(xyz), np.empty_like(xyz[0])
    distance = np.full(xyz.shape[1], inf, np.float32)
    for i in range(m):
        order[i] = current
        np.subtract(xyz, xyz[:, current : current + 1], out=difference)
        np.multiply(difference, difference, out=difference)
        np.add.reduce(difference, axis=0, out=square)
        np.minimum(distance, square, out=distance)
        distance[current] = -1.0  # below any distance: a point is taken once, after its distinct rivals
        current = int(distance.argmax())
    return rank[order]
