"""The renderer agrees with closed forms, and the pictures show what they claim to show."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from answers import answer_to
from folder_contents import run_mereo
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from shapes import ball as round_ball

import mereo
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import Triple
from mereo.geometry.mesh import PALETTE, Color, Segment, SegmentedMesh, vertex_normals
from mereo.geometry.transforms import rigid
from mereo.models.model import Model
from mereo.models.trained import Answer, EncodedCloud
from mereo.models.weights import load_model
from mereo.synthesis.examples import View
from mereo.synthesis.sample_views import load_view
from mereo.visualization import previews
from mereo.visualization.color_scales import TABLE, ColorScale, confidence, distance_scale, observed_distance, viridis
from mereo.visualization.contact_sheets import contact_sheet, depth_to_rgb, legend
from mereo.visualization.previews import preview_states
from mereo.visualization.renderer import SUPERSAMPLE, Canvas, Triangles, Viewpoint, corner_normals, shade
from mereo_learning.cases import EvaluatedView
from mereo_learning.error_maps import (
    EXTRA_OR_MISSING,
    FULL_CELLS,
    OVER,
    PALE,
    SEGMENTATION_WORDS,
    TOLERANCE_CELLS,
    UNDER,
    WRONG,
    Comparison,
    cell_size,
    comparison_picture,
    error_picture,
    offset_colors,
    offset_triangles,
    segmentation_error,
    surface_offset,
    voxel_triangles,
)
from mereo_learning.metrics_log import MetricsLog
from mereo_viewer.result_page import ask_network, first_point, probe_answer

FRONT = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def ball(center: Triple, radius: float, color: Color = PALETTE[0], name: str = "ball") -> Segment:
    mesh = trimesh.creation.icosphere(4, radius=radius)
    return Segment(name, color, mesh.vertices + np.array(center), np.array(mesh.faces))


def hue_is(pixels: ndarray, color: Color) -> ndarray:
    """Pixels whose colour is ``color`` at some brightness."""
    wanted = np.asarray(color, float)
    values = pixels.astype(float)
    cosine = (values @ wanted) / np.maximum(norm(values, axis=-1) * norm(wanted), 1e-9)
    return (cosine > 0.985) & (values.sum(axis=-1) > 30)


def test_an_orthographic_ball_has_its_closed_form_depth_and_area() -> None:
    box = np.array([[-1.0, -1, 4], [1, 1, 6]])
    view = Viewpoint.along(box, *FRONT, margin=1.25)
    canvas = Canvas.empty(view, (80, 60))
    canvas.draw_triangles(Triangles.of(SegmentedMesh((ball((0, 0, 5), 1.0),))))
    seen = np.isfinite(canvas.depth)
    side = 2 * 1.25 / (60 * SUPERSAMPLE)
    assert seen.sum() * side**2 == pytest.approx(np.pi, rel=0.01)
    row, column = np.nonzero(seen)
    x, y = (column + 0.5 - 80) * side, (row + 0.5 - 60) * side
    inner = x**2 + y**2 < 0.9
    # depth in the view frame, whose origin is the middle of the box
    assert_allclose(canvas.depth[seen][inner], -np.sqrt(1 - x**2 - y**2)[inner], atol=6e-3)
    view = Viewpoint.along(box, (0.0, 0.0, 2.0), (0.0, 0.0, 1.0))
    rotation = view.T_view_world[:3, :3]
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert_allclose(rotation[2], [0, 0, 1])


def test_a_pinhole_picture_is_the_camera_depth_image_in_colour() -> None:
    camera = Camera(64, 48, 90.0, 70.0, 30.0, 26.0)
    canvas = Canvas.empty(Viewpoint.through(camera), (64, 48))
    mesh = SegmentedMesh((ball((0.1, -0.2, 3), 0.7),))
    canvas.draw_triangles(Triangles.of(mesh))
    row, column = np.nonzero(np.isfinite(canvas.depth))
    pixel = np.column_stack([column + 0.5, row + 0.5]) / SUPERSAMPLE
    points = camera.unproject(pixel, canvas.depth[row, column])
    assert_allclose(norm(points - [0.1, -0.2, 3], axis=1), 0.7, atol=4e-3)


def test_nearer_things_hide_farther_ones() -> None:
    near, far = ball((0, 0, 0), 0.5, (255, 0, 0)), ball((0, 0, 3), 1.0, (0, 0, 255), "far")
    box = np.array([[-1.0, -1, -1], [1, 1, 4]])
    view = Viewpoint.along(box, *FRONT)
    both = SegmentedMesh((far, near))
    picture = shade(both, view, (60, 60))
    assert hue_is(picture[30, 30], (255, 0, 0))
    assert hue_is(picture[30, 8], (0, 0, 255))
    behind = Viewpoint.along(box, (0.0, 0.0, -1.0), (0.0, -1.0, 0.0))
    assert not hue_is(shade(both, behind, (60, 60)), (255, 0, 0)).any()
    recolored = shade(both, view, (60, 60), colors=[(0, 255, 0), (0, 255, 0)])
    assert hue_is(recolored[30, 30], (0, 255, 0))


def test_points_are_hidden_by_surfaces_and_by_nearer_points() -> None:
    view = Viewpoint.along(np.array([[-1.0, -1, -1], [1, 1, 1]]), *FRONT)
    canvas = Canvas.empty(view, (50, 50))
    canvas.draw_triangles(Triangles.of(SegmentedMesh((ball((0, 0, 0), 0.5, (255, 255, 255)),))))
    points = np.array([[0, 0, -0.9], [0, 0, -0.8], [0, 0, 0.9], [0.8, 0, 0.5]])
    colors = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
    canvas.draw_points(points, colors)
    picture = canvas.picture()
    assert_array_equal(picture[25, 25], [255, 0, 0])
    assert hue_is(picture, (0, 0, 255)).any()
    assert not hue_is(picture[15:35, 15:35], (0, 0, 255)).any()


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_box() -> None:
    round_one = ball((0, 0, 0), 1.0)
    normals = corner_normals(round_one.vertices, round_one.faces)
    assert (normals * round_one.vertices[round_one.faces]).sum(axis=-1).min() > 0.9999
    box = trimesh.creation.box()
    sharp = corner_normals(np.array(box.vertices), np.array(box.faces))
    assert_allclose(sharp, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-12)


def test_depth_colours_show_near_bright_and_missing_grey_and_sheets_hold_every_image_unchanged() -> None:
    camera = Camera(3, 1, 1.0, 1.0, 1.5, 0.5)
    picture = depth_to_rgb(DepthImage(np.array([[0.0, 1.0, 2.0]]), camera))[0].astype(int)
    assert picture[0].std() < 3
    assert picture[1].sum() > picture[2].sum() + 200
    assert depth_to_rgb(DepthImage(np.zeros((1, 3)), camera)).std() < 3
    images = [np.full((20, 30, 3), 40 * i, np.uint8) for i in range(5)]
    sheet = contact_sheet(images, ["a", "b", "c", "", "a very long caption that does not fit"], 3, "title")
    for image in images:
        assert (sheet == image[0, 0]).all(axis=-1).sum() >= 600
    with pytest.raises(ValueError, match="one caption for each image"):
        contact_sheet(images, ["a"], 3)


def test_voxel_faces_are_a_closed_outward_surface_of_the_right_volume() -> None:
    grid = (default_rng(3).random((6, 5, 4)) > 0.6).astype(np.uint8)
    spacing = np.array([0.5, 1.0, 2.0])
    shown = voxel_triangles(grid, np.ones((1, 3)), np.array([3.0, 2.0, 1.0]), spacing)
    surface = Segment("voxels", PALETTE[0], shown.vertices, shown.faces)
    assert surface.volume == pytest.approx(grid.sum() * spacing.prod())
    low, high = surface.bounds
    filled = np.argwhere(grid)
    assert_allclose(low, [3, 2, 1] + (filled.min(axis=0) - 0.5) * spacing)
    assert_allclose(high, [3, 2, 1] + (filled.max(axis=0) + 0.5) * spacing)


def labelled(truth: ndarray, found: ndarray, spacing: Triple = (1.0, 1.0, 1.0)) -> EvaluatedView:
    """A case whose first cell is centred at the origin, and whose cloud is the true cells."""
    cloud = PointCloud(np.argwhere(truth)[::7] * np.array(spacing))
    colors = [(0, 158, 115), (240, 228, 66), (86, 180, 233)]
    return EvaluatedView("case", cloud, truth, found, np.zeros(3), np.array(spacing), colors)


def test_the_segmentation_is_wrong_anywhere_it_differs() -> None:
    rng = default_rng(4)
    truth, found = (rng.integers(0, 4, (8, 9, 10)).astype(np.uint8) for _ in range(2))
    error = segmentation_error(labelled(truth, found))
    assert np.array_equal(error >= 2, truth != found), "the paper's definition"
    assert np.array_equal(error == 2, (truth > 0) & (found > 0) & (truth != found)), "as the confusion matrix has it"
    assert np.array_equal(error == 0, (truth == 0) & (found == 0))
    assert set(np.unique(segmentation_error(labelled(truth, truth)))) == {0, 1}


def two_boxes() -> ndarray:
    labels = np.zeros((20, 20, 20), np.uint8)
    labels[5:15, 5:10, 5:15], labels[5:15, 10:15, 5:15] = 1, 2
    return labels


def test_a_comparison_has_the_reference_and_a_column_for_each_answer(tmp_path: Path) -> None:
    truth, other = two_boxes(), two_boxes()
    other[7:13, 7:13, 1:5] = 1  # toward the camera
    views, captions = [[labelled(truth, truth), labelled(truth, other)]], [["one", "two"]]
    colored = {}
    for shown in ("segmentation", "reconstruction error"):
        comparison_picture(tmp_path / "c.png", Comparison(shown, views, captions), size=60)  # type: ignore[arg-type]
        picture = np.asarray(Image.open(tmp_path / "c.png"))
        tiles = [picture[12:72, 12 + column * 72 :][:, :60] for column in range(3)]
        colored[shown] = tiles
        assert picture.shape == (12 + 60 + 24 + 12 + 44 * (shown != "segmentation"), 12 + 3 * 72, 3)
    segmentation, error = colored["segmentation"], colored["reconstruction error"]
    assert np.array_equal(segmentation[0], segmentation[1]) and not np.array_equal(segmentation[0], segmentation[2])
    assert [bool(hue_is(tile, OVER).sum() > 20) for tile in error] == [False, False, True]
    assert np.array_equal(error[0], segmentation[0]), "the reference stays what it is"


def test_offsets_are_pale_within_the_tolerance_and_for_rounding_and_full_at_the_end_of_the_scale() -> None:
    shown = offset_colors(np.array([-9.0, -FULL_CELLS, -TOLERANCE_CELLS, 0.0, TOLERANCE_CELLS, FULL_CELLS, 9.0]))
    assert_array_equal(shown, [UNDER, UNDER, PALE, PALE, PALE, OVER, OVER])
    ramp = offset_colors(np.linspace(TOLERANCE_CELLS, FULL_CELLS, 9))
    assert (np.diff(ramp[:, 0]) < 0).all()  # the red of blue falls
    grid = np.indices((40, 40, 40)).transpose(1, 2, 3, 0)
    truth = (norm(grid - 19.5, axis=-1) < 14.0).astype(np.uint8)
    moved = (norm(grid - [19.8, 19.3, 19.6], axis=-1) < 14.1).astype(np.uint8)
    assert (truth != moved).sum() > 400  # which the staircases would show as speckle
    pale = np.isclose(offset_triangles(labelled(truth, moved)).colors, np.asarray(PALE) / 255, atol=0.08).all(axis=1)
    assert pale.mean() > 0.99
    exact = offset_triangles(labelled(truth, truth)).colors
    assert_allclose(exact, np.broadcast_to(np.asarray(PALE) / 255, exact.shape))


def strips(picture: ndarray) -> int:
    """Height of the scale and of the legend below a picture of errors."""
    return 44 + len(legend(SEGMENTATION_WORDS, (PALE, WRONG, EXTRA_OR_MISSING), picture.shape[1]))


def columns_of(picture: ndarray) -> list[ndarray]:
    """Columns of a picture of errors."""
    return np.array_split(picture[: -strips(picture), 12:], 8, axis=1)


def drawn_errors(folder: Path, truth: ndarray, found: ndarray, size: int) -> ndarray:
    """Picture of the errors of labels, which is written into a folder."""
    path = folder / "e.png"
    error_picture(path, [labelled(truth, found)], size=size)
    return np.asarray(Image.open(path))


def test_the_error_picture_shows_each_error_in_its_column_only(tmp_path: Path) -> None:
    truth, found = two_boxes(), two_boxes()
    found[15:18, 5:15, 5:15], found[5:8, 5:15, 5:15], found[10:12, 5:15, 5:15] = 1, 0, 1
    picture = drawn_errors(tmp_path, truth, found, 60)
    below = picture[-strips(picture) :]
    assert all(hue_is(below, color).any() for color in (OVER, UNDER, WRONG, EXTRA_OR_MISSING))
    columns = columns_of(picture)
    shows = [[bool(hue_is(column, c).sum() > 20) for c in (OVER, UNDER, WRONG)] for column in columns]
    assert shows[3] == shows[4] == [True, True, False]
    assert shows[6] == [False, False, True] and hue_is(columns[6], EXTRA_OR_MISSING).sum() > 20
    for plain in (0, 1, 2, 7):
        assert not any(shows[plain])
    assert [f.name for f in tmp_path.iterdir()] == ["e.png"]


def test_an_error_on_the_far_side_is_seen_from_behind_only_and_an_empty_prediction_can_be_drawn(tmp_path: Path) -> None:
    truth = np.zeros((20, 20, 20), np.uint8)
    truth[5:15, 5:15, 5:12] = 1
    found = truth.copy()
    found[7:13, 7:13, 12:16] = 1
    picture = drawn_errors(tmp_path, truth, found, 60)
    columns = columns_of(picture)
    assert [bool(hue_is(columns[k], OVER).sum() > 20) for k in (3, 4)] == [False, True]
    truth = np.zeros((6, 6, 6), np.uint8)
    truth[2:4, 2:4, 2:4] = 1
    picture = drawn_errors(tmp_path, truth, np.zeros_like(truth), 40)
    assert hue_is(picture[: -strips(picture)], UNDER).any()  # all of it is missing


def test_a_preview_of_states_has_three_pictures_for_each_state(tmp_path: Path) -> None:
    camera = Camera.from_fov(24, 24, 0.6)
    mesh = SegmentedMesh((ball((0, 0, 3), 0.5, (255, 0, 0)),))
    depth = DepthImage(np.pad(np.full((8, 8), 2.6), 8), camera)
    views = [View(mesh, depth, rigid(np.eye(3), np.array([0.0, 0.0, -3.0 * i])), ()) for i in (1, 2)]
    preview_states(tmp_path / "s.png", views, "two states", size=50)
    picture = np.asarray(Image.open(tmp_path / "s.png"))
    thirds = np.array_split(picture[:, 12:], 9, axis=1)
    reds = [int(hue_is(part, (255, 0, 0)).sum()) for part in thirds]
    assert [red > 50 for red in reds[:6]] == [True, True, False] * 2
    toward = np.array([0.0, 0.6, 0.8])
    arrow = previews._arrow(np.ones(3), toward, 2.0).vertices - 1  # from the camera's side to the object
    assert_allclose(sorted({round(far, 6) for far in arrow @ toward}), [1.7, 2.06, 2.7])
    assert norm(arrow - np.outer(arrow @ toward, toward), axis=1).max() < 0.17


SPACING = np.array([0.5, 0.3, 0.4])
CENTER = np.array([8.1, 7.9, 8.05])
CELLS = (32, 52, 40)


def ball_cells(radius: float) -> ndarray:
    """Occupied cells of a ball on the anisotropic grid."""
    grid = np.indices(CELLS).transpose(1, 2, 3, 0) * SPACING
    return np.asarray(norm(grid - CENTER, axis=-1) < radius)


def directions() -> ndarray:
    drawn = default_rng(5).normal(size=(400, 3))
    return np.asarray(drawn / norm(drawn, axis=1, keepdims=True))


@pytest.mark.parametrize(("truth", "found"), [(5.0, 5.6), (5.0, 6.5), (5.6, 5.0), (6.5, 5.0), (5.0, 5.1)])
def test_the_offset_of_concentric_balls_is_the_difference_of_their_radii(truth: float, found: float) -> None:
    places = (CENTER + max(truth, found) * directions()) / SPACING  # on the surface of both together
    expected = (found - truth) / cell_size(SPACING)
    measured = surface_offset(ball_cells(truth), ball_cells(found), SPACING, places)
    assert abs(np.median(measured) - expected) < 0.2
    assert np.abs(measured - expected).max() < 0.6


def test_what_is_missing_is_the_farther_off_the_longer_it_is() -> None:
    truth = np.zeros((40, 20, 20), bool)
    truth[5:35, 8:12, 8:12] = True
    found = truth.copy()
    found[20:] = False
    places = np.array([[x, 7.5, 9.5] for x in (10.0, 22.0, 26.0, 30.0)])
    offset = surface_offset(truth, found, np.ones(3), places)
    assert_allclose(offset, [0.0, -2.5, -6.5, -10.5], atol=0.3)
    assert_array_equal(surface_offset(found, truth, np.ones(3), places), -offset)


GREYS = ColorScale("grey", 1.0, 3.0, ((0, 0, 0), (100, 100, 100), (250, 250, 250)), ("low", "high"))


def two_balls(radius: float = 2.0) -> SegmentedMesh:
    return SegmentedMesh(
        (round_ball((0, 0, 0), radius, "one", 0, level=3), round_ball((6, 0, 0), radius, "two", 1, level=3))
    )


def test_a_scale_is_linear_between_its_stops_and_vertex_normals_of_a_ball_point_outward() -> None:
    values = np.array([-5.0, 1.0, 1.5, 2.0, 2.5, 3.0, 9.0, np.nan])
    assert GREYS.colors(values)[:, 0].tolist() == [0, 0, 50, 100, 175, 250, 250, 128]
    segment = round_ball((1, 2, 3), 2.0, "one", 0, level=3)
    assert_allclose(vertex_normals(segment), (segment.vertices - [1, 2, 3]) / 2.0, atol=0.02)


def test_confidence_is_the_drop_of_probability_across_the_surface() -> None:
    """A model that is certain of one ball's border, and says one half everywhere near the other's."""

    def ask(points: ndarray) -> Answer:
        inside = (norm(points, axis=1) < 2.0).astype(float)
        unsure = 0.5 * (norm(points - [6, 0, 0], axis=1) < 3.0)
        probability = np.stack([1 - inside - unsure, inside, unsure], axis=1)
        nothing = np.zeros(len(points))
        return Answer(probability.argmax(axis=1).astype(np.uint8), probability, nothing, np.zeros_like(points))

    sure, guessed = confidence(two_balls(), ask)
    assert_array_equal(sure, 1.0)
    assert_array_equal(guessed, 0.0)


def test_distance_to_what_was_observed_tells_seen_from_guessed() -> None:
    mesh = two_balls()
    one, two = observed_distance(mesh, mesh.segments[0].vertices)
    assert_array_equal(one, 0.0)
    assert two.min() == pytest.approx(2.0, abs=0.05)
    assert two.max() == pytest.approx(6.0, abs=0.05)
    scale = distance_scale([one, two], " mm")
    assert 0 < scale.high <= 6 and scale.words[1].endswith(" mm, guessed")
    lost = replace(mesh.segments[1], vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), np.int64))
    mesh = SegmentedMesh((mesh.segments[0], lost))
    assert [len(v) for v in observed_distance(mesh, np.zeros((1, 3)))] == [len(mesh.segments[0].vertices), 0]
    assert distance_scale([np.zeros(0)], "").high > 0


def test_a_ray_meets_the_nearest_surface_that_is_shown() -> None:
    mesh = two_balls()
    origin = np.array([-9.0, 0.01, 0.02])
    along = np.array([2.0, 0.0, 0.0])
    assert_allclose(first_point(mesh, origin, along, [True, True]), [-2.0, 0.01, 0.02], atol=0.05)
    assert_allclose(first_point(mesh, origin, along, [False, True]), [4.0, 0.01, 0.02], atol=0.05)
    assert first_point(mesh, origin, along, [False, False]) is None
    assert first_point(mesh, origin, -along, [True, True]) is None


@pytest.fixture
def encoded(monkeypatch: pytest.MonkeyPatch) -> list[ndarray]:
    """The points of every cloud that a model encodes."""
    clouds = []
    encode = Model.encode

    def counted(model: Model, cloud: PointCloud) -> EncodedCloud:
        clouds.append(np.asarray(cloud.points))
        return encode(model, cloud)

    monkeypatch.setattr(Model, "encode", counted)
    return clouds


def test_no_cloud_is_encoded_twice(encoded: list[ndarray], tmp_path: Path) -> None:
    cloud = load_view("rope").depth.to_points()
    mereo.reconstruct(cloud, load_model("rope"), "network", resolution=16).save(tmp_path / "result")
    assert len(encoded) == 1
    model = load_model("rope")
    answer = answer_to(cloud, model, None, 16)
    probe_answer(answer, cloud.points[:5])
    confidence(answer.reconstruction.surfaces, partial(ask_network, answer))
    assert len(encoded) == 2, "once for each"


ROWS = [{"step": float(step), "loss": 2.0 / step, "val_iou": 0.1 * step} for step in (1, 2, 3)]


@pytest.fixture
def no_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without the extra: it is not found, and importing it fails."""
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)


def test_the_colours_are_matplotlibs() -> None:
    import matplotlib

    values = np.concatenate([np.linspace(-0.2, 1.2, 5000), np.arange(257) / 256, [0.0, 1.0]])
    theirs = matplotlib.colormaps["viridis"](values, bytes=True)[:, :3]
    assert_array_equal(viridis(values), theirs)
    assert viridis(np.full((2, 3), np.nan)).tolist() == [[TABLE[0].tolist()] * 3] * 2


def record(run: Path) -> MetricsLog:
    log = MetricsLog(run)
    log.rows = list(ROWS)
    log.write()
    return log


@pytest.mark.usefixtures("no_matplotlib")
def test_a_run_without_curves_is_whole_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log = record(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]
    assert log.is_written(3)
    assert capsys.readouterr().out == (
        "curves.png is left out, for matplotlib, which draws it, is not installed: pip install 'mereo[plots]'\n"
    )


def test_a_run_with_curves_says_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log = record(tmp_path)
    with Image.open(tmp_path / "curves.png") as image:
        assert image.size == (1210, 440)
    assert log.is_written(3)
    (tmp_path / "curves.png").unlink()
    assert not log.is_written(3)
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("no_matplotlib")
def test_an_experiment_asks_for_the_extra_before_it_starts(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run_mereo("experiment", "sampling", "--output", tmp_path / "out") == 2
    assert capsys.readouterr().err == (
        "mereo: error: matplotlib, which draws charts, is not installed: pip install 'mereo[plots]'\n"
    )
    assert not (tmp_path / "out").exists()
