"""Closed meshes as solids of manifold3d, and back."""

import manifold3d
import numpy as np
from jaxtyping import Float, Int

Vertices = Float[np.ndarray, "_ 3"]
Faces = Int[np.ndarray, "_ 3"]


def solid_of(vertices: Vertices, faces: Faces) -> manifold3d.Manifold:
    """Solid of a closed mesh; raises ``ValueError`` where manifold3d does not accept it."""
    # copies, because manifold3d takes no array that is read-only
    mesh = manifold3d.Mesh64(np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C"))
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a mesh of {len(faces)} faces is no solid ({solid.status().name}); it must be closed")
    return solid


def mesh_of(solid: manifold3d.Manifold) -> tuple[Vertices, Faces]:
    """Vertices and faces of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)
