"""Faces small enough to bend: CAD programs write one long triangle where a surface is flat, and maps bend it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mereo.deformation.maps import Deformation
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.subdivision import TooManyFaces, split_edges
from mereo.scenes.seeds import example_rng

TOLERANCE = 0.05
"""How far, in scene units, a straight edge may leave the curve that the map makes of it: half of the noise."""

SHORTEST = 1.0
"""Edges up to this long, in scene units, are not halved: they follow any bend down to a radius of 2.5."""

STATES = 8
"""Random states in which every edge is compared with its curve."""

MOST_FACES = 20_000
"""Faces of all segments that refinement may lead to; beyond it the tolerance doubles."""

PLACES = ((0.5, 0.5), (0.25, 0.75), (0.75, 0.25))
"""Shares of an edge's two ends at which it is compared, symmetric, so that neighbours split a shared edge alike."""

Ends = Float[np.ndarray, "e 2 3"]


def refined(rest: SegmentedMesh, draw: Callable[[np.random.Generator], tuple[Deformation, ...]]) -> SegmentedMesh:
    """Mesh with all edges halved that ``draw``'s maps bend away from a straight line; itself where none is.

    An edge is halved where in one of ``STATES`` random states the map of a place on it is farther than ``TOLERANCE``
    from the straight line between the maps of its ends. Affine maps, as those of joints, split nothing. Segments that
    share a map and an edge split it alike; where they touch without sharing edges they part or meet by at most twice
    the tolerance.

    Args:
        rest: segments in scene units.
        draw: one map for each segment.
    """
    states = [draw(example_rng(0, index)) for index in range(STATES)]
    tolerance = TOLERANCE
    most = max(MOST_FACES, 2 * sum(len(segment.faces) for segment in rest.segments))
    while True:
        try:
            return _refined(rest, states, tolerance, most)
        except TooManyFaces:
            tolerance *= 2


def _refined(rest: SegmentedMesh, states: list[tuple[Deformation, ...]], tolerance: float, most: int) -> SegmentedMesh:
    segments = []
    for index, segment in enumerate(rest.segments):
        maps = [state[index] for state in states]

        def bent(ends: Ends, maps: list[Deformation] = maps) -> Bool[np.ndarray, " e"]:
            return _bent(ends, maps, tolerance)

        vertices, faces = split_edges(segment.vertices, segment.faces, bent, most)
        most -= len(faces)
        segments.append(
            segment if len(faces) == len(segment.faces) else replace(segment, vertices=vertices, faces=faces)
        )
    return replace(rest, segments=tuple(segments))


def _bent(ends: Ends, maps: list[Deformation], tolerance: float) -> Bool[np.ndarray, " e"]:
    """Which edges some map makes a curve of that is farther than ``tolerance`` from its chord."""
    result = np.zeros(len(ends), dtype=bool)
    long = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > SHORTEST
    for deform in maps:
        rows = np.flatnonzero(long & ~result)
        if len(rows) == 0:
            break
        a, b = ends[rows, 0], ends[rows, 1]
        moved = deform(np.concatenate([a, b, *(s * a + t * b for s, t in PLACES)])).reshape(2 + len(PLACES), -1, 3)
        for (s, t), place in zip(PLACES, moved[2:], strict=True):
            away = np.linalg.norm(place - (s * moved[0] + t * moved[1]), axis=1)
            result[rows] |= away > tolerance
    return result
