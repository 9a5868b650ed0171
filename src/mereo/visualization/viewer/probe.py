"""A reconstruction to be asked: what the model says at a place, and which place a look meets. In the input's frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.scanner_axes import into_camera
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, rigid, rotation_along, transform_points
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
    """Where a ray first meets the surface of a segment that is shown; None where it meets none."""
    segments = tuple(s for s, visible in zip(mesh.segments, shown, strict=True) if visible and len(s.faces))
    if not segments:
        return None
    T_mesh_ray = rigid(rotation_along(direction), origin)  # the ray is the z axis
    seen = Solids(SegmentedMesh(segments).transformed(inverse_rigid(T_mesh_ray)))
    distance = seen.first_hit(np.array([[0.0, 0.0, 1.0]])).distance[0]
    return transform_points(T_mesh_ray, np.array([0.0, 0.0, distance])) if np.isfinite(distance) else None
