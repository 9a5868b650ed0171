"""Labels of a field on a dense grid, from evaluations coarse to fine: the same at a fraction of the cost.

Every ``COARSE``-th node is evaluated; cells that may hold a change of label are halved until one step wide; all
other nodes take the label of the cell they lie in. Which cells may hold one?

- Those whose corners differ (``changing_cells``), and at the first level all cells around them.
- Those where the lead of the winning class falls so steeply that it may vanish inside (``_sloping_cells``), except
  beside a surface that is already known.
- Then no evaluated node may contradict the label assumed beside it; where one does, that neighbour is evaluated too,
  and so on (``_halve``). So a surface that is met anywhere is followed to its end.

What can be missed is a part that lies between the nodes of the coarse lattice, touches no evaluated node, and casts no
slope on its surroundings. The tests compare with the dense grid on closed forms and on trained networks.

Notation: nodes are points of the grid, cells are the boxes between eight nodes; c classes; class 0 is empty space.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

Field = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n c"]]
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

    labels: UInt8[np.ndarray, "x y z"]
    rows: Int[np.ndarray, "x y z"]
    logits: Float[np.ndarray, "m c"]


class _Evaluator:
    """Field at nodes of the finest grid; keeps every answer."""

    def __init__(self, field: Field, origin: Float[np.ndarray, "3"], spacing: Float[np.ndarray, "3"]) -> None:
        self.field, self.origin, self.spacing = field, origin, spacing
        self.chunks: list[Float[np.ndarray, "m c"]] = []
        self.count = 0

    def __call__(self, index: Int[np.ndarray, "m 3"]) -> tuple[UInt8[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Labels and rows of nodes."""
        logits = self.field(self.origin + index * self.spacing)
        rows = np.arange(self.count, self.count + len(index), dtype=np.int32)
        self.chunks.append(logits)
        self.count += len(index)
        return logits.argmax(axis=1).astype(np.uint8), rows

    def logits(self) -> Float[np.ndarray, "m c"]:
        """All answers so far, in the order of their rows."""
        return np.concatenate(self.chunks)


def sample_dense(
    field: Field, origin: Float[np.ndarray, "3"], spacing: Float[np.ndarray, "3"], shape: tuple[int, int, int]
) -> Sampled:
    """Field evaluated at every node ``origin + [i, j, k] * spacing``."""
    evaluate = _Evaluator(field, origin, spacing)
    labels, rows = evaluate(_all_nodes(shape))
    return Sampled(labels.reshape(shape), rows.reshape(shape), evaluate.logits())


def sample_coarse_to_fine(
    field: Field, origin: Float[np.ndarray, "3"], spacing: Float[np.ndarray, "3"], shape: tuple[int, int, int]
) -> Sampled:
    """Labels of ``sample_dense`` from few evaluations; every cell with a change of label is known exactly."""
    evaluate = _Evaluator(field, origin, spacing)
    # whole coarse cells: up to three nodes beyond the grid are evaluated too and cut off at the end
    cells = [-(-(nodes - 1) // COARSE) for nodes in shape]
    lattice = (cells[0] + 1, cells[1] + 1, cells[2] + 1)
    labels, rows = evaluate(COARSE * _all_nodes(lattice))
    labels, rows = labels.reshape(lattice), rows.reshape(lattice)
    step = COARSE
    while step > 1:
        changing, sloping = changing_cells(labels), _sloping_cells(rows, evaluate.logits())
        if step == COARSE:
            active = _over_neighbors(changing | sloping, np.logical_or)
        else:  # beside a surface that is known the lead is small because of it, and `_halve` watches there
            active = changing | (sloping & ~_over_neighbors(changing, np.logical_or))
        step //= 2
        labels, rows = _halve(labels, rows, active, step, evaluate)
    inside = tuple(slice(0, nodes) for nodes in shape)
    return Sampled(labels[inside], rows[inside], evaluate.logits())


def _all_nodes(shape: tuple[int, int, int]) -> Int[np.ndarray, "n 3"]:
    return np.indices(shape).reshape(3, -1).T


def changing_cells(labels: UInt8[np.ndarray, "x y z"]) -> Bool[np.ndarray, "i j k"]:
    """Cells whose eight corners do not all have one label."""
    return over_corners(labels, np.maximum) != over_corners(labels, np.minimum)


def _sloping_cells(rows: Int[np.ndarray, "x y z"], logits: Float[np.ndarray, "m c"]) -> Bool[np.ndarray, "i j k"]:
    """Cells in which the lead of the winning class, falling on as between evaluated nodes, could vanish half way.

    For a field of signed distances this finds every cell that a surface passes, also of a ball between the nodes.
    """
    lead = np.full(rows.shape, np.nan, dtype=logits.dtype)
    known = rows >= 0
    best = np.partition(logits[rows[known]], -2, axis=1)
    lead[known] = best[:, -1] - best[:, -2]
    change = np.zeros_like(lead)
    for axis in range(3):
        steps = np.nan_to_num(np.abs(np.diff(lead, axis=axis)))
        before, after = [(0, 0)] * 3, [(0, 0)] * 3
        before[axis], after[axis] = (1, 0), (0, 1)
        change += np.maximum(np.pad(steps, before), np.pad(steps, after))
    # NaN compares as False: a cell all of whose corners were skipped stays as it is
    return over_corners(lead <= REACH * 0.5 * change, np.logical_or)


def over_corners(values: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Values of each cell's eight corners, joined by ``combine``."""
    for axis in range(3):
        count = values.shape[axis]
        values = combine(
            np.take(values, np.arange(count - 1), axis=axis), np.take(values, np.arange(1, count), axis=axis)
        )
    return values


def _halve(
    labels: UInt8[np.ndarray, "x y z"],
    rows: Int[np.ndarray, "x y z"],
    active: Bool[np.ndarray, "i j k"],
    step: int,
    evaluate: _Evaluator,
) -> tuple[UInt8[np.ndarray, "u v w"], Int[np.ndarray, "u v w"]]:
    """Labels and rows of the next lattice, ``step`` fine nodes apart.

    Active cells are evaluated, others filled with their corners' label. Then every skipped node beside one of another
    label is evaluated, until none is left: so no evaluated node contradicts the label assumed beside it, and a surface
    once met is followed to its end.
    """
    shape = tuple(2 * n - 1 for n in labels.shape)
    # a node between coarse nodes takes the one below: all corners of a cell that is not active agree
    fine_labels = labels[np.ix_(*(np.arange(n) // 2 for n in shape))]
    fine_rows = np.full(shape, -1, dtype=np.int32)
    fine_rows[::2, ::2, ::2] = rows
    wanted = np.argwhere(_nodes_of(active) & (fine_rows < 0))
    while len(wanted):
        place = tuple(wanted.T)
        fine_labels[place], fine_rows[place] = evaluate(step * wanted)
        low, high = np.maximum(wanted.min(axis=0) - 1, 0), wanted.max(axis=0) + 2
        part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        wanted = low + np.argwhere(_contradicted(fine_labels[part], fine_rows[part] < 0, wanted - low))
    return fine_labels, fine_rows


def _nodes_of(cells: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "u v w"]:
    """Nodes of the lattice half as wide that lie in or on these cells."""
    for axis in range(3):
        doubled = np.repeat(cells, 2, axis=axis)
        before, after = [(0, 0)] * 3, [(0, 0)] * 3
        before[axis], after[axis] = (1, 0), (0, 1)
        cells = np.pad(doubled, after) | np.pad(doubled, before)
    return cells


def _contradicted(
    labels: UInt8[np.ndarray, "x y z"], skipped: Bool[np.ndarray, "x y z"], news: Int[np.ndarray, "m 3"]
) -> Bool[np.ndarray, "x y z"]:
    """Skipped nodes that touch one of the nodes ``news`` with another label.

    The largest and smallest label among those it touches tell: two passes of bytes instead of 26 lists of indices.
    """
    place = tuple(news.T)
    largest, smallest = np.zeros_like(labels), np.full_like(labels, 255)
    largest[place] = smallest[place] = labels[place]
    largest, smallest = _over_neighbors(largest, np.maximum), _over_neighbors(smallest, np.minimum)
    found: np.ndarray = skipped & ((largest > labels) | (smallest < labels))
    return found


def _over_neighbors(values: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Values of each node or cell and the 26 around it, joined by ``combine``."""
    for axis in range(3):
        grown = values.copy()
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        for to, source in ((tuple(low), tuple(high)), (tuple(high), tuple(low))):
            combine(grown[to], values[source], out=grown[to])
        values = grown
    return values
