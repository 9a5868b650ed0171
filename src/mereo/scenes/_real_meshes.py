"""Real meshes made fit for scenes: largest piece, closed holes, fewer faces, and to and from manifold3d's solids.

All of it is deterministic, and none of it moves what is there: pieces are dropped, holes filled, flat edges collapsed.
"""

import igl
import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.mesh import Color, Segment

Vertices = Float[np.ndarray, "_ 3"]
Faces = Int[np.ndarray, "_ 3"]


def largest_piece(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """The most faces that are connected over edges which two of them share; unused vertices are left out."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1) @ [len(vertices), 1]
    order = np.argsort(edges, kind="stable")
    _, first, uses = np.unique(edges[order], return_index=True, return_counts=True)
    pair = np.stack([order[first[uses == 2]], order[first[uses == 2] + 1]]) // 3
    graph = coo_array((np.ones(pair.shape[1]), pair), shape=(len(faces), len(faces)))
    piece = connected_components(graph, directed=False)[1]
    used, kept = np.unique(faces[piece == np.bincount(piece).argmax()], return_inverse=True)
    return vertices[used], kept.reshape(-1, 3)


def close_hole(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Close the one open loop of a mesh by a fan around the mean of its vertices; a closed mesh stays as it is."""
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    count = len(vertices)
    there, back = directed @ [count, 1], directed @ [1, count]
    loop = directed[~np.isin(there, back)]
    if len(loop) == 0:
        return vertices, faces
    fan = np.stack([loop[:, 1], loop[:, 0], np.full(len(loop), count)], axis=1)
    return np.concatenate([vertices, vertices[loop[:, :1]].mean(axis=0)]), np.concatenate([faces, fan])


def solid_of(vertices: Vertices, faces: Faces) -> manifold3d.Manifold:
    """A closed mesh as a solid; raises ``ValueError`` where manifold3d does not accept it."""
    mesh = manifold3d.Mesh64(
        np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.uint64)
    )
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"a mesh of {len(faces)} faces is no solid ({solid.status().name}); it must be closed")
    return solid


def mesh_of(solid: manifold3d.Manifold) -> tuple[Vertices, Faces]:
    """Vertices and faces of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)


def segment_of(name: str, color: Color, solid: manifold3d.Manifold) -> Segment:
    return Segment(name, color, *mesh_of(solid))


def main_part(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """The largest of a solid's parts: Booleans of meshes that nearly touch leave flecks."""
    return max(solid.decompose(), key=lambda part: part.volume())


def simplified(solid: manifold3d.Manifold, faces: int) -> manifold3d.Manifold:
    """The solid with at most ``faces`` faces: edges collapse, flattest first (Garland & Heckbert, SIGGRAPH 1997)."""
    vertices, indices = mesh_of(solid)
    fewer = igl.qslim(np.asfortranarray(vertices), np.asfortranarray(indices.astype(np.int32)), faces, False)
    return solid_of(fewer[0], fewer[1].astype(np.int64))  # C's long long, which numpy tells apart
