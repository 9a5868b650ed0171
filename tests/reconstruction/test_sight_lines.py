"""Lines of sight beside the object: what a frame rules out is empty, and where it could not see is unknown."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from camera_files import write_camera
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.ndimage import distance_transform_edt

from mereo.fitting.problem.evidence import Evidence
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, DepthImage, PointCloud, SightLines
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rigid
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction import observation
from mereo.reconstruction.config import Extent, IsolationConfig
from mereo.reconstruction.isolation import Reading, select_object
from mereo.reconstruction.observation import (
    DENSE,
    MOST_LINES,
    Observation,
    find_object,
    lines_of_frame,
    lines_of_image,
    lines_of_points,
)
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import (
    BACKGROUND,
    NOTHING,
    OBJECT,
    OCCLUDER,
    Backdrop,
    Surroundings,
    farthest,
    sample_occluder,
)
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor, SensorConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe, render_depth
from mereo.synthesis.examples import View, sample_view
from mereo_serving.options import FrameOptions

Cut = Literal["none", "tool", "hand"]
CUTS = ("none", "tool", "hand")
AWAY = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def views() -> list[View]:
    clean = GenerateConfig(noise_std=0.0)
    return [sample_view(load_scene(name), clean, example_rng(1000, 0)) for name in ("lizard", "robot")]


@dataclass(frozen=True, eq=False)
class Occluded:
    """View of which something hides a part, what is taken from it, and the depth of the object alone."""

    seen: SimulatedView
    alone: DepthImage

    @property
    def found(self) -> Observation:
        return find_object(frame_of(self.seen.image, self.seen.whole))


def frame_of(image: DepthImage, whole: DepthImage | None = None) -> SensorFrame:
    return SensorFrame(Path("simulated"), image.to_points(), None, "camera", image, whole=whole)


def kinds(lines: SightLines, camera: Camera) -> ndarray:
    """Image of "p" and "u" where a line of sight is kept, "" elsewhere; each line is in one pixel of its own."""
    image = np.full((camera.height, camera.width), "", "U1")
    for points, kind in ((lines.past, "p"), (lines.unknown, "u")):
        rows, columns = pixels(points, camera)
        inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
        assert (image[rows[inside], columns[inside]] == "").all()
        image[rows[inside], columns[inside]] = kind
    return image


def occlude(view: View, kind: Cut, sensor: SensorConfig = SENSORS["paper"], wall: bool = True) -> Occluded:
    """The same state before a far wall, alone or behind the tool or hand that hides most."""
    solids = Solids(view.mesh)
    camera = view.depth.camera
    rng = default_rng(1)
    rays = camera.directions().reshape(-1, 3)
    backdrop = Backdrop(AWAY, farthest(solids, AWAY) + 60.0) if wall else None
    choices = [Surroundings((), backdrop)]
    if kind != "none":
        points = view.depth.to_points().points
        reach = float(norm(rays[:, :2], axis=1).max())
        occluders = [sample_occluder(kind, points, reach, 1 / sensor.metres_per_unit, rng) for _ in range(8)]
        choices = [Surroundings(each, backdrop) for each in occluders]
    shown = [int((around.join(solids.first_hit(rays), rays)[1] == OBJECT).sum()) for around in choices]
    around = choices[min(range(len(choices)), key=lambda k: (shown[k] < 100, shown[k]))]
    return Occluded(observe(solids, camera, 0.0, sensor, rng, around=around), render_depth(solids, camera))


def surrounded(image: ndarray) -> ndarray:
    """Pixels around which all 5 x 5 are true."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, 2, constant_values=True), (5, 5))
    return np.asarray(windows.all(axis=(2, 3)))


@pytest.mark.parametrize("kind", CUTS)
def test_each_line_is_empty_up_to_what_it_met_be_that_an_occluder_or_a_wall(views: list[View], kind: Cut) -> None:
    for view in views:
        cut = occlude(view, kind)
        seen = cut.seen
        lines = cut.found.lines
        rows, columns = pixels(lines.past, seen.whole.camera)
        # each past line ends at what was measured there, and no part of the true object is before that
        assert_allclose(lines.past[:, 2], seen.whole.depth[rows, columns])
        alone = cut.alone.depth[rows, columns]
        assert ((alone == 0) | (alone >= lines.past[:, 2])).all()
        labels = kinds(lines, seen.whole.camera)
        assert (labels[seen.mask] == "").all()
        hidden = (cut.alone.depth > 0) & (seen.source == OCCLUDER)
        assert hidden.any() == (kind != "none")
        away = surrounded(~seen.mask)
        assert (labels[away & seen.whole.valid] != "u").all() and (labels == "p").sum() > 1000
        # an occlusion edge is no silhouette: what is hidden is behind what was met
        assert lines.other_lines == "unknown"
        edge = Evidence.of(cut.found.cloud.points, lines=lines).hidden_edge
        assert edge < 0.05 if kind == "none" else edge > (0.01 if kind == "tool" else 0.1)


@pytest.mark.parametrize("sensor", ["structured-light", "time-of-flight"])
def test_under_sensors_and_wrong_masks_few_lines_are_wrong(views: list[View], sensor: Sensor) -> None:
    wrong = total = known = 0
    for view in views:
        for kind in CUTS:
            cut = occlude(view, kind, SENSORS[sensor])
            seen = cut.seen
            lines = cut.found.lines
            alone = cut.alone.depth[pixels(lines.past, seen.whole.camera)]
            wrong += int(((alone > 0) & (alone < lines.past[:, 2] - 1)).sum())
            total += len(lines.past)
            labels = kinds(lines, seen.whole.camera)[
                surrounded((seen.source == BACKGROUND) & seen.whole.valid & ~seen.mask)
            ]
            known += (labels == "p").sum() / ((labels == "p") | (labels == "u")).sum()
    assert wrong < 0.002 * total
    assert known > 0.97 * len(views) * len(CUTS)


def test_a_rendered_image_leaves_open_what_is_beside_the_object(views: list[View]) -> None:
    for view in views:
        lines = occlude(view, "none", wall=False).found.lines
        assert lines.other_lines is None and len(lines.past) == len(lines.unknown) == 0
        # beside an occluder that was met, nothing measured is unknown
        cut = occlude(view, "hand", wall=False)
        labels = kinds(cut.found.lines, cut.seen.whole.camera)
        assert cut.found.lines.other_lines == "unknown" and (labels[cut.seen.source == NOTHING] != "p").all()


def test_what_a_bare_cloud_is_cut_by_is_what_it_is_declared_to_be(views: list[View]) -> None:
    points = views[0].depth.to_points().points
    assert Evidence.of(points, lines=SightLines.of_cloud("past")).hidden_edge == 0.0
    assert Evidence.of(points, lines=SightLines.of_cloud("unknown")).hidden_edge == 1.0


def test_what_was_to_be_seen_and_was_not_counts_where_nothing_says_what_is_there(views: list[View]) -> None:
    triangles = np.concatenate([segment.vertices[segment.faces] for segment in views[0].mesh.segments])
    points = views[0].depth.to_points().points
    nothing = np.empty((0, 3))
    is_left = points[:, 0] < np.median(points[:, 0])
    left = points[is_left]
    right = points[~is_left]
    assert Evidence.of(points, lines=SightLines.of_cloud("unknown")).unseen(triangles) < 0.02
    assert 0.3 < Evidence.of(left, lines=SightLines.of_cloud("unknown")).unseen(triangles) < 0.7
    assert Evidence.of(left, lines=SightLines.of_cloud("past")).unseen(triangles) == 0.0  # ruled out
    hidden, empty = SightLines(nothing, right, "unknown"), SightLines(2 * right, nothing, "unknown")
    assert max(Evidence.of(left, lines=lines).unseen(triangles) for lines in (hidden, empty)) < 0.05


# --- images by hand ---------------------------------------------------------------------------------------------------

WIDE = Camera(60, 50, 80.0, 80.0, 30.0, 25.0)
SHOWN = np.zeros((50, 60), bool)
SHOWN[15:35, 20:40] = True


def scene() -> ndarray:
    """A square at 1 m before a wall at 2 m; a strip at 0.8 m left of it, nothing measured above row 10."""
    depth = np.where(SHOWN, 1.0, 2.0)
    depth[:, :19] = 0.8
    depth[:10] = 0.0
    return depth


WHOLE = DepthImage(scene(), WIDE)
CUT = frame_of(DepthImage(np.where(SHOWN, WHOLE.depth, 0.0), WIDE), WHOLE)


def pixels(points: ndarray, camera: Camera) -> tuple[ndarray, ndarray]:
    """Rows and columns of the pixels that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(int).T
    return rows, columns


def test_each_pixel_off_the_rim_has_met_what_was_measured() -> None:
    lines = lines_of_image(DepthImage(scene(), WIDE), SHOWN)
    expected = np.where(scene() > 0, "p", "u")
    expected[14:36, 19:41] = "u"  # the rim, which the object's own pixels cover but for one all around
    expected[SHOWN] = ""
    assert (kinds(lines, WIDE) == expected).all()
    assert lines.other_lines == "unknown"


def test_a_table_that_the_object_lies_on_is_free_up_to_its_surface_and_no_farther() -> None:
    depth = np.where(SHOWN, 1.0, np.where(np.arange(50)[:, None] >= 35, 1.02, 2.0))
    image = DepthImage(depth, WIDE)
    by_image = lines_of_image(image, SHOWN)
    by_cloud = lines_of_points(image.to_points().points, SHOWN.ravel())
    for lines in (by_image, by_cloud):
        assert (np.isclose(lines.past[:, 2], 1.02)).sum() > 500
        evidence = Evidence.of(image.to_points(SHOWN).points, lines=lines)
        before, on = (WIDE.unproject(np.array([[30.5, 40.5]]), np.array([z])) for z in (0.9, 1.03))
        assert evidence.violations(before, 0.01)[1] > 0 and evidence.violations(on, 0.01)[1] == 0


def test_many_lines_are_thinned_far_from_the_object_only() -> None:
    camera = Camera(600, 500, 800.0, 800.0, 300.0, 250.0)
    shown, depth = np.kron(SHOWN, np.ones((10, 10), bool)), np.kron(scene(), np.ones((10, 10)))
    kept = kinds(lines_of_image(DepthImage(depth, camera), shown), camera) != ""
    assert 0.5 * MOST_LINES < kept.sum() <= MOST_LINES
    distance = distance_transform_edt(~shown)
    assert kept[(distance > 0) & (distance <= DENSE)].all()


def test_a_cloud_has_the_kinds_of_its_image() -> None:
    by_image = find_object(CUT).lines
    frame = SensorFrame(Path("x"), WHOLE.to_points(), 1.0, "camera")
    by_cloud = find_object(frame, IsolationConfig(depth_range=(0.9, 1.1))).lines
    assert by_cloud.other_lines is None
    past, unknown = (
        {place for place in zip(*pixels(points, WIDE), strict=True) if 5 <= place[0] < 45 and 5 <= place[1] < 55}
        for points in (by_cloud.past, by_cloud.unknown)
    )
    by_pixel = set(zip(*pixels(by_image.past, WIDE), strict=True))
    measured = set(zip(*np.nonzero(scene() > 0), strict=True))
    near = {place for place in measured if 5 <= place[0] < 45 and 5 <= place[1] < 55 and not SHOWN[place]}
    assert past | unknown == near and past & unknown == set()
    assert past == by_pixel & near


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
    assert (lines.past[:, 2] == -2.0).sum() > 500 and (np.isclose(lines.past[:, 2], -0.8)).sum() > 100
    turned = SightLines(lines.past, lines.unknown, "past").transformed(axes)
    assert_allclose(turned.past, lines.past * [1, -1, -1])
    assert turned.other_lines == "past"


def test_points_that_were_only_thinned_out_are_the_objects() -> None:
    camera = Camera(400, 300, 400.0, 400.0, 200.0, 150.0)
    x, y, _ = np.moveaxis(camera.directions(), 2, 0)
    ball = x**2 + y**2 < 0.2**2
    depth = np.where(ball, 1.0 - np.sqrt(np.maximum(0.2**2 - x**2 - y**2, 0.0)), 3.0)
    whole = DepthImage(depth, camera)
    seen = find_object(replace(frame_of(whole, whole), unit_m=1.0), IsolationConfig(largest_cluster=True))
    # the wall is larger: so the ball is what is left out, behind nothing, and the wall is the object
    assert seen.selection is not None and seen.selection.thinned.any()
    rest = seen.selection.of_object(seen.frame.cloud.points)
    assert rest.sum() > len(seen.cloud) and not rest[ball.ravel()].any()
    assert rest[~ball.ravel()].mean() > 0.999
    labels = kinds(seen.lines, camera)
    assert ball[labels == "p"].all() and (labels[ball & surrounded(ball)] != "u").all()


@pytest.mark.parametrize(("extent", "other_lines"), [("whole", "past"), ("partial", "unknown"), ("auto", None)])
def test_the_extent_can_be_stated(extent: Extent, other_lines: str | None) -> None:
    cloud = PointCloud(default_rng(0).normal((0, 0, 10), size=(50, 3)))
    lines = observation.observe(cloud, extent=extent).lines
    assert lines.other_lines == other_lines and len(lines.past) == len(lines.unknown) == 0
    lines = find_object(CUT, IsolationConfig(extent=extent)).lines
    assert lines.other_lines == (other_lines or "unknown")
    assert (len(lines.past) > 0) == (extent != "partial") and (len(lines.unknown) > 0) == (extent == "auto")
    assert not IsolationConfig(extent=extent).on and FrameOptions(extent=extent).isolation().extent == extent


def test_a_file_keeps_what_its_mask_leaves_out(tmp_path: Path) -> None:
    write_camera(tmp_path / "k.json", WIDE)
    Image.fromarray((1000 * scene()).astype(np.uint16)).save(tmp_path / "d.png")
    Image.fromarray(SHOWN).save(tmp_path / "m.png")
    frame = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json", mask=tmp_path / "m.png"))
    assert frame.depth is not None and frame.whole is not None and len(frame.cloud) == 400
    assert_allclose(frame.whole.depth, scene())
    seen = find_object(frame)
    assert len(seen.lines.past) > 500 and seen.lines.other_lines == "unknown"
    # strays are dropped from the points, and remain lines of sight that met something
    fewer = seen.read_as(Reading(seen.cloud, np.arange(400) > 20))
    assert len(fewer.cloud) == 379
    assert_array_equal(fewer.lines.past, seen.lines.past)
    unmasked = read_frame(tmp_path / "d.png", InputConfig(intrinsics=tmp_path / "k.json"))
    isolated = find_object(unmasked, IsolationConfig(depth_range=(0.9, 1.1)))
    assert_array_equal(isolated.lines.past, seen.lines.past)
    assert_array_equal(isolated.lines.unknown, seen.lines.unknown)
