"""RealSense: recordings of the SDK and what a camera does, by the library where it is installed, and by a stand-in.

The stand-in has the classes that are used, with what librealsense documents of them; it shows what no machine without a
camera can: that one is silent, is unplugged, or starts again with images of another size.
"""

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mereo import __main__ as command_line
from mereo.cli.stream import frames_of, watched_frames
from mereo.geometry.camera import Camera, DepthImage
from mereo.io import realsense
from mereo.io.config import InputConfig
from mereo.io.extras import library
from mereo.io.realsense import camera_frames, is_camera, is_live
from mereo.io.ros_recordings import RecordedFrame
from mereo.io.sensor_frame import read_frame
from mereo.reconstruction.config import IsolationConfig
from mereo.scenes.registry import load_scene
from mereo.synthesis.config import SENSORS, SequenceConfig
from mereo.synthesis.recording import CAMERA, FRAMES, write_recording

UNIT_M = 1e-4
"""That of a D405; others count in millimetres."""

SERIALS = "128422270987", "128422270988"


# --- the stand-in -----------------------------------------------------------------------------------------------------


class Depth:
    """``rs.depth_frame`` of an image, and its stream's profile."""

    def __init__(self, image: np.ndarray, time_ms: float, clock: str = "global_time") -> None:
        self.image, self.time_ms, self.clock = image, time_ms, clock
        self.profile = SimpleNamespace(as_video_stream_profile=lambda: self)

    def get_data(self) -> np.ndarray:
        return self.image

    def get_units(self) -> float:
        return float(np.float32(UNIT_M))

    def get_timestamp(self) -> float:
        return self.time_ms

    def get_frame_timestamp_domain(self) -> str:
        return self.clock

    def get_intrinsics(self) -> SimpleNamespace:
        height, width = self.image.shape
        center = {"ppx": (width - 1) / 2, "ppy": (height - 1) / 2}
        lens = {"coeffs": [0.0] * 5, "model": "distortion.brown_conrady"}
        return SimpleNamespace(width=width, height=height, fx=60.0, fy=61.0, **center, **lens)


class StandIn(ModuleType):
    """``pyrealsense2`` with cameras that deliver a list of images, None where none comes and errors that it raises."""

    def __init__(self, serials: tuple[str, ...], delivered: list[Any]) -> None:
        super().__init__("pyrealsense2")
        self.serials, self.delivered, self.calls = list(serials), delivered, list[Any]()
        self.stream, self.camera_info = SimpleNamespace(depth="depth", color="color"), SimpleNamespace(serial_number=1)

    def context(self) -> Any:
        devices = [SimpleNamespace(get_info=lambda _, serial=serial: serial) for serial in self.serials]
        return SimpleNamespace(query_devices=lambda: devices)

    def config(self) -> Any:
        names = "enable_device", "enable_stream"
        return SimpleNamespace(**{name: lambda *given, name=name: self.calls.append((name, *given)) for name in names})

    def pipeline(self) -> Any:
        return SimpleNamespace(
            start=lambda _: self.calls.append("start"),
            try_wait_for_frames=self.wait,
            stop=lambda: self.calls.append("stop"),
        )

    def wait(self, _: int) -> tuple[bool, Any]:
        image = self.delivered.pop(0) if self.delivered else None
        if isinstance(image, Exception):
            raise image
        if image == "unplugged":
            self.serials.clear()
            image = None
        color = SimpleNamespace() if self.delivered else None
        return image is not None, SimpleNamespace(get_depth_frame=lambda: image, get_color_frame=lambda: color)

    def align(self, stream: str) -> Any:
        self.calls.append(("align", stream))
        return SimpleNamespace(process=lambda frames: frames)


def image(value: int, width: int = 64) -> np.ndarray:
    return np.full((48, width), value, np.uint16)


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Connect cameras that deliver these, and are silent after that."""

    def connected(*delivered: Any, serials: tuple[str, ...] = SERIALS) -> StandIn:
        sdk = StandIn(serials, list(delivered))
        monkeypatch.setitem(sys.modules, "pyrealsense2", sdk)
        monkeypatch.setattr(realsense, "SILENT_S", 0.0)
        return sdk

    return connected


def arrived(source: str, **options: Any) -> Iterator[tuple[RecordedFrame, DepthImage]]:
    for frame in camera_frames(source, **options):
        if frame is not None:
            content = frame.read()
            assert isinstance(content, DepthImage)
            yield frame, content


def test_a_camera_gives_metres_its_intrinsics_and_times_of_one_clock(connect: Any) -> None:
    sdk = connect(Depth(image(5000), 3e6, "system_time"), Depth(image(0), 70.0), Depth(image(5001), 103.0))
    images = list(zip(range(3), arrived("realsense"), strict=False))
    frames, depths = zip(*(frame for _, frame in images), strict=True)
    assert sdk.calls[:3] == [("enable_device", SERIALS[0]), ("enable_stream", "depth"), "start"]
    np.testing.assert_allclose([depth.depth[0, 0] for depth in depths], [0.5, 0, 0.5001], rtol=1e-7)
    assert depths[0].camera == Camera(64, 48, 60.0, 61.0, 32.0, 24.0), "the centre of a pixel is at a half"
    first, second, third = (frame.time_s for frame in frames)
    assert first == 0 <= second < 60 and third - second == pytest.approx(0.033), "the step between clocks is no time"
    assert frames[0].name == f"realsense {SERIALS[0]} at 0.000 s"
    assert [is_camera(name) for name in ("realsense", "realsense:x.bag", "./realsense", "walk")] == [
        True,
        True,
        False,
        False,
    ]
    assert [is_live(name) for name in ("realsense", "realsense:12", "realsense:x.bag", "walk")] == [
        True,
        True,
        False,
        False,
    ]


def test_the_library_may_use_the_memory_of_an_image_again(connect: Any) -> None:
    shared = image(5000)
    connect(Depth(shared, 0.0))
    frame = next(camera_frames("realsense"))
    shared[:] = 0
    assert frame is not None and frame.read().depth.min() > 0  # type: ignore[union-attr]


def test_depth_as_the_colour_camera_sees_it(connect: Any) -> None:
    sdk = connect(Depth(image(5000), 0.0), Depth(image(5000), 33.0))  # the second without a colour image
    frames = camera_frames(f"realsense:{SERIALS[1]}", align_color=True)
    assert next(frames) is not None
    with pytest.raises(TimeoutError):
        next(frames)
    enabled = [("enable_device", SERIALS[1]), ("enable_stream", "depth"), ("enable_stream", "color")]
    assert sdk.calls == [*enabled, "start", ("align", "color"), "stop"]


BROKEN = {
    "has delivered no depth image for 0 s; it has to deliver some each second: close what else uses it": None,
    "realsense 128422270987 is not connected any more: plug it in and start again": "unplugged",
    "realsense 128422270987 has broken off (Device disconnected): plug it in": RuntimeError("Device disconnected."),
    "realsense 128422270987 has 32 x 48 pixels, and the frames before it had 64 x 48; a stream has one size": Depth(
        image(5000, 32), 99.0
    ),
}


@pytest.mark.parametrize("sentence", BROKEN)
def test_a_camera_that_breaks_off_ends_the_stream_with_one_sentence(
    sentence: str, connect: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sdk = connect(Depth(image(0), 0.0), BROKEN[sentence])  # what nothing can be seen in is that frame's error alone
    arguments = ["--weights", "rope", "--method", "network", "--surfaces", str(tmp_path / "out")]
    assert command_line.main(["stream", "realsense", *arguments]) == 2
    out, err = capsys.readouterr()
    assert "measures 0 pixels" in json.loads(out)["error"] and sdk.calls[-1] == "stop"
    assert list(tmp_path.iterdir()) == []
    (said,) = [text for text in err.splitlines() if text.startswith("mereo: error: ")]
    assert sentence in said


REFUSED = {
    "no RealSense camera is connected: plug it in (USB 3), and check the cable": ("realsense", ()),
    f"camera with the serial number 12 is connected; connected: {', '.join(SERIALS)}": ("realsense:12", SERIALS),
    "no.bag is no file; a recording of the RealSense SDK is needed": ("realsense:no.bag", ()),
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_what_is_not_there_is_said_before_anything_is_loaded(
    sentence: str, connect: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    source, serials = REFUSED[sentence]
    connect(serials=serials)
    assert command_line.main(["stream", source, "--weights", "no.safetensors"]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_options_that_mean_nothing_to_a_camera_are_refused(connect: Any, tmp_path: Path) -> None:
    connect()
    with pytest.raises(ValueError, match="a RealSense states its intrinsics, unit and axes itself: leave out all but"):
        camera_frames("realsense", InputConfig(depth_scale=1000))
    with pytest.raises(ValueError, match="realsense is no folder of frames; only such a folder can be watched"):
        watched_frames("realsense", InputConfig(), IsolationConfig())
    with pytest.raises(ValueError, match="--align-color is given for .*; it is for RealSense cameras alone"):
        frames_of(str(tmp_path), InputConfig(), IsolationConfig(), align_color=True)
    assert command_line.main(["stream", "realsense", "--weights", "rope", "--every-frame"]) == 2


def test_a_library_that_is_not_there_or_cannot_be_loaded_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(
        ImportError, match=r"needs pyrealsense2, which is not installed: pip install 'mereo\[realsense\]'"
    ):
        camera_frames("realsense")
    (tmp_path / "of_the_system.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ImportError, match="x needs of_the_system, which cannot be loaded .libusb-1.0.so.0: cannot open"
    ):
        library("of_the_system", "realsense", "x")


# --- the library itself -----------------------------------------------------------------------------------------------


@pytest.fixture
def sdk() -> Any:
    """The library, where it is installed."""
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        return pytest.skip(f"pyrealsense2 is not here ({error}): pip install 'mereo[realsense]'")


def write_bag(rs: Any, path: Path, depths: list[np.ndarray], camera: Camera, color: Camera | None = None) -> Path:
    """Recording of a device in software, as the SDK's own recorder writes it: .db3, or .bag of older versions."""
    device = rs.software_device()
    device.register_info(rs.camera_info.serial_number, SERIALS[0])
    sensors, profiles = [], []
    streams = [(rs.stream.depth, rs.format.z16, 2, camera)]
    streams += [] if color is None else [(rs.stream.color, rs.format.rgb8, 3, color)]
    for uid, (kind, layout, size, seen) in enumerate(streams):
        stream, stated = rs.video_stream(), rs.intrinsics()
        stated.width, stated.height, stated.fx, stated.fy = seen.width, seen.height, seen.focal_x_px, seen.focal_y_px
        stated.ppx, stated.ppy, stated.coeffs = seen.center_x_px - 0.5, seen.center_y_px - 0.5, [0.0] * 5
        stream.type, stream.fmt, stream.index, stream.uid, stream.intrinsics = kind, layout, 0, uid, stated
        stream.width, stream.height, stream.bpp, stream.fps = seen.width, seen.height, size, 30
        sensors.append(device.add_sensor(str(kind)))
        profiles.append(sensors[-1].add_video_stream(stream))
    sensors[0].add_read_only_option(rs.option.depth_units, UNIT_M)
    if color is not None:
        sensors[0].add_read_only_option(rs.option.stereo_baseline, 50.0)
        away = rs.extrinsics()
        away.rotation, away.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.015, 0, 0]
        profiles[0].register_extrinsics_to(profiles[1], away)
    try:
        path = path.with_suffix(".db3")
        recorder = rs.recorder(str(path), device)
    except RuntimeError:
        path = path.with_suffix(".bag")
        recorder = rs.recorder(str(path), device)
    queue = rs.frame_queue(100)
    for recorded in recorder.query_sensors():
        recorded.open(recorded.get_stream_profiles())
        recorded.start(queue)
    for number, depth in enumerate(depths):
        for sensor, profile, (*_, size, seen) in zip(sensors, profiles, streams, strict=True):
            frame = rs.software_video_frame()
            pixels = depth if size == 2 else np.zeros((seen.height, seen.width, 3), np.uint8)
            frame.pixels, frame.bpp, frame.stride = np.ascontiguousarray(pixels), size, size * seen.width
            frame.timestamp, frame.domain = 1000 + 100 * number / 3, rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = number + 1, profile.as_video_stream_profile()
            if size == 2:
                frame.depth_units = UNIT_M
            sensor.on_video_frame(frame)
            queue.wait_for_frame()
    for recorded in recorder.query_sensors():
        recorded.stop()
        recorded.close()
    return path


def test_a_recording_of_the_sdk_has_the_images_that_were_recorded_and_each_is_answered(
    sdk: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    settings = SequenceConfig(seconds=0.1, image_size=96, occluder="none")
    write_recording(folder, load_scene("rope"), settings, ("paper", SENSORS["paper"]), 740_000)
    files, reading = sorted((folder / FRAMES).iterdir()), InputConfig(intrinsics=folder / CAMERA)
    images = [image for file in files if (image := read_frame(file, reading).whole) is not None]
    stored = [np.rint(image.depth / UNIT_M).astype(np.uint16) for image in images]
    path = write_bag(sdk, folder, stored, images[0].camera)
    for (_, played), image in zip(arrived(f"realsense:{path}"), images, strict=True):
        np.testing.assert_allclose(played.depth, image.depth, rtol=1e-6)
        assert played.camera.focal_x_px == pytest.approx(image.camera.focal_x_px)
    options = ["--weights", "rope", "--method", "network", "--resolution", "24", "--every-frame"]
    assert command_line.main(["stream", f"realsense:{path}", *options]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["time_s"] for line in lines] == pytest.approx([0, 1 / 30, 2 / 30]) and len(images) == 3
    assert all("base" in line["segments"] for line in lines)


def test_aligned_depth_is_in_the_axes_of_the_colour_camera(sdk: Any, tmp_path: Path) -> None:
    camera, color = Camera(64, 48, 60.0, 60.0, 32.0, 24.0), Camera(80, 60, 90.0, 90.0, 40.0, 30.0)
    depth = image(10_000)
    depth[20:28, 30:36] = 5_000
    path = write_bag(sdk, tmp_path / "two", [depth] * 4, camera, color)
    for is_aligned, seen, shift in ((False, camera, 0.0), (True, color, 0.015)):
        _, content = next(arrived(f"realsense:{path}", align_color=is_aligned))
        assert content.camera == seen
        near = content.to_points(content.depth < 0.6).points
        np.testing.assert_allclose(near.mean(axis=0), [0.5 * 1 / 60 + shift, 0, 0.5], atol=0.005)


def test_what_is_no_recording_of_depth_is_one_sentence(sdk: Any, tmp_path: Path) -> None:
    path = write_bag(sdk, tmp_path / "walk", [image(5000)] * 3, Camera(64, 48, 60.0, 60.0, 32.0, 24.0))
    with pytest.raises(ValueError, match="gives no stream of depth and colour .*: record it again"):
        camera_frames(f"realsense:{path}", align_color=True)
    first = next(arrived(f"realsense:{path}"))[1]  # a stream that is left early
    assert first.depth.max() == pytest.approx(0.5)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"gives no stream of depth \(Failed to resolve request.*: record it again"):
        camera_frames(f"realsense:{path}")
