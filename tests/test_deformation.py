"""Every deformation: positive Jacobian, no side effects, and an inverse that is the inverse; skinned bones."""

import numpy as np
import pytest
from deformation_examples import ARM, MAKERS, cube, make_rigid, make_twist, near_bones, points_for
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mereo.deformation.maps import (
    Compose,
    Deformation,
    Identity,
    check_positive,
    invert,
    jacobian,
    jacobian_determinant,
)
from mereo.deformation.skeleton import Bone, Hinge, Skeleton


@pytest.mark.parametrize("name", MAKERS)
@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_jacobian_is_positive(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    deformation = MAKERS[name](rng)
    assert isinstance(deformation, Deformation)
    assert jacobian_determinant(deformation, points_for(name, rng)).min() > 0


@pytest.mark.parametrize("name", MAKERS)
def test_points_move_independently_of_each_other(name: str) -> None:
    rng = np.random.default_rng(1)
    deformation, points = MAKERS[name](rng), points_for(name, rng)
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
        deformation, points = MAKERS[name](rng), points_for(name, rng)
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


def test_bones_move_far_points_by_forward_kinematics() -> None:
    angles = np.array([0.9, -0.3, 0.7, 0.2])
    arm = Skeleton(ARM.bones, width=0.02).pose(angles)  # thin joints: every point belongs to one bone
    upper = Rotation.from_rotvec([0, 0, 0.9]) * Rotation.from_rotvec([-0.3, 0, 0])
    at_elbow = upper.apply([[10.0, 0, 0]])[0]
    lower = upper * Rotation.from_rotvec([0, 0.7, 0])
    still, middle, tip = np.array([[-5.0, 0.3, 0.2]]), np.array([[5.0, 0.3, -0.2]]), np.array([[16.0, 0.1, 0.4]])
    assert np.allclose(arm(still), still)
    assert np.allclose(arm(middle), upper.apply(middle))
    assert np.allclose(arm(tip), at_elbow + lower.apply(tip - np.array([10.0, 0, 0])))
    side = np.array([[-10.2, 8.0, 0.1]])
    shoulder = np.array([-10.0, 0, 0])
    assert np.allclose(arm(side), shoulder + Rotation.from_rotvec([0, 0, 0.2]).apply(side - shoulder))


def test_a_single_hinge_has_the_closed_form_jacobian() -> None:
    """``det = 1 + angle * grad w . (a x (x - c))``, and the gradient of the share obeys its bound."""
    hinge = Hinge((0.0, 0.6, 0.8), -1.0, 1.0)
    bones = (Bone(-1, (-9.0, 0, 0), (0, 0, 0)), Bone(0, (0, 0, 0), (9.0, 1.0, 0), (hinge,)))
    skeleton, points = Skeleton(bones, width=2.0), cube(np.random.default_rng(11))
    assert np.allclose(skeleton.shares(points).sum(axis=1), 1.0)
    step = 1e-5
    slope = [skeleton.shares(points + step * e)[:, 1] - skeleton.shares(points - step * e)[:, 1] for e in np.eye(3)]
    gradient = np.stack(slope, axis=1) / (2 * step)
    assert np.linalg.norm(gradient, axis=1).max() <= 1 / (2 * skeleton.width) + 1e-6
    expected = 1 + 0.8 * np.einsum("ni,ni->n", gradient, np.cross(hinge.axis, points))
    assert np.allclose(jacobian_determinant(skeleton.pose(np.array([0.8])), points), expected, atol=1e-4)


def test_every_corner_of_the_joint_limits_keeps_the_jacobian_positive() -> None:
    points = near_bones(np.random.default_rng(12), 2000)
    for corner in np.ndindex(*[2] * len(ARM.hinges)):
        check_positive(ARM.pose(ARM.limits_rad[np.arange(len(corner)), corner]), points)
