"""Random subsets of clouds and means of neighbours; grids are in test_isolation."""

import numpy as np
import pytest
from jaxtyping import Float

from mereo.geometry.camera import Camera
from mereo.geometry.downsampling import means_along_sight, random_subset


@pytest.mark.parametrize("limit", [1, 7, 49, 50, 51])
def test_a_random_subset_is_the_same_every_time(limit: int) -> None:
    """Rows of the cloud, each at most once; all of them, in their order, where they are few enough."""
    points = np.random.default_rng(3).normal(size=(50, 3))
    chosen = random_subset(points, limit)
    assert len(chosen) == min(limit, 50) == len(np.unique(chosen, axis=0))
    assert set(map(tuple, chosen)) <= set(map(tuple, points))
    assert np.array_equal(chosen, random_subset(points.copy(), limit))
    assert np.array_equal(chosen, points[random_subset(np.arange(50), limit)])
    assert limit < 50 or chosen is points


def wall(pixels: int, depth: float, noise: float) -> Float[np.ndarray, "n 3"]:
    """What a camera sees of a wall."""
    directions = Camera.from_fov(pixels, pixels, 0.6).directions().reshape(-1, 3)
    return directions * (depth + noise * np.random.default_rng(5).normal(size=(len(directions), 1)))


def test_means_of_neighbours_average_the_noise() -> None:
    """Of k pixels each, it falls by the square root of k, and the wall stays where it is."""
    points = wall(200, 50.0, 0.2)
    means = means_along_sight(points, 2500)
    assert 1800 < len(means) <= 2500
    assert means[:, 2].std() == pytest.approx(0.2 * np.sqrt(len(means) / len(points)), rel=0.1)
    assert means[:, 2].mean() == pytest.approx(50.0, abs=0.01)
    assert means_along_sight(points, len(points)) is points


def test_no_mean_lies_between_two_surfaces() -> None:
    """A near wall's edge before a far one: every mean is on either; in any unit the same."""
    points = wall(200, 50.0, 0.05)
    near = points[:, 0] > 0.013 * points[:, 2]
    points[near] *= 0.8
    means = means_along_sight(points, 2500)
    assert np.minimum(np.abs(means[:, 2] - 50.0), np.abs(means[:, 2] - 40.0)).max() < 0.1
    assert np.allclose(means_along_sight(points * 1024.0, 2500), means * 1024.0)


@pytest.mark.parametrize("count", [2, 3, 300])
def test_points_on_one_line_of_sight_are_few_already_or_parted(count: int) -> None:
    """Without any extent across the lines of sight nothing divides by zero."""
    points = np.array([[0.0, 0.0, 1.0]]) * np.linspace(1.0, 2.0, count)[:, None]
    assert 1 <= len(means_along_sight(points, 1)) <= count
