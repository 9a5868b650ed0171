"""Inside tests for all nodes of a grid at once, by winding numbers along its columns.

Instead of a test per node, every triangle is projected onto the (x, y) columns it covers; along each column the signed
crossings below a node add up to the winding number there. A column through an edge or a vertex counts as one beside it,
the same one for all triangles, so a closed mesh has no cracks.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mereo.geometry.mesh import Segment


def winding_grid(
    segment: Segment, x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"], z: Float[np.ndarray, " nz"]
) -> Bool[np.ndarray, "nx ny nz"]:
    """Whether each node of the product grid of three ascending coordinate arrays is inside a closed mesh."""
    corners = segment.vertices[segment.faces]
    triangle, i, j = _covered_columns(corners[..., :2], x, y)
    weights, left = _edge_sides(corners[triangle][..., :2], segment.faces[triangle], x[i], y[j])
    hit = np.flatnonzero(left.all(axis=1) | ~left.any(axis=1))
    # counter-clockwise in the projection: on the way up the column leaves the solid here
    step = np.where(left[hit, 0], -1, 1)
    heights, weights = corners[triangle[hit]][..., 2], weights[hit]
    height = (weights * heights).sum(axis=1) / weights.sum(axis=1)
    height = np.clip(height, heights.min(axis=1), heights.max(axis=1))  # so that level faces stay level
    crossings = np.zeros((len(x), len(y), len(z) + 1), dtype=np.int32)
    np.add.at(crossings, (i[hit], j[hit], np.searchsorted(z, height)), step)
    return crossings.cumsum(axis=2)[..., :-1] > 0


def _edge_sides(
    corners: Float[np.ndarray, "p 3 2"],
    ids: Int[np.ndarray, "p 3"],
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "p 3"]]:
    """Barycentric weights (not normalized) of columns in triangles, and whether each is left of the opposite edge.

    All triangles of an edge evaluate it from its lower vertex and so agree bit for bit. A column exactly on the edge
    is moved by (e, e^2), e infinitely small (Edelsbrunner and Muecke's simulation of simplicity): then vertices too
    are on one side of everything.
    """
    weights, left = np.empty((len(x), 3)), np.empty((len(x), 3), dtype=bool)
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        swap = ids[:, a] > ids[:, b]
        start = np.where(swap[:, None], corners[:, b], corners[:, a])
        edge = np.where(swap[:, None], corners[:, a], corners[:, b]) - start
        value = edge[:, 0] * (y - start[:, 1]) - edge[:, 1] * (x - start[:, 0])
        moved = (edge[:, 1] < 0) | ((edge[:, 1] == 0) & (edge[:, 0] > 0))
        left[:, k] = np.where(value == 0, moved, value > 0) ^ swap
        weights[:, k] = np.where(swap, -value, value)
    return weights, left


def _covered_columns(
    corners: Float[np.ndarray, "f 3 2"], x: Float[np.ndarray, " nx"], y: Float[np.ndarray, " ny"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Pairs (triangle, column i, column j) whose column lies in the triangle's projected box."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    first_i, first_j = np.searchsorted(x, low[:, 0]), np.searchsorted(y, low[:, 1])
    count_i = np.searchsorted(x, high[:, 0], "right") - first_i
    count_j = np.searchsorted(y, high[:, 1], "right") - first_j
    pairs = count_i * count_j
    triangle = np.repeat(np.arange(len(corners)), pairs)
    number = np.arange(len(triangle)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    return triangle, first_i[triangle] + number // count_j[triangle], first_j[triangle] + number % count_j[triangle]
