"""Rigid transforms. Notation: ``T_a_b`` maps b-coordinates to a-coordinates."""

import numpy as np
from jaxtyping import Float


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Homogeneous transform from a rotation and a translation."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def inverse_rigid(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of a rigid transform."""
    rotation = transform[:3, :3].T
    return rigid(rotation, -rotation @ transform[:3, 3])


def transform_points(
    transform: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Points mapped by a homogeneous transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def rotation_along(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation whose third column is along ``axis``."""
    z = axis / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"], roll_rad: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """Pose ``T_world_camera`` at ``eye``, optical axis through ``target``, image up along ``up`` before the roll."""
    z = target - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6 * np.linalg.norm(up):  # looking along `up`: any horizon is as good
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    cosine, sine = np.cos(roll_rad), np.sin(roll_rad)
    return rigid(np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1), eye)


def finite_svd(
    matrix: Float[np.ndarray, "*b m n"],
) -> tuple[Float[np.ndarray, "*b m m"], Float[np.ndarray, "*b k"], Float[np.ndarray, "*b n n"]]:
    """Singular value decomposition ``U, S, V^T`` of numpy, which for some matrices with an infinity never returns.

    Raises ``ValueError`` for a matrix that is not finite.
    """
    if not np.isfinite(matrix).all():
        raise ValueError("points are infinite or so far apart that their products are; scale them to another unit")
    u, s, v = np.linalg.svd(matrix)
    return u, s, v


def fit_rigid(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> Float[np.ndarray, "4 4"]:
    """``T_target_source`` that brings ``source`` nearest to ``target`` in least squares (Kabsch, 1976), never mirrored.

    Args:
        source: points, any unit; where they lie on a line, any turn about it is as good, and one is taken.
        target: where each of them should go.
        weights: of the squared distances, not negative and not all 0; by default all count alike.
    """
    middle, aim = (np.average(points, axis=0, weights=weights) for points in (source, target))
    offsets = target - aim if weights is None else weights[:, None] * (target - aim)
    u, _, v = finite_svd(offsets.T @ (source - middle))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return rigid(rotation, aim - rotation @ middle)
