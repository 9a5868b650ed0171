"""The paper's claims about its samplers (section 3.2), as statistics with bounds, closed forms and slow references."""

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from shapes import box

from mereo.geometry.conventions import Pair, Range
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.synthesis import query_sampling
from mereo.synthesis.config import SamplingConfig
from mereo.synthesis.query_sampling import (
    Samples,
    Shape,
    extended_boxes,
    joint_box,
    nested_sort_sample,
    owner_labels,
    sample_queries,
    sort_sample,
)


class Balls:
    """Balls in any dimension; every answer in closed form."""

    def __init__(self, *balls: tuple[tuple[float, ...], float], nesting: tuple[Pair, ...] = ()) -> None:
        self.centers, self.radii = np.array([c for c, _ in balls]), np.array([r for _, r in balls])
        self.count, self.nesting = len(balls), nesting

    def boxes(self) -> ndarray:
        return np.stack([self.centers - self.radii[:, None], self.centers + self.radii[:, None]], axis=1)

    def radius(self, index: int, points: ndarray) -> ndarray:
        return norm(points - self.centers[index], axis=1)

    def inside(self, index: int, points: ndarray) -> ndarray:
        return self.radius(index, points) < self.radii[index]

    def label(self, points: ndarray) -> ndarray:
        labels = np.zeros(len(points), np.uint8)
        for index in reversed(range(self.count)):
            labels[self.inside(index, points)] = index + 1
        return labels

    def segment_distance(self, index: int, points: ndarray) -> ndarray:
        return np.abs(self.radius(index, points) - self.radii[index])


def shapes() -> dict[str, Shape]:
    """Two dimensions and three, touching and apart."""
    return {
        "discs": Balls(((0, 0), 1.0), ((1.6, 0), 0.6), ((0, 3), 0.35)),
        "balls": Balls(((0, 0, 0), 1.0), ((2.05, 0, 0), 1.0), ((0, 1.4, 0), 0.35)),
        "cubes": Solids(SegmentedMesh((box((0, 0, 0), (1, 1, 1), "left"), box((1, 0, 0), (2, 1, 1), "right")))),
    }


def one_at_a_time(shape: Shape, keep: int, draw: int, seed: int, nested: bool) -> Samples:
    """The paper's loop, one draw after the other."""
    seeds = default_rng(seed).integers(0, 2**32, size=(shape.count, 4), dtype=np.uint32)
    points, labels = [], []
    for index, (low, high) in enumerate(extended_boxes(shape)):
        stream = default_rng(seeds[index])
        inside = []
        outside = []
        while len(inside) < draw or len(outside) < draw:
            point = low + stream.random(len(low)) * (high - low)
            label = int((owner_labels(shape, point[None]) if nested else shape.label(point[None]))[0])
            if label == index + 1:
                inside.append((point, label))
            elif label == 0 or nested:
                outside.append((point, label))
        for side in (inside, outside):
            distance = shape.segment_distance(index, np.array([p for p, _ in side]))
            nearest = sorted(np.argsort(distance)[:keep])
            points += [side[i][0] for i in nearest]
            labels += [side[i][1] for i in nearest]
    return Samples(np.array(points), np.array(labels, np.uint8))


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("name", ["discs", "balls", "cubes"])
def test_equals_drawing_one_point_at_a_time(name: str, nested: bool) -> None:
    sampler = nested_sort_sample if nested else sort_sample
    for keep, draw in ((12, 12), (9, 30)):
        fast = sampler(shapes()[name], keep, draw, default_rng(5))
        slow = one_at_a_time(shapes()[name], keep, draw, 5, nested)
        assert_array_equal(fast.points, slow.points)
        assert_array_equal(fast.labels, slow.labels)


def test_batch_size_changes_no_bit_and_the_generator_advances_alike_whatever_is_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So the uniform points after it are comparable between samplers' settings."""
    shape = shapes()["balls"]
    usual = sort_sample(shape, 40, 80, default_rng(1))
    for first, largest in ((1, 1 << 17), (300, 1 << 17), (8, 7)):
        monkeypatch.setattr(query_sampling, "_FIRST_BATCH", first)
        monkeypatch.setattr(query_sampling, "_LARGEST_BATCH", largest)
        other = sort_sample(shape, 40, 80, default_rng(1))
        assert_array_equal(usual.points, other.points)
    rngs = [default_rng(3) for _ in range(2)]
    for rng, draw in zip(rngs, (20, 200), strict=True):
        sort_sample(shape, 20, draw, rng)
    assert rngs[0].random() == rngs[1].random()


def test_the_nearest_surface_owns_nested_and_overlapping_solids() -> None:
    nested = Balls(((0, 0, 0), 3.0), ((0, 0, 0), 2.0), ((0, 0, 0), 1.0))
    points = default_rng(0).uniform(-3.2, 3.2, size=(5000, 3))
    radius = norm(points, axis=1)
    # the innermost ball that holds it, also just outside ball 3, whose surface is then the nearest of all
    assert_array_equal(owner_labels(nested, points), (radius < 3).astype(int) + (radius < 2) + (radius < 1))
    overlapping = Balls(((-0.6, 0, 0), 1.0), ((0.6, 0, 0), 1.0))
    points = points / 3.2
    lens = points[overlapping.inside(0, points) & overlapping.inside(1, points)]
    assert len(lens) > 100
    # equal radii: the first ball's surface is nearer where its centre is farther
    assert_array_equal(owner_labels(overlapping, lens), np.where(lens[:, 0] > 0, 1, 2))


@pytest.mark.parametrize("sampler", ["volume-uniform", "label-uniform", "sort-sample", "nested-sort-sample"])
def test_queries_of_an_example(sampler: str) -> None:
    shape = shapes()["balls"]
    settings = replace(SamplingConfig(), sampler=sampler, per_segment=64, uniform_fraction=0.5)
    samples = sample_queries(shape, settings, default_rng(2))
    again = sample_queries(shape, settings, default_rng(2))
    assert_array_equal(samples.points, again.points)
    assert len(samples.points) == len(samples.labels) == settings.total(3) == 64 * 3 + 96
    assert samples.labels.dtype == np.uint8
    assert_array_equal(samples.labels, shape.label(samples.points))
    low, high = joint_box(shape)
    assert_array_equal([low, high], [[-1, -1, -1], [3.05, 1.75, 1]])
    unit = (samples.points[64 * 3 :] - low) / (high - low)
    assert 0 < unit.min() < unit.max() < 1
    assert np.abs(unit.mean(axis=0) - 0.5).max() < 4 * np.sqrt(1 / 12 / 96)


def test_settings_reach_the_sampler_and_uniform_points_are_the_papers_share_of_all() -> None:
    """Appendix B: "15% of total points"."""
    for segments in range(1, 40):
        total = SamplingConfig().total(segments)
        near = 256 * segments
        assert abs((total - near) - 0.15 * total) < 1
    shape = shapes()["balls"]
    config = SamplingConfig(per_segment=80, oversample=3, box_margin=0.8, uniform_fraction=0)
    queries = sample_queries(shape, config, default_rng(4))
    direct = sort_sample(shape, 40, 120, default_rng(4), extended_boxes(shape, 0.8))
    assert_array_equal(queries.points, direct.points)


def test_bad_settings() -> None:
    with pytest.raises(ValueError, match="per_segment is 7; half the points go inside and half outside: pass an even"):
        replace(SamplingConfig(), per_segment=7)
    with pytest.raises(ValueError, match=r"box_margin is 0.0; it must be greater than 0: give for example 0.5"):
        replace(SamplingConfig(), box_margin=0.0)
    with pytest.raises(ValueError, match="keep is 9 and draw is 8; .* pass keep <= draw"):
        sort_sample(shapes()["balls"], 9, 8, default_rng(0))


@pytest.mark.parametrize(
    ("radii", "message"),
    [
        (
            (3.0, 1.0),
            "segment 1 has 0 of 30,000 draws inside it; 128 are needed: check that it is closed and no earlier segment "
            "covers it, or split it into shorter parts",
        ),
        (
            (1.0, 3.0),
            "segment 0 has 0 of 30,000 draws in the empty space around it; 128 are needed: widen box_margin, "
            "or use nested-sort-sample for a segment enclosed by others",
        ),
    ],
)
def test_segments_that_are_never_hit_or_never_missed(
    radii: Range, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_sampling, "MAX_DRAWS", 30_000)
    with pytest.raises(ValueError, match=f"^{message}$"):
        sort_sample(Balls(*(((0, 0, 0), radius) for radius in radii)), 128, 128, default_rng(0))
