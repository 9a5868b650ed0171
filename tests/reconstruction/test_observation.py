"""One frame from any kind of file, with the options that belong to it, and its size against that of training."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import write_camera
from PIL import Image

from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, DepthImage, PointCloud, SightLines
from mereo.geometry.transforms import rigid
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.models.weights import load_model
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo.reconstruction.isolation import Reading, select_object
from mereo.reconstruction.observation import (
    DENSE,
    MOST_LINES,
    find_object,
    lines_of_frame,
    lines_of_image,
    lines_of_points,
    observe,
    size_warning,
)
from mereo_serving.options import FrameOptions

CAMERA = Camera(20, 10, 30.0, 30.0, 10.0, 5.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """d.png shows 50 pixels at the value 2500; k.json is its camera."""
    write_camera(tmp_path / "k.json", CAMERA)
    depth = np.zeros((10, 20), dtype=np.uint16)
    depth[2:7, 5:15] = 2500
    Image.fromarray(depth).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", depth.astype(np.float32) / 5000)
    return tmp_path


def test_a_depth_image_becomes_the_points_it_shows(folder: Path) -> None:
    seen = find_object(read_frame(folder / "d.png", InputConfig(intrinsics=folder / "k.json", depth_scale=5000.0)))
    points = seen.cloud.points
    assert len(points) == 50 and seen.frame.unit_m == 1.0 and seen.depth_m == (0.5, 0.5, 0.5)
    np.testing.assert_allclose(points[:, 2], 0.5)
    np.testing.assert_allclose(CAMERA.project(points)[0], [5.5, 2.5])
    assert seen.size_m == pytest.approx((0.15, 4 / 60, 0.0))
    assert str(seen).splitlines() == [
        "the object has 50 points, depth 0.5 to 0.5 m (middle 0.5 m)",
        "its visible part is 0.15 x 0.0667 x 0 m",
    ]


def test_the_depth_scale_of_the_intrinsics_is_for_integers_and_gives_way(folder: Path) -> None:
    fields = json.loads((folder / "k.json").read_text())
    (folder / "bop.json").write_text(json.dumps({**fields, "depth_scale": 0.2}))
    for name, scale, expected in (
        ("d.png", None, 0.5),
        ("d.png", 2500.0, 1.0),
        ("d.npy", None, 0.5),
        ("d.npy", 0.5, 1),
    ):
        seen = find_object(read_frame(folder / name, InputConfig(intrinsics=folder / "bop.json", depth_scale=scale)))
        assert seen.depth_m[1] == pytest.approx(expected), (name, scale)


FILE = Path("k.json")


@pytest.mark.parametrize(
    "name, options, text",
    [
        ("d.png", {}, "is a depth image without intrinsics; they are needed: give --intrinsics FILE"),
        ("d.png", {"intrinsics": FILE, "frame": "scanner"}, "is a depth image; those are always in the camera frame"),
        ("d.png", {"intrinsics": FILE, "unit_m": 0.001}, "comes in metres: leave out --unit-m"),
        ("d.png", {"intrinsics": FILE, "topic": "/d"}, "is no ROS recording and has no topics"),
        ("c.ply", {"intrinsics": FILE}, "is read as a point cloud; leave out intrinsics, mask and depth scale"),
        ("c.ply", {"mask": FILE}, "is read as a point cloud; leave out intrinsics, mask and depth scale"),
        ("c.ply", {"depth_scale": 1000.0}, "is read as a point cloud; leave out intrinsics, mask and depth scale"),
    ],
)
def test_contradictory_inputs(name: str, options: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        read_frame(Path(name), InputConfig(**options))


def test_a_scan_has_no_depth(tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", np.random.default_rng(0).normal(size=(100, 3)))
    with pytest.raises(ValueError, match="scanner's frame, in which depth is not known.*crop with --box"):
        find_object(read_frame(tmp_path / "c.npy", InputConfig(frame="scanner")), IsolationConfig(depth_range=(0.1, 1)))
    seen = find_object(read_frame(tmp_path / "c.npy", InputConfig(frame="scanner")))
    assert "depth" not in str(seen) and seen.facts()["depth_m"] is None


def test_size_against_training(tmp_path: Path) -> None:
    """The Stanford Bunny is 15 cm long; the same cloud read as millimetres cannot be it."""
    np.save(tmp_path / "c.npy", np.random.default_rng(0).uniform((0, 0, 1), (0.1, 0.05, 1.1), (400, 3)))
    seen = find_object(read_frame(tmp_path / "c.npy", InputConfig(unit_m=1.0)))
    unknown = find_object(read_frame(tmp_path / "c.npy"))
    for visible_m, fits in (([0.08, 0.2], True), ([0.15, 0.3], True), ([0.25, 0.5], False), ([0.01, 0.04], False)):
        text = size_warning(seen, {"visible_m": visible_m})
        assert (text is None) == fits, visible_m
        assert size_warning(unknown, {"visible_m": visible_m}) is None, "what has no unit may be of any size"
        assert fits or (text and "m in training: other things are in the cloud" in text and "--unit-m 0.001" in text)
    assert size_warning(seen, {"scene": "bunny"}) is None and size_warning(seen, {"visible_m": None}) is None
    assert load_model("bunny").provenance["visible_m"] == pytest.approx([0.12, 0.254], abs=0.001)


def test_missing_extras_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, library in (("a.zdf", "netCDF4"), ("a.mcap", "rosbags")):
        (tmp_path / name).write_bytes(b"anything")
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(ImportError, match=rf"{name} needs {library}.*: pip install 'mereo\[sensors\]'"):
            read_frame(tmp_path / name)


WIDE = Camera(60, 50, 80.0, 80.0, 30.0, 25.0)
SHOWN = np.zeros((50, 60), dtype=bool)
SHOWN[15:35, 20:40] = True


def scene() -> np.ndarray:
    """A square at 1 m before a wall at 2 m; a strip at 0.8 m left of it, nothing measured above row 10."""
    depth = np.where(SHOWN, 1.0, 2.0)
    depth[:, :19] = 0.8
    depth[:10] = 0.0
    return depth


def pixels(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(int).T
    return rows, columns


def test_each_pixel_has_its_kind_and_a_lone_depth_between_object_and_wall_is_no_surface() -> None:
    lines = lines_of_image(DepthImage(scene(), WIDE), SHOWN)
    expected = np.where(scene() == 2.0, "p", "u")
    expected[14:36, 19:41] = "u"  # the rim, which the object's own pixels cover but for one all around
    expected[SHOWN] = ""
    image = np.full((50, 60), "", dtype="U1")
    for points, kind in ((lines.past, "p"), (lines.unknown, "u")):
        image[pixels(points, WIDE)] = kind
    wrong = image != expected
    # at the ends of the wall, at other depths beside it, a pixel may have too few that agree
    assert wrong.sum() <= 4 and not wrong[12:38, 17:43].any()
    assert lines.other_lines == "unknown"
    depth = scene()
    depth[25, 42] = 1.5
    lines = lines_of_image(DepthImage(depth, WIDE), SHOWN)
    assert 1.5 not in lines.past[:, 2]
    assert (25, 42) in set(zip(*pixels(lines.unknown, WIDE), strict=True))


def test_a_depth_as_far_as_the_object_is_unknown() -> None:
    depth = np.where(SHOWN, 1.0, np.where(np.arange(50)[:, None] >= 35, 1.02, 2.0))
    labels = lines_of_image(DepthImage(depth, WIDE), SHOWN)
    assert 1.02 not in labels.past[:, 2] and (np.isclose(depth[pixels(labels.unknown, WIDE)], 1.02)).sum() > 500
    by_cloud = lines_of_points(DepthImage(depth, WIDE).to_points().points, SHOWN.ravel())
    assert 1.02 not in by_cloud.past[:, 2] and (np.isclose(by_cloud.unknown[:, 2], 1.02)).sum() > 500


def test_a_tool_that_hides_the_object_is_unknown_where_it_is_farther_away_too() -> None:
    """It comes from behind the object's near side, and passes before it."""
    column = np.ones((50, 1)) * np.arange(60)
    tool = np.zeros(SHOWN.shape, dtype=bool)
    tool[18:32, :20] = True
    depth = np.where(SHOWN, 1.0 + 0.025 * (column - 20), np.where(tool, 0.8 + 0.026 * (19 - column), 2.0))
    past = np.zeros(SHOWN.shape, dtype=bool)
    lines = lines_of_image(DepthImage(depth, WIDE), SHOWN).past
    past[pixels(lines[WIDE.project(lines).min(axis=1) >= 0], WIDE)] = True
    assert past[:10].sum() > 100 and not past[tool].any()


def test_many_lines_are_thinned_far_from_the_object_only() -> None:
    camera = Camera(600, 500, 800.0, 800.0, 300.0, 250.0)
    shown, depth = np.kron(SHOWN, np.ones((10, 10), dtype=bool)), np.kron(scene(), np.ones((10, 10)))
    lines = lines_of_image(DepthImage(depth, camera), shown)
    kept = np.zeros(shown.shape, dtype=bool)
    for points in (lines.past, lines.unknown):
        kept[pixels(points, camera)] = True
    assert 0.5 * MOST_LINES < kept.sum() <= MOST_LINES
    rows, columns = np.mgrid[:500, :600]
    distance = np.hypot(
        np.maximum(np.maximum(150 - rows, rows - 349), 0), np.maximum(np.maximum(200 - columns, columns - 399), 0)
    )
    assert kept[(distance > 0) & (distance <= DENSE)].all()


def test_a_cloud_has_the_kinds_of_its_image() -> None:
    whole = DepthImage(scene(), WIDE)
    cut = DepthImage(np.where(SHOWN, whole.depth, 0.0), WIDE)
    frame = SensorFrame(Path("x"), cut.to_points(), 1.0, "camera", cut, whole=whole)
    by_image = find_object(frame).lines
    by_cloud = find_object(
        SensorFrame(Path("x"), whole.to_points(), 1.0, "camera"), IsolationConfig(depth_range=(0.9, 1.1))
    ).lines
    assert by_cloud.other_lines is None
    past, unknown = (
        {place for place in zip(*pixels(points, WIDE), strict=True) if 5 <= place[0] < 45 and 5 <= place[1] < 55}
        for points in (by_cloud.past, by_cloud.unknown)
    )
    by_pixel = set(zip(*pixels(by_image.past, WIDE), strict=True))
    measured = set(zip(*np.nonzero(scene() > 0), strict=True))
    near = {place for place in measured if 5 <= place[0] < 45 and 5 <= place[1] < 55 and not SHOWN[place]}
    assert past | unknown == near and past & unknown == set()
    # but for the corner of the wall, where too few pixels agree
    assert past >= by_pixel & near and len(past - by_pixel) <= 2


def test_a_scanner_has_the_lines_of_a_camera() -> None:
    points = DepthImage(scene(), WIDE).to_points().points
    is_object = points[:, 2] == 1.0
    selection = replace(select_object(PointCloud(points), IsolationConfig()), keep=is_object)
    axes = rigid(SCANNER_TO_CAMERA, np.zeros(3))
    scanned = points @ axes[:3, :3].T
    lines = lines_of_frame(SensorFrame(Path("x"), PointCloud(scanned), None, "scanner"), selection)
    # in the file's own axes: single points of it
    everything = {tuple(np.round(point, 9)) for point in scanned}
    assert {tuple(np.round(point, 9)) for point in (*lines.past, *lines.unknown)} <= everything
    assert (lines.past[:, 2] == -2.0).mean() > 0.999 and len(lines.past) > 500
    assert (np.isclose(lines.unknown[:, 2], -0.8)).sum() > 100
    turned = SightLines(lines.past, lines.unknown, "past").transformed(axes)
    np.testing.assert_allclose(turned.past, lines.past * [1, -1, -1])
    assert turned.other_lines == "past"


def test_points_that_were_only_thinned_out_are_the_objects() -> None:
    camera = Camera(400, 300, 400.0, 400.0, 200.0, 150.0)
    x, y, _ = np.moveaxis(camera.directions(), 2, 0)
    ball = x**2 + y**2 < 0.2**2
    depth = np.where(ball, 1.0 - np.sqrt(np.maximum(0.2**2 - x**2 - y**2, 0.0)), 3.0)
    whole = DepthImage(depth, camera)
    seen = find_object(
        SensorFrame(Path("x"), whole.to_points(), 1.0, "camera", whole, whole=whole),
        IsolationConfig(largest_cluster=True),
    )
    # the wall is larger: so the ball is what is left out, behind nothing, and the wall is the object
    assert seen.selection is not None and seen.selection.thinned.any()
    rest = seen.selection.of_object(seen.frame.cloud.points)
    assert rest.sum() > len(seen.cloud) and not rest[ball.ravel()].any()
    assert rest[~ball.ravel()].mean() > 0.999
    rows, columns = pixels(seen.lines.unknown, camera)
    inside = (rows >= 0) & (rows < 300) & (columns >= 0) & (columns < 400)
    assert ball[rows[inside], columns[inside]].mean() > 0.9 and len(seen.lines.past) == 0


@pytest.mark.parametrize(("extent", "other_lines"), [("whole", "past"), ("partial", "unknown"), ("auto", None)])
def test_the_extent_can_be_stated(extent: Extent, other_lines: str | None) -> None:
    lines = observe(PointCloud(np.random.default_rng(0).normal((0, 0, 10), size=(50, 3))), extent=extent).lines
    assert lines.other_lines == other_lines and len(lines.past) == len(lines.unknown) == 0
    whole = DepthImage(scene(), WIDE)
    cut = DepthImage(np.where(SHOWN, whole.depth, 0.0), WIDE)
    frame = SensorFrame(Path("x"), cut.to_points(), 1.0, "camera", cut, whole=whole)
    lines = find_object(frame, IsolationConfig(extent=extent)).lines
    assert lines.other_lines == (other_lines or "unknown")
    assert (len(lines.past) > 0) == (extent != "partial") and (len(lines.unknown) > 0) == (extent == "auto")
    assert not IsolationConfig(extent=extent).on and FrameOptions(extent=extent).isolation().extent == extent


def test_a_file_keeps_what_its_mask_leaves_out(tmp_path: Path) -> None:
    write_camera(tmp_path / "k.json", WIDE)
    Image.fromarray((1000 * scene()).astype(np.uint16)).save(tmp_path / "d.png")
    Image.fromarray(SHOWN).save(tmp_path / "m.png")
    frame = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json", mask=tmp_path / "m.png"))
    assert frame.depth is not None and frame.whole is not None and len(frame.cloud) == 400
    np.testing.assert_allclose(frame.whole.depth, scene())
    seen = find_object(frame)
    assert len(seen.lines.past) > 500 and seen.lines.other_lines == "unknown"
    # strays are dropped from the points, and remain lines of sight that met something
    fewer = seen.read_as(Reading(seen.cloud, np.arange(400) > 20))
    assert len(fewer.cloud) == 379
    np.testing.assert_array_equal(fewer.lines.past, seen.lines.past)
    unmasked = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json"))
    isolated = find_object(unmasked, IsolationConfig(depth_range=(0.9, 1.1)))
    np.testing.assert_array_equal(isolated.lines.past, seen.lines.past)
    np.testing.assert_array_equal(isolated.lines.unknown, seen.lines.unknown)
