"""Strays: points of a frame that are not the object's, dropped where the cloud itself shows that they are none.

    PointCloud -readings-> the reading to take, and the other one where the cloud leaves it open

A mask that is wrong by a pixel leaves a rim of background in the cloud, and cameras add points between both. They are
few, but the network's frame is the cloud's box, which one of them moves. Geometry alone cannot tell a rim from a thin
part of the object that something hides the root of; so where it matters there are two readings, and whoever knows more
of the object may choose. Measured in docs/design/0006-sensors.md.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import MIN_POINTS, CloudAxes
from mereo.geometry.surface_patches import STRETCH, stretch, surface_patches
from mereo.geometry.transforms import transform_points
from mereo.reconstruction.isolation import IsolationStep

SCATTERED = 4
"""Patches from which on what lies off all surfaces is taken for strays without further evidence.

A rim is torn into many, a part of the object that something cuts off is one or two: so 0.5 % of clean views lose points
without a registration, and 72 % of those of simulated sensors lose strays."""

MOST = 0.5
"""Share of the points that strays are at most; a cloud with more is no view of surfaces, or a very coarse one."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Reading of a cloud: the points that are taken for the object's, and what the others did.

    Attributes:
        whole: every point, in the input's frame and unit.
        keep: which of them are the object's.
    """

    whole: PointCloud
    keep: Bool[np.ndarray, " n"]

    def __repr__(self) -> str:
        return f"Reading({len(self.cloud):,} of {counted(len(self.whole), 'point')})"

    @classmethod
    def of_all(cls, whole: PointCloud) -> "Reading":
        """The reading with every point."""
        return cls(whole, np.ones(len(whole), dtype=bool))

    @cached_property
    def cloud(self) -> PointCloud:
        """The object's points; the whole cloud itself where nothing is dropped."""
        return self.whole if self.keep.all() else PointCloud(self.whole.points[self.keep])

    @property
    def dropped(self) -> int:
        """Number of strays."""
        return len(self.whole) - len(self.cloud)

    @property
    def stretch(self) -> float:
        """Times that the longest side of the box is as long with the strays, from 1 up."""
        return stretch(self.whole.points, self.keep)

    @property
    def step(self) -> IsolationStep | None:
        """Record of what was left out; None where nothing was."""
        if not self.dropped:
            return None
        detail = f"the longest side was {self.stretch:.3g} times as long with the others"
        return IsolationStep("strays", len(self.whole), len(self.cloud), detail)

    def __str__(self) -> str:
        """One line for people; empty where nothing was dropped."""
        if not self.dropped:
            return ""
        dropped = f"strays: {self.dropped} of {len(self.whole)} points dropped, the longest side was {self.stretch:.3g}"
        return f"{dropped} times as long with them (--keep-all keeps them)"


def as_cloud(points: PointCloud | Float[np.ndarray, "n 3"]) -> PointCloud:
    """Cloud of points; raises ``ValueError`` where they are not finite."""
    return points if isinstance(points, PointCloud) else PointCloud(np.asarray(points, dtype=np.float64))


def readings(
    cloud: PointCloud | Float[np.ndarray, "n 3"], axes: CloudAxes = "camera", keep_all: bool = False
) -> tuple[Reading, ...]:
    """Readings of a cloud, one or two, the more likely first: take that one where nothing else is known.

    One, with every point, where the points off all surfaces do not stretch the cloud's box by more than ``STRETCH``, or
    are more than ``MOST``. Else two: without them, which comes first where they are in ``SCATTERED`` patches or more,
    and with every point.

    Args:
        cloud: points on the object and strays, any unit and density.
        axes: of the cloud. A scanner's lines of sight are estimated, as for the network.
        keep_all: always only the reading with every point.

    Raises ``ValueError`` for points that are not finite.
    """
    seen = as_cloud(cloud)
    everything = Reading.of_all(seen)
    if keep_all or len(seen) < MIN_POINTS:
        return (everything,)
    points = transform_points(into_camera(seen.points, axes), seen.points)
    patch, keep = surface_patches(points)
    surfaces = Reading(seen, keep)
    if keep.sum() < max(MIN_POINTS, (1 - MOST) * len(points)) or surfaces.stretch <= STRETCH:
        return (everything,)
    scattered = len(np.unique(patch[~keep])) >= SCATTERED
    return (surfaces, everything) if scattered else (everything, surfaces)
