"""Sources of a stream's frames: a folder of files, a ROS recording, or file names on standard input."""

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from mereo.geometry.camera import PointCloud
from mereo.io.config import InputConfig
from mereo.io.depth_formats import is_depth_image
from mereo.io.point_cloud_formats import CLOUD_READERS
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame, read_frames
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object
from mereo.reconstruction.stream import StreamFrame

STANDARD_INPUT = "-"
"""Source that means names of files on standard input."""


def frames_of(
    source: str, reading: InputConfig, isolation: IsolationConfig, rate_hz: float = 30.0
) -> Iterator[StreamFrame]:
    """Frames of a source, in order; each is decoded when it is answered.

    Args:
        source: a folder of depth images or point clouds (in the order of their names), a ROS recording, or ``-`` for
            names of files, one a line, as they are written.
        reading: how a file is read.
        isolation: what is left out of it.
        rate_hz: at which a folder was recorded; recordings have their own times.

    Raises ``FileNotFoundError``, or ``ValueError`` for a folder without frames and a rate that is not positive.
    """
    if not 0 < rate_hz < float("inf"):
        raise ValueError(f"the rate is {rate_hz} Hz; it must be positive: give the frames per second, for example 30")
    if source == STANDARD_INPUT:
        return _named(reading, isolation)
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a folder of frames or a ROS recording is needed, or -")
    if is_recording(path):
        return _recorded(path, reading, isolation)
    if not path.is_dir():
        raise ValueError(f"{path} is a single file; for one frame use `mereo reconstruct`, here name its folder")
    files = sorted(file for file in path.iterdir() if _is_frame(file) and file != reading.mask)
    if not files:
        raise ValueError(f"{path} has no depth images or point clouds; a folder of frames is needed: check the path")
    return (
        StreamFrame(file.name, i / rate_hz, _loader(partial(read_frame, file, reading), isolation))
        for i, file in enumerate(files)
    )


def _is_frame(file: Path) -> bool:
    return file.is_file() and (file.suffix.lower() in CLOUD_READERS or is_depth_image(file))


def _named(reading: InputConfig, isolation: IsolationConfig) -> Iterator[StreamFrame]:
    start = time.perf_counter()
    for line in sys.stdin:
        if name := line.strip():
            load = _loader(partial(read_frame, name, reading), isolation)
            yield StreamFrame(name, time.perf_counter() - start, load)


def _recorded(path: Path, reading: InputConfig, isolation: IsolationConfig) -> Iterator[StreamFrame]:
    for message, read in read_frames(path, reading):
        yield StreamFrame(message.name, message.time_s, _loader(read, isolation))


def _loader(read: Callable[[], SensorFrame], isolation: IsolationConfig) -> Callable[[], PointCloud]:
    return lambda: find_object(read(), isolation).cloud
