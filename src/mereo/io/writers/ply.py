"""PLY, binary: positions as they are, with label and colour (Turk, "The PLY Polygon File Format", 1994).

PLY has no unit. Labels are a property called ``label``; their names are in the header, as comments that hold JSON.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from mereo.geometry.labels import SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.atomic_files import atomic_file
from mereo.io.writers.segment_table import comment_lines, with_faces

TYPES = {"u1": "uchar", "i4": "int", "f4": "float"}
"""Name that PLY has for each type of numpy."""


def write_segments_ply(path: str | Path, surfaces: SegmentedMesh, radii: Radii | None = None) -> None:
    """Write all surfaces as one mesh whose vertices and faces have ``label``, ``red``, ``green``, ``blue`` (uchar).

    Segments share no vertices, so each vertex has one label; positions are float32, in the mesh's frame and unit. With
    ``radii`` of the same unit each vertex has ``radius95``, float32.
    Raises ``ValueError`` where no segment has faces.
    """
    with_faces(surfaces)
    positions, faces, owner = surfaces.merged()
    colors = np.array(surfaces.colors, dtype=np.uint8)
    vertex_owner = np.repeat(np.arange(len(colors)), [len(segment.vertices) for segment in surfaces.segments])
    corners = {"count": ("u1", np.full(len(faces), 3)), "vertex_indices": ("i4", faces)}
    sure: Columns = {} if radii is None else {"radius95": ("f4", np.concatenate(radii.vertices))}
    vertices = _records(_positions(positions) | _colors(colors[vertex_owner]) | _label(vertex_owner + 1) | sure)
    triangles = _records(corners | _colors(colors[owner]) | _label(owner + 1))
    header = comment_lines(surfaces.names, surfaces.colors)
    if radii is not None:
        header.append(f"radius95 is in the unit of x, y, z{'' if radii.calibrated else '; it is not calibrated'}")
    _write(path, header, {"vertex": vertices, "face": triangles})


def write_points_ply(path: str | Path, cloud: SegmentedCloud) -> None:
    """Write the observed points with ``label``, its colour, ``confidence`` and ``occupancy``, see ``SegmentedCloud``.

    The last two are a network's; without one they are left out. Positions are float32, in the cloud's frame and unit.
    """
    colors = np.array(cloud.colors, dtype=np.uint8)[cloud.labels - 1]
    sure = {name: ("f4", values) for name, values in cloud.chances.items()}
    vertices = _records(_positions(cloud.points) | _colors(colors) | _label(cloud.labels) | sure)
    _write(path, comment_lines(cloud.names, cloud.colors), {"vertex": vertices})


def write_explained_ply(
    path: str | Path,
    points: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"],
    unexplained: Bool[np.ndarray, " n"],
    comment: str,
) -> None:
    """Write observed points coloured by how much they decide a place, with ``unexplained`` (uchar, 1 or 0)."""
    lost: Columns = {"unexplained": ("u1", unexplained)}
    plain = comment.encode("ascii", "replace").decode("ascii")
    _write(path, [plain], {"vertex": _records(_positions(points) | _colors(colors) | lost)})


def write_positions_ply(path: str | Path, points: Float[np.ndarray, "n 3"], comment: str = "") -> None:
    """Write a cloud's positions alone, as float32; ``comment`` is for people who open the file."""
    _write(path, [comment] if comment else [], {"vertex": _records(_positions(points))})


Columns = dict[str, tuple[str, np.ndarray]]
"""Type and values of each property, in the order of the file."""


def _positions(points: Float[np.ndarray, "n 3"]) -> Columns:
    return {axis: ("f4", points[:, k]) for k, axis in enumerate("xyz")}


def _colors(colors: UInt8[np.ndarray, "n 3"]) -> Columns:
    return {channel: ("u1", colors[:, k]) for k, channel in enumerate(("red", "green", "blue"))}


def _label(labels: Integer[np.ndarray, " n"]) -> Columns:
    return {"label": ("u1", labels)}


def _records(columns: Columns) -> np.ndarray:
    """Bytes of an element: little-endian records without padding."""
    fields = [(name, f"<{kind}", values.shape[1:]) for name, (kind, values) in columns.items()]
    records = np.zeros(len(next(iter(columns.values()))[1]), np.dtype(fields))
    for name, (_, values) in columns.items():
        records[name] = values
    return records


def _write(path: str | Path, comments: list[str], elements: dict[str, np.ndarray]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", "comment written by mereo", *(f"comment {c}" for c in comments)]
    for element, records in elements.items():
        lines += [f"element {element} {len(records)}", *_properties(records.dtype)]
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for records in elements.values():
            file.write(records.tobytes())


def _properties(dtype: np.dtype) -> list[str]:
    """Header lines of an element; ``count`` and ``vertex_indices`` together are what PLY calls a list."""
    lines = []
    for name in dtype.names or ():
        if name == "vertex_indices":
            lines.append("property list uchar int vertex_indices")
        elif name != "count":
            lines.append(f"property {TYPES[dtype[name].str[1:]]} {name}")
    return lines
