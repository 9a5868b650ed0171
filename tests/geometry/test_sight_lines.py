"""Lines of sight beside the object: what a frame rules out is empty, and where it could not see is unknown."""

import numpy as np
import pytest
from sight_parts import pixels

from mereo.fitting.problem.evidence import Evidence
from mereo.geometry.camera import SightLines
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.clutter import BACKGROUND, NOTHING, OBJECT, OCCLUDER
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import View, sample_view
from mereo.synthesis.occluded_views import Cut, OccludedView, occlude

CLEAN = GenerateConfig(noise_std=0.0)
CUTS: tuple[Cut, ...] = ("none", "screen", "picture", "tool", "hand")


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [
        sample_view(load_scene(name), CLEAN, example_rng(1000, i)) for name in ("lizard", "robot") for i in range(2)
    ]


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
            assert lines.other_lines == "unknown"


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
        assert lines.other_lines is None and len(lines.past) == len(lines.unknown) == 0
        # an occluder before nothing is unknown, and the zeros around it remain open
        seen = occlude(view, "hand", 0.3, np.random.default_rng(number), CLEAN, wall=False)
        lines = find_object(seen.frame()).lines
        labels = kinds(seen, lines)
        assert lines.other_lines is None and (labels[seen.source == NOTHING] == "").all()
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
        assert lines.other_lines == ("unknown" if wall else None)


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


def test_the_share_of_the_outline_that_is_cut_is_told(views: list[View]) -> None:
    for number, view in enumerate(views):
        for kind in CUTS:
            seen = find_object(occlude(view, kind, 0.3, np.random.default_rng(number), CLEAN).frame())
            edge = Evidence.of(seen.cloud.points, lines=seen.lines).hidden_edge
            assert edge < 0.05 if kind == "none" else edge > (0.01 if kind == "tool" else 0.1)
        alone = find_object(occlude(view, "none", 0.0, np.random.default_rng(number), CLEAN).frame()).cloud.points
        assert Evidence.of(alone, lines=SightLines.of_cloud("past")).hidden_edge == 0.0
        assert Evidence.of(alone, lines=SightLines.of_cloud("unknown")).hidden_edge == 1.0
