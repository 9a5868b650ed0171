"""Settings of getting the object out of a frame; light, so that the command line may import them."""

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, Literal

from mereo.io.bounds import NotNegative, check_bounds
from mereo.io.errors import value_text

Extent = Literal["auto", "whole", "partial", "surface"]
"""Extent of the object that a frame shows: see ``IsolationConfig.extent``."""


@dataclass(frozen=True)
class IsolationConfig:
    """Parts of a frame to leave out, so that only the object is left. Only strays are dropped by default.

    Attributes:
        depth_range: nearest and farthest depth (z) in metres that is kept.
        box: lower and upper corner of what is kept, x0 y0 z0 x1 y1 z1 in metres, in the input's frame.
        remove_plane: leave out the largest plane: the table, the wall.
        remove_outliers: leave out points whose neighbours are unusually far.
        largest_cluster: keep only the largest group of points that hang together. A part that something else in front
            cuts off is lost, unless `cluster_gap` reaches it.
        cluster_gap: with `largest_cluster`, also keep groups (of 32 points or more) nearer than this to it, in metres.
        keep_all: drop no strays, the points off all surfaces (a rim of background, flying pixels) that would stretch
            the cloud.
        extent: how much of the object's outline the frame shows. whole: nothing hides or cuts the object, so that it
            ends where its points end. partial: something may hide or cut it anywhere, so that nothing is known around
            its points. surface: no single camera saw the points, as of stitched scans, CT and an endoscope's
            reconstruction, so that they have no lines of sight and rule nothing out; their normals are compared. auto:
            as the depths measured around the object say; where the frame does not say it, the fit decides; surface
            where a file has faces or normals, and no camera at the origin can have seen them.
        point: column and row of a pixel of the depth image that shows the object, from 0 at the upper left. Of a whole
            image only what is seen there is looked at; where the size is not known, or other options leave the object
            alone, it keeps the connected surface there.
    """

    depth_range: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    remove_plane: bool = False
    remove_outliers: bool = False
    largest_cluster: bool = False
    cluster_gap: NotNegative = 0.0
    keep_all: bool = False
    extent: Extent = "auto"
    point: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_bounds(self)
        for what, values, count in (("depth range", self.depth_range, 2), ("box", self.box, 6)):
            if values is not None and not is_numbers(values, count):
                raise ValueError(f"the {what} is {value_text(values)}; it must be {count} numbers: give them in metres")
        if self.depth_range is not None and not 0 <= self.depth_range[0] < self.depth_range[1] < math.inf:
            raise ValueError(
                f"the depth range is {_numbers(self.depth_range)}; it must be the nearest and the farthest depth in "
                "metres: give for example --depth-range 0.4 0.9"
            )
        if self.box is not None and not all(
            math.isfinite(upper - lower) and lower < upper
            for lower, upper in zip(self.box[:3], self.box[3:], strict=True)
        ):
            raise ValueError(
                f"the box is {_numbers(self.box)}; each of x0 y0 z0 must be less than its x1 y1 z1: give the lower "
                "corner, then the upper one, in metres"
            )
        if self.point is not None and not (is_numbers(self.point, 2) and all(0 <= k < math.inf for k in self.point)):
            raise ValueError(
                f"the point is {value_text(self.point)}; it must be the column and the row of a pixel, from 0 at the "
                "upper left: give for example --point 320 240"
            )
        if self.cluster_gap > 0 and not self.largest_cluster:
            raise ValueError(
                f"the cluster gap is {self.cluster_gap:g} m; it belongs to the largest cluster: give for example "
                "--largest-cluster --cluster-gap 0.01"
            )

    @property
    def on(self) -> bool:
        """Whether a step was asked for."""
        return replace(self, keep_all=False, extent="auto") != IsolationConfig()


def is_numbers(values: Any, count: int) -> bool:
    """Whether these are so many real numbers, in a tuple, list or array."""
    try:
        numbers = tuple(values)
    except TypeError:
        return False
    return len(numbers) == count and all(isinstance(number, Real) for number in numbers)


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
