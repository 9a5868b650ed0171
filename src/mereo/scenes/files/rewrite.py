"""A scene file's text with other meshes; everything else in it, comments included, stays as the user wrote it."""

import re
from collections.abc import Collection

import yaml

from mereo.geometry.mesh import SegmentedMesh
from mereo.io.yaml_document import Document

Edit = tuple[int, int, str]
"""From and to which character of the text, and what comes there instead."""


def with_segment_files(document: Document, mesh: SegmentedMesh, changed: Collection[str]) -> tuple[str, dict[str, str]]:
    """The text of ``document`` with new files for changed segments, and the name of each of these files.

    Where the segments were parts of a model or labels of a volume, all get a file of their own: one scene file takes
    its segments from one kind of source.
    """
    if "segments" in document.data:
        files = {name: repaired_name(name) for name in changed}
        edits = [_file_edit(document, index, files[name]) for index, name in enumerate(mesh.names) if name in files]
    else:
        files = {name: repaired_name(name) for name in mesh.names}
        edits = _block_edits(document, _segments_block(mesh, files))
    text = document.text
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text, files


def repaired_name(segment: str) -> str:
    """The file of a repaired segment."""
    return re.sub(r"[^\w.-]+", "_", segment) + "-repaired.ply"


def _file_edit(document: Document, index: int, file: str) -> Edit:
    _, value = document.pair(("segments", index, "file"))
    return value.start_mark.index, value.end_mark.index, quoted(file)


def _block_edits(document: Document, block: str) -> list[Edit]:
    """The first of the blocks that name the source becomes ``block``, the others go."""
    edits: list[Edit] = []
    for name in ("model", "parts", "labels", "names", "cells"):
        if name in document.data:
            key, value = document.pair((name,))
            end = document.text.find("\n", _end(value))
            edits.append((key.start_mark.index, end + 1 if end >= 0 else len(document.text), "" if edits else block))
    return edits


def _end(node: yaml.Node) -> int:
    """After the last character; the mark of a block is after the comments that follow it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end


def _segments_block(mesh: SegmentedMesh, files: dict[str, str]) -> str:
    lines = ["segments:"]
    for segment in mesh.segments:
        lines += [f"  - name: {quoted(segment.name)}", f"    file: {quoted(files[segment.name])}"]
        lines.append(f"    color: {list(segment.color)}")
        lines += [f"    nested_in: {quoted(outer)}" for inner, outer in mesh.nested if inner == segment.name]
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """As a YAML value on one line: quoted unless it is a plain word."""
    plain = re.fullmatch(r"[A-Za-z_./][\w./ -]*", text) and not text.endswith(" ")
    reserved = text.lower() in ("yes", "no", "on", "off", "true", "false", "null", "y", "n")
    return text if plain and not reserved else "'" + text.replace("'", "''") + "'"
