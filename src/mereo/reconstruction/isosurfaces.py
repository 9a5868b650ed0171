"""Surfaces and labels of all segments from a field of class logits.

The surface of segment k is the zero level of its margin ``logit_k - max over j != k of logit_j``. Where two classes
meet, their margins are exact negatives of each other, so marching cubes gives both segments the same interface
vertices, below the size of a voxel. A segment with others nested in it has the surface of all of them together, as in
the model (``SegmentedMesh``). The field is evaluated coarse to fine (``mereo.reconstruction.coarse_to_fine``); every
cell that a surface crosses is known at all its corners, so the surfaces are those of the dense grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from skimage.measure import marching_cubes

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color, Segment, SegmentedMesh
from mereo.reconstruction.coarse_to_fine import Field, Sampled, sample_coarse_to_fine, sample_dense

Nested = tuple[tuple[str, str], ...]
"""Pairs of names (inner, outer), see ``SegmentedMesh``."""

MAX_NODES = 80_000_000
"""Nodes that a grid may have."""

LOCATE_CELLS = 48
"""Number of cells along the longest side while the object is being located."""

GROWTHS = 6
"""Times that a box may grow."""


@dataclass(frozen=True, eq=False)
class Extraction:
    """Surfaces and labels that a field holds.

    Attributes:
        surfaces: every segment as a closed mesh, in the order of the names; without faces where it does not occur.
        grid: the labels.
        evaluated: number of points at which the field was asked.
    """

    surfaces: SegmentedMesh
    grid: LabelGrid
    evaluated: int


def extract(
    field: Field,
    box: Float[np.ndarray, "2 3"],
    resolution: int,
    names: Sequence[str],
    colors: Sequence[Color],
    nested: Nested = (),
    *,
    dense: bool = False,
) -> Extraction:
    """Surfaces and labels of a field, evaluated only where labels may change.

    Args:
        field: logits of empty space and of each segment, in this order.
        box: lower and upper corner of the region; a segment that leaves it is closed half a voxel outside.
        resolution: cells along the longest side; voxels are cubes.
        names: of the segments.
        colors: of the segments.
        nested: which of them lie inside another; the outer one's surface is then that of both together.
        dense: evaluate the field at every node, many times slower: the reference.

    Raises ``ValueError`` for a resolution below 4, an empty box, or a grid over ``MAX_NODES`` nodes.
    """
    origin, spacing, shape = _grid(box, resolution)
    sampled = (sample_dense if dense else sample_coarse_to_fine)(field, origin, spacing, shape)
    grid = LabelGrid(sampled.labels, origin, spacing, tuple(names))
    nothing = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    empty = SegmentedMesh(tuple(Segment(*named, *nothing) for named in zip(names, colors, strict=True)), nested)
    surfaces = [
        _surface(sampled, grid, [index + 1, *(inner + 1 for inner, outer in empty.nesting if outer == index)])
        for index in range(len(names))
    ]
    found = (replace(s, vertices=v, faces=f) for s, (v, f) in zip(empty.segments, surfaces, strict=True))
    return Extraction(replace(empty, segments=tuple(found)), grid, len(sampled.logits))


def _grid(
    box: Float[np.ndarray, "2 3"], resolution: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], tuple[int, int, int]]:
    """Origin, spacing and number of nodes of a grid, which may end up to one cell behind the box."""
    size = box[1] - box[0]
    if resolution < 4:
        raise ValueError(f"the resolution is {resolution}; at least 4 cells are needed: 64 to 256 are usual")
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise ValueError(f"the box has sides {size.tolist()}; all must be positive and finite: check the point cloud")
    step = float(size.max()) / resolution
    x, y, z = (int(n) + 1 for n in np.ceil(size / step - 1e-6))
    if x * y * z > MAX_NODES:
        raise ValueError(
            f"resolution {resolution} makes a grid of {x} x {y} x {z} nodes; at most {MAX_NODES} fit: lower it"
        )
    return box[0].astype(np.float64), np.full(3, step), (x, y, z)


def locate(field: Field, box: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Box of all segments, with a margin of two coarse voxels, found on a coarse grid.

    ``box`` is where to look first; a side that a segment touches moves out by a quarter of the box, ``GROWTHS`` times
    at most, because the hidden part may reach far. Raises ``ValueError`` where the field knows only empty space.
    """
    for _ in range(GROWTHS):
        origin, spacing, shape = _grid(box, LOCATE_CELLS)
        grid = LabelGrid(sample_coarse_to_fine(field, origin, spacing, shape).labels, origin, spacing, ())
        touched = grid.touched_sides()
        if not touched.any():
            break
        box = _grown(box, touched, 0.25)
    _check_found(grid)
    occupied = np.argwhere(grid.labels > 0)
    low, high = grid.positions(occupied.min(axis=0) - 2), grid.positions(occupied.max(axis=0) + 2)
    return np.stack([np.maximum(low, box[0]), np.minimum(high, box[1])])


def extract_whole(
    field: Field,
    box: Float[np.ndarray, "2 3"],
    resolution: int,
    names: Sequence[str],
    colors: Sequence[Color],
    nested: Nested = (),
) -> Extraction:
    """Surfaces and labels of a field as ``extract`` finds them, in a box that grows where a segment touches it.

    It grows at most ``GROWTHS`` times. Raises ``ValueError`` where the field knows only empty space.
    """
    found = extract(field, box, resolution, names, colors, nested)
    for _ in range(GROWTHS):
        touched = found.grid.touched_sides()
        if not touched.any():
            break
        box = _grown(box, touched, 0.1)
        found = extract(field, box, resolution, names, colors, nested)
    _check_found(found.grid)
    return found


def _check_found(grid: LabelGrid) -> None:
    if not grid.labels.any():
        raise ValueError(
            "the model finds no segment near the cloud, only empty space; the cloud must show the object it was "
            "trained on: check the weights, the mask, and the cloud's frame (x right, y down, z forward)"
        )


def _grown(box: Float[np.ndarray, "2 3"], sides: Bool[np.ndarray, "2 3"], fraction: float) -> Float[np.ndarray, "2 3"]:
    step = fraction * float((box[1] - box[0]).max())
    return box + step * sides * np.array([[-1.0], [1.0]])


def _surface(
    sampled: Sampled, grid: LabelGrid, held: list[int]
) -> tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]:
    """Vertices and faces around ``held``, a label and those nested in it; none where the first does not occur."""
    if not (sampled.labels == held[0]).any():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    occupied = np.argwhere(np.isin(sampled.labels, held))
    low = np.maximum(occupied.min(axis=0) - 1, 0)
    part = tuple(slice(a, b) for a, b in zip(low, occupied.max(axis=0) + 2, strict=True))
    margin = np.pad(_margin(sampled.labels[part], sampled.rows[part], sampled.logits, held), 1, mode="edge")
    # one empty layer around, as far below zero as its neighbour is above: the surface closes half a voxel outside
    core = (slice(1, -1),) * 3
    closed = -np.abs(margin)
    closed[core] = margin[core]
    vertices, faces, _, _ = marching_cubes(closed, 0.0, gradient_direction="ascent")
    positions = grid.origin + (vertices.astype(np.float64) - 1 + low) * grid.spacing
    return positions, faces.astype(np.int64)


def _margin(
    labels: UInt8[np.ndarray, "x y z"],
    rows: Int[np.ndarray, "x y z"],
    logits: Float[np.ndarray, "m c"],
    held: list[int],
) -> Float[np.ndarray, "x y z"]:
    """Margin at each node: the largest logit of ``held`` less that of the others, its sign by the label.

    Where nothing was evaluated only the sign counts. A tie would put a vertex on a node, and marching cubes would make
    faces without area there; so ties are moved by a millionth.
    """
    known = rows >= 0
    values = logits[rows[known]].astype(np.float64)
    own = values[:, held].max(axis=1)
    values[:, held] = -np.inf
    margin = np.where(np.isin(labels, held), 1.0, -1.0)
    sign = margin[known]
    least = 1e-6 * np.abs(own).max(initial=1e-6)
    margin[known] = sign * np.maximum(sign * (own - values.max(axis=1)), least)
    return margin
