"""The paper's claims about densities and distances around its toy shapes (section 3.2), and its figure of them."""

from functools import cache, cached_property

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from mereo.synthesis.query_sampling import Samples, extended_boxes, label_uniform, sort_sample
from mereo_experiments.paper.sampling_figure import Polygons2D, draw_figure, read_outlines

REPEATS = 30
KEEP = 256


class Panel:
    """A toy shape in its draw box, with the areas near its outline measured by Monte Carlo."""

    def __init__(self, name: str, figure_box: bool) -> None:
        outlines, box = read_outlines()
        self.shape = Polygons2D(outlines[name])
        self.boxes = box[None] if figure_box else extended_boxes(self.shape)
        rng = np.random.default_rng(7)
        low, high = self.boxes[0]
        points = low + rng.random((150_000, 2)) * (high - low)
        distance = np.concatenate([self.shape.segment_distance(0, part) for part in np.split(points, 30)])
        inside = self.shape.inside(0, points)
        self.inside, self.outside = np.sort(distance[inside]), np.sort(distance[~inside])

    def distances(self, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        distance = self.shape.segment_distance(0, samples.points)
        return distance[samples.labels > 0], distance[samples.labels == 0]

    @cached_property
    def sorted(self) -> dict[int, list[tuple[np.ndarray, np.ndarray]]]:
        """Distances of the points kept inside and outside, for SortSample with n = k and n = 2k, in every run."""
        return {
            factor: [
                self.distances(sort_sample(self.shape, KEEP, factor * KEEP, np.random.default_rng(seed), self.boxes))
                for seed in range(REPEATS)
            ]
            for factor in (1, 2)
        }

    @cached_property
    def uniform(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The same for Label Uniform."""
        return [
            self.distances(label_uniform(self.shape, KEEP, np.random.default_rng(seed), self.boxes))
            for seed in range(REPEATS)
        ]

    def bias(self, runs: list[tuple[np.ndarray, np.ndarray]]) -> float:
        """Log ratio of densities just inside and just outside, in standard deviations.

        The two bands along the outline have equal areas, 0.3 of the shape's; counts in them are compared. Four counts
        enter, two of them Monte Carlo areas, each with a relative variance of one over itself.
        """
        area = int(0.3 * len(self.inside))
        within = [
            sum(int((side < edge).sum()) for side in sides)
            for sides, edge in zip(zip(*runs, strict=True), (self.inside[area], self.outside[area]), strict=True)
        ]
        return float(np.log(within[0] / within[1]) / np.sqrt(1 / within[0] + 1 / within[1] + 2 / area))


panel = cache(Panel)
each_panel = pytest.mark.parametrize(
    "name, figure_box", [(name, box) for name in ("simple", "small", "thin") for box in (False, True)]
)


@each_panel
@pytest.mark.parametrize("factor", [1, 2])
def test_sort_sample_has_no_density_step_at_the_surface(name: str, figure_box: bool, factor: int) -> None:
    here = panel(name, figure_box)
    assert abs(here.bias(here.sorted[factor])) < 4


@each_panel
def test_label_uniform_has_a_density_step_at_the_surface(name: str, figure_box: bool) -> None:
    """The same statistic, so that the test above is known to be able to fail: it must fail clearly here."""
    here = panel(name, figure_box)
    assert here.bias(here.uniform) > 12


@each_panel
def test_outside_points_stay_within_the_distance_that_geometry_gives(name: str, figure_box: bool) -> None:
    """With n = k the outside points fill a band of the shape's own area, with n = 2k both sides one of half of it."""
    here = panel(name, figure_box)
    for factor in (1, 2):
        runs = here.sorted[factor]
        area = len(here.inside) // factor
        reach_in, reach_out = (np.mean([run[side].max() for run in runs]) for side in (0, 1))
        assert reach_out == pytest.approx(here.outside[area], rel=0.06)
        assert reach_in == pytest.approx(here.inside[area - 1], rel=0.06)


@each_panel
def test_drawing_more_brings_points_closer(name: str, figure_box: bool) -> None:
    here = panel(name, figure_box)
    label, once, twice = (np.concatenate([out for _, out in runs]) for runs in (here.uniform, *here.sorted.values()))
    assert np.median(twice) < 0.8 * np.median(once) < 0.8 * np.median(label)
    diagonal = float(np.linalg.norm(here.boxes[0, 1] - here.boxes[0, 0]))
    assert twice.max() < once.max() < diagonal / 6
    if figure_box:
        assert label.max() > diagonal / 4


def test_the_figure_shows_both_sides_of_every_shape() -> None:
    figure = draw_figure(np.random.default_rng(0))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # red inside, blue outside, white paper
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    red, blue = pixels[..., 0] - pixels[..., 2], pixels[..., 2] - pixels[..., 0]
    assert (red > 80).mean() > 0.01
    assert (blue > 80).mean() > 0.01
