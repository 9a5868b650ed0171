"""Rigid motions that fit pairs of points: against how the pairs were made, scipy, and what makes an optimum."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mereo.geometry.transforms import fit_rigid, rigid, transform_points


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_a_fit_of_moved_points_is_the_motion(rng: np.random.Generator) -> None:
    for count in (3, 4, 50):
        motion = rigid(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * 100)
        source = rng.normal(size=(count, 3)) * [1, 5, 0.0 if count == 4 else 0.1]  # four of them in a plane
        found = fit_rigid(source, transform_points(motion, source))
        np.testing.assert_allclose(found, motion, atol=1e-9)


def test_a_fit_of_noisy_pairs_is_the_one_of_scipy_and_nothing_near_it_is_better(rng: np.random.Generator) -> None:
    source, target, weights = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), rng.random(20)
    found = fit_rigid(source, target, weights)
    middle, aim = (np.average(points, axis=0, weights=weights) for points in (source, target))
    expected = Rotation.align_vectors(target - aim, source - middle, weights=weights)[0].as_matrix()
    np.testing.assert_allclose(found, rigid(expected, aim - expected @ middle), atol=1e-9)

    def error(motion: np.ndarray) -> float:
        return float(weights @ np.sum((transform_points(motion, source) - target) ** 2, axis=1))

    for _ in range(50):
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        assert error(rigid(turn, rng.normal(size=3) * 0.01) @ found) > error(found)


def test_a_fit_of_points_whose_products_are_infinite_ends() -> None:
    points = np.diag([1e300, 1.0, 1.0])
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="so far apart that their products are"):
        fit_rigid(points, points)


def test_mirrored_points_are_turned_not_mirrored(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    rotation = fit_rigid(source, source * [-1, 1, 1])[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
