"""Surfaces and points as PLY, OBJ and STL, which have no unit: positions are in the frame and unit of what is written.

PLY is binary; labels are a property called ``label``, with names as JSON in comments of the header. A binary STL file
holds one surface, so there is one for each segment, with its name in the 80 bytes that STL leaves to the writer.
"""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy import ndarray
from numpy.linalg import norm

from mereo.geometry.labels import SegmentedCloud
from mereo.geometry.mesh import Color, Colors, Faces, Segment, SegmentedMesh, connected, edge_uses, three_cornered
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import Points
from mereo.io.atomic_files import JsonObject, atomic_file, new_directory, write_file
from mereo.io.errors import AnyPath
from mereo.io.mesh_formats import STL_NAME

OUTER_OPACITY = 0.4
"""Opacity of segments with others nested in them, which viewers draw see-through."""

MERGED_WITHIN = 2e-8
"""Distance, in a file's unit, at which programs that merge vertices on reading take two for one (trimesh: 1e-8)."""


# --- segments as all writers put them into files ----------------------------------------------------------------------


def with_faces(surfaces: SegmentedMesh) -> list[tuple[int, Segment]]:
    """Labels and segments that have a surface, without edges that end in one place once they are written (``settled``).

    Raises ``ValueError`` where none has.
    """
    segments = enumerate(surfaces.segments, start=1)
    solid = [(label, settled(segment)) for label, segment in segments if len(segment.faces)]
    if not solid:
        raise ValueError("all segments are without faces; at least one surface is needed: check the reconstruction")
    return solid


def settled(segment: Segment) -> Segment:
    """Segment whose edges of no length are closed up: both ends at one vertex, and the faces along them gone.

    Files hold float32, and readers merge what is near: of edges shorter than either can tell slivers with open edges
    would stay. A segment that would not be closed any more stays as it is.
    """
    extent = float(np.abs(segment.vertices).max(initial=0.0))
    edges = np.concatenate([segment.faces[:, pair] for pair in ((0, 1), (1, 2), (2, 0))])
    away = norm(segment.vertices[edges[:, 0]] - segment.vertices[edges[:, 1]], axis=1)
    short = edges[away < max(MERGED_WITHIN, 4 * float(np.finfo(np.float32).eps) * extent)]
    if not len(short):
        return segment
    place = connected(short, len(segment.vertices))
    _, first = np.unique(place, return_index=True)
    faces = place[segment.faces]
    faces = faces[three_cornered(faces)]
    if not len(faces) or (_is_closed(segment.faces) and not _is_closed(faces)):
        return segment
    return Segment(segment.name, segment.color, segment.vertices[first], faces)


def _is_closed(faces: Faces) -> bool:
    """Whether each edge has two faces, which run along it in opposite directions."""
    _, uses, unbalanced = edge_uses(faces)
    return bool(((uses == 2) & ~unbalanced).all())


def segment_table(names: Sequence[str], colors: Sequence[Color]) -> list[JsonObject]:
    """Label, name and colour of each segment, in label order."""
    rows = enumerate(zip(names, colors, strict=True), start=1)
    return [{"label": label, "name": name, "color": list(color)} for label, (name, color) in rows]


# --- PLY --------------------------------------------------------------------------------------------------------------


def write_segments_ply(path: AnyPath, surfaces: SegmentedMesh, radii: Radii | None = None) -> None:
    """Write all surfaces as one PLY mesh whose vertices and faces have ``label``, ``red``, ``green``, ``blue`` (uchar).

    Positions are float32, and ``radius95`` of ``radii`` of the same unit. Raises ``ValueError`` where no segment has
    faces.
    """
    with_faces(surfaces)
    positions, faces, owner = surfaces.merged()
    colors = np.array(surfaces.colors, np.uint8)
    vertex_owner = np.repeat(np.arange(len(colors)), [len(segment.vertices) for segment in surfaces.segments])
    corners = {"count": ("u1", np.full(len(faces), 3)), "vertex_indices": ("i4", faces)}
    sure = {} if radii is None else {"radius95": ("f4", np.concatenate(radii.vertices))}
    vertices = _records(
        _positions(positions) | _colors(colors[vertex_owner]) | {"label": ("u1", vertex_owner + 1)} | sure
    )
    triangles = _records(corners | _colors(colors[owner]) | {"label": ("u1", owner + 1)})
    comments = _comments(surfaces.names, surfaces.colors)
    if radii is not None:
        comments.append(f"radius95 is in the unit of x, y, z{'' if radii.calibrated else '; it is not calibrated'}")
    _write(path, comments, {"vertex": vertices, "face": triangles})


def write_points_ply(path: AnyPath, cloud: SegmentedCloud) -> None:
    """Write the observed points with ``label``, its colour, and a network's ``confidence`` and ``occupancy``."""
    colors = np.array(cloud.colors, np.uint8)[cloud.labels - 1]
    sure = {name: ("f4", values) for name, values in cloud.chances.items()}
    vertices = _records(_positions(cloud.points) | _colors(colors) | {"label": ("u1", cloud.labels)} | sure)
    _write(path, _comments(cloud.names, cloud.colors), {"vertex": vertices})


def write_positions_ply(path: AnyPath, points: Points, comment: str = "") -> None:
    """Write a cloud's positions alone, as float32; ``comment`` is for people who open the file."""
    _write(path, [comment] if comment else [], {"vertex": _records(_positions(points))})


Columns = dict[str, tuple[str, ndarray]]
"""Type and values of each property, in the order of the file."""


def _positions(points: Points) -> Columns:
    return {axis: ("f4", points[:, k]) for k, axis in enumerate("xyz")}


def _colors(colors: Colors) -> Columns:
    return {channel: ("u1", colors[:, k]) for k, channel in enumerate(("red", "green", "blue"))}


def _comments(names: Sequence[str], colors: Sequence[Color]) -> list[str]:
    """Table of segments as ASCII lines, so that any name survives."""
    return [f"segment {json.dumps(row)}" for row in segment_table(names, colors)]


def _records(columns: Columns) -> ndarray:
    fields = [(name, f"<{kind}", values.shape[1:]) for name, (kind, values) in columns.items()]
    records = np.zeros(len(next(iter(columns.values()))[1]), np.dtype(fields))
    for name, (_, values) in columns.items():
        records[name] = values
    return records


def _write(path: AnyPath, comments: list[str], elements: dict[str, ndarray]) -> None:
    types = {"u1": "uchar", "i4": "int", "f4": "float"}
    lines = ["ply", "format binary_little_endian 1.0", "comment written by mereo", *(f"comment {c}" for c in comments)]
    for element, records in elements.items():
        lines.append(f"element {element} {len(records)}")
        kinds = {name: types[records.dtype[name].base.str[1:]] for name in records.dtype.names or ()}
        if kinds.pop("count", None):  # with ``vertex_indices`` what PLY calls a list
            kinds["vertex_indices"] = "list uchar int"
        lines += [f"property {kind} {name}" for name, kind in kinds.items()]
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for records in elements.values():
            file.write(records.tobytes())


# --- OBJ --------------------------------------------------------------------------------------------------------------


def write_segments_obj(path: AnyPath, surfaces: SegmentedMesh) -> None:
    """Write one OBJ object (``o``) per segment with a material of its colour; the materials go next to it, as STEM.mtl.

    Materials have the segments' names, too, as many programs name what they read after its material (trimesh, VTK).
    Segments without faces are left out. Raises ``ValueError`` where no segment has faces.
    """
    path = Path(path)
    library = path.with_suffix(".mtl")
    solid = with_faces(surfaces)
    materials = material_names(solid)
    with atomic_file(library) as partial_library, atomic_file(path) as partial:
        partial_library.write_text(_materials(solid, materials, surfaces.opaque), "utf-8")
        with partial.open("w", encoding="utf-8", newline="\n") as file:
            file.write(f"# written by mereo\nmtllib {library.name}\n")
            first = 1  # OBJ counts vertices from 1, through all objects
            for (_, segment), material in zip(solid, materials, strict=True):
                file.write(f"o {' '.join(segment.name.split())}\nusemtl {material}\n")
                file.writelines(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in segment.vertices.tolist())
                file.writelines(f"f {a} {b} {c}\n" for a, b, c in (segment.faces + first).tolist())
                first += len(segment.vertices)


def material_names(solid: Sequence[tuple[int, Segment]]) -> list[str]:
    """Name of each segment's material: one word, and no other's; those that would be alike get their labels."""
    words = [(label, re.sub(r"\W+", "_", segment.name).strip("_")) for label, segment in solid]
    alike = Counter(word for _, word in words)
    return [word if word and alike[word] == 1 else f"{word}_label_{label}".lstrip("_") for label, word in words]


def _materials(solid: list[tuple[int, Segment]], names: list[str], opaque: tuple[bool, ...]) -> str:
    """Material library: ``Kd`` is the diffuse colour, taken as that on the screen (sRGB), ``d`` the opacity."""
    blocks = []
    for (label, segment), name in zip(solid, names, strict=True):
        color = " ".join(f"{value / 255:.6f}" for value in segment.color)
        blocks.append(f"newmtl {name}\nKd {color}\nd {1.0 if opaque[label - 1] else OUTER_OPACITY}\n")
    return "\n".join(blocks)


# --- STL --------------------------------------------------------------------------------------------------------------


def write_segments_stl(directory: AnyPath, surfaces: SegmentedMesh) -> None:
    """Write a new directory of ``1-head.stl``, ``2-left-ear.stl``, ...: label and name of each segment with faces.

    Positions are float32. Raises as ``new_directory``, and ``ValueError`` where no segment has faces.
    """
    solid = with_faces(surfaces)
    with new_directory(directory) as partial:
        for label, segment in solid:
            (partial / stl_name(label, segment.name)).write_bytes(_stl(segment))


def write_surface_stl(path: AnyPath, surfaces: SegmentedMesh) -> None:
    """Write all segments as one nameless surface; positions are float32."""
    vertices, faces, _ = surfaces.merged()
    write_file(path, _stl(Segment("", surfaces.colors[0], vertices, faces)))


def stl_name(label: int, name: str) -> str:
    """File name of a segment that every system takes: letters and digits of its name; the label keeps it unique."""
    words = re.sub(r"[^\w]+", "-", name).strip("-")
    return f"{label}-{words}.stl" if words else f"{label}.stl"


def _stl(segment: Segment) -> bytes:
    """File as trimesh writes it, but for its header: the name, where it is not too long for that."""
    mesh = trimesh.Trimesh(segment.vertices, segment.faces, process=False)
    content = trimesh.exchange.stl.export_stl(mesh)
    text = STL_NAME + segment.name.encode("utf-8")
    header = text if len(text) <= 80 and segment.name.isprintable() else b"written by mereo"
    return header.ljust(80) + content[80:]
