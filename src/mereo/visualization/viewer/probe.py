"""A reconstruction to be asked: what the model says at a place, and which place a look meets. In the input's frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.scanner_axes import into_camera
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.models.model import Answer, EncodedCloud, Model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct, segment_names


@dataclass(frozen=True, eq=False)
class Inspection:
    """What was seen, what was made of it, and the model that knows more.

    Attributes:
        cloud, result: in the input's frame.
        model, code: the model, and what it made of the cloud.
        T_camera_input: the cloud's axes to the camera's.
    """

    cloud: PointCloud
    result: Reconstruction
    model: Model
    code: EncodedCloud
    T_camera_input: Float[np.ndarray, "4 4"]

    @classmethod
    def of(cls, cloud: PointCloud, model: Model, resolution: int = 128, frame: CloudAxes = "camera") -> "Inspection":
        """Reconstruct a cloud. Raises as ``reconstruct`` does."""
        result = reconstruct(cloud, model, resolution, frame)
        T_camera_input = into_camera(cloud.points, frame)
        code = model.encode(PointCloud(transform_points(T_camera_input, cloud.points)))
        return cls(cloud, result, model, code, T_camera_input)

    @property
    def names(self) -> tuple[str, ...]:
        """Of empty space and the segments, by label."""
        return ("empty space", *segment_names(self.model)[0])

    def ask(self, points: Float[np.ndarray, "n 3"]) -> Answer:
        """The model's answers at points of the input's frame, in that frame."""
        answer = self.model.query(self.code, transform_points(self.T_camera_input, points))
        turn = inverse_rigid(self.T_camera_input)[:3, :3]
        return replace(answer, direction=answer.direction @ turn.T)


def first_hit(
    mesh: SegmentedMesh, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], shown: list[bool]
) -> Float[np.ndarray, "3"] | None:
    """Where a ray first meets the surface of a segment that is shown; None where it meets none.

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
