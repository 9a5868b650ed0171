"""Lines of sight beside the object: what a frame rules out is empty, and where it could not see is unknown."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from mereo.fitting.problem.evidence import Evidence
from mereo.geometry.camera import Camera, DepthImage, SightLines
from mereo.geometry.solids import Solids
from mereo.io.sensor_frame import SensorFrame
from mereo.reconstruction.observation import Observation, find_object
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

Cut = Literal["none", "tool", "hand"]
CUTS: tuple[Cut, ...] = ("none", "tool", "hand")
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
        image = self.seen.image
        frame = SensorFrame(Path("simulated"), image.to_points(), None, "camera", image, whole=self.seen.whole)
        return find_object(frame)

    def kinds(self, lines: SightLines) -> np.ndarray:
        """Image of "p" and "u" where a line of sight is kept, "" elsewhere; each line is in one pixel of its own."""
        image = np.full(self.seen.mask.shape, "", dtype="U1")
        for points, kind in ((lines.past, "p"), (lines.unknown, "u")):
            rows, columns = pixels(points, self.seen.whole.camera)
            inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
            assert (image[rows[inside], columns[inside]] == "").all()
            image[rows[inside], columns[inside]] = kind
        return image


def pixels(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points are seen in."""
    columns, rows = np.floor(camera.project(points)).astype(int).T
    return rows, columns


def occlude(view: View, kind: Cut, sensor: SensorConfig = SENSORS["paper"], wall: bool = True) -> Occluded:
    """The same state before a far wall, alone or behind the tool or hand that hides most."""
    solids, camera, rng = Solids(view.mesh), view.depth.camera, np.random.default_rng(1)
    rays = camera.directions().reshape(-1, 3)
    backdrop = Backdrop(AWAY, farthest(solids, AWAY) + 60.0) if wall else None
    choices = [Surroundings((), backdrop)]
    if kind != "none":
        points, reach = view.depth.to_points().points, float(np.linalg.norm(rays[:, :2], axis=1).max())
        occluders = [sample_occluder(kind, points, reach, 1 / sensor.metres_per_unit, rng) for _ in range(8)]
        choices = [Surroundings(each, backdrop) for each in occluders]
    shown = [int((around.join(solids.first_hit(rays), rays)[1] == OBJECT).sum()) for around in choices]
    around = choices[min(range(len(choices)), key=lambda k: (shown[k] < 100, shown[k]))]
    return Occluded(observe(solids, camera, 0.0, sensor, rng, around=around), render_depth(solids, camera))


def surrounded(image: np.ndarray) -> np.ndarray:
    """Pixels around which all 5 x 5 are true."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, 2, constant_values=True), (5, 5))
    return np.asarray(windows.all(axis=(2, 3)))


@pytest.mark.parametrize("kind", CUTS)
def test_past_is_empty_and_nothing_is_known_where_the_object_is_hidden(views: list[View], kind: Cut) -> None:
    for view in views:
        cut = occlude(view, kind)
        seen, lines = cut.seen, cut.found.lines
        rows, columns = pixels(lines.past, seen.whole.camera)
        # each past line ends at what was measured there, and no part of the true object is before that
        np.testing.assert_allclose(lines.past[:, 2], seen.whole.depth[rows, columns])
        alone = cut.alone.depth[rows, columns]
        assert ((alone == 0) | (alone >= lines.past[:, 2])).all()
        labels = cut.kinds(lines)
        assert (labels[seen.mask] == "").all()
        hidden = (cut.alone.depth > 0) & (seen.source == OCCLUDER)
        assert (labels[hidden] != "p").all() and hidden.any() == (kind != "none")
        # the wall is past the object, wherever nothing else is near
        assert (labels[surrounded(seen.source == BACKGROUND)] != "u").all() and (labels == "p").sum() > 1000
        # an occlusion edge is no silhouette: hidden pixels beside the visible ones are there, and unknown
        near = ~surrounded(~seen.mask)
        assert (labels[hidden & near] == "u").all()
        assert lines.other_lines == "unknown"
        edge = Evidence.of(cut.found.cloud.points, lines=lines).hidden_edge
        assert edge < 0.05 if kind == "none" else edge > (0.01 if kind == "tool" else 0.1)


@pytest.mark.parametrize("sensor", ["structured-light", "time-of-flight"])
def test_under_sensors_and_wrong_masks_few_lines_are_wrong(views: list[View], sensor: Sensor) -> None:
    wrong = total = known = 0
    for view in views:
        for kind in CUTS:
            cut = occlude(view, kind, SENSORS[sensor])
            seen, lines = cut.seen, cut.found.lines
            alone = cut.alone.depth[pixels(lines.past, seen.whole.camera)]
            wrong += int(((alone > 0) & (alone < lines.past[:, 2] - 1)).sum())
            total += len(lines.past)
            labels = cut.kinds(lines)[surrounded((seen.source == BACKGROUND) & seen.whole.valid & ~seen.mask)]
            known += (labels == "p").sum() / ((labels == "p") | (labels == "u")).sum()
    assert wrong < 0.002 * total
    assert known > 0.97 * len(views) * len(CUTS)


def test_a_rendered_image_leaves_open_what_is_beside_the_object(views: list[View]) -> None:
    for view in views:
        lines = occlude(view, "none", wall=False).found.lines
        assert lines.other_lines is None and len(lines.past) == len(lines.unknown) == 0
        # an occluder before nothing is unknown, and the zeros around it remain open
        cut = occlude(view, "hand", wall=False)
        labels = cut.kinds(cut.found.lines)
        assert cut.found.lines.other_lines is None and (labels[cut.seen.source == NOTHING] == "").all()
        hidden = (cut.alone.depth > 0) & (cut.seen.source == OCCLUDER)
        assert hidden.any() and (labels[hidden] == "u").all()


def test_what_a_bare_cloud_is_cut_by_is_what_it_is_declared_to_be(views: list[View]) -> None:
    points = views[0].depth.to_points().points
    assert Evidence.of(points, lines=SightLines.of_cloud("past")).hidden_edge == 0.0
    assert Evidence.of(points, lines=SightLines.of_cloud("unknown")).hidden_edge == 1.0
