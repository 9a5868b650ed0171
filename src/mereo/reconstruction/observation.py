"""One frame of a sensor, from whatever file holds it, and the object out of it: what a reconstruction starts from.

    file -read-> PointCloud -isolate-> PointCloud

A file is a depth image, a point cloud or a ROS recording; which of them, its name says.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.io.config import InputConfig
from mereo.io.depth_formats import is_depth_image, metres, read_raw_depth
from mereo.io.errors import readable
from mereo.io.readers import read_intrinsics, read_point_cloud, usable_depth, valid_points
from mereo.io.ros_recordings import RecordedFrame, is_recording, recorded_frame
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import IsolationStep, isolate

UNITS_M = {".zdf": 0.001}
"""Metres per unit of clouds whose format says it."""

SIZE_FACTOR = 2.0
"""A visible part this many times smaller or larger than any in training is not the object, or not its unit."""


class SizeWarning(UserWarning):
    """What is seen is not as large as the object that a model was trained on."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What a frame shows of the object.

    Attributes:
        source: the file, and which of its messages.
        cloud: its points, in the input's frame and unit.
        unit_m: metres per unit.
        frame: the cloud's axes.
        whole: the points before isolation: how many, and their nearest, middle and farthest depth in metres.
        steps: what isolation left out.
    """

    source: str
    cloud: PointCloud
    unit_m: float
    frame: CloudAxes
    whole: tuple[int, tuple[float, float, float]]
    steps: tuple[IsolationStep, ...] = ()

    @property
    def depth_m(self) -> tuple[float, float, float]:
        """Nearest, middle and farthest depth of the object."""
        return _depths_m(self.cloud, self.unit_m)

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Sides of the visible part's box."""
        x, y, z = (np.ptp(self.cloud.points, axis=0) * self.unit_m).tolist()
        return x, y, z

    def facts(self) -> dict[str, Any]:
        """For a result's summary."""
        return {
            "source": self.source,
            "unit_m": self.unit_m,
            "depth_m": self.depth_m if self.frame == "camera" else None,
            "visible_size_m": self.size_m,
            "isolation": [asdict(step) for step in self.steps],
        }

    def __str__(self) -> str:
        """One line for the frame, one for each step, one for what is left."""
        lines = [self._line("the frame has", *self.whole)] if self.steps else []
        lines += [f"  {step}" for step in self.steps]
        lines.append(self._line("the object has", len(self.cloud), self.depth_m))
        return "\n".join([*lines, f"its visible part is {' x '.join(f'{side:.3g}' for side in self.size_m)} m"])

    def _line(self, start: str, count: int, depth_m: tuple[float, float, float]) -> str:
        near, middle, far = depth_m
        depth = f", depth {near:.3g} to {far:.3g} m (middle {middle:.3g} m)" if self.frame == "camera" else ""
        return f"{start} {count} points{depth}"


def read_observation(
    path: str | Path,
    reading: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008
) -> Observation:
    """The object in a depth image, point cloud or ROS recording.

    Depth images and recordings come in metres, point clouds keep their file's unit; all lengths of ``isolation`` are in
    metres.

    Raises ``FileNotFoundError``, ``ImportError`` for a missing extra, and ``ValueError`` for a damaged file, options
    that do not belong to this kind of file, and where too little is left of the object.
    """
    path = Path(path)
    cloud, unit_m, source = _read(path, reading)
    if isolation.depth_range is not None and reading.frame == "scanner":
        raise ValueError(
            f"{path} is in a scanner's frame, in which depth is not known: leave out --depth-range and crop with --box"
        )
    whole = len(cloud), _depths_m(cloud, unit_m)
    kept, steps = isolate(cloud, isolation, unit_m, reading.frame)
    return Observation(source, kept, unit_m, reading.frame, whole, steps)


def size_warning(observation: Observation, provenance: Mapping[str, object]) -> str | None:
    """A sentence where the visible part cannot be the object that a model was trained on; None where it can.

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


def _depths_m(cloud: PointCloud, unit_m: float) -> tuple[float, float, float]:
    near, middle, far = (np.quantile(cloud.points[:, 2], [0.0, 0.5, 1.0]) * unit_m).tolist()
    return near, middle, far


# --- kinds of files --------------------------------------------------------------------------------------------------


def _read(path: Path, reading: InputConfig) -> tuple[PointCloud, float, str]:
    """Points, metres per unit, and where they come from."""
    recording = is_recording(path)
    if reading.topic is not None and not recording:
        raise ValueError(f"{path} is no ROS recording and has no topics: leave out --topic")
    if not recording and not is_depth_image(path):
        return *_read_cloud(path, reading), path.name
    if reading.frame != "camera":
        kind = "recording" if recording else "depth image"
        raise ValueError(f"the frame is {reading.frame!r} but {path} is a {kind}; those are always in the camera frame")
    if reading.unit_m is not None:
        raise ValueError(f"{path} comes in metres: leave out --unit-m, and give --depth-scale if its scale is wrong")
    if recording:
        cloud, source = _read_recording(path, reading)
        return cloud, 1.0, source
    return _read_depth(path, reading), 1.0, path.name


def _read_cloud(path: Path, reading: InputConfig) -> tuple[PointCloud, float]:
    if reading.intrinsics is not None or reading.mask is not None or reading.depth_scale is not None:
        raise ValueError(f"{path} is read as a point cloud; leave out intrinsics, mask and depth scale")
    unit_m = UNITS_M.get(path.suffix.lower(), 1.0) if reading.unit_m is None else reading.unit_m
    return read_point_cloud(path, reading.drop_invalid), unit_m


def _read_depth(path: Path, reading: InputConfig) -> PointCloud:
    if reading.intrinsics is None:
        raise ValueError(f"{path} is a depth image without intrinsics; they are needed: give --intrinsics FILE")
    with readable(path, "depth image"):
        raw = read_raw_depth(path)
    found = read_intrinsics(reading.intrinsics, (raw.shape[1], raw.shape[0]), path, reading.frame_index)
    stated = None if raw.dtype.kind == "f" else found.depth_scale
    scale = stated if reading.depth_scale is None else reading.depth_scale
    return usable_depth(DepthImage(metres(raw, scale), found.camera), path, reading.mask).to_points()


def _read_recording(path: Path, reading: InputConfig) -> tuple[PointCloud, str]:
    """The points, and which message they are."""
    frame = recorded_frame(path, reading.frame_index or 0, *recording_options(reading))
    return recorded_points(frame, path, reading), f"{path.name}, {frame.topic} at {frame.stamp_ns / 1e9:.3f} s"


def recording_options(reading: InputConfig) -> tuple[str | None, Camera | None, float | None]:
    """Topic, camera and depth scale, as ``recorded_frames`` takes them."""
    own = None if reading.intrinsics is None else read_intrinsics(reading.intrinsics)
    scale = own.depth_scale if own is not None and reading.depth_scale is None else reading.depth_scale
    return reading.topic, own.camera if own else None, scale


def recorded_points(frame: RecordedFrame, path: Path, reading: InputConfig) -> PointCloud:
    """The points of one message of the recording ``path``, in metres."""
    content = frame.read()
    if isinstance(content, DepthImage):
        return usable_depth(content, path, reading.mask).to_points()
    if reading.mask is not None:
        raise ValueError(f"{frame.topic} in {path} has point clouds; leave out the mask, or name an image's --topic")
    return PointCloud(valid_points(content, path, reading.drop_invalid))
