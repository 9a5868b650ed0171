"""The joint normalizer (paper, section 3.2) and rigid transforms.

Notation: ``T_a_b`` maps b-coordinates to a-coordinates. Normalized coordinates carry no suffix; the object's visible
part fills [-1, 1]^3 and the hidden part may lie outside.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Normalizer:
    """``normalized = (points - center) * scale``, from the observed point cloud only.

    Attributes:
        center: middle of the cloud's bounding box, in the camera frame (the paper's -t).
        scale: one over half the box's longest side (the paper's s), in 1/unit.
    """

    center: Float[np.ndarray, "3"]
    scale: float

    @classmethod
    def fit(cls, points: Float[np.ndarray, "n 3"]) -> "Normalizer":
        """The paper's t and s. Raises ``ValueError`` when the cloud has no extent."""
        if len(points) == 0:
            raise ValueError("the point cloud is empty; it needs points on the object: check the mask and the units")
        low, high = points.min(axis=0), points.max(axis=0)
        half = float((high - low).max()) / 2
        if not half > 0:
            raise ValueError("all points coincide; the cloud needs an extent: check the file's columns and units")
        return cls((low + high) / 2, 1.0 / half)

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        return (points - self.center) * self.scale

    def invert(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        return points / self.scale + self.center

    @property
    def viewpoint(self) -> Float[np.ndarray, "3"]:
        """The camera's position (the origin of the camera frame) in normalized coordinates."""
        return -self.center * self.scale


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
    """Map points by a homogeneous transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]
