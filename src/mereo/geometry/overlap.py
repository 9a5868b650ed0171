"""Volume that segments share, measured on a grid over the smaller one."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import label_grid

TOLERANCE = 1e-3
"""Share of a segment's volume that may lie in another one, or of a nested one's outside of its outer one."""

CELLS = 40
"""Along each side of a segment's box, where meshes may have holes: fast also for these."""


@dataclass(frozen=True)
class Overlap:
    """Volume that two segments share without being declared nested, or that a nested one has outside.

    Attributes:
        small, large: names; the smaller one, or the inner one, first.
        share: of the smaller segment's volume.
        nested: whether the pair is declared nested; then ``share`` lies outside of the outer one.
    """

    small: str
    large: str
    share: float
    nested: bool = False

    def __str__(self) -> str:
        if self.nested:
            return f"{self.small} is nested in {self.large}, but {self.share:.2%} of it lies outside"
        return f"{self.small} and {self.large} overlap in {self.share:.2%} of {self.small}"


def overlaps(mesh: SegmentedMesh, tolerance: float = TOLERANCE, cells: int = CELLS) -> tuple[Overlap, ...]:
    """Pairs of segments that share more than ``tolerance`` of the smaller one, or nest with as much outside.

    Segments that touch share no volume. Segments may be no solids, so their boxes say which of two is smaller.

    Args:
        mesh: any unit.
        tolerance: share of a segment's volume, from 0 to 1.
        cells: of the grid along each side of a segment's box.
    """
    return tuple(found for found in _pairs(mesh, cells) if found.share > tolerance)


def _pairs(mesh: SegmentedMesh, cells: int) -> Iterator[Overlap]:
    """Every two segments, smaller ones first."""
    nesting = set(mesh.nesting)
    order = sorted(range(len(mesh.segments)), key=lambda index: _box_volume(mesh.segments[index]))
    grids = {index: _Filled(mesh.segments[index], cells) for index in order}
    for small, large in combinations(order, 2):
        first, second = sorted((small, large))
        nested = (first, second) in nesting
        inner, outer = (first, second) if nested else (small, large)
        share = grids[inner].share_in(mesh.segments[outer])
        yield Overlap(mesh.names[inner], mesh.names[outer], 1.0 - share if nested else share, nested)


def _box_volume(segment: Segment) -> float:
    return float(np.prod(segment.bounds[1] - segment.bounds[0]))


def grid_volume(segment: Segment, cells: int = CELLS) -> float:
    """Volume inside a mesh, also of one with holes, measured on a grid: within a percent or so."""
    return _Filled(segment, cells).volume


class _Filled:
    """A segment as the filled cells of a grid over its box."""

    def __init__(self, segment: Segment, cells: int) -> None:
        low, high = segment.bounds
        self.box = segment.bounds
        self.axes = [low[k] + (np.arange(cells) + 0.5) * (high[k] - low[k]) / cells for k in range(3)]
        self.filled = label_grid(SegmentedMesh((segment,)), *self.axes) > 0
        self.volume = int(self.filled.sum()) * float(np.prod((high - low) / cells))

    def share_in(self, other: Segment) -> float:
        """How much of the filled volume lies in another segment, from 0 to 1."""
        if (other.bounds[1] <= self.box[0]).any() or (other.bounds[0] >= self.box[1]).any():
            return 0.0
        both = self.filled & (label_grid(SegmentedMesh((other,)), *self.axes) > 0)
        return float(both.sum() / max(int(self.filled.sum()), 1))
