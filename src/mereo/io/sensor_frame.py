"""One frame of a sensor from whatever file holds it: a depth image, a point cloud or a ROS recording.

Options that do not belong to a file's kind are refused, because ignored ones are wrong results that nobody notices.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mereo.geometry.brief import counted
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.io.bounds import PositiveOrUnknown, check_bounds
from mereo.io.config import InputConfig
from mereo.io.intrinsics import read_intrinsics
from mereo.io.readers import depth_of, is_depth_image, read_points, read_raw_depth, usable_depth, valid_points
from mereo.io.ros_recordings import RecordedFrame, is_recording, recorded_frame, recorded_frames


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """Everything that a sensor measured at one moment, before the object is looked for.

    Attributes:
        path: the file, as it was named.
        cloud: the measured points, in the file's axes and unit.
        unit_m: metres per unit; None where neither the file nor an option says it.
        axes: the cloud's.
        depth: the depth image that the points come from, in their unit, without what a mask leaves out.
        message: the recording's message, by topic and time; empty for other files.
        invalid: number of points without a measurement that were left out.
        whole: the whole depth image, without any mask; None for clouds.
    """

    path: Path
    cloud: PointCloud
    unit_m: PositiveOrUnknown
    axes: CloudAxes
    depth: DepthImage | None = None
    message: str = ""
    invalid: int = 0
    whole: DepthImage | None = None

    def __post_init__(self) -> None:
        check_bounds(self)

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in np.ptp(self.cloud.points, axis=0) * self.metres)
        points = counted(len(self.cloud), "point")
        return f"SensorFrame({self.source!r}, {points}, {size} {self.length_name}, {self.axes} axes)"

    @property
    def metres(self) -> float:
        """Metres per unit; 1 where that is not known, so that lengths are taken for metres."""
        return 1.0 if self.unit_m is None else self.unit_m

    @property
    def length_name(self) -> str:
        """Name of the unit of lengths times ``metres``: "m", or "units" where it is not known."""
        return "units" if self.unit_m is None else "m"

    @property
    def source(self) -> str:
        """Name of the file, and which of its messages."""
        return f"{self.path.name}, {self.message}" if self.message else self.path.name


def read_frame(path: str | Path, reading: InputConfig = InputConfig()) -> SensorFrame:  # noqa: B008 (frozen)
    """Frame that a depth image, point cloud or ROS recording holds, or that ``reading`` picks from it.

    Depth images and recordings come in metres and camera axes; point clouds keep their file's unit and axes. Raises
    ``FileNotFoundError``, ``ImportError`` for a missing extra, and ``ValueError`` for a damaged file and for options
    that do not belong to this kind of file.
    """
    path = Path(path)
    kind = "recording" if is_recording(path) else "depth image" if is_depth_image(path) else "point cloud"
    _check_options(path, kind, reading)
    if kind == "recording":
        return _recorded(recorded_frame(path, reading.frame_index or 0, *_recording_options(reading)), path, reading)
    if kind == "depth image":
        return _depth_image(path, reading)
    unit_m = reading.unit_m
    if unit_m is None and path.suffix.lower() == ".zdf":  # in millimetres, by its definition
        unit_m = 0.001
    points = read_points(path)
    cloud = PointCloud(valid_points(points, path, reading.drop_invalid))
    return SensorFrame(path, cloud, unit_m, reading.frame, invalid=len(points) - len(cloud))


def read_frames(path: Path, reading: InputConfig) -> Iterator[tuple[RecordedFrame, Callable[[], SensorFrame]]]:
    """Messages of a ROS recording's topic in their order, each with what decodes it; raises as ``read_frame``."""
    for message in recorded_frames(path, *_recording_options(reading)):
        yield message, partial(_recorded, message, path, reading)


def _check_options(path: Path, kind: str, reading: InputConfig) -> None:
    if reading.topic is not None and kind != "recording":
        raise ValueError(f"{path} is no ROS recording and has no topics: leave out --topic")
    if kind == "point cloud":
        if reading.intrinsics is not None or reading.mask is not None or reading.depth_scale is not None:
            raise ValueError(f"{path} is read as a point cloud; leave out intrinsics, mask and depth scale")
        if reading.frame_index is not None:
            raise ValueError(f"{path} is one point cloud, not a recording of many: leave out --frame-index")
        return
    if reading.frame != "camera":
        raise ValueError(f"the frame is {reading.frame!r} but {path} is a {kind}; those are always in the camera frame")
    if reading.unit_m is not None:
        raise ValueError(f"{path} comes in metres: leave out --unit-m, and give --depth-scale if its scale is wrong")


def _depth_image(path: Path, reading: InputConfig) -> SensorFrame:
    if reading.intrinsics is None:
        raise ValueError(f"{path} is a depth image without intrinsics; they are needed: give --intrinsics FILE")
    raw = read_raw_depth(path)
    intrinsics = read_intrinsics(reading.intrinsics, (raw.shape[1], raw.shape[0]), path, reading.frame_index)
    stated = None if raw.dtype.kind == "f" else intrinsics.depth_scale
    scale = stated if reading.depth_scale is None else reading.depth_scale
    whole = depth_of(path, raw, scale, intrinsics.camera)
    image = usable_depth(whole, path, reading.mask)
    return SensorFrame(path, image.to_points(), 1.0, "camera", image, whole=whole)


def _recording_options(reading: InputConfig) -> tuple[str | None, Camera | None, float | None]:
    known = None if reading.intrinsics is None else read_intrinsics(reading.intrinsics)
    scale = known.depth_scale if known and reading.depth_scale is None else reading.depth_scale
    return reading.topic, known.camera if known else None, scale


def _recorded(message: RecordedFrame, path: Path, reading: InputConfig) -> SensorFrame:
    content = message.read()
    if isinstance(content, DepthImage):
        image = usable_depth(content, path, reading.mask)
        return SensorFrame(path, image.to_points(), 1.0, reading.frame, image, message.name, whole=content)
    if reading.mask is not None:
        raise ValueError(f"{message.topic} in {path} has point clouds; leave out the mask, or name an image's --topic")
    cloud = PointCloud(valid_points(content, path, reading.drop_invalid))
    lost = len(content) - len(cloud)
    return SensorFrame(path, cloud, 1.0, reading.frame, message=message.name, invalid=lost)
