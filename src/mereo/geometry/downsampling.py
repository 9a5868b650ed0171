"""Fewer points of a cloud: at random, or evenly in space."""

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial import cKDTree

MAX_POINTS = 50_000
"""Many times what any network is trained on; comparing neighbours takes a fraction of a second."""

SPACING_SAMPLE = 1000
"""Points whose nearest neighbour is looked up for the spacing; its median is then good to a few percent."""


def random_subset(rows: Shaped[np.ndarray, "n *r"], limit: int) -> Shaped[np.ndarray, "m *r"]:
    """At most ``limit`` of the rows, drawn at random but always the same; all, in their order, where they are few."""
    if len(rows) <= limit:
        return rows
    return rows[np.random.default_rng(0).choice(len(rows), limit, replace=False)]


def thin_to_grid(points: Float[np.ndarray, "n 3"], limit: int) -> Int[np.ndarray, " m"]:
    """Rows of at most ``limit`` of the points, one per cell of a cubic grid, in their order; all where they are few.

    Single measurements are kept, not means of cells: a mean of both sides of an edge would lie on neither. The first
    point of a cell stands for it. Cells are made larger until few enough are occupied, so between half of ``limit`` and
    ``limit`` points stay, unless many coincide.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    low, side = points.min(axis=0), float(np.ptp(points, axis=0).max())
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
        found = first_in_cell(points - low, finer)
        if len(found) > limit:
            return rows
        cell, rows = finer, found


def first_in_cell(offsets: Float[np.ndarray, "n 3"], cell: float) -> Int[np.ndarray, " m"]:
    """Rows of the first point in each occupied cell of a grid, in their order; ``offsets`` are not negative."""
    index = np.floor(offsets / cell).astype(np.int64)
    counts = index.max(axis=0) + 1
    key = (index[:, 0] * counts[1] + index[:, 1]) * counts[2] + index[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


def spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """Median distance from a point to its nearest neighbour at another place; 0 where all coincide."""
    sample = points[:: max(1, len(points) // SPACING_SAMPLE)]
    distance = cKDTree(points).query(sample, k=min(8, len(points)))[0].reshape(len(sample), -1)
    apart = np.where(distance > 0, distance, np.inf).min(axis=1)
    return float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else 0.0
