"""Segments as the writers put them into files: which have a surface, closed for other programs too, and their table."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mereo.geometry.mesh import Color, Segment, SegmentedMesh

MERGED_WITHIN = 2e-8
"""Distance, in a file's unit, at which programs that merge vertices on reading take two for one (trimesh: 1e-8)."""


def with_faces(surfaces: SegmentedMesh) -> list[tuple[int, Segment]]:
    """Labels and segments that have a surface, without edges that end in one place once they are written (``settled``).

    Raises ``ValueError`` where none has.
    """
    found = [
        (label, settled(segment)) for label, segment in enumerate(surfaces.segments, start=1) if len(segment.faces)
    ]
    if not found:
        raise ValueError("all segments are without faces; at least one surface is needed: check the reconstruction")
    return found


def settled(segment: Segment) -> Segment:
    """Segment whose edges of no length are closed up: both ends at one vertex, and the faces along them gone.

    Files hold float32, and readers merge what is near; the two ends become one place there, but the faces between them
    stay as slivers with open edges. Which is why such edges, shorter than either can tell, go before. No other vertex
    moves or changes its number of faces; a segment that would not be closed any more stays as it is.
    """
    extent = float(np.abs(segment.vertices).max(initial=0.0))
    edges = np.concatenate([segment.faces[:, pair] for pair in ((0, 1), (1, 2), (2, 0))])
    away = np.linalg.norm(segment.vertices[edges[:, 0]] - segment.vertices[edges[:, 1]], axis=1)
    short = edges[away < max(MERGED_WITHIN, 4 * float(np.finfo(np.float32).eps) * extent)]
    if not len(short):
        return segment
    count = len(segment.vertices)
    graph = coo_array((np.ones(len(short)), (short[:, 0], short[:, 1])), shape=(count, count))
    place = connected_components(graph, directed=False)[1]
    first, local = np.unique(place, return_index=True, return_inverse=True)[1:]
    faces = local.reshape(-1)[segment.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces) or (_is_closed(segment.faces) and not _is_closed(faces)):
        return segment
    return Segment(segment.name, segment.color, segment.vertices[first], faces)


def _is_closed(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether each edge has two faces, which run along it in opposite directions."""
    edges = np.concatenate([faces[:, pair] for pair in ((0, 1), (1, 2), (2, 0))]).astype(np.int64)
    base = int(edges.max(initial=0)) + 1
    there, back = edges[:, 0] * base + edges[:, 1], edges[:, 1] * base + edges[:, 0]
    unique = np.unique(there)
    return len(unique) == len(there) and np.array_equal(unique, np.unique(back))


def segment_table(names: Sequence[str], colors: Sequence[Color]) -> list[dict[str, Any]]:
    """Label, name and colour of each segment, in label order."""
    rows = enumerate(zip(names, colors, strict=True), start=1)
    return [{"label": label, "name": name, "color": list(color)} for label, (name, color) in rows]


def comment_lines(names: Sequence[str], colors: Sequence[Color]) -> list[str]:
    """Table of segments as ASCII lines for file headers: ``segment`` and a JSON object, so that any name survives."""
    return [f"segment {json.dumps(row)}" for row in segment_table(names, colors)]
