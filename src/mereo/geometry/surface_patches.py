"""Surface patches of a point cloud: what hangs together as seen from the camera, and what is too thin to be a surface.

Where a mask is wrong by a pixel or two, it lets in a rim of whatever is behind the object, and cameras add points between
both. They are few, but they lie far off. Such a rim is one to three pixels wide, a surface is wider: so a patch counts
where some point of it has nearly all of the 24 neighbours that it would have inside an image. Measured in
docs/design/0006-sensors.md. Notation: n points, k neighbours.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

NEIGHBORS = 24
"""Neighbours that are looked at: in an image, the 5 x 5 pixels around one."""

BESIDE, AROUND = 1.6, 3.0
"""Angles in pitches within which points are beside each other (diagonals are), and within which neighbours count."""

JUMP = 4.0
"""Largest step in range between points beside each other, in widths of a pixel there: a surface seen at 76 degrees."""

INNER = 20
"""Neighbours of the same patch, of the 24, that make a point an inner one; a strip of three pixels has 14."""

STRETCH = 1.03
"""How much longer strays make the points' box where they are left out: the box is what a network is normalized by."""


def surface_points(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether each point belongs to a patch of surface; all do where the cloud is too sparse to tell.

    Args:
        points: seen from the origin (camera frame), any unit and density.
    """
    if len(points) <= NEIGHBORS + 1:
        return np.ones(len(points), dtype=bool)
    patch, inner = _patches(points)
    keep: Bool[np.ndarray, " n"] = np.bincount(patch, inner)[patch] > 0
    return keep if keep.any() else np.ones(len(points), dtype=bool)


def _patches(points: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Number of each point's patch, and whether it is an inner point of it."""
    distance = np.linalg.norm(points, axis=1)
    sight = points / np.maximum(distance, np.finfo(float).tiny)[:, None]
    angle, neighbor = cKDTree(sight).query(sight, k=NEIGHBORS + 1)
    angle, neighbor = angle[:, 1:], neighbor[:, 1:]
    pitch = float(np.median(angle[:, 3]))
    step = np.abs(distance[neighbor] - distance[:, None])
    row, column = np.nonzero((angle <= BESIDE * pitch) & (step <= JUMP * pitch * distance[:, None]))
    edges = (np.ones(len(row), dtype=np.int8), (row, neighbor[row, column]))
    patch = connected_components(coo_matrix(edges, shape=(len(points),) * 2), directed=False)[1]
    same = (angle <= AROUND * pitch) & (patch[neighbor] == patch[:, None])
    return patch, same.sum(axis=1) >= INNER


def longest_side(points: Float[np.ndarray, "n 3"]) -> float:
    """Longest side of the points' box, parallel to the axes."""
    return float(np.ptp(points, axis=0).max())


def without_strays(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether each point is left where strays are removed: all are, unless strays make the box ``STRETCH`` longer.

    Args:
        points: seen from the origin (camera frame), any unit and density.
    """
    keep = surface_points(points)
    if keep.all() or longest_side(points) <= STRETCH * longest_side(points[keep]):
        return np.ones(len(points), dtype=bool)
    return keep
