"""Segmented meshes from files: one file with named parts, several files, or a directory with one file per segment.

``read_segmented_mesh`` reads files for what they enclose; ``read_glb`` reads GLB files as a viewer shows them.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from mereo.geometry.conventions import LARGEST
from mereo.geometry.mesh import PALETTE, Color, Segment, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.errors import check_count, check_suffix, readable
from mereo.io.extras import library
from mereo.io.readers import check_ply

VIEWER_ROOT = "camera_frame"
"""Name of the root node of our own GLB files; below it, vertices are in the input's camera frame."""

STL_NAME = b"written by mereo: "
"""What the header of our own STL files says before the name of the segment."""

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".3mf")
"""Suffixes of mesh files that are read."""


def read_segmented_mesh(*paths: str | Path) -> SegmentedMesh:
    """Segments of one or more GLB, OBJ, 3MF, PLY, STL or OFF files, in label order; they are not checked.

    A file with several named parts (GLB nodes, OBJ objects or groups, 3MF objects) gives one segment each; a file with
    one part gives one segment called after its GLB node, or as our own STL files say, or else after the file. A
    directory stands for the mesh files in it, by name. Node transforms are applied, except the root of GLB files
    written by mereo: those come back in the camera frame. Vertices at the same position are merged, because exporters
    split them at normals and texture seams, which would open a closed mesh.

    Raises ``FileNotFoundError``, ``ValueError`` where a file is of another format, damaged or without faces, or two
    segments have the same name, and ``ImportError`` for a 3MF file without the extra `cad`.
    """
    parts = list[Part]()
    for path in map(Path, paths):
        files = [path]
        if path.is_dir() and not (files := sorted(f for f in path.iterdir() if f.suffix.lower() in MESH_SUFFIXES)):
            raise ValueError(f"{path} has no mesh files; a {', '.join(MESH_SUFFIXES)} per segment is needed: add them")
        parts += [part for file in files for part in _parts(file)]
    segments = (
        Segment(name, color or PALETTE[index % len(PALETTE)], vertices, faces)
        for index, (name, color, vertices, faces) in enumerate(parts)
    )
    return SegmentedMesh(tuple(segments))


Part = tuple[str, Color | None, Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Part of a mesh file: name, colour if known, vertices, faces."""


def _parts(path: Path) -> list[Part]:
    suffix = path.suffix.lower()
    check_suffix(path, MESH_SUFFIXES, "mesh")
    if suffix == ".3mf":
        library("lxml", "cad", path)
    with readable(path, "mesh"):
        if suffix == ".ply":
            check_ply(path)
        if suffix == ".off":
            _check_off(path)
        parts = _obj_parts(path) if suffix == ".obj" else _scene_parts(path)
        if not parts:
            raise ValueError("it has no faces")
        for name, _, vertices, _ in parts:
            _check_places(name, vertices)
    return parts


def _check_places(name: str, vertices: Float[np.ndarray, "v 3"]) -> None:
    if not (np.abs(vertices) <= LARGEST).all():
        raise ValueError(f"its part {name!r} has vertices that are NaN, infinite or beyond {LARGEST:g}")


def _check_off(path: Path) -> None:
    """Raise ``ValueError`` for an OFF file that was cut short, of which trimesh would return a part."""
    text = re.sub(r"#.*", "", path.read_text("utf-8", errors="replace"))
    head = re.match(r"\s*[A-Za-z0-9]*OFF\s+(-?\d+)\s+(-?\d+).*", text)
    if head is None:
        raise ValueError("it has no OFF header")
    vertices, faces = int(head[1]), int(head[2])
    rows = len([line for line in text[head.end() :].splitlines() if line.strip()])
    check_count(vertices, rows, "vertices")
    check_count(faces, rows - vertices, "faces")


def _obj_parts(path: Path) -> list[Part]:
    """Parts of an OBJ file, parsed here because trimesh gives them in no stable order. Polygons become fans."""
    positions: list[list[float]] = []
    faces: list[list[int]] = []
    owners: list[tuple[str, str, str]] = []
    name = {"o": "", "g": "", "usemtl": "", "mtllib": ""}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *cells = line.split() or [""]
        if kind == "v":
            positions.append([float(cell) for cell in cells[:3]])
        elif kind in name:
            name[kind] = " ".join(cells)
        elif kind == "f":
            corners = [_obj_index(cell, len(positions)) for cell in cells]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
            owners += [(name["o"], name["g"], name["usemtl"])] * (len(corners) - 2)
    colors = _material_colors(path, name["mtllib"])
    return _split_parts(np.asarray(positions), np.asarray(faces, dtype=np.int64), owners, colors, path.stem)


def _obj_index(cell: str, count: int) -> int:
    """Index of a vertex from ``vertex/texture/normal``, counted from 1, or from the end when negative."""
    index = int(cell.split("/")[0])
    index += -1 if index > 0 else count
    if not 0 <= index < count:
        raise ValueError(f"a face refers to vertex {cell} of {count}")
    return index


def _split_parts(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    owners: list[tuple[str, str, str]],
    colors: dict[str, Color],
    stem: str,
) -> list[Part]:
    """Parts of a file, with the colour of all faces: one per object, or per group where there is only one object."""
    level = 0 if len({key[0] for key in owners}) > 1 else 1
    labels = [key[level] or key[0] for key in owners]
    names, parts = list(dict.fromkeys(labels)), list[Part]()
    for name in names:
        rows = [row for row, label in enumerate(labels) if label == name]
        used, local = np.unique(faces[rows], return_inverse=True)
        worn = {colors.get(owners[row][2]) for row in rows}
        color = worn.pop() if len(worn) == 1 else None
        title = name if name and len(names) > 1 else stem
        parts.append((title, color, *merge_positions(vertices[used], local.reshape(-1, 3))))
    return parts


def _material_colors(mesh: Path, library: str) -> dict[str, Color]:
    """Diffuse colour (``Kd``, taken as that on the screen) of each material without a texture in an OBJ file's library.

    Only a file in the same folder is read, because a downloaded mesh should not choose which files are opened.
    """
    path = mesh.parent / library
    if not library or Path(library).name != library or not path.is_file():
        return {}
    colors, textured, name = dict[str, Color](), set[str](), ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *cells = line.split() or [""]
        if kind == "newmtl":
            name = " ".join(cells)
        elif kind == "map_Kd":
            textured.add(name)
        elif kind == "Kd":
            with suppress(ValueError):  # of a spectral curve, CIE XYZ, damage
                red, green, blue = map(float, cells)
                if min(red, green, blue) >= 0 and max(red, green, blue) <= 1:
                    colors[name] = round(255 * red), round(255 * green), round(255 * blue)
    return {name: color for name, color in colors.items() if name not in textured}


def _scene_parts(path: Path) -> list[Part]:
    scene: Any = trimesh.load_scene(path, process=False)
    base = VIEWER_ROOT if VIEWER_ROOT in scene.graph.nodes else scene.graph.base_frame
    nodes, parts = _nodes_with_faces(scene), list[Part]()
    for node in nodes:
        vertices, faces, geometry = _in_frame(scene, node, base)
        # a file without names gets its own name as the node's
        is_unnamed = len(nodes) == 1 and (node.startswith("geometry_") or Path(node).stem == path.stem)
        parts.append((path.stem if is_unnamed else node, _color(geometry), *merge_positions(vertices, faces)))
    if path.suffix.lower() == ".stl":
        with path.open("rb") as file:
            header = file.read(80)
        name = header.removeprefix(STL_NAME).decode("utf-8", errors="replace").strip()
        if header.startswith(STL_NAME) and name:
            return [(name, *rest) for _, *rest in parts]  # type: ignore[misc]
    return parts


def _nodes_with_faces(scene: Any) -> list[str]:
    """Nodes with faces in the file's order, which makes the labels; the graph has them in none."""
    order = {key: index for index, key in enumerate(scene.geometry)}
    keys = {node: scene.graph[node][1] for node in scene.graph.nodes_geometry}
    nodes = [node for node, key in keys.items() if len(getattr(scene.geometry[key], "faces", ())) > 0]
    return sorted(nodes, key=lambda node: (order[keys[node]], node))


def _in_frame(scene: Any, node: str, base: str) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Any]:
    """Vertices of a node in the frame of another one, its faces, and trimesh's geometry."""
    transform, key = scene.graph.get(node, frame_from=base)
    geometry = scene.geometry[key]
    vertices = np.asarray(geometry.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(geometry.faces, dtype=np.int64)
    if np.linalg.det(transform[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return vertices, faces, geometry


def _color(geometry: Any) -> Color | None:
    """Colour of a part: the exact one of our own files, else a material's or uniform vertex colour, else none."""
    stated = geometry.metadata.get("color")
    if stated is not None:
        return int(stated[0]), int(stated[1]), int(stated[2])
    if not geometry.visual.defined or geometry.visual.kind == "texture":
        return None
    red, green, blue = (int(value) for value in geometry.visual.main_color[:3])
    return red, green, blue


def merge_positions(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Merge vertices at exactly the same position, in order of first use, and drop the faces this collapses."""
    first, index = _distinct(vertices)
    if len(first) == len(vertices):
        return vertices, faces
    merged = index[faces]
    proper = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    return vertices[first], merged[proper]


def _distinct(rows: Float[np.ndarray, "v k"]) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " v"]]:
    """First of each group of equal rows, in their order, and which of these each row is."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.reshape(-1)]


# --- GLB files as a viewer shows them ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GlbScene:
    """Content of a GLB file.

    Attributes:
        mesh: each node with faces as a segment, its vertices merged where they have the same place and colour; of our
            own files in the input's frame and unit, of others in glTF's, metres and y up.
        colors: of the vertices of each, where it has several; None where it has one.
        radii: how sure the surfaces are, where our own file says it.
        rotation: from the vertices' frame to glTF's.
        unit_m: metres per unit of the vertices.
        is_ours: whether mereo wrote the file.
    """

    mesh: SegmentedMesh
    colors: tuple[UInt8[np.ndarray, "_ 3"] | None, ...]
    radii: Radii | None
    rotation: Float[np.ndarray, "3 3"]
    unit_m: float
    is_ours: bool


def is_glb(path: Path) -> bool:
    """Whether a path names a GLB file."""
    return path.suffix.lower() == ".glb"


def read_glb(path: str | Path) -> GlbScene:
    """Meshes of any GLB file; raises ``FileNotFoundError``, and ``ValueError`` where it is damaged or has no faces."""
    path = Path(path)
    with readable(path, "GLB file"):
        scene: Any = trimesh.load_scene(path, process=False)
        is_ours = VIEWER_ROOT in scene.graph.nodes
        base = VIEWER_ROOT if is_ours else scene.graph.base_frame
        root = np.asarray(scene.graph.get(VIEWER_ROOT)[0] if is_ours else np.eye(4), dtype=np.float64)[:3, :3]
        nodes = _nodes_with_faces(scene)
        if not nodes:
            raise ValueError("it has no faces")
        parts = (_glb_part(scene, node, base, number, path.stem) for number, node in enumerate(nodes))
        segments, colors, radii, calibrated = zip(*parts, strict=True)
        unit_m = float(abs(np.linalg.det(root)) ** (1 / 3))
        if not unit_m > 0:
            raise ValueError("its root node has a scale of 0")
        mesh = SegmentedMesh(_renamed(segments))
        return GlbScene(mesh, colors, _radii(segments, radii, all(calibrated)), root / unit_m, unit_m, is_ours)


def _glb_part(
    scene: Any, node: str, base: str, number: int, stem: str
) -> tuple[Segment, UInt8[np.ndarray, "v 3"] | None, Float[np.ndarray, " v"] | None, bool]:
    """Segment of a node with faces, colours of its vertices, their radii, and whether these are calibrated."""
    vertices, faces, geometry = _in_frame(scene, node, base)
    _check_places(node, vertices)
    color, colors = _colors(geometry, PALETTE[number % len(PALETTE)])
    radii = geometry.vertex_attributes.get("_RADIUS95")
    facts = geometry.metadata.get("radius95")
    kept, index = _distinct(vertices if colors is None else np.column_stack([vertices, colors]))
    return (
        Segment(stem if node.startswith("geometry_") else node, color, vertices[kept], index[faces], solid=False),
        None if colors is None else colors[kept],
        None if radii is None else np.asarray(radii, dtype=np.float64).reshape(-1)[kept],
        isinstance(facts, dict) and facts.get("calibrated") is True,
    )


def _colors(geometry: Any, plain: Color) -> tuple[Color, UInt8[np.ndarray, "v 3"] | None]:
    """One colour of a mesh, and those of its vertices where they have several; as a screen shows them."""
    visual, count = geometry.visual, len(geometry.vertices)
    material = getattr(visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    tint = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    each = None
    painted = getattr(visual, "vertex_attributes", {}).get("color")
    painted = visual.vertex_colors if painted is None and visual.kind == "vertex" else painted
    if painted is not None and len(painted) == count:
        share = np.asarray(painted)[:, :3] / (255.0 if np.asarray(painted).dtype == np.uint8 else 1.0)
        each = _screen(share * tint)
    elif getattr(material, "baseColorTexture", None) is not None and getattr(visual, "uv", None) is not None:
        each = np.asarray(visual.to_color().vertex_colors)[:, :3].astype(np.uint8)
    color = geometry.metadata.get("color")
    if color is None and each is not None:
        color = each.mean(axis=0)
    elif color is None:
        color = plain if factor is None else _screen(tint[None])[0]
    varied = each is not None and (each != each[0]).any()
    return (int(color[0]), int(color[1]), int(color[2])), each if varied else None


def _screen(linear: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a screen from linear light (glTF 2.0, section 3.9.2)."""
    light = np.clip(linear, 0.0, 1.0)
    share = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * share).astype(np.uint8)


def _renamed(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    """Segments of which no two have the same name: repeated ones are numbered."""
    names: list[str] = []
    for segment in segments:
        tries = (segment.name if n == 1 else f"{segment.name} ({n})" for n in range(1, len(segments) + 1))
        names.append(next(name for name in tries if name not in names))
    return tuple(replace(segment, name=name) for segment, name in zip(segments, names, strict=True))


def _radii(
    segments: Sequence[Segment], radii: Sequence[Float[np.ndarray, " _"] | None], calibrated: bool
) -> Radii | None:
    values = [each for each in radii if each is not None and np.isfinite(each).all()]
    if len(values) < len(segments):
        return None
    counts = tuple(len(value) for value in values)
    labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
    points = np.concatenate([segment.vertices for segment in segments])
    return Radii(points, labels, np.concatenate(values), counts, calibrated)
