"""Labels in space: on a regular grid, and on the points of a cloud."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from mereo.geometry.brief import counted, listed
from mereo.geometry.conventions import Names
from mereo.geometry.mesh import SegmentColors
from mereo.geometry.transforms import Labels, PointArray, Points, Values, Vector

GridLabels = UInt8[ndarray, "x y z"]
"""Label of each node of a grid."""

VoxelMask = Bool[ndarray, "x y z"]
"""Whether each voxel of a grid is meant."""


def part_of_grid(low: Int[ndarray, "3"], end: Int[ndarray, "3"]) -> tuple[slice, ...]:
    """Index of the voxels from ``low`` to before ``end``."""
    return tuple(slice(first, after) for first, after in zip(low, end, strict=True))


@dataclass(frozen=True, eq=False)
class LabelGrid:
    """Labels on a regular grid.

    Attributes:
        labels: 0 is empty space, k is ``names[k - 1]``.
        origin: position of the centre of voxel [0, 0, 0].
        spacing: between voxel centres along x, y, z.
        names: of the segments.
    """

    labels: GridLabels
    origin: Vector
    spacing: Vector
    names: Names

    def __repr__(self) -> str:
        voxels = " x ".join(map(str, self.labels.shape))
        return f"LabelGrid({voxels} voxels, {self.spacing.max():.3g} apart; {listed(self.names)})"

    def axes(self) -> tuple[Float[ndarray, " x"], Float[ndarray, " y"], Float[ndarray, " z"]]:
        """Coordinates of the voxel centres along each axis."""
        x, y, z = (self.origin[i] + np.arange(self.labels.shape[i]) * self.spacing[i] for i in range(3))
        return x, y, z

    def positions(self, index: Int[ndarray, "*n 3"]) -> PointArray:
        """Centres of voxels given by their index."""
        return self.origin + index * self.spacing

    def touched_sides(self) -> Bool[ndarray, "2 3"]:
        """Whether a segment reaches the grid's lower and upper border along x, y, z."""
        ends = [[np.take(self.labels, end, axis=axis).any() for axis in range(3)] for end in (0, -1)]
        return np.array(ends, bool)


@dataclass(frozen=True, eq=False)
class SegmentedCloud:
    """Observed points and the segment that each lies on.

    Attributes:
        points: in the input's frame and units.
        labels: of the most likely segment, from 1 up. Empty space does not compete: a point on the surface is half in
            it, so it would win every second time.
        confidence: probability of that segment among the segments; NaN of all points, as is the next, where no network
            was asked.
        occupancy: probability of any segment against empty space: about a half on the surface of the object, near 0 at
            points that are not on it.
        names, colors: of the segments; ``names[k]`` has label k + 1.
    """

    points: Points
    labels: Labels
    confidence: Values
    occupancy: Values
    names: Names
    colors: SegmentColors

    def __post_init__(self) -> None:
        count, *others = map(len, (self.points, self.labels, self.confidence, self.occupancy))
        if others != [count] * 3:
            raise ValueError(
                f"{count} points have {others[0]} labels, {others[1]} confidences and {others[2]} occupancies; each "
                "point needs one: give arrays of one length"
            )

    def __repr__(self) -> str:
        return f"SegmentedCloud({counted(len(self.points), 'point')}; {listed(self.names)})"

    @property
    def chances(self) -> dict[str, Values]:
        """``confidence`` and ``occupancy`` by their names; none without a network's answer."""
        if len(self.points) and np.isnan(self.confidence).all():
            return {}
        return {"confidence": self.confidence, "occupancy": self.occupancy}
