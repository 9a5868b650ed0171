"""Every deformation: positive Jacobian, no side effects, and an inverse that is the inverse."""

import numpy as np
import pytest
from deformation_examples import MAKERS, cube, make_rigid, make_twist
from hypothesis import given, settings
from hypothesis import strategies as st

from mereo.deformation.maps import (
    Compose,
    Deformation,
    Identity,
    invert,
    jacobian,
    jacobian_determinant,
)


@pytest.mark.parametrize("name", MAKERS)
@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_jacobian_is_positive(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    deformation = MAKERS[name](rng)
    assert isinstance(deformation, Deformation)
    assert jacobian_determinant(deformation, cube(rng)).min() > 0


@pytest.mark.parametrize("name", MAKERS)
def test_points_move_independently_of_each_other(name: str) -> None:
    rng = np.random.default_rng(1)
    deformation, points = MAKERS[name](rng), cube(rng)
    before = points.copy()
    together = deformation(points)
    assert np.array_equal(points, before)
    alone = np.concatenate([deformation(points[i : i + 1]) for i in range(20)])
    assert np.allclose(together[:20], alone, atol=1e-12)
    assert deformation(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("name", MAKERS)
def test_inverse_of_the_image_is_the_point(name: str) -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        deformation, points = MAKERS[name](rng), cube(rng)
        guess = points + rng.normal(scale=0.3, size=points.shape)
        found, converged = invert(deformation, deformation(points), guess)
        assert converged.mean() > 0.99
        assert np.abs(deformation(found) - deformation(points))[converged].max() < 1e-5
        assert np.abs(found - points)[converged].max() < 1e-3


def test_damping_converges_where_newton_overshoots() -> None:
    """Newton's method for arctan x = 0 runs away from |x| > 1.39; with damping it comes back."""
    start = np.array([[3.0, -8.0, 2.0], [1.5, 10.0, -4.0]])
    found, converged = invert(np.arctan, np.zeros((2, 3)), start)
    assert converged.all() and np.abs(found).max() < 1e-5


def test_what_cannot_be_reached_is_reported() -> None:
    def flatten(points: np.ndarray) -> np.ndarray:
        return points * np.array([1.0, 1.0, 0.0])

    targets = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 3.0]])
    _, converged = invert(flatten, targets, targets.copy())
    assert converged.tolist() == [True, False]
    found, converged = invert(Identity(), np.empty((0, 3)), np.empty((0, 3)))
    assert found.shape == (0, 3) and converged.shape == (0,)


def test_jacobian_of_a_linear_map_is_its_matrix_at_any_scale() -> None:
    matrix = np.array([[1.0, 0.2, 0.0], [-0.3, 2.0, 0.1], [0.0, 0.5, 0.7]])
    for scale in (1e-3, 1.0, 1e4):
        points = np.random.default_rng(0).normal(scale=scale, size=(50, 3))
        value, found = jacobian(lambda p: p @ matrix.T, points)
        assert np.allclose(value, points @ matrix.T, rtol=1e-12, atol=0) and np.allclose(found, matrix, atol=1e-7)


def test_composition_applies_the_first_part_first() -> None:
    rng = np.random.default_rng(3)
    turn, twist, points = make_rigid(rng), make_twist(rng), cube(rng)
    assert np.array_equal(Compose((turn, twist))(points), twist(turn(points)))
    assert np.abs(Compose((turn, twist))(points) - Compose((twist, turn))(points)).max() > 0.1
    nested = Compose((Compose((turn, twist)), Compose(())))
    assert np.array_equal(nested(points), Compose((turn, twist))(points))
    product = jacobian_determinant(turn, points) * jacobian_determinant(twist, turn(points))
    assert np.allclose(jacobian_determinant(nested, points), product, atol=1e-5)


def test_rigid_preserves_distances_and_moves_its_center_by_the_translation() -> None:
    rng = np.random.default_rng(4)
    motion, points = make_rigid(rng), cube(rng)
    moved = motion(points)
    assert np.allclose(np.linalg.norm(np.diff(moved, axis=0), axis=1), np.linalg.norm(np.diff(points, axis=0), axis=1))
    assert np.allclose(motion(motion.center[None])[0], motion.center + motion.translation)  # type: ignore[attr-defined]
