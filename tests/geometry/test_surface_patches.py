"""What is a patch of surface is kept, a rim of another one is not; and smoothing along lines of sight."""

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.geometry.camera import Camera
from mereo.geometry.surface_patches import longest_side, smoothed, surface_points


def rays(size: int = 96) -> np.ndarray:
    return Camera.from_fov(size, size, 0.5).directions()


def plate(size: int = 96, half: float = 0.5, rim: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Slanted round plate, half of the image wide, and a rim of the wall behind it; whether each is of the plate."""
    line = (np.arange(size) - (size - 1) / 2) / (size / 2)
    radius = np.hypot(*np.meshgrid(line, line))
    inside, wide = radius < half, radius < half + 2 * rim / size
    depth = np.where(inside, 5 + rays(size)[..., 0], 8.0)
    noise = np.random.default_rng(0).normal(0, 0.002, depth.shape)
    return (rays(size) * (depth + noise)[..., None])[wide], inside[wide]


def ball(size: int = 96) -> np.ndarray:
    """What a camera sees of a ball of radius 1, 6 away."""
    sight = rays(size).reshape(-1, 3)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    along = 6 * sight[:, 2]
    root = along**2 - 35
    return sight[root > 0] * (along[root > 0] - np.sqrt(root[root > 0]))[:, None]


POINTS, PLATE = plate()


@pytest.mark.parametrize("rim", [1, 2, 3])
def test_a_rim_of_background_is_no_surface(rim: int) -> None:
    points, genuine = plate(rim=rim)
    np.testing.assert_array_equal(surface_points(points), genuine)
    assert longest_side(points) > 1.5 * longest_side(points[genuine])


def test_parts_of_different_density_lose_nothing() -> None:
    """A ball of 1,800 random points beside a plate of 600, which are farther apart."""
    rng = np.random.default_rng(4)
    plate = rng.uniform((2, -1, 6), (4, 1, 6), (600, 3))
    assert surface_points(np.concatenate([rng.permutation(ball())[:1800], plate])).mean() > 0.99


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_neither_unit_nor_turn_nor_order_matters(factor: float) -> None:
    order = np.random.default_rng(1).permutation(len(POINTS))
    turned = factor * POINTS[order] @ Rotation.from_rotvec([1.0, 0.5, -0.3]).as_matrix().T
    np.testing.assert_array_equal(surface_points(turned), PLATE[order])


def test_too_few_points_to_tell_are_all_kept() -> None:
    rng = np.random.default_rng(2)
    for count in (0, 1, 2, 25):
        assert surface_points(rng.normal((0, 0, 9), 1, (count, 3))).all()
    for place in ([0.0, 0, 0], [0, 0, 3.0]):
        assert surface_points(np.tile(place, (100, 1))).all()


def test_points_closer_than_their_noise_are_a_surface() -> None:
    """A hundred frames of one plate fused: neighbours' ranges differ by many times their distance."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (20_000, 3)) * [1, 1, 0] + [0, 0, 5]
    assert surface_points(points * (1 + rng.normal(0, 0.05, (len(points), 1)))).mean() > 0.99


SIGHT = Camera.from_fov(48, 48, 0.5).directions().reshape(-1, 3)


def plane(tilt: float) -> Float[np.ndarray, "n 3"]:
    normal = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    return SIGHT * (normal[2] * 50.0 / (SIGHT @ normal))[:, None]


def noisy(points: Float[np.ndarray, "n 3"], std: float) -> Float[np.ndarray, "n 3"]:
    return points * (1.0 + np.random.default_rng(2).normal(scale=std / 50.0, size=(len(points), 1)))


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.1])
def test_planes_stay_and_their_noise_falls(tilt: float) -> None:
    flat = plane(tilt)
    np.testing.assert_allclose(smoothed(flat), flat, rtol=2e-3)
    before, after = noisy(flat, 0.3) - flat, smoothed(noisy(flat, 0.3)) - flat
    assert np.linalg.norm(after, axis=1).std() < 0.5 * np.linalg.norm(before, axis=1).std()


def test_points_stay_on_their_lines_of_sight_in_any_frame_and_unit() -> None:
    points = noisy(plane(0.4), 0.3)
    moved = smoothed(points)
    along = np.einsum("ij,ij->i", moved, points) / (np.linalg.norm(moved, axis=1) * np.linalg.norm(points, axis=1))
    np.testing.assert_allclose(along, 1.0)
    np.testing.assert_allclose(smoothed(points * 1024.0), moved * 1024.0)
    turn = Rotation.from_rotvec([0.2, -0.4, 1.0]).as_matrix()
    turned = smoothed(points @ turn.T) @ turn
    assert np.median(np.linalg.norm(turned - moved, axis=1)) < 0.02


def test_an_edge_stays_sharp() -> None:
    points = plane(0.0)
    points[SIGHT[:, 0] > 0.02] *= 0.8
    depth = smoothed(points)[:, 2]
    assert np.minimum(np.abs(depth - 50.0), np.abs(depth - 40.0)).max() < 0.1


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_handful_of_points_is_as_good_as_it_is(count: int) -> None:
    points = SIGHT[:count] * 50.0
    np.testing.assert_allclose(smoothed(points), points, rtol=2e-2)
    same = np.repeat(points[:1], 8, axis=0)
    np.testing.assert_allclose(smoothed(same), same)
