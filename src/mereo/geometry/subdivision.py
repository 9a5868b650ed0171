"""Subdivision of triangle meshes, so that a flat one can bend: edges are halved until none is too long."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

Faces = Int[np.ndarray, "_ 3"]

TooLong = Callable[[Float[np.ndarray, "e 2 3"]], Bool[np.ndarray, " e"]]
"""Which edges are to be halved, by the places of their ends; the order of the two must not matter."""


def split_long_edges(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], longest: float, most: int
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The same surface without edges over ``longest``; the given vertices come first and keep their places.

    Both triangles at an edge are split there, so that closed meshes stay closed. Raises ``ValueError`` where that takes
    more than ``most`` faces.
    """
    try:
        return split_edges(
            vertices, faces, lambda ends: np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > longest, most
        )
    except TooManyFaces:
        raise ValueError(
            f"a mesh would take {most:,} triangles or more to have no edge over {longest:.3g}; it is too large, or "
            "in another unit: cut it to what is near the object, or check its unit"
        ) from None


class TooManyFaces(ValueError):
    """Error of a subdivision that takes more faces than are allowed."""


def split_edges(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], too_long: TooLong, most: int
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The same surface with all edges halved, and their halves again, that are ``too_long``; each is asked once.

    The given vertices come first. Both triangles at an edge are split there, so that closed meshes stay closed. Raises
    ``TooManyFaces`` where that takes more than ``most``.
    """
    faces = faces.astype(np.int64)
    short: Int[np.ndarray, " k"] = np.empty(0, dtype=np.int64)
    while True:
        edges, edge_of = _edges(faces)
        keys = edges[:, 0] << 32 | edges[:, 1]
        new = ~np.isin(keys, short)
        long = np.zeros(len(edges), dtype=bool)
        long[new] = too_long(vertices[edges[new]])
        if not long.any():
            return vertices, faces
        short = keys[~long]
        faces = _split(faces, len(vertices) + np.cumsum(long)[edge_of] - 1, long[edge_of])
        vertices = np.concatenate([vertices, vertices[edges[long]].mean(axis=1)])
        if len(faces) > most:
            raise TooManyFaces(f"a mesh would take {most:,} triangles or more")


def _edges(faces: Faces) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "_ 3"]]:
    """All edges, and for each face which they are: edge k leads from corner k to the next."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    return edges, inverse.reshape(-1, 3)


def _split(faces: Faces, middle: Int[np.ndarray, "_ 3"], long: Bool[np.ndarray, "_ 3"]) -> Faces:
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
