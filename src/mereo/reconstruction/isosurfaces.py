"""Surfaces and labels of all segments from a field of class logits.

The surface of segment k is the zero level of its margin ``logit_k - max over j != k of logit_j``. Where two classes
meet, their margins are exact negatives of each other, so marching cubes gives both segments the same interface
vertices, below the size of a voxel. A segment with others nested in it has the surface of all of them together, as in
the model (``SegmentedMesh``). The field is evaluated coarse to fine (``mereo.reconstruction.isosurfaces``); every
cell that a surface crosses is known at all its corners, so the surfaces are those of the dense grid.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from mereo.geometry.conventions import GridShape
from mereo.geometry.labels import GridLabels, LabelGrid, VoxelMask, part_of_grid
from mereo.geometry.marching_cubes import CellFlags, changing_cells, nodes_of, on_both_sides, over_corners, zero_surface
from mereo.geometry.mesh import EMPTY_MESH, AnyMesh, Color, Nested, Segment, SegmentedMesh
from mereo.geometry.transforms import Corners, Points, Rows, Subset, Vector, longest_side

GridRows = Int[ndarray, "x y z"]
"""Row of the logits of each node."""

Logits = Float[ndarray, "m c"]
"""Logits in rows."""

# --- coarse to fine ---------------------------------------------------------------------------------------------------

# Every ``COARSE``-th node is evaluated; cells that may hold a change of label are halved until one step wide; all
# other nodes take the label of the cell they lie in. Which cells may hold one?
#
# - Those whose corners differ (``changing_cells``), and at the first level all cells around them.
# - Those where the lead of the winning class falls so steeply that it may vanish inside (``_sloping_cells``), except
#   next to a surface that is already known.
# - Then no evaluated node may contradict the label assumed next to it; where one does, that neighbour is evaluated too,
#   and so on (``_halve``). So a surface that is met anywhere is followed to its end.
#
# What can be missed is a part that lies between the nodes of the coarse lattice, touches no evaluated node, and casts
# no slope on its surroundings. The tests compare with the dense grid on closed forms and on trained networks.
#
# Notation: nodes are points of the grid, cells are the boxes between eight nodes; c classes; class 0 is empty space.

Field = Callable[[Points], Rows]
"""Function from points to their class logits."""

COARSE = 4
"""Nodes from one that is always evaluated to the next: every fourth, 1.6 % of the grid."""

REACH = 1.0
"""Trust in slopes to go on; larger values refine more cells that hold no change of label."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """Field on a grid: labels, and logits where it was evaluated.

    Attributes:
        labels: the class of the largest logit; the lowest one of equals.
        rows: the row of ``logits`` that belongs to a node, or -1 where the label follows from the cell.
        logits: of the evaluated nodes.
    """

    labels: GridLabels
    rows: GridRows
    logits: Logits


class _Evaluator:
    """Field at nodes of the finest grid; keeps every answer."""

    def __init__(self, field: Field, origin: Vector, spacing: Vector) -> None:
        self.field, self.origin, self.spacing = field, origin, spacing
        self.chunks = list[Logits]()
        self.count = 0

    def __call__(self, index: Int[ndarray, "m 3"]) -> tuple[UInt8[ndarray, " m"], Subset]:
        """Labels and rows of nodes."""
        logits = self.field(self.origin + index * self.spacing)
        rows = np.arange(self.count, self.count + len(index), dtype=np.int32)
        self.chunks.append(logits)
        self.count += len(index)
        return logits.argmax(axis=1).astype(np.uint8), rows

    def logits(self) -> Logits:
        """All answers so far, in the order of their rows."""
        return np.concatenate(self.chunks)


def sample_dense(field: Field, origin: Vector, spacing: Vector, shape: GridShape) -> Sampled:
    """Field evaluated at every node ``origin + [i, j, k] * spacing``."""
    evaluate = _Evaluator(field, origin, spacing)
    labels, rows = evaluate(_all_nodes(shape))
    return Sampled(labels.reshape(shape), rows.reshape(shape), evaluate.logits())


def sample_coarse_to_fine(field: Field, origin: Vector, spacing: Vector, shape: GridShape) -> Sampled:
    """Labels of ``sample_dense`` from few evaluations; every cell with a change of label is known exactly."""
    evaluate = _Evaluator(field, origin, spacing)
    # whole coarse cells: up to three nodes beyond the grid are evaluated too and cut off at the end
    cells = [-(-(nodes - 1) // COARSE) for nodes in shape]
    lattice = (cells[0] + 1, cells[1] + 1, cells[2] + 1)
    labels, rows = evaluate(COARSE * _all_nodes(lattice))
    labels = labels.reshape(lattice)
    rows = rows.reshape(lattice)
    step = COARSE
    while step > 1:
        changing = changing_cells(labels)
        sloping = _sloping_cells(rows, evaluate.logits())
        if step == COARSE:
            active = _over_neighbors(changing | sloping, np.logical_or)
        else:  # next to a surface that is known the lead is small because of it, and `_halve` watches there
            active = changing | (sloping & ~_over_neighbors(changing, np.logical_or))
        step //= 2
        labels, rows = _halve(labels, rows, active, step, evaluate)
    inside = tuple(slice(0, nodes) for nodes in shape)
    return Sampled(labels[inside], rows[inside], evaluate.logits())


def _all_nodes(shape: GridShape) -> Int[ndarray, "n 3"]:
    return np.indices(shape).reshape(3, -1).T


def _sloping_cells(rows: GridRows, logits: Logits) -> CellFlags:
    """Cells in which the lead of the winning class, falling on as between evaluated nodes, could vanish half way.

    For a field of signed distances this finds every cell that a surface passes, also of a ball between the nodes.
    """
    lead = np.full(rows.shape, np.nan, logits.dtype)
    known = rows >= 0
    best = np.partition(logits[rows[known]], -2, axis=1)
    lead[known] = best[:, -1] - best[:, -2]
    change = np.zeros_like(lead)
    for axis in range(3):
        steps = np.nan_to_num(np.abs(np.diff(lead, axis=axis)))
        change += on_both_sides(steps, axis, np.maximum)
    # NaN compares as False: a cell all of whose corners were skipped stays as it is
    return over_corners(lead <= REACH * 0.5 * change, np.logical_or)


def _halve(
    labels: GridLabels,
    rows: GridRows,
    active: CellFlags,
    step: int,
    evaluate: _Evaluator,
) -> tuple[UInt8[ndarray, "u v w"], Int[ndarray, "u v w"]]:
    """Labels and rows of the next lattice, ``step`` fine nodes apart.

    Active cells are evaluated, others filled with their corners' label. Then every skipped node next to one of another
    label is evaluated, until none is left: so no evaluated node contradicts the label assumed next to it, and a surface
    once met is followed to its end.
    """
    shape = tuple(2 * n - 1 for n in labels.shape)
    # a node between coarse nodes takes the one below: all corners of a cell that is not active agree
    fine_labels = labels[np.ix_(*(np.arange(n) // 2 for n in shape))]
    fine_rows = np.full(shape, -1, np.int32)
    fine_rows[::2, ::2, ::2] = rows
    halves = active.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    wanted = np.argwhere(nodes_of(halves) & (fine_rows < 0))
    while len(wanted):
        place = tuple(wanted.T)
        fine_labels[place], fine_rows[place] = evaluate(step * wanted)
        low = np.maximum(wanted.min(axis=0) - 1, 0)
        high = wanted.max(axis=0) + 2
        part = part_of_grid(low, high)
        wanted = low + np.argwhere(_contradicted(fine_labels[part], fine_rows[part] < 0, wanted - low))
    return fine_labels, fine_rows


def _contradicted(labels: GridLabels, skipped: VoxelMask, news: Int[ndarray, "m 3"]) -> VoxelMask:
    """Skipped nodes that touch one of the nodes ``news`` with another label.

    The largest and smallest label among those it touches tell: two passes of bytes instead of 26 lists of indices.
    """
    place = tuple(news.T)
    largest = np.zeros_like(labels)
    smallest = np.full_like(labels, 255)
    largest[place] = smallest[place] = labels[place]
    largest, smallest = _over_neighbors(largest, np.maximum), _over_neighbors(smallest, np.minimum)
    return skipped & ((largest > labels) | (smallest < labels))


def _over_neighbors(values: ndarray, combine: np.ufunc) -> ndarray:
    """Values of each node or cell and the 26 around it, joined by ``combine``."""
    for axis in range(3):
        grown = values.copy()
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        for to, source in ((tuple(low), tuple(high)), (tuple(high), tuple(low))):
            combine(grown[to], values[source], out=grown[to])
        values = grown
    return values


# --- isosurfaces ------------------------------------------------------------------------------------------------------

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
        evaluated: number of points at which the field was evaluated.
    """

    surfaces: SegmentedMesh
    grid: LabelGrid
    evaluated: int


def extract(
    field: Field,
    box: Corners,
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
    empty = SegmentedMesh(tuple(Segment(*named, *EMPTY_MESH) for named in zip(names, colors, strict=True)), nested)
    surfaces = [
        _surface(sampled, grid, [index + 1, *(inner + 1 for inner, outer in empty.nesting if outer == index)])
        for index in range(len(names))
    ]
    segments = (replace(s, vertices=v, faces=f) for s, (v, f) in zip(empty.segments, surfaces, strict=True))
    return Extraction(replace(empty, segments=tuple(segments)), grid, len(sampled.logits))


def _grid(box: Corners, resolution: int) -> tuple[Vector, Vector, GridShape]:
    """Origin, spacing and number of nodes of a grid, which may end up to one cell behind the box."""
    size = box[1] - box[0]
    if resolution < 4:
        raise ValueError(f"the resolution is {resolution}; at least 4 cells are needed: 64 to 256 are usual")
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise ValueError(f"the box has sides {size.tolist()}; all must be positive and finite: check the point cloud")
    step = float(size.max()) / resolution
    x, y, z = (int(n) + 1 for n in np.ceil(size / step - 1e-6))
    check_nodes(resolution, x, y, z)
    return box[0].astype(float), np.full(3, step), (x, y, z)


def check_nodes(resolution: int, x: int, y: int, z: int) -> None:
    """Raise ``ValueError`` for a grid with more than ``MAX_NODES`` nodes."""
    if x * y * z > MAX_NODES:
        raise ValueError(
            f"resolution {resolution} makes a grid of {x} x {y} x {z} nodes; at most {MAX_NODES} fit: lower it"
        )


def locate(field: Field, box: Corners) -> Corners:
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
    _check_occupied(grid)
    occupied = np.argwhere(grid.labels > 0)
    low, high = grid.positions(occupied.min(axis=0) - 2), grid.positions(occupied.max(axis=0) + 2)
    return np.stack([np.maximum(low, box[0]), np.minimum(high, box[1])])


def extract_whole(
    field: Field,
    box: Corners,
    resolution: int,
    names: Sequence[str],
    colors: Sequence[Color],
    nested: Nested = (),
) -> Extraction:
    """Surfaces and labels of a field as ``extract`` finds them, in a box that grows where a segment touches it.

    It grows at most ``GROWTHS`` times. Raises ``ValueError`` where the field knows only empty space.
    """
    extraction = extract(field, box, resolution, names, colors, nested)
    for _ in range(GROWTHS):
        touched = extraction.grid.touched_sides()
        if not touched.any():
            break
        box = _grown(box, touched, 0.1)
        extraction = extract(field, box, resolution, names, colors, nested)
    _check_occupied(extraction.grid)
    return extraction


def _check_occupied(grid: LabelGrid) -> None:
    if not grid.labels.any():
        raise ValueError(
            "the model finds no segment near the cloud, only empty space; the cloud must show the object it was "
            "trained on: check the weights, the mask, and the cloud's frame (x right, y down, z forward)"
        )


def _grown(box: Corners, sides: Bool[ndarray, "2 3"], fraction: float) -> Corners:
    step = fraction * longest_side(box)
    return box + step * sides * np.array([[-1.0], [1.0]])


def _surface(sampled: Sampled, grid: LabelGrid, held: list[int]) -> AnyMesh:
    """Vertices and faces around ``held``, a label and those nested in it; none where the first does not occur."""
    if not (sampled.labels == held[0]).any():
        return EMPTY_MESH
    occupied = np.argwhere(np.isin(sampled.labels, held))
    low = np.maximum(occupied.min(axis=0) - 1, 0)
    part = tuple(slice(a, b) for a, b in zip(low, occupied.max(axis=0) + 2, strict=True))
    margin = np.pad(_margin(sampled.labels[part], sampled.rows[part], sampled.logits, held), 1, mode="edge")
    # one empty layer around, as far below zero as its neighbour is above: the surface closes half a voxel outside
    core = (slice(1, -1),) * 3
    closed = -np.abs(margin)
    closed[core] = margin[core]
    vertices, faces = zero_surface(closed)
    return grid.origin + (vertices - 1 + low) * grid.spacing, faces


def _margin(
    labels: GridLabels,
    rows: GridRows,
    logits: Logits,
    held: list[int],
) -> Float[ndarray, "x y z"]:
    """Margin at each node: the largest logit of ``held`` less that of the others, its sign by the label.

    Where nothing was evaluated only the sign counts. A tie would put a vertex on a node, and marching cubes would make
    faces without area there; so ties are moved by a millionth.
    """
    known = rows >= 0
    values = logits[rows[known]].astype(float)
    largest = values[:, held].max(axis=1)
    values[:, held] = -np.inf
    margin = np.where(np.isin(labels, held), 1.0, -1.0)
    sign = margin[known]
    least = 1e-6 * np.abs(largest).max(initial=1e-6)
    margin[known] = sign * np.maximum(sign * (largest - values.max(axis=1)), least)
    return margin
