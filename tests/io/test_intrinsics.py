"""Intrinsics of every program mean the same camera, and depth scales of every convention the same metre."""

import json
from pathlib import Path

import numpy as np
import pytest
from folder_contents import refusal

from mereo.geometry.camera import Camera
from mereo.io.intrinsics import CameraWarning, read_camera, read_intrinsics

K = [[525.0, 0.0, 319.5], [0.0, 520.0, 239.5], [0.0, 0.0, 1.0]]
FLAT = [v for row in K for v in row]
SIZE = {"width": 640, "height": 480}
PLAIN = {"fx": 525, "fy": 520, "cx": 319.5, "cy": 239.5, **SIZE}
ROS2 = "header:\n  frame_id: depth\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\nd:\n- 0.0\n- 0.0\nk:\n"
ROS2 += "".join(f"- {v}\n" for v in FLAT) + "r:\n- 1.0\n- 0.0\n---\n"
ROS1 = f"image_width: 640\nimage_height: 480\ncamera_name: depth\nK: {FLAT}\nD: [0, 0]\n"
CALIBRATOR = f"image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {FLAT}\n"
CAMERAS = {
    "plain.json": json.dumps(PLAIN),
    "realsense.json": json.dumps({"fx": 525, "fy": 520, "ppx": 319.5, "ppy": 239.5, **SIZE}),
    "open3d.json": json.dumps({"intrinsic_matrix": np.array(K).T.ravel().tolist(), **SIZE}),
    "matrix.json": json.dumps({"K": K, **SIZE}),
    "record3d.json": json.dumps({"K": np.array(K).T.ravel().tolist(), "w": 640, "h": 480, "fps": 60}),
    "centred.json": json.dumps({"fx": 525, "fy": 520, "cx": 320.0, "cy": 240.0, "pixel_center": 0.5, **SIZE}),
    "ros2.yaml": ROS2,
    "ros1.yaml": ROS1,
    "opencv.yaml": "%YAML:1.0\n" + CALIBRATOR.replace("camera_matrix:", "camera_matrix: !!opencv-matrix"),
    "bop.json": json.dumps({"0": {"cam_K": FLAT, "depth_scale": 1.0, **SIZE}}),
    "nerfstudio.json": json.dumps({"fl_x": 525, "fl_y": 520, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}),
    "calibrator.yml": CALIBRATOR,
    "open3d parameters.json": json.dumps({"intrinsic": {"intrinsic_matrix": np.array(K).T.ravel().tolist(), **SIZE}}),
    "one for all.json": json.dumps(
        {"fl_x": 525, "fl_y": 520, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "frames": [{"file_path": "x.png"}] * 3}
    ),
    "tracking.yaml": "%YAML:1.2\nintrinsics: {f_u: 525, f_v: 520, pp_x: 319.5, pp_y: 239.5, width: 640, height: 480}\n",
}


@pytest.mark.parametrize("name", CAMERAS)
def test_all_forms_of_intrinsics_mean_the_same_camera(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(CAMERAS[name])
    # 319.5 where pixel centres are whole numbers is the middle of 640 pixels: 320
    assert read_camera(tmp_path / name) == Camera(640, 480, 525.0, 520.0, 320.0, 240.0)


@pytest.mark.parametrize(
    "content, expected",
    [
        ("{", "cannot be read as a camera intrinsics file"),
        ("[1, 2]", "not an object"),
        ('{"width": 4, "height": 3}', "neither fx, fy, cx, cy nor"),
        ('{"fx": 5, "fy": 5, "cx": 2, "cy": 2}', "no width and height"),
        ('{"fx": -5, "fy": 5, "cx": 2, "cy": 2, "width": 4, "height": 3}', "focal length is -5"),
        ('{"K": [5, 0, 2, 0], "width": 4, "height": 3}', "4 numbers instead of 9"),
        (json.dumps({"K": [*FLAT[:6], 1, 2, 1], **SIZE}), "last row of its matrix is .1.0, 2.0, 1.0. instead"),
        (json.dumps({"K": K, **SIZE, "depth_scale": 50}), "its depth scale is 50; .* correct it there"),
        (json.dumps({"K": K, **SIZE, "depth_scale": 0}), "its depth scale is 0"),
    ],
)
def test_bad_intrinsics_get_one_sentence(tmp_path: Path, content: str, expected: str) -> None:
    (tmp_path / "c.json").write_text(content)
    with refusal(expected):
        read_camera(tmp_path / "c.json")


PADDED = np.pad(np.array(K), ((0, 1), (0, 1))) + np.diag([0, 0, 0, 1])
NUMBERS = {
    "cam_K.txt": "\n".join(" ".join(f"{v:.18e}" for v in row) for row in K),
    "row.txt": " ".join(map(str, FLAT)),
    "printed.txt": f"# of the depth camera\n{K}\n",
    "four by four.txt": "\n".join(" ".join(map(str, row)) for row in PADDED.tolist()),
    "three by four.txt": ", ".join(str(v) for row in PADDED[:3].tolist() for v in row),
    "tum.txt": "525.0 520.0 319.5 239.5\n",
    "tum with a lens.txt": "525.0 520.0 319.5 239.5 0 0 0 0 0",
}


@pytest.mark.parametrize("name", NUMBERS)
def test_bare_numbers_are_intrinsics_of_the_image(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(NUMBERS[name])
    assert read_camera(tmp_path / name, (640, 480)) == Camera(640, 480, 525.0, 520.0, 320.0, 240.0)


def test_bare_numbers_of_another_image_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam_K.txt"
    for text, size, expected in (
        (
            "525 520 639.5 359.5",
            (640, 480),
            "cam_K.txt is in the middle of about 1280 x 720 pixels, the image is 640 x 480; they must agree: give ",
        ),
        (
            "525 520 159.5 119.5",
            (640, 480),
            "in the middle of about 320 x 240 pixels, .*: give the intrinsics of this image",
        ),
        ("525 520 319.5", (640, 480), "it has 3 numbers, not a matrix of 3 x 3, 3 x 4 or 4 x 4, nor fx fy cx cy"),
        ("525 520 319.5 239.5", None, "no width and height"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=expected):
            read_camera(path, size)
    path.write_text("525 520 319.5 239.5 0.1 0 0 0")
    with pytest.warns(CameraWarning, match="pixels in the corners"):
        read_camera(path, (640, 480))


BOP = {"0": {"cam_K": FLAT, "depth_scale": 0.1}, "7": {"cam_K": [600.0, *FLAT[1:]], "depth_scale": 1.0}}
NERF = {"fl_y": 520, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
FRAMES = [{"fl_x": 525, "depth_file_path": "depth/a.png"}, {"fl_x": 600, "depth_file_path": "depth/b.png"}]
MANY = {
    "scene_camera.json": (BOP, "000000.png", "000007.png", 7),
    "transforms.json": ({"frames": [{**NERF, **frame} for frame in FRAMES]}, "a.png", "b.png", 1),
}


@pytest.mark.parametrize("name", MANY)
def test_the_frame_is_chosen_by_the_images_name_or_by_its_index(tmp_path: Path, name: str) -> None:
    content, first, second, index = MANY[name]
    path = tmp_path / name
    size = (640, 480)
    path.write_text(json.dumps(content))
    assert read_intrinsics(path, size, first).camera == Camera(640, 480, 525.0, 520.0, 320.0, 240.0)
    assert read_intrinsics(path, size, second).camera.focal_x_px == 600.0
    assert read_intrinsics(path, size, first, index).camera.focal_x_px == 600.0, "the index comes first"
    with pytest.raises(ValueError, match=r"it has 2 frames from 0 to \d and no frame is named.*--frame-index"):
        read_intrinsics(path, size, "unknown.png")
    with pytest.raises(ValueError, match="frame 5 is not there"):
        read_intrinsics(path, size, None, 5)


@pytest.mark.parametrize(
    "stated, expected",
    [
        ({"depth_scale": 0.1}, 10000.0),  # BOP: a tenth of a millimetre
        ({"depth_scale": 1.0}, 1000.0),  # BOP: millimetres
        ({"depth_scale": 0.001}, 1000.0),  # RealSense: metres of one unit
        ({"depth_scale": 0.00025}, 4000.0),  # RealSense L515
        ({"depth_units": 0.0001}, 10000.0),  # RealSense's option, D405
        ({"depth_scale": 5000}, 5000.0),  # TUM
        ({}, None),
    ],
)
def test_the_stated_depth_scale_is_turned_into_ours(tmp_path: Path, stated: dict, expected: float | None) -> None:
    (tmp_path / "c.json").write_text(json.dumps(PLAIN | stated))
    found = read_intrinsics(tmp_path / "c.json").depth_scale
    assert found == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    "stated, amount",
    [
        # a corner at radius 0.75 (in focal lengths) is moved by k1 r^3 = 0.1 x 0.42, times about 525 pixels
        ({"D": [0.1, 0]}, r"up to 2\d pixels in the corners\), which is ignored: rectify"),
        ({"coeffs": [0, 0, 0.01, 0, 0], "model": "distortion.brown_conrady"}, "pixels"),
        ({"d": [0.1, 0, 0, 0], "distortion_model": "equidistant"}, "a fisheye lens"),
        ({"k1": 0.05, "k2": 0.01}, "pixels"),
        ({"distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0, 0, 0, 0]}}, "pixels"),
    ],
)
def test_distortion_in_all_its_forms(tmp_path: Path, stated: dict, amount: str) -> None:
    (tmp_path / "c.json").write_text(json.dumps(PLAIN | stated))
    with pytest.warns(CameraWarning, match=amount):
        read_camera(tmp_path / "c.json")
