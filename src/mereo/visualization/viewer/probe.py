"""Probe of a reconstruction, in the input's frame: what the model says at a place, and which place a look meets."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, rigid, rotation_along, transform_points
from mereo.models.model import Answer, Model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct, segment_names


@dataclass(frozen=True, eq=False)
class Inspection:
    """Cloud that was seen, what was made of it, and the model that knows more.

    Attributes:
        cloud: what was seen, in the input's frame.
        result: its reconstruction, in the same frame.
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
    """Place where a ray first meets the surface of a segment that is shown; None where it meets none."""
    segments = tuple(s for s, visible in zip(mesh.segments, shown, strict=True) if visible and len(s.faces))
    if not segments:
        return None
    T_mesh_ray = rigid(rotation_along(direction), origin)  # the ray is the z axis
    seen = Solids(SegmentedMesh(segments).transformed(inverse_rigid(T_mesh_ray)))
    distance = seen.first_hit(np.array([[0.0, 0.0, 1.0]])).distance[0]
    return transform_points(T_mesh_ray, np.array([0.0, 0.0, distance])) if np.isfinite(distance) else None
