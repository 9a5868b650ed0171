"""PLY, binary: positions as they are, with label and colour (Turk, "The PLY Polygon File Format", 1994).

PLY has no unit. Labels are a property called ``label``; their names are in the header, as comments that hold JSON.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mereo.geometry.labels import SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.atomic_files import atomic_file
from mereo.io.writers.segment_table import comment_lines, with_faces

COLOR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
TYPES = {"u1": "uchar", "i4": "int", "f4": "float"}


def write_segments_ply(path: str | Path, surfaces: SegmentedMesh) -> None:
    """All surfaces in one mesh; vertices and faces have ``label``, ``red``, ``green``, ``blue`` (uchar).

    Segments share no vertices, so each vertex has one label; positions are float32, in the mesh's frame and unit.
    Raises ``ValueError`` where no segment has faces.
    """
    with_faces(surfaces)
    positions, faces, owner = surfaces.merged()
    colors = np.array(surfaces.colors, dtype=np.uint8)
    vertex_owner = np.repeat(np.arange(len(colors)), [len(segment.vertices) for segment in surfaces.segments])
    vertices = _records(len(positions), [("x", "f4"), ("y", "f4"), ("z", "f4"), *COLOR, ("label", "u1")])
    triangles = _records(len(faces), [("count", "u1"), ("vertex_indices", "i4", 3), *COLOR, ("label", "u1")])
    for records, index in ((vertices, vertex_owner), (triangles, owner)):
        _set_columns(records, ("red", "green", "blue"), colors[index])
        records["label"] = index + 1
    _set_columns(vertices, "xyz", positions)
    triangles["count"], triangles["vertex_indices"] = 3, faces
    header = comment_lines(surfaces.names, surfaces.colors)
    _write(path, header, {"vertex": vertices, "face": triangles})


def write_points_ply(path: str | Path, cloud: SegmentedCloud) -> None:
    """The observed points with ``label``, its colour, ``confidence`` and ``occupancy``, see ``SegmentedCloud``.

    Positions are float32, in the cloud's frame and unit.
    """
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), *COLOR, ("label", "u1"), ("confidence", "f4"), ("occupancy", "f4")]
    vertices = _records(len(cloud.points), fields)
    _set_columns(vertices, "xyz", cloud.points)
    _set_columns(vertices, ("red", "green", "blue"), np.array(cloud.colors, dtype=np.uint8)[cloud.labels - 1])
    vertices["label"], vertices["confidence"], vertices["occupancy"] = cloud.labels, cloud.confidence, cloud.occupancy
    _write(path, comment_lines(cloud.names, cloud.colors), {"vertex": vertices})


def _records(count: int, fields: Sequence[tuple[str, str] | tuple[str, str, int]]) -> np.ndarray:
    """Little-endian records without padding: the bytes of the file."""
    return np.zeros(count, np.dtype([(field[0], "<" + field[1], *field[2:]) for field in fields]))


def _set_columns(records: np.ndarray, names: Sequence[str], values: np.ndarray) -> None:
    for column, name in enumerate(names):
        records[name] = values[:, column]


def _write(path: str | Path, comments: list[str], elements: dict[str, np.ndarray]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", "comment written by mereo", *(f"comment {c}" for c in comments)]
    for element, records in elements.items():
        lines += [f"element {element} {len(records)}", *_properties(records.dtype)]
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for records in elements.values():
            file.write(records.tobytes())


def _properties(dtype: np.dtype) -> list[str]:
    """``count`` and ``vertex_indices`` together are what PLY calls a list."""
    lines = []
    for name in dtype.names or ():
        if name == "vertex_indices":
            lines.append("property list uchar int vertex_indices")
        elif name != "count":
            lines.append(f"property {TYPES[dtype[name].str[1:]]} {name}")
    return lines
