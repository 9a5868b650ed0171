"""RealSense: what a camera does by a stand-in of its library, and a recording by the library where it is installed."""

import json
import re
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import trimesh
from folder_contents import run_mereo
from numpy.testing import assert_allclose
from page_blocks import ROOT

from mereo import __main__ as command_line
from mereo.geometry.camera import Camera
from mereo.geometry.conventions import Names
from mereo.io import realsense
from mereo.io.extras import library
from mereo.io.realsense import camera_frames

UNIT_M = 1e-4
"""That of a D405; others count in millimetres."""

SERIAL = "128422270987"
CAMERA = Camera(64, 48, 60.0, 61.0, 32.0, 24.0)
STATED = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "ppx": 31.5, "ppy": 23.5, "coeffs": [0.0] * 5}


def image(value: int, time_ms: float, clock: str = "global_time", width: int = 64) -> Any:
    """Depth frame of one value."""
    frame = MagicMock(**{"get_timestamp.return_value": time_ms, "get_frame_timestamp_domain.return_value": clock})
    frame.get_data.return_value, frame.get_units.return_value = np.full((48, width), value, np.uint16), UNIT_M
    frame.profile.as_video_stream_profile().get_intrinsics.return_value = SimpleNamespace(**STATED, model="")
    return frame


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Connect cameras that deliver these and raise what is an error; after that they are silent."""

    def connected(*delivered: Any, serials: Names = (SERIAL, "12")) -> MagicMock:
        sdk = MagicMock()
        waiting = list(delivered)
        plugged = list(serials)

        def wait(_: int) -> tuple[bool, Any]:
            frame = waiting.pop(0) if waiting else None
            if isinstance(frame, Exception):
                raise frame
            if frame == "unplugged":
                plugged.clear()
            return isinstance(frame, MagicMock), MagicMock(**{"get_depth_frame.return_value": frame})

        sdk.pipeline().try_wait_for_frames = wait
        sdk.context().query_devices = lambda: [MagicMock(**{"get_info.return_value": serial}) for serial in plugged]
        monkeypatch.setitem(sys.modules, "pyrealsense2", sdk)
        monkeypatch.setattr(realsense, "SILENT_S", 0.0)
        return sdk

    return connected


def test_a_camera_gives_metres_its_intrinsics_and_times_of_one_clock(connect: Any) -> None:
    shared = image(5000, 70.0, "hardware_clock")
    connect(shared, image(0, 9e7), image(5001, 90000033.0))
    source = camera_frames("realsense")
    first, second, third = frames = [next(source) for _ in range(3)]
    shared.get_data()[:] = 0  # the library uses the memory of an image again
    assert_allclose([each.read().depth[0, 0] for each in frames], [0.5, 0, 0.5001])
    assert first.read().camera == CAMERA and first.name == f"realsense {SERIAL} at 0.000 s"
    assert third.time_s - second.time_s == pytest.approx(0.033) and second.time_s < 60  # between clocks


def test_depth_as_the_colour_camera_sees_it(connect: Any) -> None:
    sdk = connect(image(0, 0.0))
    sdk.align().process().get_depth_frame.return_value = image(5000, 0.0)
    assert next(camera_frames("realsense:12", align_color=True)).read().depth.max() == pytest.approx(0.5)
    sdk.config().enable_stream.assert_called_with(sdk.stream.color)


def test_the_line_of_the_quickstart_finds_a_rigid_object(
    connect: Any, working_folder: Path, capsys: pytest.CaptureFixture
) -> None:
    trimesh.creation.box((0.16, 0.24, 0.1)).export("bottle.obj")
    front = image(0, 0.0)
    front.get_data()[10:39, 22:41] = 5000
    connect(front)
    (line,) = re.findall("^mereo (stream realsense .*)", (ROOT / "docs/quickstart.md").read_text("utf-8"), re.M)
    assert command_line.main(shlex.split(line, comments=True)) == 2, "the camera falls silent"
    first = json.loads(capsys.readouterr().out.splitlines()[0])
    assert first["tracking"] == "found" and first["pose"][2][3] == pytest.approx(0.55, abs=0.005)


BROKEN = {
    "has delivered no depth image for 0 s; it has to deliver some each second: close what else uses it": None,
    "is not connected any more: plug it in and start again": "unplugged",
    "has broken off (Device disconnected): plug it in": RuntimeError("Device disconnected."),
    "has 32 x 48 pixels, and the frames before it had 64 x 48; a stream has one size": image(5, 99.0, width=32),
}


@pytest.mark.parametrize("sentence", BROKEN)
def test_a_camera_that_breaks_off_ends_the_stream_with_one_sentence(
    sentence: str, connect: Any, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    sdk = connect(image(0, 0.0), BROKEN[sentence])
    arguments = ["--weights", "rope", "--method", "network", "--surfaces", str(tmp_path / "out")]
    assert run_mereo("stream", "realsense", *arguments) == 2
    out, err = capsys.readouterr()
    assert "measures 0 pixels" in json.loads(out)["error"], "what shows nothing is that frame's error alone"
    assert f"mereo: error: realsense {SERIAL} {sentence}" in err and list(tmp_path.iterdir()) == []
    sdk.pipeline().stop.assert_called_once()


REFUSED = {
    "no RealSense camera is connected: plug it in (USB 3), and check the cable": ("realsense",),
    "no RealSense camera with the serial number 7 is connected; connected: 12": ("realsense:7",),
    "no.bag is no file; a recording of the RealSense SDK is needed": ("realsense:no.bag",),
    "a RealSense states its intrinsics, unit and axes itself: leave out": ("realsense", "--depth-scale", "1000"),
    "realsense is a camera, which waits for no answer: leave out --every-frame": ("realsense", "--every-frame"),
    "realsense is no folder of frames; only such a folder can be watched": ("realsense", "--watch"),
    "--align-color is given for -; it is for RealSense cameras alone": ("-", "--align-color"),
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_what_cannot_be_is_said_before_anything_is_loaded(
    sentence: str, connect: Any, capsys: pytest.CaptureFixture
) -> None:
    connect(serials=("12",) if "12" in sentence else ())
    assert run_mereo("stream", *REFUSED[sentence], "--weights", "none.safetensors") == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_a_library_that_cannot_be_loaded_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "of_the_system.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match="x needs of_the_system, which cannot be loaded .libusb-1.0.so.0: cannot"):
        library("of_the_system", "realsense", "x")


RECORDED = Path(__file__).parents[1] / "golden" / "realsense.bag"
"""Of a device in software (pyrealsense2 2.55), by its recorder; pixel i of image n is 1000 n + i."""


def test_a_recording_has_the_images_that_were_recorded_or_is_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("pyrealsense2", reason="pip install 'mereo[realsense]'", exc_type=ImportError)
    frames = [frame for frame in camera_frames(f"realsense:{RECORDED}") if frame is not None]
    assert [frame.time_s for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30], abs=1e-6)
    for number, frame in enumerate(frames, start=1):
        read = frame.read()
        assert_allclose(read.depth.ravel(), UNIT_M * (1000 * number + np.arange(48 * 64)), rtol=1e-6)
        assert read.camera == CAMERA
    with pytest.raises(ValueError, match="gives no stream of depth and colour .*: record it again"):
        camera_frames(f"realsense:{RECORDED}", align_color=True)
    next(camera_frames(f"realsense:{RECORDED}"))  # one that is left early is closed
    path = tmp_path / "cut.bag"
    path.write_bytes(RECORDED.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"gives no stream of depth \(Failed to resolve request.*: record it again"):
        camera_frames(f"realsense:{path}")
