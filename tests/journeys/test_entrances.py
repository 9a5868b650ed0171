"""One frame has one answer, whatever holds it and through whichever door it comes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import write_camera
from toy_frames import MODEL, seen
from two_balls import scene

import mereo
from mereo.fitting.registration.answer import Answer
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.io.atomic_files import to_json
from mereo.visualization.result_files import summary_of

pytestmark = pytest.mark.usefixtures("small_previews")

RESOLUTION = 12


def figures(summary: Answer | dict[str, Any]) -> dict[str, Any]:
    """What of a summary no clock and no name of a file decides, as JSON has it."""
    plain = json.loads(json.dumps(to_json(summary_of(summary) if isinstance(summary, Answer) else summary)))
    return {name: value for name, value in plain.items() if name not in ("timings_s", "title", "source", "weights")}


def asked(frame: Any, **reading: Any) -> mereo.Result:
    return mereo.reconstruct(frame, MODEL, "network", resolution=RESOLUTION, **reading)


def same(found: Answer, wanted: Answer) -> None:
    np.testing.assert_array_equal(found.seen.cloud.points, wanted.seen.cloud.points)
    np.testing.assert_array_equal(found.reconstruction.labels.labels, wanted.reconstruction.labels.labels)
    np.testing.assert_array_equal(found.surfaces.merged()[0], wanted.surfaces.merged()[0])
    assert figures(found) == figures(wanted)


@pytest.fixture(scope="module")
def result() -> mereo.Result:
    return asked(seen())


def ply(path: Path) -> Path:
    """The points as doubles, so that none is rounded."""
    rows = "\n".join(" ".join(repr(float(value)) for value in point) for point in seen())
    head = "\n".join(f"property double {axis}" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(seen())}\n{head}\nend_header\n{rows}\n")
    return path


def npy(path: Path) -> Path:
    np.save(path, seen())
    return path


CLOUDS: dict[str, Callable[[Path], Any]] = {
    "array": lambda _: seen(),
    "list": lambda _: seen().tolist(),
    "PointCloud": lambda _: PointCloud(seen()),
    "npy, a string": lambda folder: str(npy(folder / "cloud.npy")),
    "ply": lambda folder: ply(folder / "cloud.ply"),
    "load_frame of an array": lambda _: mereo.load_frame(seen()),
    "load_frame of a file": lambda folder: mereo.load_frame(npy(folder / "cloud.npy")),
}


@pytest.mark.parametrize("kind", CLOUDS)
def test_points_have_one_answer(kind: str, result: mereo.Result, tmp_path: Path) -> None:
    found = asked(CLOUDS[kind](tmp_path))
    same(found, result)
    assert found.unit_m is None and found.seen.frame.axes == "camera"


@pytest.mark.parametrize("axes", ["camera", "scanner"])
def test_axes_and_unit_are_the_same_beside_the_frame_and_before_it(axes: CloudAxes, tmp_path: Path) -> None:
    points, model = scene(axes)
    np.save(tmp_path / "cloud.npy", points)
    reading: dict[str, Any] = {"axes": axes, "unit_m": 0.5}

    def found(frame: Any, **given: Any) -> mereo.Result:
        return mereo.reconstruct(frame, model, "network", resolution=RESOLUTION, **given)

    wanted = found(points, **reading)
    assert wanted.unit_m == 0.5 and wanted.seen.frame.axes == axes
    for frame in (points.tolist(), PointCloud(points), tmp_path / "cloud.npy"):
        same(found(frame, **reading), wanted)
        same(found(mereo.load_frame(frame, **reading)), wanted)


def test_a_list_of_frames_is_a_list_of_answers(result: mereo.Result, tmp_path: Path) -> None:
    frames: list[Any] = [seen(), PointCloud(seen()), npy(tmp_path / "cloud.npy"), mereo.load_frame(seen())]
    found = mereo.reconstruct(frames, MODEL, "network", resolution=RESOLUTION)
    assert len(found) == len(frames)
    for one in found:
        same(one, result)
    read = [mereo.load_frame(seen()), found[0].seen]
    for many in (read, tuple(read)):
        assert [one.unit_m for one in mereo.reconstruct(many, MODEL, "network", resolution=8)] == [None, None]


def depth_image() -> DepthImage:
    """A bump before a camera, in whole millimetres."""
    camera = Camera.from_fov(48, 36, 0.6)
    rows, columns = np.indices((36, 48))
    away = np.hypot(rows - 17.5, columns - 23.5)
    return DepthImage(np.where(away < 15, np.rint(600 - np.sqrt(np.maximum(15**2 - away**2, 0))) / 1000, 0.0), camera)


def test_a_depth_image_has_one_answer(tmp_path: Path) -> None:
    image = depth_image()
    millimetres = np.rint(1000 * image.depth).astype(np.uint16)
    np.save(tmp_path / "depth.npy", millimetres)
    write_camera(tmp_path / "camera.json", image.camera)
    wanted = asked(image, unit_m=1.0)
    scaled: dict[str, Any] = {"intrinsics": tmp_path / "camera.json", "depth_scale": 1000}
    for found in (
        asked(millimetres, intrinsics=image.camera, depth_scale=1000),
        asked(millimetres, **scaled),
        asked(tmp_path / "depth.npy", **scaled),
        asked(mereo.load_frame(tmp_path / "depth.npy", **scaled)),
        asked(mereo.load_frame(image, unit_m=1.0)),
    ):
        same(found, wanted)
    assert wanted.unit_m == 1.0 and asked(image).unit_m is None, "an image of any unit, unless it is said"
