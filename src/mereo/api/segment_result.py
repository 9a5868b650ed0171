"""One segment of a result: its surface, and its figures."""

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mereo.geometry.mesh import Segment

if TYPE_CHECKING:
    import trimesh

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class SegmentResult:
    """One segment of a result, in the frame's axes and unit.

    Attributes:
        name: of the segment.
        label: its number in label grids, 1 or more.
        mesh: its closed surface; without faces where it was not found.
        centroid: of its volume, NaN where it was not found.
        volume: inside its surface, less what is nested in it; 0 where it was not found.
        confidence: mean probability that the network gives it over its volume, NaN where it was not found, and
            without a network.
        error_radius: radius around the centroid that holds the true one with probability 0.95; None where the answer
            is the network's.
        pose: best rigid motion from the object's own files to the frame, as ``Result.pose``; None likewise.
    """

    name: str
    label: int
    mesh: Segment
    centroid: Float[np.ndarray, "3"]
    volume: float
    confidence: float
    error_radius: float | None
    pose: Pose | None

    @property
    def is_found(self) -> bool:
        """Whether the frame shows it, or the registered model has it."""
        return len(self.mesh.faces) > 0

    def to_trimesh(self) -> "trimesh.Trimesh":
        """Surface as a mesh of trimesh, in the segment's colour."""
        import trimesh

        vertices, faces = self.mesh.vertices, self.mesh.faces
        colors = np.tile(np.array([*self.mesh.color, 255], dtype=np.uint8), (len(faces), 1))
        return trimesh.Trimesh(vertices, faces, face_colors=colors, process=False)

    def to_open3d(self) -> Any:
        """Surface as a ``TriangleMesh`` of Open3D, in the segment's colour; ``ImportError`` without Open3D."""
        try:
            open3d = import_module("open3d")
        except ImportError:
            raise ImportError("Open3D is not installed: pip install open3d, or take to_trimesh()") from None
        vertices = open3d.utility.Vector3dVector(self.mesh.vertices)
        mesh = open3d.geometry.TriangleMesh(vertices, open3d.utility.Vector3iVector(self.mesh.faces))
        mesh.paint_uniform_color([channel / 255 for channel in self.mesh.color])
        mesh.compute_vertex_normals()
        return mesh

    def __repr__(self) -> str:
        sure = "" if np.isnan(self.confidence) else f", confidence {self.confidence:.2f}"
        found = f"volume {self.volume:.3g}{sure}" if self.is_found else "not found"
        return f"SegmentResult({self.name!r}, {found})"
