"""Overlaps and gaps between the segments of a state: exact, by Booleans, or where vertices are, by winding numbers."""

from itertools import combinations

import igl
import numpy as np
from manifold3d import Manifold
from numpy.linalg import norm

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import solid_of


def solid(segment: Segment) -> Manifold:
    return solid_of(segment.vertices, segment.faces)


def overlapping_pairs(mesh: SegmentedMesh) -> list[tuple[str, str]]:
    """Names of segments that have any volume in common."""
    solids = {segment.name: solid(segment) for segment in mesh.segments}
    boxes = {segment.name: segment.bounds for segment in mesh.segments}
    near = [
        (a, b)
        for a, b in combinations(mesh.names, 2)
        if (boxes[a][0] < boxes[b][1]).all() and (boxes[b][0] < boxes[a][1]).all()
    ]
    return [(a, b) for a, b in near if (solids[a] ^ solids[b]).volume() > 1e-9]


def gap(mesh: SegmentedMesh, first: str, second: str) -> float:
    """Least distance between two segments, at most 1."""
    a, b = (solid(mesh.segments[mesh.names.index(name)]) for name in (first, second))
    return float(a.min_gap(b, 1.0))


def crowded(mesh: SegmentedMesh, depth: float, chosen: slice = slice(None)) -> set[str]:
    """Segments with a vertex, of those ``chosen``, that two solids hold, or one that passes through itself.

    Winding numbers of all segments add up; a place in one nested segment counts twice, and may. Every vertex is moved
    inwards by ``depth`` first, so what overlaps less is not counted.
    """
    vertices, faces, _ = mesh.merged()
    corners = vertices[faces]
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None])
    normals /= norm(normals, axis=1, keepdims=True) + 1e-30
    owner = np.repeat(np.arange(len(mesh.segments)), [len(segment.vertices) for segment in mesh.segments])[chosen]
    allowed = 1 + np.array([sum(inner == index for inner, _ in mesh.nesting) for index in range(len(mesh.segments))])
    winding = igl.fast_winding_number(vertices, faces, (vertices - depth * normals)[chosen])
    return {mesh.names[index] for index in np.unique(owner[winding > allowed[owner] + 0.5])}
