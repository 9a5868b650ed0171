"""Offsets between surfaces on grids agree with closed forms to a fraction of a cell."""

import numpy as np
import pytest

from mereo.visualization.error_maps import cell_size, signed_distance, surface_offset

SPACING = np.array([0.5, 0.3, 0.4])
CENTER = np.array([8.1, 7.9, 8.05])
CELLS = (32, 52, 40)


def ball(radius: float) -> np.ndarray:
    """Occupied cells of a ball on the anisotropic grid."""
    grid = np.indices(CELLS).transpose(1, 2, 3, 0) * SPACING
    return np.asarray(np.linalg.norm(grid - CENTER, axis=-1) < radius)


def directions() -> np.ndarray:
    drawn = np.random.default_rng(5).normal(size=(400, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


@pytest.mark.parametrize(("truth", "found"), [(5.0, 5.6), (5.0, 6.5), (5.6, 5.0), (6.5, 5.0), (5.0, 5.1)])
def test_the_offset_of_concentric_balls_is_the_difference_of_their_radii(truth: float, found: float) -> None:
    places = (CENTER + max(truth, found) * directions()) / SPACING  # on the surface of both together
    expected = (found - truth) / cell_size(SPACING)
    measured = surface_offset(ball(truth), ball(found), SPACING, places)
    assert abs(np.median(measured) - expected) < 0.2
    assert np.abs(measured - expected).max() < 0.6


def test_what_is_missing_is_the_farther_off_the_longer_it_is() -> None:
    truth = np.zeros((40, 20, 20), dtype=bool)
    truth[5:35, 8:12, 8:12] = True
    found = truth.copy()
    found[20:] = False
    places = np.array([[x, 7.5, 9.5] for x in (10.0, 22.0, 26.0, 30.0)])
    offset = surface_offset(truth, found, np.ones(3), places)
    np.testing.assert_allclose(offset, [0.0, -2.5, -6.5, -10.5], atol=0.3)
    np.testing.assert_array_equal(surface_offset(found, truth, np.ones(3), places), -offset)


def test_equal_grids_have_no_offset_and_distances_vanish_on_faces() -> None:
    occupied = np.random.default_rng(6).random((7, 8, 9)) > 0.5
    places = np.random.default_rng(7).uniform(-0.5, 6.5, size=(90, 3))
    assert not surface_offset(occupied, occupied, SPACING, places).any()
    slab = np.zeros((9, 4, 4), dtype=bool)
    slab[:4] = True
    expected = (np.arange(9) - 3.5) * 0.5
    np.testing.assert_allclose(signed_distance(slab, SPACING)[:, 1, 2], expected, rtol=1e-6)


def test_a_grid_without_anything_is_far_from_everything() -> None:
    occupied = np.zeros((6, 6, 6), dtype=bool)
    occupied[2:4, 2:4, 2:4] = True
    places = np.array([[1.5, 2.0, 3.0], [2.0, 3.0, 3.5]])
    assert surface_offset(occupied, np.zeros_like(occupied), np.ones(3), places).max() < -10
