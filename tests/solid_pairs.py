"""Exact overlaps and gaps between the segments of a state, by Booleans on the meshes themselves."""

from itertools import combinations

import numpy as np
from manifold3d import Manifold, Mesh64

from mereo.mesh import Segment, SegmentedMesh


def solid(segment: Segment) -> Manifold:
    return Manifold(Mesh64(segment.vertices, segment.faces.astype(np.uint64)))


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
