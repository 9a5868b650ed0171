"""STL, binary: one file for each segment, because a file holds one surface. It has neither unit nor colour.

The name is in the 80 bytes that STL leaves to the writer, as ``STL_NAME`` and UTF-8, and comes back from there.
"""

import re
from pathlib import Path

import trimesh

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.io.atomic_files import atomic_file
from mereo.io.mesh_formats import STL_NAME
from mereo.io.output_folders import new_directory
from mereo.io.writers.segment_table import with_faces


def write_segments_stl(directory: str | Path, surfaces: SegmentedMesh, force: bool = False) -> None:
    """Write a new directory of ``1-head.stl``, ``2-left-ear.stl``, ...: label and name of each segment with faces.

    Positions are float32, in the mesh's frame and unit. Raises ``ValueError`` where no segment has faces, and
    ``FileExistsError`` for a directory with content unless ``force``.
    """
    found = with_faces(surfaces)
    with new_directory(directory, force) as partial:
        for label, segment in found:
            (partial / stl_name(label, segment.name)).write_bytes(_binary(segment))


def write_surface_stl(path: str | Path, surfaces: SegmentedMesh) -> None:
    """Write all segments as one nameless surface; positions are float32, in the mesh's frame and unit."""
    vertices, faces, _ = surfaces.merged()
    with atomic_file(path) as partial:
        partial.write_bytes(_binary(Segment("", surfaces.colors[0], vertices, faces)))


def stl_name(label: int, name: str) -> str:
    """File name of a segment that every system takes: letters and digits of its name; the label keeps it unique."""
    words = re.sub(r"[^\w]+", "-", name).strip("-")
    return f"{label}-{words}.stl" if words else f"{label}.stl"


def _header(name: str) -> bytes:
    """80 bytes with a segment's name; one that is too long for them is left out, not cut short."""
    text = STL_NAME + name.encode("utf-8")
    return (text if len(text) <= 80 and name.isprintable() else b"written by mereo").ljust(80)


def _binary(segment: Segment) -> bytes:
    """The file as trimesh writes it, but for its header, which must not begin with "solid" as text files do."""
    mesh = trimesh.Trimesh(segment.vertices, segment.faces, process=False)
    content: bytes = trimesh.exchange.stl.export_stl(mesh)
    return _header(segment.name) + content[80:]
