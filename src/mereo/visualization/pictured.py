"""Meshes as pictures and reports need them: coarse enough to be drawn, with what is carried before the segments."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mereo.fitting.registration.carry import Carried
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.attachments import Surfaces
from mereo.visualization.reconstruction_report import cluster

PICTURED_FACES = 100_000
"""A mesh of more faces is coarsened for pictures: shading takes seconds for each hundred thousand."""

PICTURED_CELLS = 150
"""Cells along the longest side to which it is coarsened."""


def pictured(mesh: SegmentedMesh) -> SegmentedMesh:
    """A mesh as pictures need it."""
    return replace(mesh, segments=tuple(_coarsened(segment) for segment in mesh.segments))


def _coarsened(segment: Segment) -> Segment:
    if len(segment.faces) <= PICTURED_FACES:
        return segment
    return cluster(segment, float(np.ptp(segment.vertices, axis=0).max()) / PICTURED_CELLS)


def with_carried(surfaces: SegmentedMesh, carried: Sequence[Carried]) -> SegmentedMesh:
    """Segments with all carried surfaces before them, declared to lie inside them, so that they are seen through them.

    Their names are those of their files, with that of the part where a file has several; their colours differ from the
    segments'.
    """
    parts: list[Segment] = []
    for one in carried:
        if isinstance(one.content, Surfaces):
            mesh = one.content.mesh
            several = len(mesh.segments) > 1
            parts += [replace(s, name=f"{one.name}: {s.name}" if several else one.name) for s in mesh.segments]
    free = [color for color in reversed(PALETTE) if color not in surfaces.colors] or list(PALETTE)
    parts = [replace(part, color=free[index % len(free)]) for index, part in enumerate(parts)]
    nested = tuple((part.name, name) for part in parts for name in surfaces.names)
    return SegmentedMesh((*parts, *surfaces.segments), (*surfaces.nested, *nested))
