"""Creases of surfaces: edges at which viewers must not smooth, because the object has an edge there.

    Segment -split_at_creases-> Segment whose vertices have one normal each, and which vertex each of them was

A viewer shades a triangle between the normals of its vertices. Where two flat faces of a machine part share a vertex,
its one normal is right for neither, and the part looks melted. So faces that meet at a crease get vertices of their own
there; everywhere else neighbours go on sharing theirs, and a smooth surface has as many as before.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.geometry.mesh import Segment

CREASE_DEG = 30.0
"""Angle between the normals of two neighbouring faces above which the edge between them is a crease."""

ROUNDING_DEG = 0.01
"""Angle that is added to it: a cylinder of twelve sides has exactly 30 degrees at each edge, up to rounding."""

NO_AREA = 1e-12
"""Area of a face, as a share of its longest side squared, below which it has no normal."""


def split_at_creases(segment: Segment, angle_deg: float = CREASE_DEG) -> tuple[Segment, Int[np.ndarray, " n"]]:
    """The same surface, its vertices split where faces meet at a crease.

    A vertex is split into as many as there are groups of faces around it between which only creases lie; where a crease
    ends within a smooth surface there is one such group, and it stays one vertex. Faces without area have no normal and
    are not seen: they split nothing.

    Args:
        segment: any triangle mesh, any unit; open or closed.
        angle_deg: angle between normals above which an edge is a crease.

    Returns the segment (itself where nothing is split), and for each of its vertices the index of the one that it was:
    first all old ones in their order, then the added ones. Faces keep their order and orientation.
    """
    faces, count = segment.faces, len(segment.vertices)
    same = np.arange(count)
    if not len(faces):
        return segment, same
    normals = _face_normals(segment)
    first, second, edge = _neighbours(faces)
    is_flat = np.abs(normals).max(axis=1) == 0.0
    cosine = np.einsum("ni,ni->n", normals[first], normals[second])
    is_told = ~(is_flat[first] | is_flat[second])
    is_crease = is_told & (cosine < np.cos(np.deg2rad(angle_deg + ROUNDING_DEG)))
    if not is_crease.any():
        return segment, same
    on_crease = np.zeros(count, dtype=bool)
    on_crease[edge[is_crease]] = True
    is_smooth = is_told & ~is_crease
    group = _groups(faces, (first[is_smooth], second[is_smooth], edge[is_smooth]), on_crease)
    corner = faces.reshape(-1).astype(np.int64)
    touched = np.flatnonzero(on_crease[corner] & ~np.repeat(is_flat, 3))
    # one new vertex for each pair of an old one and a group of faces there, but the first keeps the old one
    pairs, place = np.unique(np.stack([corner[touched], group[touched]]), axis=1, return_inverse=True)
    is_first = np.concatenate([[True], pairs[0, 1:] != pairs[0, :-1]])
    index = np.where(is_first, pairs[0], count + np.cumsum(~is_first) - 1)
    corner[touched] = index[place.reshape(-1)]
    source = np.concatenate([same, pairs[0, ~is_first]])
    return replace(segment, vertices=segment.vertices[source], faces=corner.reshape(-1, 3)), source


def _face_normals(segment: Segment) -> Float[np.ndarray, "f 3"]:
    """Unit normals of the faces; zero for those without area."""
    a, b, c = (segment.vertices[segment.faces[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1, keepdims=True)
    longest = np.max([((q - p) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)[:, None]
    result: Float[np.ndarray, "f 3"] = np.where(area > NO_AREA * longest, normals / np.maximum(area, 1e-300), 0.0)
    return result


def _neighbours(
    faces: Int[np.ndarray, "f 3"],
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, "n 2"]]:
    """Pairs of faces with a common edge, and its two vertices; of more than two at an edge each with the next."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    together = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, other = order[together], order[together + 1]
    return one // 3, other // 3, edges[one]


def _groups(
    faces: Int[np.ndarray, "f 3"],
    smooth: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, "n 2"]],
    on_crease: Bool[np.ndarray, " v"],
) -> Int[np.ndarray, " c"]:
    """Number of the group of each corner of each face: corners at one vertex between which no crease lies share it.

    ``smooth`` are neighbours without a crease between them, as ``_neighbours`` has them.
    """
    first, second, edge = smooth
    pairs = [np.stack([_corner(faces, face, edge[:, end]) for face in (first, second)]) for end in (0, 1)]
    one, other = np.concatenate(pairs, axis=1)
    kept = on_crease[faces.reshape(-1)[one]]
    one, other, size = one[kept], other[kept], faces.size
    links = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(size, size))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _corner(
    faces: Int[np.ndarray, "f 3"], face: Int[np.ndarray, " n"], vertex: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Which of all corners (three for each face, in their order) each vertex is of its face."""
    result: Int[np.ndarray, " n"] = 3 * face + (faces[face] == vertex[:, None]).argmax(axis=1)
    return result
