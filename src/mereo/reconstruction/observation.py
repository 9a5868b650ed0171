"""The object in one frame of a sensor: what a reconstruction starts from.

    SensorFrame -find_object-> Observation (the object's points, and what each step left out)

Frames are read by ``mereo.io.sensor_frame``.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import MIN_POINTS, CloudAxes
from mereo.geometry.downsampling import MAX_POINTS, random_subset
from mereo.geometry.sight_lines import SightLines
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo.reconstruction.isolation import IsolationStep, Selection, clusters, select_object
from mereo.reconstruction.lines_of_sight import lines_of_frame
from mereo.reconstruction.strays import Reading

SIZE_FACTOR = 2.0
"""Times that a visible part may be smaller or larger than any in training; beyond, it is another object or unit."""


CLOUD = Path("cloud")
"""Name of a frame that comes from no file."""


LIKE_SIZE, APART = 0.4, 0.25
"""Points of a second cluster, in those of the largest, and its distance from that, in its own size, from which on both
may be objects."""


class FrameWarning(UserWarning):
    """Warning that what is seen may not be the object, or not the object alone."""


class ClustersWarning(FrameWarning):
    """Warning that two separate things of like size are seen."""


class SizeWarning(FrameWarning):
    """Warning that what is seen is not as large as the object that a model was trained on."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Object in a frame of a sensor: its points, and what isolation left out.

    Attributes:
        frame: everything that the sensor measured.
        cloud: the object's points, in the frame's axes and unit.
        steps: what isolation left out.
        selection: points of the frame that isolation took for the object's; None means all.
        extent: how much of the object's outline the frame shows, see ``IsolationConfig``.
    """

    frame: SensorFrame
    cloud: PointCloud
    steps: tuple[IsolationStep, ...] = ()
    selection: Selection | None = None
    extent: Extent = "auto"

    @cached_property
    def lines(self) -> SightLines:
        """Lines of sight beside the object, in the frame's axes and unit; strays count as the object's points."""
        return lines_of_frame(self.frame, self.selection, self.extent)

    def read_as(self, reading: Reading) -> "Observation":
        """The object as a reading of ``cloud`` has it: what was dropped as strays is a step of its own."""
        steps = self.steps if reading.step is None else (*self.steps, reading.step)
        return replace(self, cloud=reading.cloud, steps=steps)

    def in_unit(self, unit_m: float | None) -> "Observation":
        """The object with the frame's unit, where the frame does not know it."""
        if unit_m is None or self.frame.unit_m is not None:
            return self
        return replace(self, frame=replace(self.frame, unit_m=unit_m))

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in self.size_m)
        points = counted(len(self.cloud), "point")
        return f"Observation({self.frame.source!r}, {points}, {size} {self.frame.length_name})"

    @property
    def depth_m(self) -> tuple[float, float, float]:
        """Nearest, middle and farthest depth of the object in metres, or in the frame's unit where it is not known."""
        return depths(self.cloud, self.frame.metres)

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Sides of the visible part's box in metres, or in the frame's unit where it is not known."""
        x, y, z = (np.ptp(self.cloud.points, axis=0) * self.frame.metres).tolist()
        return x, y, z

    def facts(self) -> dict[str, Any]:
        """Source, unit, depth, size and steps, dropped strays among them, for a result's summary.

        What is in metres is None where the unit is not known.
        """
        known = self.frame.unit_m is not None
        return {
            "source": self.frame.source,
            "unit_m": self.frame.unit_m,
            "depth_m": self.depth_m if known and self.frame.axes == "camera" else None,
            "visible_size_m": self.size_m if known else None,
            "invalid_points": self.frame.invalid,
            "isolation": [asdict(step) for step in self.steps],
        }

    def __str__(self) -> str:
        """One line for the frame, one for each step, one for what is left."""
        lines = [self._line("the frame has", self.frame.cloud)] if self.steps else []
        if self.frame.invalid:
            lines.append(f"{counted(self.frame.invalid, 'point')} without a measurement left out")
        lines += [f"  {step}" for step in self.steps]
        lines.append(self._line("the object has", self.cloud))
        size = " x ".join(f"{side:.3g}" for side in self.size_m)
        return "\n".join([*lines, f"its visible part is {size} {self.frame.length_name}"])

    def _line(self, start: str, cloud: PointCloud) -> str:
        near, middle, far = depths(cloud, self.frame.metres)
        unit, points = self.frame.length_name, f"{start} {len(cloud)} points"
        if self.frame.axes == "scanner":
            return points
        return f"{points}, depth {near:.3g} to {far:.3g} {unit} (middle {middle:.3g} {unit})"


def depths(cloud: PointCloud, factor: float) -> tuple[float, float, float]:
    """Nearest, middle and farthest z of a cloud, times a factor."""
    near, middle, far = (np.quantile(cloud.points[:, 2], [0.0, 0.5, 1.0]) * factor).tolist()
    return near, middle, far


def find_object(
    frame: SensorFrame,
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008 (frozen)
) -> Observation:
    """Object in a frame: everything that the steps of ``isolation`` keep, whose lengths are all in metres.

    A frame whose unit is not known is taken to be in metres.

    Raises ``ValueError`` where too little is left, and for a range of depths in a scanner's axes.
    """
    if isolation.depth_range is not None and frame.axes == "scanner":
        raise ValueError(
            f"{frame.path} is in a scanner's frame, in which depth is not known: leave out --depth-range and crop with "
            "--box"
        )
    selection = select_object(frame.cloud, isolation, frame.metres, frame.axes)
    cloud = frame.cloud if selection.keep.all() else PointCloud(frame.cloud.points[selection.keep])
    return Observation(frame, cloud, selection.steps, selection, isolation.extent)


def observe(
    cloud: PointCloud, axes: CloudAxes = "camera", unit_m: float | None = None, extent: Extent = "auto"
) -> Observation:
    """Observation of points that are all the object's, in ``unit_m`` metres or an unknown unit.

    ``extent`` is how much of the object's outline they show, see ``IsolationConfig``.
    """
    return Observation(SensorFrame(CLOUD, cloud, unit_m, axes), cloud, extent=extent)


def size_warning(observation: Observation, provenance: Mapping[str, object]) -> str | None:
    """Sentence where the visible part cannot be the object that a model was trained on; None where it can.

    None also for a frame whose unit is not known, which may be of any size.

    ``provenance["visible_m"]`` is the least and greatest longest side of the visible part in training, in metres;
    models of objects whose true size is not known have none.
    """
    seen = provenance.get("visible_m")
    if not isinstance(seen, list | tuple) or observation.frame.unit_m is None:
        return None
    least, greatest = (float(value) for value in seen)
    longest = max(observation.size_m)
    if least / SIZE_FACTOR <= longest <= greatest * SIZE_FACTOR:
        return None
    return (
        f"the visible part is {longest:.3g} m long, but {least:.3g} to {greatest:.3g} m in training: other things are "
        "in the cloud (crop with --box or --depth-range), or its unit is wrong (--unit-m 0.001 for clouds in "
        "millimetres, --depth-scale for images); results are in the cloud's unit all the same"
    )


def clusters_warning(observation: Observation) -> str | None:
    """Sentence where the cloud is two separate clusters of like size, of which one may be another object; else None."""
    points = random_subset(observation.cloud.points, MAX_POINTS)
    label = clusters(points)
    first, second = points[label == 0], points[label == 1]
    if len(second) < max(MIN_POINTS, LIKE_SIZE * len(first)):
        return None
    gap, size = cKDTree(first).query(second)[0].min(), np.linalg.norm(np.ptp(second, axis=0))
    if gap < APART * size:
        return None
    metres, name = observation.frame.metres, observation.frame.length_name
    return (
        f"the cloud has two separate clusters of like size ({len(first)} and {len(second)} of {len(points)} points, "
        f"{gap * metres:.3g} {name} apart), and one object is looked for in all of it: if they are two, crop to one "
        "with --box, or take the larger one with --largest-cluster"
    )
