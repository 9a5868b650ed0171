"""Surfaces where a field on a grid is zero: marching cubes by libigl's cases, alike for a field and its negative."""

from functools import cache

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mereo.geometry.conventions import WholeNumbers
from mereo.geometry.labels import VoxelMask
from mereo.geometry.mesh import AnyFaces
from mereo.geometry.transforms import Flags, Points

CellFlags = Bool[ndarray, "i j k"]
"""Whether each cell between nodes is meant."""

CORNERS = np.array([[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 1], [1, 1, 1], [1, 0, 1]])
"""Of a cell, in the order in which libigl gives faces that face where the field is negative."""

FAR_SIDES = ((2, 3, 7, 6), (1, 2, 6, 5), (4, 5, 6, 7))
"""Corners around the far side of a cell along each axis."""


@cache
def cases() -> Int[ndarray, "256 f 3 3"]:
    """Corners of the faces in a cell, in half cells, or -1 where there are fewer than five, by libigl.

    Bit k of a case says whether the field is positive at corner k.
    """
    faces = np.full((256, 5, 3, 3), -1)
    for case in range(1, 255):
        values = np.where(case >> np.arange(8) & 1, 1.0, -1.0)
        middles, rows, _ = igl.marching_cubes(values, CORNERS.astype(float), np.arange(8)[None], 0.0)
        faces[case, : len(rows)] = 2 * middles[rows]
    return faces


def over_corners(values: ndarray, combine: np.ufunc) -> ndarray:
    """Values of each cell's eight corners, joined by ``combine``."""
    for axis in range(3):
        count = values.shape[axis]
        values = combine(
            np.take(values, np.arange(count - 1), axis=axis), np.take(values, np.arange(1, count), axis=axis)
        )
    return values


def changing_cells(values: ndarray) -> CellFlags:
    """Cells whose eight corners do not all have one value."""
    return over_corners(values, np.maximum) != over_corners(values, np.minimum)


def on_both_sides(values: ndarray, axis: int, combine: np.ufunc) -> ndarray:
    """Values that lie between nodes along an axis, at the nodes: those of both sides joined by ``combine``."""
    before, after = [(0, 0)] * 3, [(0, 0)] * 3
    before[axis], after[axis] = (1, 0), (0, 1)
    return combine(np.pad(values, before), np.pad(values, after))


def nodes_of(cells: CellFlags) -> VoxelMask:
    """Nodes that are corners of these cells."""
    for axis in range(3):
        cells = on_both_sides(cells, axis, np.logical_or)
    return cells


def zero_surface(field: Float[ndarray, "x y z"]) -> tuple[Points, AnyFaces]:
    """Vertices, in steps of the grid, and faces of the surface where a field is 0; they face where it is negative."""
    inside = field > 0
    doubled = tuple(2 * size for size in field.shape)
    cells = np.argwhere(changing_cells(inside))
    positive = inside[tuple(np.moveaxis(cells[:, None] + CORNERS, 2, 0))]
    turned = _turned(cells, positive, field.shape)
    faces = cases()[(positive ^ turned[:, None]) @ (1 << np.arange(8))]
    cell, face = np.nonzero(faces[:, :, 0, 0] >= 0)
    corners = 2 * cells[cell, None] + faces[cell, face]
    corners = np.where(turned[cell, None, None], corners[:, ::-1], corners)
    edges, rows = np.unique(np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), doubled), return_inverse=True)
    middle = np.stack(np.unravel_index(edges, doubled), axis=1)
    low, high = (field[tuple(node.T // 2)].astype(float) for node in (middle, middle + 1))
    return middle // 2 + middle % 2 * (low / (low - high))[:, None], rows.reshape(-1, 3)


def _turned(cells: Int[ndarray, "c 3"], positive: Bool[ndarray, "c 8"], shape: WholeNumbers) -> Flags:
    """Whether each cell is taken for its negative, which cuts corners off where this joins them.

    Where two cells share a side on which opposite corners are alike, both are; else the surface would be open there.
    So are all cells that hang together in this way, by the sign at the first of them.
    """
    row_of = np.zeros(shape, np.int64)
    row_of[tuple(cells.T)] = np.arange(len(cells))
    links = list[ndarray]()
    for step, side in zip(np.eye(3, dtype=int), FAR_SIDES, strict=True):
        a, b, c, d = positive[:, side].T
        rows = np.flatnonzero((a == c) & (b == d) & (a != b))
        links.append(np.stack([rows, row_of[tuple((cells[rows] + step).T)]]))
    near, far = np.concatenate(links, axis=1)
    graph = csr_array((np.ones(len(near)), (near, far)), shape=(len(cells), len(cells)))
    group = connected_components(graph, directed=False)[1]
    return positive[np.unique(group, return_index=True)[1][group], 0]
