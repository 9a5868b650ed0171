"""Lines of sight beside the object: what a frame rules out is empty, and where it could not see is unknown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import write_camera
from PIL import Image

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.scanner_axes import SCANNER_TO_CAMERA
from mereo.geometry.sight_lines import SightLines
from mereo.geometry.transforms import rigid
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo.reconstruction.isolation import select_object
from mereo.reconstruction.lines_of_sight import DENSE, MOST_LINES, lines_of_frame, lines_of_image, lines_of_points
from mereo.reconstruction.observation import find_object, observe
from mereo.reconstruction.strays import Reading
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.serving.options import FrameOptions
from mereo.synthesis.clutter import BACKGROUND, NOTHING, OBJECT, OCCLUDER
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import View, sample_view
from mereo.synthesis.occluded_views import Cut, OccludedView, occlude
from mereo.visualization.sight_picture import OBJECT_COLOR, PAST_COLOR, UNKNOWN_COLOR, sight_picture

CLEAN = GenerateConfig(noise_std=0.0)
CUTS: tuple[Cut, ...] = ("none", "screen", "picture", "tool", "hand")


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [
        sample_view(load_scene(name), CLEAN, example_rng(1000, i)) for name in ("lizard", "robot") for i in range(2)
    ]


def pixels(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(int).T
    return rows, columns


def kinds(seen: OccludedView, lines: SightLines) -> np.ndarray:
    """Image of "p" and "u" where a line of sight is kept, "" elsewhere; each line is in one pixel of its own."""
    image = np.full(seen.mask.shape, "", dtype="U1")
    for points, kind in ((lines.past, "p"), (lines.unknown, "u")):
        rows, columns = pixels(points, seen.whole.camera)
        inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
        assert (image[rows[inside], columns[inside]] == "").all()
        image[rows[inside], columns[inside]] = kind
    return image


def surrounded(image: np.ndarray) -> np.ndarray:
    """Pixels around which all 5 x 5 are true."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, 2, constant_values=True), (5, 5))
    return np.asarray(windows.all(axis=(2, 3)))


# --- what is true of every frame -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CUTS)
def test_past_is_empty_and_nothing_is_known_where_the_object_is_hidden(views: list[View], kind: Cut) -> None:
    for number, view in enumerate(views):
        for share in (0.3, 0.5):
            seen = occlude(view, kind, share, np.random.default_rng(number), CLEAN)
            lines = find_object(seen.frame()).lines
            rows, columns = pixels(lines.past, seen.whole.camera)
            # each past line ends at what was measured there, and no part of the true object is before that
            np.testing.assert_allclose(lines.past[:, 2], seen.whole.depth[rows, columns])
            alone = seen.alone.depth[rows, columns]
            assert ((alone == 0) | (alone >= lines.past[:, 2])).all()
            labels = kinds(seen, lines)
            assert (labels[seen.mask] == "").all()
            hidden = (seen.alone.depth > 0) & (seen.source == OCCLUDER)
            assert (labels[hidden] != "p").all()
            # the wall is past the object, wherever nothing else is near
            assert (labels[surrounded(seen.source == BACKGROUND)] != "u").all() and (labels == "p").sum() > 1000
            # an occlusion edge is no silhouette: hidden pixels beside the visible ones are there, and unknown
            near = ~surrounded(~seen.mask)
            assert (labels[hidden & near] == "u").all()
            assert lines.elsewhere == "unknown"


@pytest.mark.parametrize("sensor", ["structured-light", "time-of-flight"])
def test_under_sensors_and_wrong_masks_few_lines_are_wrong(views: list[View], sensor: Sensor) -> None:
    wrong = total = known = 0
    for number, view in enumerate(views):
        for kind in CUTS:
            seen = occlude(view, kind, 0.3, np.random.default_rng(number), GenerateConfig(sensor=SENSORS[sensor]))
            lines = find_object(seen.frame()).lines
            alone = seen.alone.depth[pixels(lines.past, seen.whole.camera)]
            wrong += int(((alone > 0) & (alone < lines.past[:, 2] - 1)).sum())
            total += len(lines.past)
            labels = kinds(seen, lines)[surrounded((seen.source == BACKGROUND) & seen.whole.valid & ~seen.mask)]
            known += (labels == "p").sum() / ((labels == "p") | (labels == "u")).sum()
    assert wrong < 0.002 * total
    assert known > 0.97 * len(views) * len(CUTS)


def test_a_rendered_image_leaves_open_what_is_beside_the_object(views: list[View]) -> None:
    for number, view in enumerate(views):
        seen = occlude(view, "none", 0.0, np.random.default_rng(0), CLEAN, wall=False)
        lines = find_object(seen.frame()).lines
        assert lines.elsewhere is None and len(lines.past) == len(lines.unknown) == 0
        # an occluder before nothing is unknown, and the zeros around it remain open
        seen = occlude(view, "hand", 0.3, np.random.default_rng(number), CLEAN, wall=False)
        lines = find_object(seen.frame()).lines
        labels = kinds(seen, lines)
        assert lines.elsewhere is None and (labels[seen.source == NOTHING] == "").all()
        hidden = (seen.alone.depth > 0) & (seen.source == OCCLUDER)
        assert hidden.any() and (labels[hidden] == "u").all()


def test_outside_the_picture_is_unknown_where_the_object_reaches_its_edge(views: list[View]) -> None:
    for wall in (True, False):
        seen = occlude(views[0], "picture", 0.5, np.random.default_rng(1), CLEAN, wall=wall)
        camera, whole = seen.whole.camera, views[0].depth.camera
        assert camera.width * camera.height < whole.width * whole.height
        lines = find_object(seen.frame()).lines
        rows, columns = pixels(lines.unknown, camera)
        outside = (rows < 0) | (rows >= camera.height) | (columns < 0) | (columns >= camera.width)
        # every pixel of the object that is lost, and near, has an unknown line of sight
        lost = views[0].depth.to_points().points
        u, v = camera.project(lost).T
        lost = lost[((u < 0) | (u >= camera.width) | (v < 0) | (v >= camera.height))]
        assert len(lost) > 50
        sight = lines.unknown[outside, :2] / lines.unknown[outside, 2:]
        gap = np.linalg.norm(sight[:, None] - (lost[:, :2] / lost[:, 2:])[None], axis=2).min(axis=0)
        assert gap.max() < 4 / camera.focal_x_px and np.median(gap) < 1e-9 + 1 / camera.focal_x_px
        assert lines.elsewhere == ("unknown" if wall else None)


# --- one scene by hand -----------------------------------------------------------------------------------------------

CAMERA = Camera(60, 50, 80.0, 80.0, 30.0, 25.0)
SHOWN = np.zeros((50, 60), dtype=bool)
SHOWN[15:35, 20:40] = True


def scene() -> np.ndarray:
    """A square at 1 m before a wall at 2 m; a strip at 0.8 m left of it, nothing measured above row 10."""
    depth = np.where(SHOWN, 1.0, 2.0)
    depth[:, :19] = 0.8
    depth[:10] = 0.0
    return depth


def test_each_pixel_has_its_kind() -> None:
    lines = lines_of_image(DepthImage(scene(), CAMERA), SHOWN)
    expected = np.where(scene() == 2.0, "p", "u")
    expected[14:36, 19:41] = "u"  # the rim, which the object's own pixels cover but for one all around
    expected[SHOWN] = ""
    image = np.full((50, 60), "", dtype="U1")
    for points, kind in ((lines.past, "p"), (lines.unknown, "u")):
        image[pixels(points, CAMERA)] = kind
    reach = np.s_[:, :]
    wrong = image[reach] != expected[reach]
    # at the ends of the wall, at other depths beside it, a pixel may have too few that agree
    assert wrong.sum() <= 4 and not wrong[12:38, 17:43].any()
    assert lines.elsewhere == "unknown"


def test_a_lone_depth_between_object_and_wall_is_no_surface() -> None:
    depth = scene()
    depth[25, 42] = 1.5
    lines = lines_of_image(DepthImage(depth, CAMERA), SHOWN)
    assert 1.5 not in lines.past[:, 2]
    assert (25, 42) in set(zip(*pixels(lines.unknown, CAMERA), strict=True))


def test_a_depth_as_far_as_the_object_is_unknown() -> None:
    """What it stands on touches it: neither before nor behind."""
    depth = np.where(SHOWN, 1.0, np.where(np.arange(50)[:, None] >= 35, 1.02, 2.0))
    labels = lines_of_image(DepthImage(depth, CAMERA), SHOWN)
    assert 1.02 not in labels.past[:, 2] and (np.isclose(depth[pixels(labels.unknown, CAMERA)], 1.02)).sum() > 500
    by_cloud = lines_of_points(DepthImage(depth, CAMERA).to_points().points, SHOWN.ravel())
    assert 1.02 not in by_cloud.past[:, 2] and (np.isclose(by_cloud.unknown[:, 2], 1.02)).sum() > 500


@pytest.mark.parametrize("factor", [0.001, 1000.0])
def test_any_unit_gives_the_same_lines(factor: float) -> None:
    lines = lines_of_image(DepthImage(scene(), CAMERA), SHOWN)
    other = lines_of_image(DepthImage(scene() * factor, CAMERA), SHOWN)
    for expected, found in ((lines.scaled(factor), other), (lines, other.scaled(1 / factor))):
        np.testing.assert_allclose(found.past, expected.past)
        np.testing.assert_allclose(found.unknown, expected.unknown)
        assert found.elsewhere == expected.elsewhere


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
    # the gap grows no faster than the distance, and reaches everywhere within one size of the object
    near = np.argwhere(kept)
    for row, column in np.argwhere((distance > 0) & (distance <= 100))[::997]:
        gap = np.abs(near - [row, column]).max(axis=1).min()
        assert gap <= max(1.0, distance[row, column] / DENSE)


# --- clouds ----------------------------------------------------------------------------------------------------------


def test_a_cloud_has_the_kinds_of_its_image() -> None:
    """What isolation leaves out of a cloud is compared as the pixels that a mask leaves out; no pixel is no point."""
    whole = DepthImage(scene(), CAMERA)
    cut = DepthImage(np.where(SHOWN, whole.depth, 0.0), CAMERA)
    frame = SensorFrame(Path("x"), cut.to_points(), 1.0, "camera", cut, whole=whole)
    by_image = find_object(frame).lines
    by_cloud = find_object(
        SensorFrame(Path("x"), whole.to_points(), 1.0, "camera"), IsolationConfig(depth_range=(0.9, 1.1))
    ).lines
    assert by_cloud.elsewhere is None
    past, unknown = (
        {place for place in zip(*pixels(points, CAMERA), strict=True) if 5 <= place[0] < 45 and 5 <= place[1] < 55}
        for points in (by_cloud.past, by_cloud.unknown)
    )
    by_pixel = set(zip(*pixels(by_image.past, CAMERA), strict=True))
    measured = set(zip(*np.nonzero(scene() > 0), strict=True))
    near = {place for place in measured if 5 <= place[0] < 45 and 5 <= place[1] < 55 and not SHOWN[place]}
    assert past | unknown == near and past & unknown == set()
    # but for the corner of the wall, where too few pixels agree
    assert past >= by_pixel & near and len(past - by_pixel) <= 2


def test_a_scanner_has_the_lines_of_a_camera() -> None:
    points = DepthImage(scene(), CAMERA).to_points().points
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
    assert turned.elsewhere == "past"


def test_a_bare_cloud_says_nothing() -> None:
    points = np.random.default_rng(0).normal((0, 0, 10), size=(100, 3))
    for lines in (observe(PointCloud(points)).lines, lines_of_points(points, np.ones(100, dtype=bool))):
        assert lines.elsewhere is None and len(lines.past) == len(lines.unknown) == 0


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


# --- options and files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("extent", "elsewhere"), [("whole", "past"), ("partial", "unknown"), ("auto", None)])
def test_the_extent_can_be_stated(extent: Extent, elsewhere: str | None) -> None:
    lines = observe(PointCloud(np.random.default_rng(0).normal((0, 0, 10), size=(50, 3))), extent=extent).lines
    assert lines.elsewhere == elsewhere and len(lines.past) == len(lines.unknown) == 0
    whole = DepthImage(scene(), CAMERA)
    cut = DepthImage(np.where(SHOWN, whole.depth, 0.0), CAMERA)
    frame = SensorFrame(Path("x"), cut.to_points(), 1.0, "camera", cut, whole=whole)
    lines = find_object(frame, IsolationConfig(extent=extent)).lines
    assert lines.elsewhere == (elsewhere or "unknown")
    assert (len(lines.past) > 0) == (extent != "partial") and (len(lines.unknown) > 0) == (extent == "auto")
    assert not IsolationConfig(extent=extent).on and FrameOptions(extent=extent).isolation().extent == extent


def test_a_file_keeps_what_its_mask_leaves_out(tmp_path: Path) -> None:
    write_camera(tmp_path / "k.json", CAMERA)
    Image.fromarray((1000 * scene()).astype(np.uint16)).save(tmp_path / "d.png")
    Image.fromarray(SHOWN).save(tmp_path / "m.png")
    frame = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json", mask=tmp_path / "m.png"))
    assert frame.depth is not None and frame.whole is not None and len(frame.cloud) == 400
    np.testing.assert_allclose(frame.whole.depth, scene())
    seen = find_object(frame)
    assert len(seen.lines.past) > 500 and seen.lines.elsewhere == "unknown"
    # strays are dropped from the points, and remain lines of sight that met something
    fewer = seen.read_as(Reading(seen.cloud, np.arange(400) > 20))
    assert len(fewer.cloud) == 379
    np.testing.assert_array_equal(fewer.lines.past, seen.lines.past)
    unmasked = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json"))
    isolated = find_object(unmasked, IsolationConfig(depth_range=(0.9, 1.1)))
    np.testing.assert_array_equal(isolated.lines.past, seen.lines.past)
    np.testing.assert_array_equal(isolated.lines.unknown, seen.lines.unknown)
    picture = sight_picture(isolated)
    for place, color in (((20, 45), PAST_COLOR), ((20, 18), UNKNOWN_COLOR), ((20, 30), OBJECT_COLOR)):
        assert np.argmax(picture[place]) == np.argmax(color), place
    with pytest.raises(ValueError, match="cloud has no depth image; lines of sight are drawn in one"):
        sight_picture(observe(isolated.cloud))


# --- the simulator ---------------------------------------------------------------------------------------------------


def test_occluded_views_repeat_and_hide_what_was_asked_for(views: list[View]) -> None:
    for kind in CUTS:
        first, second = (occlude(views[0], kind, 0.3, np.random.default_rng(7)) for _ in range(2))
        np.testing.assert_array_equal(first.whole.depth, second.whole.depth)
        np.testing.assert_array_equal(first.mask, second.mask)
        assert first.depth.to_points().points.shape == first.frame().cloud.points.shape
        shown, alone = int((first.source == OBJECT).sum()), int((views[0].depth.depth > 0).sum())
        assert first.hidden == pytest.approx(1 - shown / alone, abs=0.01)
        if kind == "screen":
            assert first.hidden == pytest.approx(0.3, abs=0.01)
        elif kind == "picture":
            assert 0.3 - 0.1 < first.hidden <= 0.3
        else:
            assert (first.hidden > 0) == (kind != "none")
    with pytest.raises(ValueError, match=r"the hidden share is 1; it must be at least 0 and less than 1"):
        occlude(views[0], "screen", 1, np.random.default_rng(0))
