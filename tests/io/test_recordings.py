"""ROS 1 bags, ROS 2 bags and MCAP files, written here by rosbags itself, give back depth and points."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folder_contents import refusal
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from mereo.geometry.camera import Camera, DepthImage
from mereo.io.atomic_files import JsonObject
from mereo.io.config import InputConfig
from mereo.io.intrinsics import CameraWarning
from mereo.io.ros_recordings import recorded_frame, recorded_frames
from mereo.io.sensor_frame import read_frame

pytest.importorskip("rosbags", reason="rosbags comes with the extra sensors")

from recorded_bags import DEPTH_MM, Messages, Topics, depth_topics, write_bag

CAMERA = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)


def check_depths(path: Path) -> None:
    for frame, depth in zip(recorded_frames(path), DEPTH_MM, strict=True):
        content = frame.read()
        assert isinstance(content, DepthImage) and content.camera == CAMERA
        assert_array_equal(content.depth, depth / 1000)


def depth_in(path: Path, **options: Any) -> DepthImage:
    content = recorded_frame(path, **options).read()
    assert isinstance(content, DepthImage)
    return content


@pytest.mark.parametrize("name, ros", [("a.bag", 1), ("a.db3", 2), ("a.mcap", 2)])
def test_the_depth_topic_is_found_and_read(tmp_path: Path, name: str, ros: int) -> None:
    path = write_bag(tmp_path / name, ros, depth_topics)
    assert [frame.time_s for frame in recorded_frames(path)] == [1.0, 2.0, 3.0]
    check_depths(path)
    seen = read_frame(path, InputConfig(frame_index=2))
    assert len(seen.cloud) == 47 and seen.unit_m == 1.0
    assert seen.source == f"{path.name}, /camera/depth/image_raw at 3.000 s"
    assert seen.depth is not None
    assert_array_equal(seen.depth.depth, DEPTH_MM[2] / 1000)


def test_a_recording_that_is_damaged_anywhere_is_a_sentence_after_its_whole_frames(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", 1, depth_topics)
    whole = path.read_bytes()
    sentences = set()
    for start in range(4096, len(whole), 131):
        path.write_bytes(whole[:start] + b"\xff" * 60 + whole[start + 60 :])
        try:
            for frame in recorded_frames(path):
                frame.read()
        except ValueError as error:
            sentences.add(str(error))
    farther = [text for text in sentences if f"{path} cannot be read as a ROS bag (" in text]
    assert farther and all(text.endswith("record or copy it again") for text in farther)


def test_the_unit_is_that_which_the_sdk_of_a_realsense_records(tmp_path: Path) -> None:
    def topics(make: Messages) -> Topics:
        depth = make.image(DEPTH_MM[0], "16UC1")
        unit = make.types["std_msgs/msg/String"](data="0.000100")
        return {"/a/Depth_0": [depth], "/b": [make.info()], "/a/option/Depth_Units/value": [unit]}

    assert_allclose(depth_in(write_bag(tmp_path / "a.mcap", 2, topics)).depth, DEPTH_MM[0] / 10_000)


def test_floats_are_metres_in_either_byte_order(tmp_path: Path) -> None:
    metres = (DEPTH_MM / np.float32(1000)).astype(np.float32)
    metres[DEPTH_MM == 0] = np.nan
    path = write_bag(
        tmp_path / "a.bag", 1, lambda m: {"/d/image": [m.image(metres[0], "32FC1", big=True)], "/d/info": [m.info()]}
    )
    assert_allclose(depth_in(path).depth, DEPTH_MM[0] / 1000, rtol=1e-6)


def test_compressed_depth_is_found_beside_compressed_colour(tmp_path: Path) -> None:
    def topics(make: Messages) -> Topics:
        return {
            "/camera/color/image_raw/compressed": [make.compressed(DEPTH_MM[0], "bgr8; jpeg compressed bgr8")],
            "/camera/depth/image_raw/compressedDepth": [
                make.compressed(depth, "16UC1; compressedDepth png") for depth in DEPTH_MM
            ],
            "/camera/depth/camera_info": [make.info()],
        }

    check_depths(write_bag(tmp_path / "a.mcap", 2, topics))


def test_compressed_floats_are_inverse_depth(tmp_path: Path) -> None:
    """The transport's own formulas: a = z0 (z0 + 1) and b = 1 - a / zmax give a / z + b in 16 bits."""
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
    metres = np.where(DEPTH_MM[0] > 0, DEPTH_MM[0] / 1000, 1.0)
    stored = np.where(DEPTH_MM[0] > 0, np.round(a / metres + b), 0)
    format_ = "32FC1; compressedDepth"
    path = write_bag(
        tmp_path / "a.bag", 1, lambda m: {"/d/c": [m.compressed(stored, format_, (a, b))], "/d/info": [m.info()]}
    )
    assert_allclose(depth_in(path).depth, DEPTH_MM[0] / 1000, rtol=2e-4)


@pytest.mark.parametrize(
    "format_", ["16UC1; compressedDepth rvl", "rgb8; jpeg compressed bgr8", "8UC1; compressedDepth"]
)
def test_other_compressions_are_refused(tmp_path: Path, format_: str) -> None:
    path = write_bag(
        tmp_path / "a.bag", 1, lambda m: {"/d/c": [m.compressed(DEPTH_MM[0], format_)], "/d/info": [m.info()]}
    )
    with pytest.raises(ValueError, match=f"its format is '{format_}', not PNG-compressed depth"):
        recorded_frame(path, topic="/d/c").read()


def test_point_clouds_keep_their_missing_points_until_asked(tmp_path: Path) -> None:
    points = default_rng(1).normal((0, 0, 2), 0.1, (80, 3)).astype(np.float32)
    points[5] = np.nan
    path = write_bag(tmp_path / "a.mcap", 2, lambda m: {"/points": [m.cloud(points)]})
    assert_array_equal(recorded_frame(path).read(), points.astype(float))
    with pytest.raises(ValueError, match="1 of 80 points without a measurement.*--drop-invalid"):
        read_frame(path)
    assert len(read_frame(path, InputConfig(drop_invalid=True)).cloud) == 79


def test_distortion_counts_unless_the_topic_is_rectified(tmp_path: Path) -> None:
    def topics(make: Messages) -> Topics:
        image = make.image(DEPTH_MM[0], "16UC1")
        info = make.info(focal=20.0, distortion=0.2)
        return {"/d/image_raw": [image], "/d/image_rect": [image], "/d/camera_info": [info]}

    path = write_bag(tmp_path / "a.bag", 1, topics)
    with pytest.warns(CameraWarning, match="states lens distortion"):
        assert depth_in(path, topic="/d/image_raw").camera.focal_x_px == 20.0
    assert depth_in(path, topic="/d/image_rect").camera == CAMERA, "matrix P, not K"


def test_one_broken_frame_stops_nothing(tmp_path: Path) -> None:
    def topics(make: Messages) -> Topics:
        good, odd = make.image(DEPTH_MM[0], "16UC1"), make.image(DEPTH_MM[0, :, :4], "16UC1")
        return {"/d/image": [good, odd, good], "/d/camera_info": [make.info()]}

    frames = list(recorded_frames(write_bag(tmp_path / "a.bag", 1, topics)))
    with pytest.raises(ValueError, match=r"/d/image at 2000000000 ns cannot be read .*4 x 6 pixels.*: take another"):
        frames[1].read()
    assert isinstance(frames[2].read(), DepthImage)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"topic": "/nothing"}, "no images or clouds on topic '/nothing'; those it has are on: /camera/color"),
        ({"frame_index": 3}, "has 3 frames; frame 3 is asked for"),
        ({"topic": "/camera/color/image_raw"}, "its encoding is 'mono8', not one of 16UC1"),
        ({"frame": "scanner"}, "is a recording; those are always in the camera frame"),
    ],
)
def test_what_a_recording_does_not_have_is_said(tmp_path: Path, options: JsonObject, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        read_frame(write_bag(tmp_path / "a.bag", 1, depth_topics), InputConfig(**options))


def test_what_is_no_recording_of_depth_is_said(tmp_path: Path) -> None:
    blind = write_bag(tmp_path / "blind.bag", 1, lambda m: {"/d/image": [m.image(DEPTH_MM[0], "16UC1")]})
    with pytest.raises(ValueError, match="has no CameraInfo.*--intrinsics"):
        recorded_frame(blind)
    assert depth_in(blind, camera=CAMERA).camera == CAMERA
    color = write_bag(tmp_path / "color.bag", 1, lambda m: {"/c": [m.image(np.zeros((6, 8), np.uint8), "mono8")]})
    with pytest.raises(ValueError, match=r"has neither depth images .* only /c \(sensor_msgs/msg/Image\)"):
        recorded_frame(color)
    (tmp_path / "noise.mcap").write_bytes(b"noise" * 50)
    with refusal(r"noise.mcap cannot be read as a ROS bag"):
        recorded_frame(tmp_path / "noise.mcap")
    with pytest.raises(FileNotFoundError, match="does not exist; a ROS bag is needed"):
        recorded_frame(tmp_path / "no.bag")
