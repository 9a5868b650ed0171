"""A reconstruction to be asked: what the model says at a place, and which place a look meets. In the input's frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.models.model import Answer, Model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct, segment_names


@dataclass(frozen=True, eq=False)
class Inspection:
    """Cloud that was seen, what was made of it, and the model that knows more.

    Attributes:
        cloud, result: in the input's frame.
        model: what made the result, and is asked for more.
    """

    cloud: PointCloud
    result: Reconstruction
    model: Model

    @classmethod
    def of(cls, cloud: PointCloud, model: Model, resolution: int = 128, frame: CloudAxes = "camera") -> "Inspection":
        """Reconstruction of a cloud, to be asked. Raises as ``reconstruct`` does."""
        return cls(cloud, reconstruct(cloud, model, resolution, frame), model)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of empty space and the segments, by label."""
        return ("empty space", *segment_names(self.model)[0])

    def ask(self, points: Float[np.ndarray, "n 3"]) -> Answer:
        """Answers of the model at points of the input's frame, in that frame."""
        T_camera_input = self.result.T_camera_input
        answer = self.model.query(self.result.code, transform_points(T_camera_input, points))
        turn = inverse_rigid(T_camera_input)[:3, :3]
        return replace(answer, direction=answer.direction @ turn.T)


def first_hit(
    mesh: SegmentedMesh, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], shown: list[bool]
) -> Float[np.ndarray, "3"] | None:
    """Place where a ray first meets the surface of a segment that is shown; None where it meets none.

    Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997.
    """
    nearest = np.inf
    for segment, visible in zip(mesh.segments, shown, strict=True):
        if not visible or len(segment.faces) == 0:
            continue
        a, b, c = (segment.vertices[segment.faces[:, k]] for k in range(3))
        across = np.cross(direction, c - a)
        determinant = np.einsum("ij,ij->i", b - a, across)
        scale = 1.0 / np.where(np.abs(determinant) < 1e-30, np.inf, determinant)
        u = scale * ((origin - a) * across).sum(axis=1)
        turned = np.cross(origin - a, b - a)
        v = scale * (turned @ direction)
        t = scale * ((c - a) * turned).sum(axis=1)
        hit = (scale != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest = min(nearest, float(t[hit].min(initial=np.inf)))
    return origin + nearest * direction if np.isfinite(nearest) else None
