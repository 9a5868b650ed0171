"""What is a patch of surface is kept, a rim of another one is not; and smoothing along lines of sight."""

import numpy as np
import pytest
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation
from two_balls import front

from mereo.geometry.camera import Camera
from mereo.geometry.downsampling import MAX_POINTS, farthest_point_order, means_along_sight, random_subset
from mereo.geometry.surface_patches import roughness, surface_points
from mereo.geometry.transforms import longest_side


def rays(size: int = 96) -> ndarray:
    return Camera.from_fov(size, size, 0.5).directions()


def plate(size: int = 96, half: float = 0.5, rim: int = 2) -> tuple[ndarray, ndarray]:
    """Slanted round plate, half of the image wide, and a rim of the wall behind it; whether each is of the plate."""
    line = (np.arange(size) - (size - 1) / 2) / (size / 2)
    radius = np.hypot(*np.meshgrid(line, line))
    inside, wide = radius < half, radius < half + 2 * rim / size
    depth = np.where(inside, 5 + rays(size)[..., 0], 8.0)
    noise = default_rng(0).normal(0, 0.002, depth.shape)
    return (rays(size) * (depth + noise)[..., None])[wide], inside[wide]


POINTS, PLATE = plate()


@pytest.mark.parametrize("rim", [1, 2, 3])
def test_a_rim_of_background_is_no_surface(rim: int) -> None:
    points, genuine = plate(rim=rim)
    assert_array_equal(surface_points(points), genuine)
    assert longest_side(points) > 1.5 * longest_side(points[genuine])


def test_parts_of_different_density_lose_nothing() -> None:
    """A ball of 1,800 random points beside a plate of 600, which are farther apart."""
    plate = default_rng(4).uniform((2, -1, 6), (4, 1, 6), (600, 3))
    assert surface_points(np.concatenate([front((0.0, 0.0, 6.0), 1.0, -1.0, 1800), plate])).mean() > 0.99


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_neither_unit_nor_turn_nor_order_matters(factor: float) -> None:
    order = default_rng(1).permutation(len(POINTS))
    turned = factor * POINTS[order] @ Rotation.from_rotvec([1.0, 0.5, -0.3]).as_matrix().T
    assert_array_equal(surface_points(turned), PLATE[order])


def test_many_points_are_decided_by_some_of_them() -> None:
    points, genuine = plate(size=1050)
    assert len(points) > 4 * MAX_POINTS
    assert (surface_points(points) == genuine).mean() > 0.999


def test_too_few_points_to_tell_are_all_kept() -> None:
    rng = default_rng(2)
    for count in (0, 1, 2, 25):
        assert surface_points(rng.normal((0, 0, 9), 1, (count, 3))).all()
    for place in ([0.0, 0, 0], [0, 0, 3.0]):
        assert surface_points(np.tile(place, (100, 1))).all()


def test_points_closer_than_their_noise_are_a_surface() -> None:
    """A hundred frames of one plate fused: neighbours' ranges differ by many times their distance."""
    rng = default_rng(3)
    points = rng.uniform(-1, 1, (20_000, 3)) * [1, 1, 0] + [0, 0, 5]
    assert surface_points(points * (1 + rng.normal(0, 0.05, (len(points), 1)))).mean() > 0.99


SIGHT = Camera.from_fov(48, 48, 0.5).directions().reshape(-1, 3)


def plane(tilt: float) -> Float[ndarray, "n 3"]:
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    return SIGHT * (normal[2] * 50.0 / (SIGHT @ normal))[:, None]


def noisy(points: Float[ndarray, "n 3"], std: float) -> Float[ndarray, "n 3"]:
    return points * (1.0 + default_rng(2).normal(scale=std / 50.0, size=(len(points), 1)))


@pytest.mark.parametrize("std", [0.05, 0.4])
def test_the_calmest_part_of_a_cloud_bounds_its_noise(std: float) -> None:
    points = noisy(plane(0.6), std)
    assert 0.5 * std < roughness(points) < 0.8 * std, "a tenth of all patches is that calm by chance"
    crumpled = np.where(SIGHT[:, :1] > 0, 1.0, 1.0 + default_rng(3).uniform(-0.1, 0.1, (len(SIGHT), 1)))
    assert 0.5 * std < roughness(points * crumpled) < std, "however rough the rest is"
    assert roughness(1024.0 * points) == pytest.approx(1024.0 * roughness(points), rel=1e-6)
    assert roughness(points[:6]) == np.inf


@pytest.mark.parametrize("limit", [1, 7, 49, 50, 51])
def test_a_random_subset_is_the_same_every_time(limit: int) -> None:
    points = default_rng(3).normal(size=(50, 3))
    chosen = random_subset(points, limit)
    assert len(chosen) == min(limit, 50) == len(np.unique(chosen, axis=0))
    assert set(map(tuple, chosen)) <= set(map(tuple, points))
    assert np.array_equal(chosen, random_subset(points.copy(), limit))
    assert np.array_equal(chosen, points[random_subset(np.arange(50), limit)])
    assert limit < 50 or chosen is points


def wall(noise: float) -> Float[ndarray, "n 3"]:
    directions = Camera.from_fov(200, 200, 0.6).directions().reshape(-1, 3)
    return directions * (50.0 + noise * default_rng(5).normal(size=(len(directions), 1)))


def test_means_of_neighbours_average_the_noise() -> None:
    points = wall(0.2)
    means = means_along_sight(points, 2500)
    assert 1800 < len(means) <= 2500
    assert means[:, 2].std() == pytest.approx(0.2 * np.sqrt(len(means) / len(points)), rel=0.1)
    assert means[:, 2].mean() == pytest.approx(50.0, abs=0.01)
    assert means_along_sight(points, len(points)) is points


def test_no_mean_lies_between_two_surfaces() -> None:
    points = wall(0.05)
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


def lattice(side: int) -> ndarray:
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def test_on_a_lattice_the_choice_is_exact_and_ties_go_to_smaller_coordinates() -> None:
    points = lattice(5)
    order = farthest_point_order(points, 60)
    # each point's distance to the nearest of the first 1, 2, ... chosen ones
    gaps = np.minimum.accumulate(norm(points[:, None] - points[order[:-1]][None], axis=-1), axis=1)
    # rows of the lattice are sorted by x, y, z, and argmax takes the first: the rule in one line
    assert np.array_equal(order[1:], gaps.argmax(axis=0))


@pytest.mark.parametrize("points", [lattice(4), default_rng(2).normal(size=(200, 3))], ids=["ties", "random"])
def test_the_points_chosen_do_not_depend_on_their_order(points: ndarray) -> None:
    expected = points[farthest_point_order(points, 50)]
    for seed in range(4):
        shuffled = default_rng(seed).permutation(points)
        assert np.array_equal(shuffled[farthest_point_order(shuffled, 50)], expected)


def test_it_starts_at_the_point_farthest_from_the_middle_of_the_box_or_where_it_is_given() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [4, 3, 2], [2, 1, 0], [0, 3, 0]])
    assert farthest_point_order(points, 1).tolist() == [0]  # as far as [4, 3, 2], and smaller in x
    assert farthest_point_order(points[1:], 1).tolist() == [3]  # [0, 3, 0] and [4, 3, 2] again tie


def test_coinciding_points_come_last_and_no_row_twice() -> None:
    distinct = default_rng(4).normal(size=(30, 3))
    points = default_rng(5).permutation(np.concatenate([distinct, distinct[:12], distinct[:5]]))
    order = farthest_point_order(points, 100)
    assert sorted(order) == list(range(47))
    assert len(np.unique(points[order[:30]], axis=0)) == 30


def test_where_a_small_cloud_lies_does_not_matter() -> None:
    points = np.round(default_rng(6).normal(size=(300, 3)), 3)
    far = points + 4096.0
    assert np.array_equal(farthest_point_order(points, 300)[:100], farthest_point_order(far, 300)[:100])
