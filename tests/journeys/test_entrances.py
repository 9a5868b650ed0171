"""One frame has one answer, whatever holds it and through whichever door it comes."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from camera_files import write_camera
from numpy.testing import assert_allclose, assert_array_equal
from page_blocks import ROOT, blocks
from toy_frames import MODEL, NAMES, seen
from two_balls import scene

import mereo
from mereo.fitting.registration.answer import Answer
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.io.atomic_files import JsonObject, to_json
from mereo.io.writers.meshes import write_positions_ply
from mereo.synthesis.depth_sensor import KINECT_DISPARITY_M, axial_std_m, quantize
from mereo.visualization.result_files import summary_of

pytestmark = pytest.mark.usefixtures("small_previews")

RESOLUTION = 12


def figures(summary: Answer | JsonObject) -> JsonObject:
    """What of a summary no clock and no name of a file decides, as JSON has it."""
    plain = json.loads(json.dumps(to_json(summary_of(summary) if isinstance(summary, Answer) else summary)))
    return {name: value for name, value in plain.items() if name not in ("timings_s", "title", "source", "weights")}


def asked(frame: Any, **reading: Any) -> mereo.Result:
    return mereo.reconstruct(frame, MODEL, "network", resolution=RESOLUTION, **reading)


def same(found: Answer, wanted: Answer) -> None:
    assert_array_equal(found.seen.cloud.points, wanted.seen.cloud.points)
    assert_array_equal(found.reconstruction.labels.labels, wanted.reconstruction.labels.labels)
    assert_array_equal(found.surfaces.merged()[0], wanted.surfaces.merged()[0])
    assert figures(found) == figures(wanted)


@pytest.fixture(scope="module")
def result() -> mereo.Result:
    return asked(seen())


def npy(path: Path) -> Path:
    np.save(path, seen())
    return path


@pytest.mark.parametrize("axes", ["camera", "scanner"])
def test_axes_and_unit_are_the_same_beside_the_frame_and_before_it(axes: CloudAxes, tmp_path: Path) -> None:
    points, model = scene(axes)
    np.save(tmp_path / "cloud.npy", points)
    reading = {"axes": axes, "unit_m": 0.5}

    def found(frame: Any, **given: Any) -> mereo.Result:
        return mereo.reconstruct(frame, model, "network", resolution=RESOLUTION, **given)

    wanted = found(points, **reading)
    assert wanted.unit_m == 0.5 and wanted.seen.frame.axes == axes
    for frame in (points.tolist(), PointCloud(points), tmp_path / "cloud.npy", str(tmp_path / "cloud.npy")):
        same(found(frame, **reading), wanted)
        same(found(mereo.load_frame(frame, **reading)), wanted)


def test_a_list_of_frames_is_a_list_of_answers(result: mereo.Result, tmp_path: Path) -> None:
    frames = [seen(), PointCloud(seen()), npy(tmp_path / "cloud.npy"), mereo.load_frame(seen())]
    found = mereo.reconstruct(frames, MODEL, "network", resolution=RESOLUTION)
    assert len(found) == len(frames) and result.unit_m is None and result.seen.frame.axes == "camera"
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
    scaled = {"intrinsics": tmp_path / "camera.json", "depth_scale": 1000}
    for found in (
        asked(millimetres, intrinsics=image.camera, depth_scale=1000),
        asked(millimetres, **scaled),
        asked(tmp_path / "depth.npy", **scaled),
        asked(mereo.load_frame(tmp_path / "depth.npy", **scaled)),
        asked(mereo.load_frame(image, unit_m=1.0)),
    ):
        same(found, wanted)
    assert wanted.unit_m == 1.0 and asked(image).unit_m is None, "an image of any unit, unless it is said"


CAMERAS, TOOLS = ROOT / "docs" / "cameras.md", ROOT / "docs" / "from-other-tools.md"
MODELS = ("structured-light", "time-of-flight")


Variables = dict[str, Any]
"""What a block of code leaves, by name."""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Variables]:
    """Run the only block that has a word, next to frame.ply; stand-ins are modules by their names."""

    def run_block(word: str, modules: Variables) -> Variables:
        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(mereo, "load_object", lambda _: MODEL, raising=False)
        (code,) = (code for code in blocks(TOOLS, "python") if word in code)
        names = {}
        exec(compile(code, word, "exec"), names)
        return names

    write_positions_ply(tmp_path / "frame.ply", seen())
    return run_block


def test_open3d(run: Callable[..., Variables]) -> None:
    cloud = SimpleNamespace(points=np.concatenate([seen(), [[0, 0, 0], [np.nan, 1, 1]]]))
    open3d = MagicMock(**{"io.read_point_cloud.return_value": cloud})
    names = run("import open3d", {"open3d": open3d})
    assert np.array_equal(names["without_nan"](cloud.points), seen())
    ((drawn,),) = open3d.visualization.draw_geometries.call_args_list[0][:1]
    assert drawn[0] is cloud and set(names["meshes"]) == set(NAMES[:2]) and len(drawn) == 3


def test_slicer(run: Callable[..., Variables], tmp_path: Path) -> None:
    slicer = MagicMock()
    names = run("import slicer", {"slicer": slicer})
    slicer.util.loadSegmentation.assert_called_once_with(str(Path("result/labels.seg.nrrd")))
    assert (tmp_path / "result/labels.seg.nrrd").is_file()
    made = slicer.mrmlScene.AddNewNodeByClass
    node, points = slicer.util.updateMarkupsControlPointsFromArray.call_args[0]
    assert made.call_args[0][1] == "centroids" and node is made.return_value
    assert_allclose(points[0], [-20, 30, 600], atol=8)
    assert_allclose(names["from_ras_mm"](names["to_ras_mm"](seen(), 0.5), 0.5), seen())
    assert names["to_ras_mm"]([[1, 2, 3]], 0.001).tolist() == [[-1, -2, 3]]


def test_the_table_of_distances_follows_the_formulas() -> None:
    row = r"^\| ([\d.]+) \| ([\d.]+), ([\d.]+) \| ([\d.]+) \| ([\d.]+), ([\d.]+) \| (\d+) \| (\d+) \|$"
    rows = re.findall(row, CAMERAS.read_text(), re.M)
    assert len(rows) == 6
    for z, *stated in np.array(rows, float).tolist():
        at = np.full(2, z)
        angles = np.deg2rad([0.0, 60.0])
        light, flight = (1e3 * axial_std_m(at, angles, model) for model in MODELS)
        assert stated[:5] == pytest.approx((*light, 1e3 * z**2 / KINECT_DISPARITY_M, *flight), abs=0.0051)
        assert stated[5:] == [round(0.1 * focal / z) for focal in (420, 525)]
    depths = np.unique(quantize(np.linspace(0.99, 1.01, 10_000), 1.0))
    assert 1e3 * np.median(np.diff(depths)) == pytest.approx(2.85, abs=0.02), "the step as it is simulated"
