"""Real meshes made fit for scenes: largest piece, closed holes, fewer faces.

All of it is deterministic, and none of it moves what is there: pieces are dropped, holes filled, flat edges collapsed.
"""

import igl
import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.scenes._solids import Faces, Vertices, mesh_of, solid_of


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


def main_part(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """The largest of a solid's parts: Booleans of meshes that nearly touch leave flecks."""
    return max(solid.decompose(), key=lambda part: part.volume())


def simplified(solid: manifold3d.Manifold, faces: int, block_intersections: bool = False) -> manifold3d.Manifold:
    """The solid with at most ``faces`` faces: edges collapse, flattest first (Garland & Heckbert, SIGGRAPH 1997).

    Where the surface folds closely upon itself (lips, eyelids), ``block_intersections`` keeps it from passing through
    itself; that takes twice as long.
    """
    vertices, indices = mesh_of(solid)
    fewer = igl.qslim(
        np.asfortranarray(vertices), np.asfortranarray(indices.astype(np.int32)), faces, block_intersections
    )
    return solid_of(fewer[0], fewer[1].astype(np.int64))  # C's long long, which numpy tells apart
