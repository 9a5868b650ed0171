"""Samplers of training queries, the paper's, in any dimension (Henrich et al., WACV 2024, section 3.2).

Notation: k is the number of points kept on each side of a segment's surface, n >= k the number drawn on each side
before the k nearest are kept. "Inside" means in this segment; "empty" means in no segment.

SortSample is defined on single draws: draw until both sides hold n. Here draws come in batches, but the draw at which
both sides hold n ends the segment and later draws are dropped, and each segment has a random stream of its own. So the
result does not depend on the size of a batch: it is, bit for bit, that of drawing one point at a time.
"""

from collections.abc import Callable
from math import inf
from typing import NamedTuple, NoReturn, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from scipy.spatial import cKDTree

from mereo.geometry.transforms import Flags, Labels, Values
from mereo.synthesis.config import SamplingConfig

Places = Float[ndarray, "n d"]
"""Positions in rows, in space of any dimension."""

# --- labels -----------------------------------------------------------------------------------------------------------

# Where segments overlap, the first one owns the point (``Shape.label``): nested ones are declared, and the inner one
# comes first. ``owner_labels`` is the rule of the authors' later work, which needs no declaration.


@runtime_checkable
class Shape(Protocol):
    """Questions that a sampler asks of an object; ``geometry.solids.Solids`` answers them, as do polygons.

    Points are [n, d] in the object's frame, distances are in its units.
    """

    count: int
    """Number of segments."""

    nesting: tuple[tuple[int, int], ...]
    """Indices (inner, outer) of segments declared to lie one inside the other; the inner one comes first."""

    def boxes(self) -> Float[ndarray, "s 2 d"]:
        """Lower and upper corner of each segment's axis-aligned box."""

    def label(self, points: Places) -> Labels:
        """Label of each point: 0 in empty space, else index + 1 of the first segment that holds it."""

    def inside(self, index: int, points: Places) -> Flags:
        """Whether each point lies in segment ``index``."""

    def segment_distance(self, index: int, points: Places) -> Values:
        """Unsigned distance of each point to the surface of segment ``index``."""


def owner_labels(shape: Shape, points: Places) -> Labels:
    """Label of each point where solids may overlap, an organ inside an organ: the nearest surface's segment owns it.

    Only segments that hold the point compete. The nearest surface of all may belong to one that does not: just outside
    the innermost of three nested balls, it is the innermost ball's. Where one segment lies wholly inside another this
    is the inner one, as in ``Shape.label``: the way to the outer surface meets the inner one first.
    """
    holds = np.stack([shape.inside(index, points) for index in range(shape.count)])
    labels = np.where(holds.any(axis=0), holds.argmax(axis=0) + 1, 0).astype(np.uint8)
    shared = np.flatnonzero(holds.sum(axis=0) > 1)
    distance = np.full((shape.count, len(shared)), inf)
    for index in np.flatnonzero(holds[:, shared].any(axis=1)):
        mine = holds[index, shared]
        distance[index, mine] = shape.segment_distance(int(index), points[shared[mine]])
    if len(shared):
        labels[shared] = distance.argmin(axis=0) + 1
    return labels


# --- query sampling ---------------------------------------------------------------------------------------------------

MAX_DRAWS = 2_000_000
"""Number of draws for one segment after which sampling gives up: its share of its box is too small for it."""

_FIRST_BATCH = 8
_LARGEST_BATCH = 1 << 17
"""The first batch draws so many times n: a segment usually fills a tenth to a quarter of its extended box."""


class Samples(NamedTuple):
    """Query points with labels: segment by segment, inside before outside, then the uniform ones."""

    points: Places
    labels: Labels


Boxes = Float[ndarray, "s 2 d"]
Label = Callable[[Places], Labels]


def extended_boxes(shape: Shape, margin: float = 0.5) -> Boxes:
    """Box of each segment, extended by ``margin`` of its size, half on each side (the paper: 50 %)."""
    boxes = shape.boxes()
    reach = (boxes[:, 1] - boxes[:, 0]) * margin / 2
    return np.stack([boxes[:, 0] - reach, boxes[:, 1] + reach], axis=1)


def joint_box(shape: Shape) -> Float[ndarray, "2 d"]:
    """Box of all segments together, not extended: the paper's "joint boundaries of all segments"."""
    low, high = shape.boxes().swapaxes(0, 1)
    return np.stack([low.min(axis=0), high.max(axis=0)])


def volume_uniform(shape: Shape, count: int, rng: Generator, boxes: Boxes | None = None) -> Samples:
    """Volume Uniform samples: ``count`` points per segment, uniform in its draw box (extended), whatever they hit."""
    boxes = extended_boxes(shape) if boxes is None else boxes
    points = np.concatenate([_uniform(box, count, rng) for box in boxes])
    return Samples(points, shape.label(points))


def label_uniform(shape: Shape, keep: int, rng: Generator, boxes: Boxes | None = None) -> Samples:
    """Label Uniform samples: per segment, ``keep`` points uniform inside it and ``keep`` outside it in its draw box.

    Points outside may lie in other segments and carry their labels. Raises ``ValueError`` as ``sort_sample``.
    """
    draws = _draw_all(shape, boxes, keep, shape.label, others=True, rng=rng)
    return _join([(d, rows[:keep]) for d in draws for rows in d.sides()])


def sort_sample(shape: Shape, keep: int, draw: int, rng: Generator, boxes: Boxes | None = None) -> Samples:
    """SortSample: per segment, the ``keep`` points nearest to its surface inside it, and as many in empty space.

    Points are drawn uniformly in the segment's draw box until ``draw`` of them lie inside the segment and ``draw`` in
    empty space; those in other segments are dropped. Where segments overlap, the first one owns the point. A segment
    declared nested has no empty space around it: draws in those around it are its outside, with their labels.

    ``keep`` and ``draw`` are the paper's k and n; twice as many drawn as kept are closer to the surface. ``rng``
    advances by the same amount whatever is drawn. Raises ``ValueError`` where a side of a segment stays short of
    ``draw`` points after ``MAX_DRAWS`` draws.
    """
    return _sort(shape, keep, draw, shape.label, others=False, rng=rng, boxes=boxes)


def nested_sort_sample(shape: Shape, keep: int, draw: int, rng: Generator, boxes: Boxes | None = None) -> Samples:
    """NestedSortSample (the authors' later work): as ``sort_sample``, for organs inside organs.

    A draw in another segment counts as outside and keeps that segment's label; see ``owner_labels`` for overlaps.
    """
    return _sort(shape, keep, draw, lambda points: owner_labels(shape, points), others=True, rng=rng, boxes=boxes)


def sample_queries(shape: Shape, settings: SamplingConfig, rng: Generator) -> Samples:
    """Queries of one example: ``settings.sampler``'s, then uniform points in ``joint_box`` (paper, section 3.2).

    They are ``settings.total(shape.count)`` points. Raises ``ValueError`` where a segment cannot be sampled.
    """
    boxes = extended_boxes(shape, settings.box_margin)
    keep, draw = settings.per_segment // 2, settings.per_segment // 2 * settings.oversample
    near = {
        "volume-uniform": lambda: volume_uniform(shape, settings.per_segment, rng, boxes),
        "label-uniform": lambda: label_uniform(shape, keep, rng, boxes),
        "sort-sample": lambda: sort_sample(shape, keep, draw, rng, boxes),
        "nested-sort-sample": lambda: nested_sort_sample(shape, keep, draw, rng, boxes),
    }[settings.sampler]()
    spread = _uniform(joint_box(shape), settings.total(shape.count) - len(near.points), rng)
    nested = settings.sampler == "nested-sort-sample"
    labels = owner_labels(shape, spread) if nested else shape.label(spread)
    return Samples(np.concatenate([near.points, spread]), np.concatenate([near.labels, labels]))


class _Draws:
    """The draws for one segment, up to the one at which both sides hold ``need``."""

    def __init__(self, index: int, box: Float[ndarray, "2 d"], need: int, outside: ndarray, seed: ndarray):
        self.index, self.box, self.need, self.outside = index, box, need, outside
        self.rng = default_rng(seed)
        self.points = np.empty((0, box.shape[1]))
        self.labels = np.empty(0, np.uint8)
        self.fewest = 0

    def sides(self) -> tuple[ndarray, ndarray]:
        """Rows of the draws inside the segment and of those that count as outside, in drawing order."""
        return np.flatnonzero(self.labels == self.index + 1), np.flatnonzero(self.outside[self.labels])

    def next_batch(self) -> Float[ndarray, "b d"]:
        """About as many draws as are still missing, from the hit rate so far; at most four times those made."""
        drawn = len(self.points)
        size = _FIRST_BATCH * self.need
        if drawn:
            size = min(int(1.2 * (self.need - self.fewest) * drawn / (self.fewest + 1)) + 1, 4 * drawn)
        return _uniform(self.box, min(size, _LARGEST_BATCH, MAX_DRAWS - drawn), self.rng)

    def add(self, points: Float[ndarray, "b d"], labels: UInt8[ndarray, " b"]) -> bool:
        """Take a batch; True when the segment is done, and then drop what was drawn after its last draw."""
        self.points, self.labels = np.concatenate([self.points, points]), np.concatenate([self.labels, labels])
        inside, outside = self.sides()
        self.fewest = min(len(inside), len(outside))
        if self.fewest < self.need:
            if len(self.points) >= MAX_DRAWS:
                self._give_up(len(inside), len(outside))
            return False
        stop = max(inside[self.need - 1], outside[self.need - 1]) + 1
        self.points, self.labels = self.points[:stop], self.labels[:stop]
        return True

    def _give_up(self, inside: int, outside: int) -> NoReturn:
        hits = inside
        where = "inside it"
        cure = "check that it is closed and no earlier segment covers it, or split it into shorter parts"
        if inside >= self.need:
            hits = outside
            where = "outside it" if self.outside.sum() > 1 else "in the empty space around it"
            cure = "widen box_margin, or use nested-sort-sample for a segment enclosed by others"
        raise ValueError(
            f"segment {self.index} has {hits} of {MAX_DRAWS:,} draws {where}; {self.need} are needed: {cure}"
        )


def _draw_all(shape: Shape, boxes: Boxes | None, need: int, label: Label, others: bool, rng: Generator) -> list[_Draws]:
    """Draw for all segments at once: one large call of ``label`` per round, two to four rounds in all."""
    boxes = extended_boxes(shape) if boxes is None else boxes
    # a stream per segment: how many draws one segment's batches hold changes no other segment's points
    seeds = rng.integers(0, 2**32, size=(shape.count, 4), dtype=np.uint32)
    # which labels count as outside of each: empty space, what it is nested in, and maybe all others
    outside = np.full((shape.count, shape.count + 1), others)
    outside[:, 0] = True
    for inner, outer in shape.nesting:
        outside[inner, outer + 1] = True
    outside[np.arange(shape.count), np.arange(shape.count) + 1] = False
    draws = [_Draws(i, boxes[i], need, outside[i], seeds[i]) for i in range(shape.count)]
    pending = draws
    while pending:
        batches = [d.next_batch() for d in pending]
        ends = np.cumsum([len(batch) for batch in batches])[:-1]
        labels = np.split(label(np.concatenate(batches)), ends)
        pending = [d for d, b, part in zip(pending, batches, labels, strict=True) if not d.add(b, part)]
    return draws


def _sort(
    shape: Shape, keep: int, draw: int, label: Label, others: bool, rng: Generator, boxes: Boxes | None
) -> Samples:
    """Samples with the ``keep`` points on each side of every segment that are nearest to its surface."""
    if not 1 <= keep <= draw:
        raise ValueError(f"keep is {keep} and draw is {draw}; at least as many are drawn as kept: pass keep <= draw")
    draws = [(d, rows) for d in _draw_all(shape, boxes, draw, label, others, rng) for rows in d.sides()]
    return _join([(d, rows[_nearest_rows(shape, d.index, d.points[rows], keep)]) for d, rows in draws])


def _nearest_rows(shape: Shape, index: int, points: Places, keep: int) -> ndarray:
    """Rows of the ``keep`` points nearest to segment ``index``'s surface, in the order given; exact.

    Distances dominate data generation, so most are avoided: a point is no nearer to the surface than to its box, and a
    distance grows by at most the way travelled, so a point ``gap`` away from one of known distance is no nearer than
    that distance minus ``gap``. The points nearest to the box are measured first and the others in the order of their
    bound, until it exceeds the distance of the keep-th nearest.
    """
    if len(points) <= keep:
        return np.arange(len(points))
    low, high = shape.boxes()[index]
    to_box = norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    known = np.argsort(to_box, kind="stable")[: 2 * keep]
    distance = np.full(len(points), inf)
    distance[known] = shape.segment_distance(index, points[known])
    rest = np.flatnonzero(np.isinf(distance) & (to_box <= _keep_th(distance, keep)))
    if len(rest):
        gap, pivot = cKDTree(points[known]).query(points[rest])
        bound = np.maximum(distance[known][pivot] - gap, to_box[rest])
        rest = rest[np.argsort(bound)]
        bound = np.sort(bound)
    while len(rest):
        chunk = rest[: min(keep, int(np.searchsorted(bound, _keep_th(distance, keep))))]
        if len(chunk) == 0:
            break
        distance[chunk] = shape.segment_distance(index, points[chunk])
        rest, bound = rest[len(chunk) :], bound[len(chunk) :]
    return np.sort(np.argpartition(distance, keep - 1)[:keep])


def _keep_th(distance: Values, keep: int) -> float:
    return float(np.partition(distance, keep - 1)[keep - 1])


def _join(sides: list[tuple[_Draws, ndarray]]) -> Samples:
    points, labels = zip(*((draws.points[rows], draws.labels[rows]) for draws, rows in sides), strict=True)
    return Samples(np.concatenate(points), np.concatenate(labels))


def _uniform(box: Float[ndarray, "2 d"], count: int, rng: Generator) -> Places:
    low, high = box
    return low + rng.random((count, len(low))) * (high - low)
