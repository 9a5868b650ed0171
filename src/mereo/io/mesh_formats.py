"""Segmented meshes from files: one file with named parts, several files, or a directory with one file per segment."""

import re
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int

from mereo.geometry.mesh import PALETTE, Color, Segment, SegmentedMesh
from mereo.io.errors import check_count, readable
from mereo.io.material_colors import material_colors
from mereo.io.point_cloud_formats import check_ply

VIEWER_ROOT = "camera_frame"
"""Name of the root node of our own GLB files; below it, vertices are in the input's camera frame."""

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".3mf")
"""Suffixes of mesh files that are read."""


def read_segmented_mesh(*paths: str | Path) -> SegmentedMesh:
    """Segments of one or more GLB, OBJ, 3MF, PLY, STL or OFF files, in label order.

    A file with several named parts (GLB nodes, OBJ objects or groups, 3MF objects) gives one segment each; a file with
    one part gives one segment called after its GLB node, or as our own STL files say, or else after the file. A
    directory stands for the mesh files in it, by name.
    Node transforms are applied, except the root of GLB files written by mereo: those come back in the camera frame.
    Vertices at the same position are merged, because exporters split them at normals and texture seams, which would
    open a closed mesh. ``SegmentedMesh.check`` is left to the caller.

    Raises:
        FileNotFoundError, ValueError: a file is missing, of another format, damaged or without faces, or two segments
            have the same name.
        ImportError: a 3MF file, without the extra `cad`.
    """
    files = [file for path in paths for file in _mesh_files(Path(path))]
    parts = [part for file in files for part in _parts(file)]
    segments = (
        Segment(name, color or PALETTE[index % len(PALETTE)], vertices, faces)
        for index, (name, color, vertices, faces) in enumerate(parts)
    )
    return SegmentedMesh(tuple(segments))


def _mesh_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise ValueError(f"{path} has no mesh files; one of {', '.join(MESH_SUFFIXES)} per segment is needed: add them")
    return files


Part = tuple[str, Color | None, Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Part of a mesh file: name, colour if known, vertices, faces."""


def _parts(path: Path) -> list[Part]:
    if path.exists() and path.suffix.lower() not in MESH_SUFFIXES:
        known = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"{path} has the suffix {path.suffix!r}; a mesh is one of {known}: convert or rename it")
    if path.suffix.lower() == ".3mf" and find_spec("lxml") is None:
        raise ImportError(f"{path} needs lxml, which reads 3MF files and is not installed: pip install 'mereo[cad]'")
    with readable(path, "mesh"):
        if path.suffix.lower() in CHECKS:
            CHECKS[path.suffix.lower()](path)
        parts = _obj_parts(path) if path.suffix.lower() == ".obj" else _scene_parts(path)
        if not parts:
            raise ValueError("it has no faces")
    return parts


def _check_off(path: Path) -> None:
    """Raise ``ValueError`` for an OFF file that was cut short, of which trimesh would return a part."""
    lines = (line.partition("#")[0].strip() for line in path.read_text("utf-8", errors="replace").splitlines())
    rows = [line for line in lines if line]
    keyword = re.match(r"[A-Za-z0-9]*OFF\b", rows[0]) if rows else None
    if keyword is None:
        raise ValueError("it has no OFF header")
    rest = rows[0][keyword.end() :].split()
    counts, body = (rest, rows[1:]) if rest else (rows[1].split(), rows[2:])
    vertices, faces = int(counts[0]), int(counts[1])
    check_count(vertices, len(body), "vertices")
    check_count(faces, len(body) - vertices, "faces")


CHECKS: dict[str, Callable[[Path], None]] = {".ply": check_ply, ".off": _check_off}
"""Check of the formats of which trimesh returns a part where a text file was cut short."""


STL_NAME = b"written by mereo: "
"""What the header of our own STL files says before the name of the segment."""


def stl_segment_name(path: Path) -> str | None:
    """Name of the segment in an STL file that mereo wrote; None for another one."""
    with path.open("rb") as file:
        header = file.read(80)
    if not header.startswith(STL_NAME):
        return None
    return header.removeprefix(STL_NAME).decode("utf-8", errors="replace").strip() or None


def _obj_parts(path: Path) -> list[Part]:
    """Parts of an OBJ file, by an own parser because trimesh gives them in no stable order. Polygons become fans."""
    positions: list[list[float]] = []
    faces: list[list[int]] = []
    owners: list[tuple[str, str]] = []
    dyes: list[str] = []
    name, library = {"o": "", "g": "", "usemtl": ""}, ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *cells = line.split() or [""]
        if kind == "v":
            positions.append([float(cell) for cell in cells[:3]])
        elif kind in name:
            name[kind] = " ".join(cells)
        elif kind == "mtllib":
            library = " ".join(cells)
        elif kind == "f":
            corners = [_obj_index(cell, len(positions)) for cell in cells]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
            owners += [(name["o"], name["g"])] * (len(corners) - 2)
            dyes += [name["usemtl"]] * (len(corners) - 2)
    known = material_colors(path, library)
    colors = [known.get(material) for material in dyes]
    return _split_parts(np.asarray(positions), np.asarray(faces, dtype=np.int64), owners, colors, path.stem)


def _obj_index(cell: str, count: int) -> int:
    """Index of a vertex from ``vertex/texture/normal``, counted from 1, or from the end when negative."""
    index = int(cell.split("/")[0])
    index = index - 1 if index > 0 else count + index
    if not 0 <= index < count:
        raise ValueError(f"a face refers to vertex {cell} of {count}")
    return index


def _split_parts(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    owners: list[tuple[str, str]],
    colors: list[Color | None],
    stem: str,
) -> list[Part]:
    """Parts of a file: one per object, or per group where there is only one object; unused vertices are left out.

    A part has a colour where all its faces have that one.
    """
    level = 0 if len({key[0] for key in owners}) > 1 else 1
    labels = [key[level] or key[0] for key in owners]
    names = list(dict.fromkeys(labels))
    index = np.asarray([names.index(label) for label in labels], dtype=np.int64)
    parts: list[Part] = []
    for i, name in enumerate(names):
        used, local = np.unique(faces[index == i], return_inverse=True)
        worn = {color for color, label in zip(colors, labels, strict=True) if label == name}
        color = worn.pop() if len(worn) == 1 else None
        title = name if name and len(names) > 1 else stem
        parts.append((title, color, *merge_positions(vertices[used], local.reshape(-1, 3))))
    return parts


def _scene_parts(path: Path) -> list[Part]:
    scene: Any = trimesh.load_scene(path, process=False)
    # the graph's nodes come in no order; the file's order makes the labels
    order = {key: index for index, key in enumerate(scene.geometry)}
    nodes = [node for node in scene.graph.nodes_geometry if _has_faces(scene, node)]
    nodes.sort(key=lambda node: (order[scene.graph[node][1]], node))
    parts = [_part(scene, node, path.stem if len(nodes) == 1 else "") for node in nodes]
    own = stl_segment_name(path) if path.suffix.lower() == ".stl" else None
    return parts if own is None else [(own, color, vertices, faces) for _, color, vertices, faces in parts]


def _has_faces(scene: Any, node: str) -> bool:
    return len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) > 0


def _part(scene: Any, node: str, stem: str) -> Part:
    base = VIEWER_ROOT if VIEWER_ROOT in scene.graph.nodes else scene.graph.base_frame
    transform, key = scene.graph.get(node, frame_from=base)
    geometry = scene.geometry[key]
    vertices = np.asarray(geometry.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(geometry.faces, dtype=np.int64)
    if np.linalg.det(transform[:3, :3]) < 0:
        faces = faces[:, ::-1]
    # a file without names gets its own name as the node's
    unnamed = node.startswith("geometry_") or Path(node).stem == stem
    return (stem if stem and unnamed else node, _color(geometry), *merge_positions(vertices, faces))


def _color(geometry: Any) -> Color | None:
    """Colour of a part: the exact one of our own files, else a material's or uniform vertex colour, else none."""
    own = geometry.metadata.get("color")
    if own is not None:
        return int(own[0]), int(own[1]), int(own[2])
    if not geometry.visual.defined or geometry.visual.kind == "texture":
        return None
    red, green, blue = (int(value) for value in geometry.visual.main_color[:3])
    return red, green, blue


def merge_positions(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Merge vertices at exactly the same position, in order of first use, and drop the faces this collapses."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(vertices):
        return vertices, faces
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    merged = rank[inverse.reshape(-1)][faces]
    proper = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    return vertices[first[order]], merged[proper]
