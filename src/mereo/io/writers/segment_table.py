"""Table of labels, names and colours that the writers put into files, and which segments have a surface."""

import json
from collections.abc import Sequence
from typing import Any

from mereo.geometry.mesh import Color, Segment, SegmentedMesh


def with_faces(surfaces: SegmentedMesh) -> list[tuple[int, Segment]]:
    """Labels and segments that have a surface. Raises ``ValueError`` where none has."""
    found = [(label, segment) for label, segment in enumerate(surfaces.segments, start=1) if len(segment.faces)]
    if not found:
        raise ValueError("all segments are without faces; at least one surface is needed: check the reconstruction")
    return found


def segment_table(names: Sequence[str], colors: Sequence[Color]) -> list[dict[str, Any]]:
    """Label, name and colour of each segment, in label order."""
    rows = enumerate(zip(names, colors, strict=True), start=1)
    return [{"label": label, "name": name, "color": list(color)} for label, (name, color) in rows]


def comment_lines(names: Sequence[str], colors: Sequence[Color]) -> list[str]:
    """Table of segments as ASCII lines for file headers: ``segment`` and a JSON object, so that any name survives."""
    return [f"segment {json.dumps(row)}" for row in segment_table(names, colors)]
