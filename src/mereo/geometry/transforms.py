"""Rigid transforms and the joint normalizer. Notation: ``T_a_b`` maps b-coordinates to a-coordinates."""

from dataclasses import dataclass
from numbers import Real

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from numpy.linalg import det, norm, svd
from numpy.typing import ArrayLike

from mereo.geometry.conventions import LARGEST

PointArray = Float[ndarray, "*n 3"]
"""Points in an array of any shape."""

Points = Float[ndarray, "n 3"]
"""Positions or vectors in rows: as many as whatever else has the axis ``n`` in a signature."""

AnyPoints = Float[ndarray, "_ 3"]
"""The same, as many as there are: no other array of the signature has to have as many rows."""

Rows = Float[ndarray, "n c"]
"""Numbers in rows, one for each point: its position and what else is known of it, or what a network says of it."""

Values = Float[ndarray, " n"]
"""A number for each row of the axis ``n``; ``Indices``, ``Labels`` (of segments) and ``Flags`` likewise."""

Indices = Int[ndarray, " n"]
Labels = UInt8[ndarray, " n"]
Flags = Bool[ndarray, " n"]

Subset = Int[ndarray, " m"]
"""Indices of some of the rows, which are as many as whatever else has the axis ``m``."""

Vector = Float[ndarray, "3"]

Matrix = Float[ndarray, "3 3"]
"""Linear map of space, such as a rotation; ``Matrices`` are one for each row of the axis ``n``."""

Matrices = Float[ndarray, "n 3 3"]

Transform = Float[ndarray, "4 4"]
"""Homogeneous matrix of a map between two frames."""

NamedPoses = dict[str, Transform]
"""Poses by the names of segments or links."""

Corners = Float[ndarray, "2 3"]
"""Lower and upper corner of a box along the axes."""


def rigid(rotation: Matrix, translation: Vector) -> Transform:
    """Homogeneous transform from a rotation and a translation."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def inverse_rigid(transform: Transform) -> Transform:
    """Inverse of a rigid transform."""
    rotation = transform[:3, :3].T
    return rigid(rotation, -rotation @ transform[:3, 3])


def is_rigid(transform: Transform, tolerance: float = 1e-6) -> bool:
    """Whether a transform is a rotation and a translation, up to rounding; finite, and with 0 0 0 1 below."""
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        return False
    rotation = transform[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance) and det(rotation) > 0
    return bool(is_rotation and transform[3].tolist() == [0, 0, 0, 1])


def checked_pose(pose: ArrayLike) -> Transform:
    """A rigid pose as numbers, of a few printed digits or more; ``ValueError`` for what is none."""
    entries = np.asarray(pose, object)  # of which rows may differ in length
    what = f"of the shape {entries.shape}"
    if entries.shape == (4, 4):
        what = "not of real numbers"
        if all(isinstance(entry, Real) for entry in entries.flat):
            T = entries.astype(float)
            if is_rigid(T, 1e-3) and np.abs(T).max() <= LARGEST:
                return T
            what = str(np.round(T, 3).tolist())
    raise ValueError(
        f"the pose is {what}, and must be 4 x 4 finite numbers: a rotation and a translation "
        f"of {LARGEST:g} at most, with 0 0 0 1 in the last row"
    )


def transform_points(transform: Transform, points: PointArray) -> PointArray:
    """Points mapped by a homogeneous transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def rotation_along(axis: Vector) -> Matrix:
    """Rotation whose third column is along ``axis``."""
    z = axis / norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def look_at(eye: Vector, target: Vector, up: Vector, roll_rad: float = 0.0) -> Transform:
    """Pose ``T_world_camera`` at ``eye``, optical axis through ``target``, image up along ``up`` before the roll."""
    z = target - eye
    z = z / norm(z)
    x = np.cross(z, up)
    if norm(x) < 1e-6 * norm(up):  # looking along `up`: any horizon is as good
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x = x / norm(x)
    y = np.cross(z, x)
    cosine = np.cos(roll_rad)
    sine = np.sin(roll_rad)
    return rigid(np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1), eye)


def box_of(points: AnyPoints) -> Corners:
    """Box around points, parallel to the axes."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def longest_side(points: AnyPoints) -> float:
    """Longest side of the points' box, parallel to the axes."""
    return float(np.ptp(points, axis=0).max())


def unit_rows(vectors: Float[ndarray, "*n k"]) -> Float[ndarray, "*n k"]:
    """Vectors of length 1 along each row; rows of zeros stay so."""
    return vectors / np.maximum(norm(vectors, axis=-1, keepdims=True), 1e-30)


def finite_svd(
    matrix: Float[ndarray, "*b m n"],
) -> tuple[Float[ndarray, "*b m m"], Float[ndarray, "*b k"], Float[ndarray, "*b n n"]]:
    """Singular value decomposition ``U, S, V^T`` of numpy, which for some matrices with an infinity never returns.

    Raises ``ValueError`` for a matrix that is not finite.
    """
    if not np.isfinite(matrix).all():
        raise ValueError("points are infinite or so far apart that their products are; scale them to another unit")
    u, s, v = svd(matrix)
    return u, s, v


def fit_rigid(source: Points, target: Points, weights: Values | None = None) -> Transform:
    """``T_target_source`` that brings ``source`` nearest to ``target`` in least squares (Kabsch, 1976), never mirrored.

    Of points on a line any turn about it is as good, and one is taken. ``weights`` are of the squared distances, not
    negative and not all 0; by default all count alike.
    """
    middle, aim = (np.average(points, axis=0, weights=weights) for points in (source, target))
    offsets = target - aim if weights is None else weights[:, None] * (target - aim)
    u, _, v = finite_svd(offsets.T @ (source - middle))
    rotation = (u * [1.0, 1.0, np.sign(det(u @ v))]) @ v
    return rigid(rotation, aim - rotation @ middle)


# --- normalized coordinates -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Normalizer:
    """Joint normalizer (paper, section 3.2): map to normalized coordinates, ``(points - center) * scale``.

    It comes from the observed points only: their box fills [-1, 1]^3, and the hidden part may lie outside. Normalized
    coordinates carry no suffix.

    Attributes:
        center: middle of the cloud's bounding box, in the camera frame (the paper's -t).
        scale: one over half the box's longest side (the paper's s), in 1/unit.
    """

    center: Vector
    scale: float

    @classmethod
    def fit(cls, points: Points) -> "Normalizer":
        """Normalizer of a cloud, the paper's t and s. Raises ``ValueError`` when the cloud has no extent."""
        if len(points) == 0:
            raise ValueError("the point cloud is empty; it needs points on the object: check the mask and the units")
        low, high = box_of(points)
        half = float((high - low).max()) / 2
        if not half > 0:
            raise ValueError("all points coincide; the cloud needs an extent: check the file's columns and units")
        return cls((low + high) / 2, 1.0 / half)

    def apply(self, points: PointArray) -> PointArray:
        """Points in normalized coordinates."""
        return (points - self.center) * self.scale

    def invert(self, points: PointArray) -> PointArray:
        """Points in the cloud's frame and unit, from normalized coordinates."""
        return points / self.scale + self.center

    @property
    def matrix(self) -> Transform:
        """Homogeneous transform that ``apply`` is."""
        result = np.diag([self.scale, self.scale, self.scale, 1.0])
        result[:3, 3] = -self.scale * self.center
        return result

    @property
    def viewpoint(self) -> Vector:
        """Position of the camera (the origin of the camera frame) in normalized coordinates."""
        return -self.center * self.scale


# --- best rotations ---------------------------------------------------------------------------------------------------


def best_rotations(covariance: Float[ndarray, "*s 3 3"]) -> Float[ndarray, "*s 3 3"]:
    """Rotations R that maximize ``trace(R H)`` for ``H = sum_i x_i y_i^T``, centred: they bring x onto y (Kabsch)."""
    left, _, right = finite_svd(covariance)
    proper = np.sign(det(left) * det(right))
    left[..., 2] *= np.where(proper == 0, 1.0, proper)[..., None]
    return np.swapaxes(left @ right, -1, -2)


def robust_rigid(
    source: Points,
    target: Points,
    weight: Values,
    sigma: float,
) -> Transform:
    """``fit_rigid`` under a Cauchy loss whose scale falls from the residuals' own median to ``sigma``."""
    T = fit_rigid(source, target, weight)
    for _ in range(20):  # it has converged by then
        distance = norm(transform_points(T, source) - target, axis=1)
        scale = max(float(np.median(distance)), sigma)
        T = fit_rigid(source, target, weight / (1.0 + (distance / scale) ** 2))
    return T


def align_all(
    shapes: Float[ndarray, "s n 3"], rounds: int, tolerance: float
) -> tuple[Float[ndarray, "s 3 3"], Float[ndarray, "s 3"], Points]:
    """Rotations and centres that bring shapes to their mean: generalized Procrustes alignment without scale (Gower).

    ``(shapes - center) @ R.T`` are the aligned shapes. It must converge (the mean moves by less than ``tolerance``):
    stopped early, the aligned states of a bending object do not lie in few dimensions.
    """
    center = shapes.mean(axis=1)
    centred = shapes - center[:, None]
    mean = centred[0]
    rotation = np.broadcast_to(np.eye(3), (len(shapes), 3, 3))
    for _ in range(rounds):
        covariance = np.matmul(centred.transpose(0, 2, 1), mean)
        rotation = best_rotations(covariance.astype(float)).astype(shapes.dtype)
        moved = np.matmul(centred, rotation.transpose(0, 2, 1)).mean(axis=0)
        change = np.abs(moved - mean).max()
        mean = moved
        if change < tolerance:
            break
    return rotation, center, mean
