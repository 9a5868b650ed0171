"""Splitting of triangle meshes: at long edges, so that a flat one can bend, and at creases, so that it looks flat."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.linalg import norm

from mereo.geometry.mesh import AnyFaces, ChangedMesh, Faces, Segment, Vertices, connected, directed_edges, face_corners
from mereo.geometry.transforms import Indices

TooLong = Callable[[Float[ndarray, "e 2 3"]], Bool[ndarray, " e"]]
"""Which edges are to be halved, by the places of their ends; the order of the two must not matter."""


def split_long_edges(vertices: Vertices, faces: Faces, longest: float, most: int) -> ChangedMesh:
    """The same surface without edges over ``longest``; the given vertices come first and keep their places.

    Both triangles at an edge are split there, so that closed meshes stay closed. Raises ``ValueError`` where that takes
    more than ``most`` faces.
    """
    try:
        return split_edges(vertices, faces, lambda ends: norm(ends[:, 0] - ends[:, 1], axis=1) > longest, most)
    except TooManyFaces:
        raise ValueError(
            f"a mesh would take {most:,} triangles or more to have no edge over {longest:.3g}; it is too large, or "
            "in another unit: cut it to what is near the object, or check its unit"
        ) from None


class TooManyFaces(ValueError):
    """Error of a subdivision that takes more faces than are allowed."""


def split_edges(vertices: Vertices, faces: Faces, too_long: TooLong, most: int) -> ChangedMesh:
    """The same surface with all edges halved, and their halves again, that are ``too_long``; each is tested once.

    The given vertices come first. Both triangles at an edge are split there, so that closed meshes stay closed. Raises
    ``TooManyFaces`` where that takes more than ``most``.
    """
    faces = faces.astype(np.int64)
    short = np.empty(0, np.int64)
    while True:
        edges, edge_of = _edges(faces)
        keys = edges[:, 0] << 32 | edges[:, 1]
        new = ~np.isin(keys, short)
        long = np.zeros(len(edges), bool)
        long[new] = too_long(vertices[edges[new]])
        if not long.any():
            return vertices, faces
        short = keys[~long]
        faces = _split(faces, len(vertices) + np.cumsum(long)[edge_of] - 1, long[edge_of])
        vertices = np.concatenate([vertices, vertices[edges[long]].mean(axis=1)])
        if len(faces) > most:
            raise TooManyFaces(f"a mesh would take {most:,} triangles or more")


def _edges(faces: AnyFaces) -> tuple[Int[ndarray, "e 2"], AnyFaces]:
    """All edges, and for each face which they are: edge k leads from corner k to the next."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    return edges, inverse.reshape(-1, 3)


def _split(faces: AnyFaces, middle: AnyFaces, long: Bool[ndarray, "_ 3"]) -> AnyFaces:
    """Faces after halving their long edges, whose new vertices are ``middle``."""
    result = [faces[~long.any(axis=1)]]
    for count in (1, 2, 3):
        chosen = long.sum(axis=1) == count
        # turned so that the long edges come first
        turn = (np.argmax(long, axis=1) if count == 1 else (np.argmin(long, axis=1) + 1) % 3)[chosen]
        columns = (turn[:, None] + np.arange(3)) % 3
        (a, b, c), (ab, bc, ca) = (np.take_along_axis(x[chosen], columns, axis=1).T for x in (faces, middle))
        pieces = {
            1: ((a, ab, c), (ab, b, c)),
            2: ((ab, b, bc), (a, ab, bc), (a, bc, c)),
            3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        }[count]
        result += [np.stack(piece, axis=1) for piece in pieces]
    return np.concatenate(result)


# --- creases ----------------------------------------------------------------------------------------------------------

# A viewer shades a triangle between the normals of its vertices. Where two flat faces of a machine part share a vertex,
# its one normal is right for neither, and the part looks melted. So there faces that meet at a crease get vertices of
# their own; everywhere else neighbours go on sharing theirs, and a smooth surface has as many as before.

CREASE_DEG = 30.0
"""Angle between the normals of two neighbouring faces above which the edge between them is a crease."""


def split_at_creases(segment: Segment) -> tuple[Segment, Indices]:
    """The same surface, its vertices split where faces meet at a crease: normals are farther apart than ``CREASE_DEG``.

    A vertex is split into as many as there are groups of faces around it between which only creases lie; where a crease
    ends within a smooth surface there is one such group, and it stays one vertex. Faces without area have no normal and
    are not seen: they split nothing.

    Returns the segment (itself where nothing is split), and for each of its vertices the index of the one that it was:
    first all old ones in their order, then the added ones. Faces keep their order and orientation.
    """
    faces = segment.faces
    count = len(segment.vertices)
    same = np.arange(count)
    if not len(faces):
        return segment, same
    normals = _face_normals(segment)
    first, second, edge = _neighbours(faces)
    is_flat = np.abs(normals).max(axis=1) == 0.0
    cosine = np.einsum("ni,ni->n", normals[first], normals[second])
    has_normals = ~(is_flat[first] | is_flat[second])
    # a cylinder of twelve sides has exactly 30 degrees at each edge, up to rounding
    is_crease = has_normals & (cosine < np.cos(np.deg2rad(CREASE_DEG + 0.01)))
    if not is_crease.any():
        return segment, same
    on_crease = np.zeros(count, bool)
    on_crease[edge[is_crease]] = True
    is_smooth = has_normals & ~is_crease
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


def _face_normals(segment: Segment) -> Float[ndarray, "f 3"]:
    """Unit normals of the faces; zero for those without area."""
    a, b, c = face_corners(segment.vertices.astype(float), segment.faces)
    normals = np.cross(b - a, c - a)
    area = norm(normals, axis=1, keepdims=True)
    longest = np.max([((q - p) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)[:, None]
    return np.where(area > 1e-12 * longest, normals / np.maximum(area, 1e-300), 0.0)


def _neighbours(
    faces: Faces,
) -> tuple[Indices, Indices, Int[ndarray, "n 2"]]:
    """Pairs of faces with a common edge, and its two vertices; of more than two at an edge each with the next."""
    edges = np.sort(directed_edges(faces), axis=1)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    together = np.flatnonzero(key[order][1:] == key[order][:-1])
    first, second = order[together], order[together + 1]
    return first // 3, second // 3, edges[first]


def _groups(
    faces: Faces,
    smooth: tuple[Indices, Indices, Int[ndarray, "n 2"]],
    on_crease: Bool[ndarray, " v"],
) -> Int[ndarray, " c"]:
    """Number of the group of each corner of each face: corners at one vertex between which no crease lies share it.

    ``smooth`` are neighbours without a crease between them, as ``_neighbours`` has them.
    """
    *sides, edge = smooth
    # which of all corners, three for each face in their order, an edge's ends are of the faces on both of its sides
    corners = [[3 * face + (faces[face] == end[:, None]).argmax(axis=1) for face in sides] for end in edge.T]
    links = np.concatenate(corners, axis=1)
    links = links[:, on_crease[faces.reshape(-1)[links[0]]]]
    return connected(links.T, faces.size)
