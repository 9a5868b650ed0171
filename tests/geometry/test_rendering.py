"""The depth camera against closed forms, and the statistics of its noise."""

import numpy as np
import pytest
from shapes import ball, box, one

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

CAMERA = Camera.from_fov(96, 96, float(np.deg2rad(30)))


def test_depth_of_a_sphere_is_the_smaller_root_of_the_ray_equation() -> None:
    center, radius = np.array([6.0, -4.0, 150.0]), 25.0
    depth = render_depth(one(ball(tuple(center), radius, level=5)), CAMERA).depth
    rays = CAMERA.directions()
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - radius**2
    discriminant = b**2 - a * c
    expected = np.where(discriminant > 0, (b - np.sqrt(np.maximum(discriminant, 0))) / a, 0.0)
    miss = np.linalg.norm(center - (b / a)[..., None] * rays, axis=-1)  # how far the ray passes from the centre
    well_inside, well_outside = miss < 0.95 * radius, miss > radius
    assert well_inside.sum() > 500 and well_outside.sum() > 500
    assert (depth[well_outside] == 0).all()
    # a face of this sphere is up to radius * 5e-4 below the sphere, seen at a slant of at most 1 / 0.3
    error = depth[well_inside] - expected[well_inside]
    assert error.min() > -1e-3 and error.max() < 0.05


def test_the_nearer_surface_hides_the_other() -> None:
    mesh = SegmentedMesh((box((-50, -50, 130), (50, 50, 140), "wall"), box((-5, -5, 100), (5, 5, 110), "block", 1)))
    depth = render_depth(mesh, CAMERA).depth
    block = np.abs(CAMERA.directions()[..., :2] * 100).max(axis=-1) < 5
    assert np.allclose(depth[block], 100, rtol=1e-6) and np.allclose(depth[~block], 130, rtol=1e-6)


def test_noise_has_the_asked_deviation_on_hits_only() -> None:
    image = render_depth(one(ball((0, 0, 150), 30.0)), CAMERA)
    draws = [add_depth_noise(image, 0.1, np.random.default_rng(seed)).depth - image.depth for seed in range(40)]
    noise = np.stack(draws)
    assert (noise[:, ~image.valid] == 0).all()
    hits = noise[:, image.valid]
    count = hits.size
    assert abs(hits.mean()) < 5 * 0.1 / np.sqrt(count)
    assert abs(hits.std() / 0.1 - 1) < 5 / np.sqrt(2 * count)
    # Gaussian tails: P(|x| > 2 sd) = 0.0455
    assert abs((np.abs(hits) > 0.2).mean() - 0.0455) < 5 * np.sqrt(0.0455 / count)


def test_strong_noise_neither_loses_nor_invents_hits() -> None:
    image = render_depth(one(ball((0, 0, 150), 30.0)), CAMERA)
    noisy = add_depth_noise(image, 500.0, np.random.default_rng(0))
    assert np.array_equal(noisy.valid, image.valid)


@pytest.mark.parametrize("std", [-0.1, float("nan"), float("inf")])
def test_a_deviation_must_be_finite_and_not_negative(std: float) -> None:
    image = render_depth(one(ball((0, 0, 150), 30.0)), CAMERA)
    with pytest.raises(ValueError, match=r"the depth noise is .*; it is a standard deviation, finite and at least 0"):
        add_depth_noise(image, std, np.random.default_rng(0))
