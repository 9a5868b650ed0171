"""Farthest-point order: greedy and exact, a prefix for every size, the same whatever order the points come in."""

import numpy as np
import pytest

from mereo.geometry.downsampling import farthest_point_order


def lattice(side: int) -> np.ndarray:
    """Points with as many equal distances as possible."""
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def gap_to_chosen(points: np.ndarray, order: np.ndarray) -> np.ndarray:
    """[m - 1, n]: each point's distance to the nearest of the first 1, 2, ... chosen ones, in double precision."""
    distances = np.linalg.norm(points[:, None] - points[order[:-1]][None], axis=-1)
    return np.minimum.accumulate(distances, axis=1).T


@pytest.mark.parametrize("seed", range(3))
def test_each_next_point_is_the_farthest_from_all_before(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(400, 3))
    order = farthest_point_order(points, 200)
    gaps = gap_to_chosen(points, order)
    chosen = gaps[np.arange(199), order[1:]]
    assert np.allclose(chosen, gaps.max(axis=1), rtol=1e-6)


def test_on_a_lattice_the_choice_is_exact_and_ties_go_to_smaller_coordinates() -> None:
    points = lattice(5)
    order = farthest_point_order(points, 60)
    gaps = gap_to_chosen(points, order)
    # rows of the lattice are sorted by x, y, z, and argmax takes the first: the rule in one line
    assert np.array_equal(order[1:], gaps.argmax(axis=1))


def test_a_smaller_sample_is_a_prefix_of_a_larger_one() -> None:
    points = np.random.default_rng(1).normal(size=(300, 3))
    longest = farthest_point_order(points, 300)
    assert all(np.array_equal(farthest_point_order(points, m), longest[:m]) for m in (1, 2, 37, 128))
    assert sorted(longest) == list(range(300))


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
