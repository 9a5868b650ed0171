"""Volume that segments share: exact by Booleans of solids, on a grid where a mesh is none."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import manifold3d
import numpy as np

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import solid_of
from mereo.geometry.solids import label_grid

TOLERANCE = 1e-3
"""Share of a segment's volume that may lie in another one, or of a nested one's outside of its outer one."""

CELLS = 40
"""Along each side of a segment's box, for meshes that are no solids: fast also where they have holes."""


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


def overlaps(mesh: SegmentedMesh, tolerance: float = TOLERANCE) -> tuple[Overlap, ...]:
    """Pairs of segments that share more than ``tolerance`` of the smaller one, or nest with as much outside.

    Exact for solids, however thin what they share; within a percent or so where one of two is no solid. Segments that
    touch share no volume. Segments may be no solids, so their boxes say which of two is smaller.

    Args:
        mesh: any unit.
        tolerance: share of a segment's volume, from 0 to 1.
    """
    return tuple(found for found in _pairs(mesh) if found.share > tolerance)


def _pairs(mesh: SegmentedMesh) -> Iterator[Overlap]:
    """Every two segments, smaller ones first."""
    nesting = set(mesh.nesting)
    order = sorted(range(len(mesh.segments)), key=lambda index: _box_volume(mesh.segments[index]))
    bodies = {index: _Body(mesh.segments[index]) for index in order}
    for small, large in combinations(order, 2):
        first, second = sorted((small, large))
        nested = (first, second) in nesting
        inner, outer = (first, second) if nested else (small, large)
        share = bodies[inner].share_in(bodies[outer])
        yield Overlap(mesh.names[inner], mesh.names[outer], 1.0 - share if nested else share, nested)


class _Body:
    """A segment as a solid and as a grid, each made on first use."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment

    @cached_property
    def solid(self) -> manifold3d.Manifold | None:
        """The solid; None where the mesh is none, or none for manifold3d."""
        if not self.segment.solid:
            return None
        try:
            return solid_of(self.segment.vertices, self.segment.faces)
        except ValueError:
            return None

    @cached_property
    def grid(self) -> "_Filled":
        return _Filled(self.segment)

    def share_in(self, other: "_Body") -> float:
        """How much of the volume lies in another segment, from 0 to 1."""
        box, around = self.segment.bounds, other.segment.bounds
        if (around[1] <= box[0]).any() or (around[0] >= box[1]).any():
            return 0.0
        if self.solid is None or other.solid is None:
            return self.grid.share_in(other.segment)
        return float(np.clip((self.solid ^ other.solid).volume() / self.solid.volume(), 0.0, 1.0))


def _box_volume(segment: Segment) -> float:
    return float(np.prod(segment.bounds[1] - segment.bounds[0]))


def grid_volume(segment: Segment) -> float:
    """Volume inside a mesh, also of one with holes, measured on a grid: within a percent or so."""
    return _Filled(segment).volume


class _Filled:
    """A segment as the filled cells of a grid over its box."""

    def __init__(self, segment: Segment) -> None:
        low, high = segment.bounds
        self.axes = [low[k] + (np.arange(CELLS) + 0.5) * (high[k] - low[k]) / CELLS for k in range(3)]
        self.filled = label_grid(SegmentedMesh((segment,)), *self.axes) > 0
        self.volume = int(self.filled.sum()) * float(np.prod((high - low) / CELLS))

    def share_in(self, other: Segment) -> float:
        """How much of the filled volume lies in another segment, from 0 to 1."""
        both = self.filled & (label_grid(SegmentedMesh((other,)), *self.axes) > 0)
        return float(both.sum() / max(int(self.filled.sum()), 1))
