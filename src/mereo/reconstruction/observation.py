"""The object in one frame of a sensor: what a reconstruction starts from.

    SensorFrame -find_object-> Observation (the object's points, and what each step left out)

Frames are read by ``mereo.io.sensor_frame``.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud
from mereo.io.sensor_frame import SensorFrame, depths_m
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import IsolationStep, isolate
from mereo.reconstruction.strays import Reading

SIZE_FACTOR = 2.0
"""Times that a visible part may be smaller or larger than any in training; beyond, it is another object or unit."""


class SizeWarning(UserWarning):
    """Warning that what is seen is not as large as the object that a model was trained on."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Object in a frame of a sensor: its points, and what isolation left out.

    Attributes:
        frame: everything that the sensor measured.
        cloud: the object's points, in the frame's axes and unit.
        steps: what isolation left out.
    """

    frame: SensorFrame
    cloud: PointCloud
    steps: tuple[IsolationStep, ...] = ()

    def read_as(self, reading: Reading) -> "Observation":
        """The object as a reading of ``cloud`` has it: what was dropped as strays is a step of its own."""
        steps = self.steps if reading.step is None else (*self.steps, reading.step)
        return replace(self, cloud=reading.cloud, steps=steps)

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in self.size_m)
        return f"Observation({self.frame.source!r}, {counted(len(self.cloud), 'point')}, {size} m)"

    @property
    def depth_m(self) -> tuple[float, float, float]:
        """Nearest, middle and farthest depth of the object, in metres."""
        return depths_m(self.cloud, self.frame.unit_m)

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Sides of the visible part's box, in metres."""
        x, y, z = (np.ptp(self.cloud.points, axis=0) * self.frame.unit_m).tolist()
        return x, y, z

    def facts(self) -> dict[str, Any]:
        """Source, unit, depth, size and steps, dropped strays among them, for a result's summary."""
        return {
            "source": self.frame.source,
            "unit_m": self.frame.unit_m,
            "depth_m": self.depth_m if self.frame.axes == "camera" else None,
            "visible_size_m": self.size_m,
            "isolation": [asdict(step) for step in self.steps],
        }

    def __str__(self) -> str:
        """One line for the frame, one for each step, one for what is left."""
        lines = [self._line("the frame has", self.frame.cloud)] if self.steps else []
        lines += [f"  {step}" for step in self.steps]
        lines.append(self._line("the object has", self.cloud))
        return "\n".join([*lines, f"its visible part is {' x '.join(f'{side:.3g}' for side in self.size_m)} m"])

    def _line(self, start: str, cloud: PointCloud) -> str:
        near, middle, far = depths_m(cloud, self.frame.unit_m)
        depth = f", depth {near:.3g} to {far:.3g} m (middle {middle:.3g} m)" if self.frame.axes == "camera" else ""
        return f"{start} {len(cloud)} points{depth}"


def find_object(
    frame: SensorFrame,
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008 (frozen)
) -> Observation:
    """Object in a frame: everything that the steps of ``isolation`` keep, whose lengths are all in metres.

    Raises ``ValueError`` where too little is left, and for a range of depths in a scanner's axes.
    """
    if isolation.depth_range is not None and frame.axes == "scanner":
        raise ValueError(
            f"{frame.path} is in a scanner's frame, in which depth is not known: leave out --depth-range and crop with "
            "--box"
        )
    cloud, steps = isolate(frame.cloud, isolation, frame.unit_m, frame.axes)
    return Observation(frame, cloud, steps)


def size_warning(observation: Observation, provenance: Mapping[str, object]) -> str | None:
    """Sentence where the visible part cannot be the object that a model was trained on; None where it can.

    ``provenance["visible_m"]`` is the least and greatest longest side of the visible part in training, in metres;
    models of objects whose true size is not known have none.
    """
    seen = provenance.get("visible_m")
    if not isinstance(seen, list | tuple):
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
