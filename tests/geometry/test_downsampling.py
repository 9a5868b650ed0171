"""Fewer points of a cloud: random subsets, means of neighbours, and the exact farthest-point order."""

import numpy as np
import pytest
from jaxtyping import Float

from mereo.geometry.camera import Camera
from mereo.geometry.downsampling import farthest_point_order, means_along_sight, random_subset


@pytest.mark.parametrize("limit", [1, 7, 49, 50, 51])
def test_a_random_subset_is_the_same_every_time(limit: int) -> None:
    points = np.random.default_rng(3).normal(size=(50, 3))
    chosen = random_subset(points, limit)
    assert len(chosen) == min(limit, 50) == len(np.unique(chosen, axis=0))
    assert set(map(tuple, chosen)) <= set(map(tuple, points))
    assert np.array_equal(chosen, random_subset(points.copy(), limit))
    assert np.array_equal(chosen, points[random_subset(np.arange(50), limit)])
    assert limit < 50 or chosen is points


def wall(pixels: int, depth: float, noise: float) -> Float[np.ndarray, "n 3"]:
    directions = Camera.from_fov(pixels, pixels, 0.6).directions().reshape(-1, 3)
    return directions * (depth + noise * np.random.default_rng(5).normal(size=(len(directions), 1)))


def test_means_of_neighbours_average_the_noise() -> None:
    points = wall(200, 50.0, 0.2)
    means = means_along_sight(points, 2500)
    assert 1800 < len(means) <= 2500
    assert means[:, 2].std() == pytest.approx(0.2 * np.sqrt(len(means) / len(points)), rel=0.1)
    assert means[:, 2].mean() == pytest.approx(50.0, abs=0.01)
    assert means_along_sight(points, len(points)) is points


def test_no_mean_lies_between_two_surfaces() -> None:
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


def lattice(side: int) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def gap_to_chosen(points: np.ndarray, order: np.ndarray) -> np.ndarray:
    """[m - 1, n]: each point's distance to the nearest of the first 1, 2, ... chosen ones, in double precision."""
    distances = np.linalg.norm(points[:, None] - points[order[:-1]][None], axis=-1)
    return np.minimum.accumulate(distances, axis=1).T


def test_on_a_lattice_the_choice_is_exact_and_ties_go_to_smaller_coordinates() -> None:
    points = lattice(5)
    order = farthest_point_order(points, 60)
    gaps = gap_to_chosen(points, order)
    # rows of the lattice are sorted by x, y, z, and argmax takes the first: the rule in one line
    assert np.array_equal(order[1:], gaps.argmax(axis=1))


@pytest.mark.parametrize("points", [lattice(4), np.random.default_rng(2).normal(size=(200, 3))], ids=["ties", "random"])
def test_the_points_chosen_do_not_depend_on_their_order(points: np.ndarray) -> None:
    expected = points[farthest_point_order(points, 50)]
    for seed in range(4):
        shuffled = np.random.default_rng(seed).permutation(points)
        assert np.array_equal(shuffled[farthest_point_order(shuffled, 50)], expected)


def test_it_starts_at_the_point_farthest_from_the_middle_of_the_box() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [4, 3, 2], [2, 1, 0], [0, 3, 0]])
    assert farthest_point_order(points, 1).tolist() == [0]  # as far as [4, 3, 2], and smaller in x
    assert farthest_point_order(points[1:], 1).tolist() == [3]  # [0, 3, 0] and [4, 3, 2] again tie


def test_a_given_start_comes_first() -> None:
    points = np.random.default_rng(3).normal(size=(100, 3))
    for start in (0, 57, 99):
        order = farthest_point_order(points, 100, start)
        assert order[0] == start and len(set(order.tolist())) == 100


def test_coinciding_points_come_last_and_no_row_twice() -> None:
    distinct = np.random.default_rng(4).normal(size=(30, 3))
    points = np.random.default_rng(5).permutation(np.concatenate([distinct, distinct[:12], distinct[:5]]))
    order = farthest_point_order(points, 100)
    assert sorted(order) == list(range(47))
    assert len(np.unique(points[order[:30]], axis=0)) == 30


def test_where_a_small_cloud_lies_does_not_matter() -> None:
    points = np.round(np.random.default_rng(6).normal(size=(300, 3)), 3)
    far = points + 4096.0
    assert np.array_equal(farthest_point_order(points, 300)[:100], farthest_point_order(far, 300)[:100])
