"""Strays are dropped where the cloud shows that they are none of the object's; else nothing is lost, or it is open."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from mereo.geometry.camera import PointCloud
from mereo.geometry.downsampling import random_subset
from mereo.geometry.solids import Solids
from mereo.geometry.surface_patches import longest_side
from mereo.reconstruction.isolation import Reading, readings
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig, Sensor
from mereo.synthesis.examples import sample_view
from mereo_learning.scans import SCANS, bunny_scan

SEED, OFF = 700_000, 3.0
"""Training draws, and the distance in scene units from which on a point is a stray: six times the noise."""


def views(name: str, sensor: Sensor, which: Iterable[int]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points of views, and whether each is on the object."""
    scene, settings = load_scene(name).for_seed(SEED), GenerateConfig(sensor=SENSORS[sensor])
    seen = [sample_view(scene, settings, example_rng(SEED, index)) for index in which]
    clouds = [(view, view.depth.to_points().points) for view in seen]
    return [(points, np.asarray(Solids(view.mesh).nearest(points).distance) < OFF) for view, points in clouds]


def strays_left(reading: Reading, points: np.ndarray, genuine: np.ndarray) -> int:
    return len(set(map(tuple, points[~genuine])) & set(map(tuple, reading.cloud.points)))


def lengthened(reading: Reading, points: np.ndarray, genuine: np.ndarray) -> float:
    return longest_side(reading.cloud.points) / longest_side(points[genuine])


def wall_behind_plate(rim: int = 2, fragments: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A plate of 30 x 30 pixels and pieces of a rim of the wall, in metres; whether each point is of the plate."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(30 + rim) - 15.0, np.arange(30) - 15.0))
    genuine = u < 15
    whole = genuine | (v % (30 // fragments) > 0)
    depth = np.where(genuine, 0.5, 1.5)
    return (np.column_stack([u, v, np.full(len(u), 100.0)]) * depth[:, None] / 100)[whole], genuine[whole]


def test_scattered_strays_are_dropped_and_said() -> None:
    points, genuine = wall_behind_plate()
    taken, other = readings(PointCloud(points))
    np.testing.assert_array_equal(taken.cloud.points, points[genuine])
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
    np.testing.assert_array_equal(other.cloud.points, points[genuine])


def test_everything_is_kept_where_asked_or_where_nothing_can_be_told() -> None:
    points, _ = wall_behind_plate()
    (everything,) = readings(points, keep_all=True)
    assert everything.cloud.points is points
    rng = np.random.default_rng(0)
    for cloud in (points[:31], rng.uniform((-1, -1, 4), (1, 1, 6), (3000, 3)), np.ones((50, 3)), np.zeros((0, 3))):
        assert [reading.dropped for reading in readings(cloud)] == [0]


@pytest.mark.parametrize("name", ["shapes", "lizard"])
def test_clean_views_lose_nothing(name: str) -> None:
    for points, genuine in views(name, "paper", range(6)):
        assert genuine.all() and readings(points)[0].cloud.points is points


def test_views_of_a_sensor_come_back_to_the_objects_size() -> None:
    for points, genuine in views("shapes", "structured-light", (2, 3, 4)):
        taken, other = readings(points)
        assert lengthened(other, points, genuine) > 1.08 and strays_left(other, points, genuine) >= 5
        assert 0.96 < lengthened(taken, points, genuine) < 1.01 and strays_left(taken, points, genuine) == 0


@pytest.mark.parametrize("name", SCANS)
def test_real_scans_lose_nothing(name: str, require_asset: Callable[[str], Path]) -> None:
    require_asset(f"bunny/{name}.ply")
    points = bunny_scan(name)[0].points
    for limit in (2000, 10_000, 10**6):
        scan = random_subset(points, limit)
        (only,) = readings(scan, "scanner")
        assert only.cloud.points is scan
