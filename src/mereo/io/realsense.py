"""RealSense cameras and their recordings: depth images with their intrinsics, as they come from pyrealsense2.

    realsense, realsense:SERIAL, realsense:FILE -camera_frames-> RecordedFrame (None while nothing new has come)

The image is that of the depth camera, in metres by the unit that the device states for each frame; aligned, it is as
the colour camera sees it, with the intrinsics of that. Images are copied as they come, for the library has few buffers.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from jaxtyping import UInt16

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import Pair, WholeNumbers
from mereo.io.config import InputConfig
from mereo.io.errors import reason
from mereo.io.extras import library
from mereo.io.intrinsics import camera_from_fields, warn_of_distortion
from mereo.io.readers import metres
from mereo.io.ros_recordings import RecordedFrame

REALSENSE = "realsense"

WAIT_MS = 200
"""Milliseconds of one wait for a frame, between which a stream may end."""

SILENT_S = 5.0
"""Seconds without a depth image after which a camera is taken to deliver none."""


def is_camera(source: str) -> bool:
    """Whether a source is a RealSense camera, or a recording that is played as one."""
    return source.partition(":")[0] == REALSENSE


def is_live(source: str) -> bool:
    """Whether a source is a camera, which waits for nobody; its name is a serial number, of digits, or none."""
    name = source.partition(":")[2]
    return is_camera(source) and (not name or name.isdigit())


def camera_frames(
    source: str,
    reading: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    align_color: bool = False,
) -> Iterator[RecordedFrame | None]:
    """Open a camera, or a recording of one, and yield its depth images, with times from the first.

    Args:
        source: "realsense" for the first camera, "realsense:SERIAL", or "realsense:FILE" of its own recorder.
        reading: settings, of which only a mask may be given: unit and intrinsics are the device's.
        align_color: give depth as the colour camera sees it.

    Yields None where nothing new has come for 0.2 s. Raises ``ImportError`` without the extra `realsense`, and
    ``ValueError`` or ``FileNotFoundError`` for what cannot be opened, at once; while it runs ``TimeoutError`` for a
    camera that delivers nothing for 5 s, ``ConnectionError`` where it was unplugged, and ``ValueError`` where its
    images change their size.
    """
    if reading != InputConfig(mask=reading.mask, mask_value=reading.mask_value):
        raise ValueError(
            f"options say how {source} is read, but a RealSense states its intrinsics, unit and axes itself: leave out "
            "all but --mask and --mask-value"
        )
    rs = library("pyrealsense2", REALSENSE, source)
    config = rs.config()
    pipeline = rs.pipeline()
    name = source.partition(":")[2]
    if is_live(source):
        serials = _serials(rs)
        if not serials or name not in ("", *serials):
            connected = f"; connected: {', '.join(serials)}" if serials else ""
            what = f"with the serial number {name} " if name else ""
            raise ValueError(
                f"no RealSense camera {what}is connected{connected}: plug it in (USB 3), and check the cable"
            )
        name = name or serials[0]
        config.enable_device(name)
    elif not Path(name).is_file():
        raise FileNotFoundError(f"{name} is no file; a recording of the RealSense SDK is needed: check the path")
    else:
        config.enable_device_from_file(name, False)
    for kind in (rs.stream.depth, *([rs.stream.color] if align_color else [])):
        config.enable_stream(kind)
    playback = None
    try:
        if not is_live(source):  # before it starts, else frames are lost until it is known that none may be
            playback = config.resolve(pipeline).get_device().as_playback()
            playback.set_real_time(False)
        pipeline.start(config)
    except RuntimeError as error:
        streams = "depth and colour" if align_color else "depth"
        cure = "close what else uses it, or take another USB 3 port" if is_live(source) else "record it again"
        raise ValueError(f"{source} gives no stream of {streams} ({reason(error)}): {cure}") from error
    return _frames(rs, pipeline, playback, name, rs.align(rs.stream.color) if align_color else None)


def _serials(rs: Any) -> list[str]:
    """Serial numbers of the cameras that are connected."""
    return [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]


def _frames(rs: Any, pipeline: Any, playback: Any, name: str, align: Any) -> Iterator[RecordedFrame | None]:
    topic = f"{REALSENSE} {Path(name).name}"
    time_s = 0.0
    arrived_s = monotonic()
    camera: Camera | None = None
    before: tuple[Any, float] | None = None
    try:
        while True:
            depth = _next_depth(pipeline, name, align)
            if depth is None:
                if playback is not None and playback.current_status() == rs.playback_status.stopped:
                    return
                if playback is None and monotonic() - arrived_s >= SILENT_S:
                    raise _silence(name, name in _serials(rs))
                yield None
                continue
            image = np.array(depth.get_data(), np.uint16)
            camera = camera or _camera(depth, topic)
            if image.shape != (camera.height, camera.width):
                raise ValueError(resized(topic, image.shape[::-1], (camera.width, camera.height)))
            stamp = depth.get_frame_timestamp_domain(), depth.get_timestamp()
            if before is not None:  # the first frames may be stamped by another clock
                is_same = stamp[0] == before[0]
                time_s += max(0.0, stamp[1] - before[1]) / 1e3 if is_same else monotonic() - arrived_s
            before = stamp
            arrived_s = monotonic()
            yield RecordedFrame(topic, time_s, partial(_depth_image, image, float(depth.get_units()), camera))
    finally:
        with suppress(RuntimeError):  # of a camera that is gone
            pipeline.stop()


def _next_depth(pipeline: Any, name: str, align: Any) -> Any:
    """Next depth image of the library; None where none has come."""
    try:
        is_new, frames = pipeline.try_wait_for_frames(WAIT_MS)
        if not is_new or (align is not None and not frames.get_color_frame()):
            return None
        return (frames if align is None else align.process(frames)).get_depth_frame() or None
    except RuntimeError as error:
        words = f"{REALSENSE} {name} has broken off ({reason(error)}): plug it in, or record it again"
        raise ConnectionError(words) from error


def _silence(name: str, is_connected: bool) -> OSError:
    """Error of a camera that has delivered nothing for too long."""
    if not is_connected:
        return ConnectionError(f"{REALSENSE} {name} is not connected any more: plug it in and start again")
    return TimeoutError(
        f"{REALSENSE} {name} has delivered no depth image for {SILENT_S:g} s; it has to deliver some each second: "
        "close what else uses it, or take another USB 3 port or cable"
    )


def resized(name: str, size: WholeNumbers, before: Pair) -> str:
    """Sentence on a frame whose size, (width, height) in pixels, is not that of the frames before it."""
    return (
        f"{name} has {size[0]} x {size[1]} pixels, and the frames before it had {before[0]} x {before[1]}; a stream "
        "has one size: see what has set the camera to another, and start again"
    )


def _camera(depth: Any, topic: str) -> Camera:
    stated = depth.profile.as_video_stream_profile().get_intrinsics()
    camera = camera_from_fields({name: getattr(stated, name) for name in ("width", "height", "fx", "fy", "ppx", "ppy")})
    warn_of_distortion(camera, {"coeffs": list(stated.coeffs), "model": str(stated.model)}, topic)
    return camera


def _depth_image(raw: UInt16[np.ndarray, "h w"], unit_m: float, camera: Camera) -> DepthImage:
    return DepthImage(metres(raw, 1.0 / unit_m), camera)
