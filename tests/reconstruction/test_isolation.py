"""Each step leaves out what it is for and keeps the object, whatever the unit; the real scan survives its clutter."""

import numpy as np
import pytest
from two_balls import front

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.downsampling import thin_to_grid
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.isolation import IsolationStep, clusters, largest_plane
from mereo.reconstruction.observation import find_object, observe


def half_ball(count: int = 3000, center: tuple[float, float, float] = (0.0, 0.0, 0.8)) -> np.ndarray:
    return front(center, 0.1, -1.0, count)


def wall(count: int = 6000, z: float = 1.5) -> np.ndarray:
    x, y = np.random.default_rng(1).uniform(-0.6, 0.6, (2, count))
    return np.column_stack([x, y, z + 0.1 * x + np.random.default_rng(2).normal(0, 0.002, count)])


BALL, WALL = half_ball(), wall()
STRAYS = np.random.default_rng(3).uniform((-0.5, -0.5, 0.5), (0.5, 0.5, 1.2), (40, 3))
EVERYTHING = np.concatenate([BALL, WALL, STRAYS])


def isolate(
    seen: PointCloud | DepthImage, config: IsolationConfig, unit_m: float = 1.0
) -> tuple[PointCloud, tuple[IsolationStep, ...]]:
    cloud = seen.to_points() if isinstance(seen, DepthImage) else seen
    found = find_object(observe(cloud, unit_m=unit_m).frame, config)
    return found.cloud, found.steps


def kept(points: np.ndarray, config: IsolationConfig, unit_m: float = 1.0) -> np.ndarray:
    return isolate(PointCloud(points), config, unit_m)[0].points


def test_nothing_happens_by_default_and_a_depth_image_is_taken_as_its_points() -> None:
    cloud = PointCloud(EVERYTHING)
    left, steps = isolate(cloud, IsolationConfig())
    assert left.points is cloud.points and steps == () and not IsolationConfig().on
    image = DepthImage(np.full((20, 20), 0.5), Camera(20, 20, 30.0, 30.0, 10.0, 10.0))
    assert len(isolate(image, IsolationConfig(depth_range=(0.4, 0.6)))[0]) == 400


def test_crops_are_in_metres_whatever_the_unit() -> None:
    for unit_m in (1.0, 0.001):
        crop = IsolationConfig(depth_range=(0.7, 0.8), box=(-0.1, -0.1, 0.0, 0.0, 0.1, 2.0))
        corners = np.array([[-0.05, 0, 0.7], [0.05, 0, 0.7], [-0.05, 0, 0.69], [-0.05, 0.2, 0.75]])
        around = 5e-4 * np.stack([np.arange(40) % 7, np.arange(40) // 7, np.zeros(40)], axis=1)
        points = (corners + around[:, None]).reshape(-1, 3) / unit_m
        left, steps = isolate(PointCloud(points), crop, unit_m)
        assert len(left) == 40 and [step.name for step in steps] == ["depth range", "box"]
        assert [(step.before, step.kept) for step in steps] == [(160, 120), (120, 40)]


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_the_largest_plane_goes_and_the_object_stays(factor: float) -> None:
    left = kept(factor * EVERYTHING, IsolationConfig(remove_plane=True), 1 / factor) / factor
    assert (left[:, 2] < 1.3).sum() >= len(BALL), "all of the ball"
    assert (left[:, 2] > 1.4).sum() < 0.01 * len(WALL)
    with pytest.raises(ValueError, match=r"the largest plane holds \d% of the 20000 points.*leave out --remove-plane"):
        isolate(PointCloud(half_ball(20000)), IsolationConfig(remove_plane=True))


def test_the_plane_is_the_one_of_least_squares() -> None:
    plane = largest_plane(EVERYTHING, np.full(len(EVERYTHING), 0.01), np.random.default_rng(5))
    assert plane is not None
    expected = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    assert abs(plane.normal @ expected) == pytest.approx(1.0, abs=1e-5)
    least = np.linalg.eigvalsh(np.cov(WALL.T, bias=True))[0]
    assert (plane.distance(WALL) ** 2).mean() < 1.01 * least
    line = np.outer(np.arange(50.0), [1.0, 2.0, 3.0])
    assert largest_plane(line, np.full(50, 0.1), np.random.default_rng(5)) is None


def test_outliers_go_and_the_object_stays() -> None:
    left = kept(np.concatenate([BALL, STRAYS]), IsolationConfig(remove_outliers=True))
    off = np.linalg.norm(left - [0, 0, 0.8], axis=1) - 0.1
    assert (np.abs(off) < 1e-9).sum() >= 0.999 * len(BALL) and (off > 0.03).mean() < 0.002


def test_the_largest_cluster_is_kept_whole() -> None:
    small = half_ball(500, (0.5, 0.0, 0.8))
    left = kept(np.concatenate([small, BALL, STRAYS]), IsolationConfig(largest_cluster=True))
    assert set(map(tuple, BALL)) <= set(map(tuple, left)) and len(left) <= len(BALL) + 5


def test_clusters_follow_neighbours_not_distance() -> None:
    """Two dense sheets 5 spacings apart are two; a sheet whose rows are 5 spacings apart is one."""
    dense = np.stack(np.meshgrid(np.arange(60.0), np.arange(50.0), [0.0]), axis=-1).reshape(-1, 3)
    sheets = np.concatenate([dense[:1500] + np.array([0, 0, 5.0]), dense])
    np.testing.assert_array_equal(clusters(sheets), np.repeat([1, 0], [1500, 3000]))
    assert (clusters(dense * [1.0, 5.0, 1.0]) == 0).all()
    assert (clusters(dense * [1.0, 10.1, 1.0]) > 0).any(), "rows farther apart than the gap"
    for count in (1, 2, 5):
        assert clusters(np.ones((count, 3))).tolist() == [0] * count


def test_groups_within_the_gap_are_kept_with_those_behind_them() -> None:
    row = [half_ball(n, (x, 0.0, 0.8)) for n, x in ((3000, 0.0), (800, 0.25), (500, 0.5), (700, -0.5))]
    row.append(np.array([0.0, 0.0, 0.66]) + np.zeros((5, 1)))
    gap = IsolationConfig(largest_cluster=True, cluster_gap=0.06)
    left, (step,) = isolate(PointCloud(1000 * np.concatenate(row)), gap, 0.001)
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
    for config, expected in (
        (
            IsolationConfig(depth_range=(5.0, 6.0)),
            r"the step 'depth range' leaves 0 of 9040 points, which reach from \(-0.6, -0.6, 0.5.* m; .*: widen",
        ),
        (IsolationConfig(box=(5, 5, 5, 6, 6, 6)), "the step 'box' leaves 0 of 9040 points, .*: widen --box"),
    ):
        with pytest.raises(ValueError, match=expected):
            isolate(PointCloud(EVERYTHING), config)


def test_thinning_is_even_and_keeps_measurements() -> None:
    """Nine tenths of the points are in one corner; a tenth of the cells is there."""
    rng = np.random.default_rng(0)
    sheet = np.concatenate([rng.uniform(0, 1, (20000, 2)), rng.uniform(0, 0.3, (180000, 2))])
    points = np.column_stack([sheet, np.ones(len(sheet))])
    rows = thin_to_grid(points, 5000)
    assert 2500 <= len(rows) <= 5000 and (np.diff(rows) > 0).all()
    corner = (points[rows, :2] < 0.3).all(axis=1).mean()
    assert corner == pytest.approx(0.09, abs=0.02)
    assert thin_to_grid(points[:5000], 5000).tolist() == list(range(5000))
    assert len(thin_to_grid(np.ones((100, 3)), 10)) == 10
