"""A scene file written anew with other meshes; its comments stay in the user's own file, which nobody changes."""

import re
from collections.abc import Collection
from typing import Any

import yaml

from mereo.geometry.mesh import SegmentedMesh
from mereo.io.yaml_document import Document

SOURCES = ("segments", "model", "parts", "labels", "names", "cells")
"""Keys that say where the segments come from."""

HEADER = """\
# {name} with repaired meshes, written by `mereo scene check {name} --repair`.
# Everything else says the same as there; the comments are there too.
"""


def with_segment_files(document: Document, mesh: SegmentedMesh, changed: Collection[str]) -> tuple[str, dict[str, str]]:
    """Text of a scene file that says what ``document`` says with new files for changed segments, and their names.

    Where the segments were parts of a model or labels of a volume, all get a file of their own: one scene file takes
    its segments from one kind of source.

    Args:
        document: a valid scene file.
        mesh: its segments, in the order of the file.
        changed: names of the segments that need a new file.

    Returns:
        The text, and for each segment with a new file that file's name.
    """
    if "segments" in document.data:
        files = {name: repaired_name(name) for name in changed}
        segments = [{**block, "file": files.get(block["name"], block["file"])} for block in document.data["segments"]]
    else:
        files = {name: repaired_name(name) for name in mesh.names}
        segments = _segment_blocks(mesh, files)
    first = next(key for key in document.data if key in SOURCES)
    data: dict[str, Any] = {}
    for key, value in document.data.items():
        if key == first:
            data["segments"] = segments
        elif key not in SOURCES:
            data[key] = value
    body = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    return HEADER.format(name=document.path.name) + body, files


def repaired_name(segment: str) -> str:
    """Name of the file of a repaired segment."""
    return re.sub(r"[^\w.-]+", "_", segment) + "-repaired.ply"


def _segment_blocks(mesh: SegmentedMesh, files: dict[str, str]) -> list[dict[str, Any]]:
    outer = dict(mesh.nested)
    return [
        {"name": segment.name, "file": files[segment.name], "color": list(segment.color)}
        | ({"nested_in": outer[segment.name]} if segment.name in outer else {})
        for segment in mesh.segments
    ]
