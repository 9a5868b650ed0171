"""Strays: points of a frame that are not the object's, dropped where the cloud itself shows that they are none.

    PointCloud -readings-> the reading to take, and the other one where the cloud leaves it open

A mask that is wrong by a pixel leaves a rim of background in the cloud, and cameras add points between both. They are
few, but the network's frame is the cloud's box, which one of them moves. Geometry alone cannot tell a rim from a thin
part of the object that something hides the root of; so where it matters there are two readings, and whoever knows more
of the object may choose. Measured in docs/design/0006-sensors.md.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import MIN_POINTS, CloudAxes
from mereo.geometry.scanner_axes import into_camera
from mereo.geometry.surface_patches import STRETCH, longest_side, surface_patches
from mereo.geometry.transforms import transform_points
from mereo.reconstruction.isolation import IsolationStep

SCATTERED = 4
"""Patches from which on what lies off all surfaces is taken for strays without further evidence.

A rim is torn into many, a part of the object that something cuts off is one or two: so 2 of these clean views lose
genuine points, without this 12 would, and 0.67 of the sensors' views lose their strays, without this 0.74 would."""

MOST = 0.5
"""Share of the points that strays are at most; a cloud with more is no view of surfaces, or a very coarse one."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Reading of a cloud: the points that are taken for the object's, and what the others did.

    Attributes:
        cloud: the object's points, in the input's frame and unit; the cloud itself where nothing is dropped.
        before: points before strays were dropped.
        stretch: times that the longest side of the box was as long with the strays, from 1 up (camera axes).
    """

    cloud: PointCloud
    before: int
    stretch: float = 1.0

    @property
    def dropped(self) -> int:
        """Number of strays."""
        return self.before - len(self.cloud)

    @property
    def step(self) -> IsolationStep | None:
        """Record of what was left out; None where nothing was."""
        if not self.dropped:
            return None
        detail = f"the longest side was {self.stretch:.3g} times as long with the others"
        return IsolationStep("strays", self.before, len(self.cloud), detail)

    def __str__(self) -> str:
        """One line for people; empty where nothing was dropped."""
        if not self.dropped:
            return ""
        return (
            f"strays: {self.dropped} of {self.before} points dropped, the longest side was {self.stretch:.3g} times as "
            "long with them (--keep-all keeps them)"
        )


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
    seen = cloud if isinstance(cloud, PointCloud) else PointCloud(np.asarray(cloud, dtype=np.float64))
    everything = Reading(seen, len(seen))
    if keep_all or len(seen) < MIN_POINTS:
        return (everything,)
    points = transform_points(into_camera(seen.points, axes), seen.points)
    patch, keep = surface_patches(points)
    stretch = longest_side(points) / max(longest_side(points[keep]), np.finfo(float).tiny)
    if stretch <= STRETCH or keep.sum() < max(MIN_POINTS, (1 - MOST) * len(points)):
        return (everything,)
    surfaces = Reading(PointCloud(seen.points[keep]), len(seen), stretch)
    scattered = len(np.unique(patch[~keep])) >= SCATTERED
    return (surfaces, everything) if scattered else (everything, surfaces)
