"""Each step leaves out what it is for and keeps the object, whatever the unit; the real scan survives its clutter."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from two_balls import front

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Triple
from mereo.geometry.downsampling import random_subset, thin_to_grid
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import longest_side
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import IsolationStep, Reading, clusters, largest_plane, readings
from mereo.reconstruction.observation import find_object, observe
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo_learning.scans import SCANS, bunny_scan


def half_ball(count: int = 3000, center: Triple = (0.0, 0.0, 0.8)) -> ndarray:
    return front(center, 0.1, -1.0, count)


def wall(count: int = 6000, z: float = 1.5) -> ndarray:
    x, y = default_rng(1).uniform(-0.6, 0.6, (2, count))
    return np.column_stack([x, y, z + 0.1 * x + default_rng(2).normal(0, 0.002, count)])


BALL = half_ball()
WALL = wall()
STRAYS = default_rng(3).uniform((-0.5, -0.5, 0.5), (0.5, 0.5, 1.2), (40, 3))
EVERYTHING = np.concatenate([BALL, WALL, STRAYS])


def isolate(
    points: ndarray, config: IsolationConfig, unit_m: float = 1.0
) -> tuple[PointCloud, tuple[IsolationStep, ...]]:
    found = find_object(observe(PointCloud(points), unit_m=unit_m).frame, config)
    return found.cloud, found.steps


def kept(points: ndarray, config: IsolationConfig, unit_m: float = 1.0) -> ndarray:
    return isolate(points, config, unit_m)[0].points


def test_nothing_happens_by_default() -> None:
    left, steps = isolate(EVERYTHING, IsolationConfig())
    assert left.points is EVERYTHING and steps == () and not IsolationConfig().on


def test_crops_are_in_metres_whatever_the_unit() -> None:
    for unit_m in (1.0, 0.001):
        crop = IsolationConfig(depth_range=(0.7, 0.8), box=(-0.1, -0.1, 0.0, 0.0, 0.1, 2.0))
        corners = np.array([[-0.05, 0, 0.7], [0.05, 0, 0.7], [-0.05, 0, 0.69], [-0.05, 0.2, 0.75]])
        around = 5e-4 * np.stack([np.arange(40) % 7, np.arange(40) // 7, np.zeros(40)], axis=1)
        points = (corners + around[:, None]).reshape(-1, 3) / unit_m
        left, steps = isolate(points, crop, unit_m)
        assert len(left) == 40 and [step.name for step in steps] == ["depth range", "box"]
        assert [(step.before, step.kept) for step in steps] == [(160, 120), (120, 40)]


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_the_largest_plane_goes_and_the_object_stays(factor: float) -> None:
    left = kept(factor * EVERYTHING, IsolationConfig(remove_plane=True), 1 / factor) / factor
    assert (left[:, 2] < 1.3).sum() >= len(BALL), "all of the ball"
    assert (left[:, 2] > 1.4).sum() < 0.01 * len(WALL)
    with pytest.raises(ValueError, match=r"the largest plane holds \d% of the 20000 points.*leave out --remove-plane"):
        isolate(half_ball(20000), IsolationConfig(remove_plane=True))


def test_the_plane_is_the_one_of_least_squares() -> None:
    plane = largest_plane(EVERYTHING, np.full(len(EVERYTHING), 0.01), default_rng(5))
    expected = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    assert abs(plane.normal @ expected) == pytest.approx(1.0, abs=1e-5)
    least = np.linalg.eigvalsh(np.cov(WALL.T, bias=True))[0]
    assert (plane.distance(WALL) ** 2).mean() < 1.01 * least
    line = np.outer(np.arange(50.0), [1.0, 2.0, 3.0])
    assert largest_plane(line, np.full(50, 0.1), default_rng(5)) is None


def test_outliers_go_and_the_object_stays() -> None:
    left = kept(np.concatenate([BALL, STRAYS]), IsolationConfig(remove_outliers=True))
    off = norm(left - [0, 0, 0.8], axis=1) - 0.1
    assert (np.abs(off) < 1e-9).sum() >= 0.999 * len(BALL) and (off > 0.03).mean() < 0.002


def test_the_largest_cluster_is_kept_whole() -> None:
    small = half_ball(500, (0.5, 0.0, 0.8))
    left = kept(np.concatenate([small, BALL, STRAYS]), IsolationConfig(largest_cluster=True))
    assert set(map(tuple, BALL)) <= set(map(tuple, left)) and len(left) <= len(BALL) + 5


def test_clusters_follow_neighbours_not_distance() -> None:
    """Two dense sheets 5 spacings apart are two; a sheet whose rows are 5 spacings apart is one."""
    dense = np.stack(np.meshgrid(np.arange(60.0), np.arange(50.0), [0.0]), axis=-1).reshape(-1, 3)
    sheets = np.concatenate([dense[:1500] + np.array([0, 0, 5.0]), dense])
    assert_array_equal(clusters(sheets), np.repeat([1, 0], [1500, 3000]))
    assert (clusters(dense * [1.0, 5.0, 1.0]) == 0).all()
    assert (clusters(dense * [1.0, 10.1, 1.0]) > 0).any(), "rows farther apart than the gap"
    for count in (1, 2, 5):
        assert clusters(np.ones((count, 3))).tolist() == [0] * count


def test_groups_within_the_gap_are_kept_with_those_behind_them() -> None:
    row = [half_ball(n, (x, 0.0, 0.8)) for n, x in ((3000, 0.0), (800, 0.25), (500, 0.5), (700, -0.5))]
    row.append(np.array([0.0, 0.0, 0.66]) + np.zeros((5, 1)))
    gap = IsolationConfig(largest_cluster=True, cluster_gap=0.06)
    left, (step,) = isolate(1000 * np.concatenate(row), gap, 0.001)
    assert len(left) == 4300 and left.points[:, 0].min() > -110
    assert step.detail == "3 of 5 clusters, the largest left out has 700"


@pytest.mark.parametrize(
    "options, expected",
    [
        ({"depth_range": (0.9, 0.4)}, "the depth range is 0.9 0.4; it must be the nearest and the farthest"),
        ({"depth_range": (0.4, float("nan"))}, "the depth range is 0.4 nan"),
        ({"cluster_gap": 0.01}, "the cluster gap is 0.01 m; it belongs to the largest"),
        ({"box": (0, 0, 0, 1, 0, 1)}, "the box is 0 0 0 1 0 1; each of x0 y0 z0 must be less than"),
    ],
)
def test_bad_settings(options: dict, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        IsolationConfig(**options)


def test_too_little_left_names_the_step_and_its_cure() -> None:
    reach = r"which reach from \(-0.6, -0.6, 0.5.* m"
    for config, expected in (
        (IsolationConfig(depth_range=(5.0, 6.0)), f"'depth range' leaves 0 of 9040 points, {reach}; .*: widen"),
        (IsolationConfig(box=(5, 5, 5, 6, 6, 6)), "'box' leaves 0 of 9040 points, .*: widen --box"),
    ):
        with pytest.raises(ValueError, match=expected):
            isolate(EVERYTHING, config)


def test_thinning_is_even_and_keeps_measurements() -> None:
    """Nine tenths of the points are in one corner; a tenth of the cells is there."""
    rng = default_rng(0)
    sheet = np.concatenate([rng.uniform(0, 1, (20000, 2)), rng.uniform(0, 0.3, (180000, 2))])
    points = np.column_stack([sheet, np.ones(len(sheet))])
    rows = thin_to_grid(points, 5000)
    assert 2500 <= len(rows) <= 5000 and (np.diff(rows) > 0).all()
    corner = (points[rows, :2] < 0.3).all(axis=1).mean()
    assert corner == pytest.approx(0.09, abs=0.02)
    assert thin_to_grid(points[:5000], 5000).tolist() == list(range(5000))
    assert len(thin_to_grid(np.ones((100, 3)), 10)) == 10


SEED, OFF = 700_000, 3.0
"""Training draws, and the distance in scene units from which on a point is a stray: six times the noise."""


def views(name: str, sensor: Sensor, which: Iterable[int]) -> list[tuple[ndarray, ndarray]]:
    """Points of views, and whether each is on the object."""
    scene = load_scene(name).for_seed(SEED)
    settings = GenerateConfig(sensor=SENSORS[sensor])
    seen = (sample_view(scene, settings, example_rng(SEED, index)) for index in which)
    clouds = ((view, view.depth.to_points().points) for view in seen)
    return [(points, np.asarray(Solids(view.mesh).nearest(points).distance) < OFF) for view, points in clouds]


def strays_and_stretch(reading: Reading, points: ndarray, genuine: ndarray) -> tuple[int, float]:
    """How many strays are left, and how many times as long the longest side is as that of the object."""
    left = set(map(tuple, points[~genuine])) & set(map(tuple, reading.cloud.points))
    return len(left), longest_side(reading.cloud.points) / longest_side(points[genuine])


def wall_behind_plate(rim: int = 2, fragments: int = 8) -> tuple[ndarray, ndarray]:
    """A plate of 30 x 30 pixels and pieces of a rim of the wall, in metres; whether each point is of the plate."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(30 + rim) - 15.0, np.arange(30) - 15.0))
    genuine = u < 15
    whole = genuine | (v % (30 // fragments) > 0)
    depth = np.where(genuine, 0.5, 1.5)
    return (np.column_stack([u, v, np.full(len(u), 100.0)]) * depth[:, None] / 100)[whole], genuine[whole]


def test_scattered_strays_are_dropped_and_said() -> None:
    points, genuine = wall_behind_plate()
    taken, other = readings(PointCloud(points))
    assert_array_equal(taken.cloud.points, points[genuine])
    assert other.cloud.points is points and (other.dropped, other.step, str(other)) == (0, None, "")
    assert taken.dropped == (~genuine).sum() and taken.step is not None
    assert (taken.step.name, taken.step.before, taken.step.kept) == ("strays", len(points), genuine.sum())
    assert str(taken) == (
        f"strays: {taken.dropped} of {len(points)} points dropped, the longest side was {taken.stretch:.3g} times as "
        "long with them (--keep-all keeps them)"
    )
    assert taken.stretch == pytest.approx(longest_side(points) / longest_side(points[genuine]))
    assert taken.step.detail == f"the longest side was {taken.stretch:.3g} times as long with the others"


def test_one_piece_that_lies_apart_stays_and_is_left_open() -> None:
    """It may be a part whose root is hidden: the head behind the body."""
    points, genuine = wall_behind_plate(fragments=1)
    taken, other = readings(points)
    assert taken.dropped == 0 and taken.cloud.points is points
    assert_array_equal(other.cloud.points, points[genuine])


def test_what_lies_before_a_gap_in_range_is_a_reading_too() -> None:
    """A mask that is far too wide lets in more than a rim: what is behind is then as much of a surface."""
    points, genuine = wall_behind_plate(rim=20, fragments=1)
    *others, nearer = readings(points)
    assert max(other.dropped for other in others) < (~genuine).sum()
    assert_array_equal(nearer.cloud.points, points[genuine])


def test_everything_is_kept_where_asked_or_where_nothing_can_be_told() -> None:
    points, _ = wall_behind_plate()
    (everything,) = readings(points, keep_all=True)
    assert everything.cloud.points is points
    rng = default_rng(0)
    for cloud in (points[:31], rng.uniform((-1, -1, 4), (1, 1, 6), (3000, 3)), np.ones((50, 3)), np.zeros((0, 3))):
        assert [reading.dropped for reading in readings(cloud)] == [0]


@pytest.mark.parametrize("name", ["shapes", "lizard"])
def test_clean_views_lose_nothing(name: str) -> None:
    for points, genuine in views(name, "paper", range(6)):
        assert genuine.all() and readings(points)[0].cloud.points is points


def test_views_of_a_sensor_come_back_to_the_objects_size() -> None:
    for points, genuine in views("shapes", "structured-light", (2, 3, 4)):
        taken, other, *_ = (strays_and_stretch(reading, points, genuine) for reading in readings(points))
        assert other[0] >= 5 and other[1] > 1.08 and taken[0] == 0 and 0.96 < taken[1] < 1.01


@pytest.mark.parametrize("name", SCANS)
def test_real_scans_lose_nothing(name: str, require_asset: Callable[[str], Path]) -> None:
    require_asset(f"bunny/{name}.ply")
    points = bunny_scan(name)[0].points
    for limit in (2000, 10_000, 10**6):
        scan = random_subset(points, limit)
        first, *_ = readings(scan, "scanner")
        assert first.cloud.points is scan


def test_a_scan_is_seen_along_its_estimated_lines_of_sight() -> None:
    """Where it was taken from is not said; points that float about a plate are off it from anywhere in front."""
    line = np.linspace(-0.1, 0.1, 40)
    plate = np.stack(np.meshgrid(line, line, [5.0]), axis=-1).reshape(-1, 3)
    floating = default_rng(0).uniform((-0.1, -0.1, 4.2), (0.1, 0.1, 4.8), (20, 3))
    scan = np.concatenate([plate, floating])
    taken, other = readings(PointCloud(scan), "scanner")
    assert_array_equal(taken.cloud.points, plate)
    assert other.dropped == 0 and taken.stretch == pytest.approx(np.ptp(scan[:, 2]) / 0.2)
