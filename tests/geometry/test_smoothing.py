"""Smoothing along lines of sight: what it leaves as it is, and how much noise it takes away."""

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.geometry.camera import Camera
from mereo.geometry.surface_patches import smoothed

SIGHT = Camera.from_fov(48, 48, 0.5).directions().reshape(-1, 3)


def plane(tilt: float) -> Float[np.ndarray, "n 3"]:
    """A plane through (0, 0, 50), tilted about x."""
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
    """Turned about the camera and in other units, all is the same."""
    points = noisy(plane(0.4), 0.3)
    moved = smoothed(points)
    along = np.einsum("ij,ij->i", moved, points) / (np.linalg.norm(moved, axis=1) * np.linalg.norm(points, axis=1))
    np.testing.assert_allclose(along, 1.0)
    np.testing.assert_allclose(smoothed(points * 1024.0), moved * 1024.0)
    turn = Rotation.from_rotvec([0.2, -0.4, 1.0]).as_matrix()
    turned = smoothed(points @ turn.T) @ turn
    assert np.median(np.linalg.norm(turned - moved, axis=1)) < 0.02


def test_an_edge_stays_sharp() -> None:
    """Nothing lies between a near wall and a far one."""
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
