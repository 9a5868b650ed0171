"""The joint normalizer (paper, section 3.2).

Normalized coordinates carry no suffix; the object's visible part fills [-1, 1]^3 and the hidden part may lie outside.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Normalizer:
    """Map to normalized coordinates, ``(points - center) * scale``, from the observed point cloud only.

    Attributes:
        center: middle of the cloud's bounding box, in the camera frame (the paper's -t).
        scale: one over half the box's longest side (the paper's s), in 1/unit.
    """

    center: Float[np.ndarray, "3"]
    scale: float

    @classmethod
    def fit(cls, points: Float[np.ndarray, "n 3"]) -> "Normalizer":
        """Normalizer of a cloud, the paper's t and s. Raises ``ValueError`` when the cloud has no extent."""
        if len(points) == 0:
            raise ValueError("the point cloud is empty; it needs points on the object: check the mask and the units")
        low, high = points.min(axis=0), points.max(axis=0)
        half = float((high - low).max()) / 2
        if not half > 0:
            raise ValueError("all points coincide; the cloud needs an extent: check the file's columns and units")
        return cls((low + high) / 2, 1.0 / half)

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in normalized coordinates."""
        return (points - self.center) * self.scale

    def invert(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in the cloud's frame and unit, from normalized coordinates."""
        return points / self.scale + self.center

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Homogeneous transform that ``apply`` is."""
        result = np.diag([self.scale, self.scale, self.scale, 1.0])
        result[:3, 3] = -self.scale * self.center
        return result

    @property
    def viewpoint(self) -> Float[np.ndarray, "3"]:
        """Position of the camera (the origin of the camera frame) in normalized coordinates."""
        return -self.center * self.scale
