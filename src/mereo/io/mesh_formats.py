"""Segmented meshes from files: one file with named parts, several files, or a directory with one file per segment.

``read_segmented_mesh`` reads files for what they enclose; ``read_glb`` reads GLB files as a viewer shows them.
"""

import json
import re
import warnings
from base64 import b64decode
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from zipfile import ZipFile

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from numpy.linalg import det

from mereo.geometry.conventions import LARGEST
from mereo.geometry.mesh import (
    PALETTE,
    AnyFaces,
    ChangedMesh,
    Color,
    Colors,
    Faces,
    Segment,
    SegmentedMesh,
    Vertices,
    edge_imbalance,
    palette_color,
    three_cornered,
    with_used_vertices,
)
from mereo.geometry.mesh_repair import simplified
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import AnyPoints, Matrix, Points, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.errors import AnyPath, check_count, check_size, check_suffix, readable
from mereo.io.extras import library
from mereo.io.progress import stage
from mereo.io.readers import check_ply, lies_below

VIEWER_ROOT = "camera_frame"
"""Name of the root node of our own GLB files; below it, vertices are in the input's camera frame."""

STL_NAME = b"written by mereo: "
"""What the header of our own STL files says before the name of the segment."""

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".3mf", ".dae")
"""Suffixes of mesh files that are read."""

EXTRAS = {".3mf": ("lxml", "cad"), ".dae": ("collada", "robot")}
"""Libraries that some need, and the extras that have them."""


class MeshWarning(UserWarning):
    """Warning that a mesh is used, but not as its file may mean it."""


def read_segmented_mesh(*paths: AnyPath) -> SegmentedMesh:
    """Segments of one or more GLB, OBJ, 3MF, DAE, PLY, STL or OFF files, in label order; they are not checked.

    A file with several named parts (GLB nodes and their instances, OBJ objects or groups, 3MF objects) gives one
    segment each; a file with one part gives one segment called after its GLB node, or as our own STL files say, or else
    after the file. Materials are parts where each of them is closed by itself: those of one GLB node, and of an OBJ
    file without objects and groups; of such a file whose materials are not, a ``MeshWarning`` says so. A directory
    stands for the mesh files in it, by name. Node transforms are applied, except the root of GLB files written by
    mereo: those come back in the camera frame. DAE files come in metres, by the unit that they state, and in their own
    axes whichever is up, as RViz has them. Vertices at the same position are merged, because exporters split them
    at normals and texture seams, which would open a closed mesh. Other files are opened only where a glTF file names
    them as buffers, and an OBJ file for its materials' colours, and only in the same folder or below.

    Raises ``FileNotFoundError``, ``ValueError`` where a file is of another format, damaged or without faces, or two
    segments have the same name, and ``ImportError`` for a 3MF or DAE file without the extra `cad` or `robot`.
    """
    parts = list[Part]()
    for path in map(Path, paths):
        files = [path]
        if path.is_dir() and not (files := sorted(f for f in path.iterdir() if f.suffix.lower() in MESH_SUFFIXES)):
            raise ValueError(f"{path} has no mesh files; a {', '.join(MESH_SUFFIXES)} per segment is needed: add them")
        parts += [part for file in files for part in _parts(file)]
    segments = (
        Segment(name, color or palette_color(index), vertices, faces)
        for index, (name, color, vertices, faces) in enumerate(parts)
    )
    return SegmentedMesh(tuple(segments))


def read_object_mesh(path: AnyPath) -> SegmentedMesh:
    """Segments of a file, or of a folder's files, for an object that is to be found; raises as ``read_segmented_mesh``.

    Solids of more than ``mesh_repair.MOST_FACES`` faces are simplified, and a ``MeshWarning`` says how far. What was
    read before is kept, as long as its files are the same.
    """
    path = Path(path)
    states = [
        (file.name, file.stat()) for file in (sorted(path.iterdir()) if path.is_dir() else [path]) if file.exists()
    ]
    return _kept_mesh(_Known(path, tuple((name, s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns) for name, s in states)))


@dataclass(frozen=True)
class _Known:
    """Place of files, by whatever path, whose names and states on the disk are known."""

    path: Path = field(compare=False)
    states: tuple[tuple[str | int, ...], ...]


@lru_cache(maxsize=64)
def _kept_mesh(known: _Known) -> SegmentedMesh:
    path = known.path
    with stage(f"read {path}"):
        mesh = read_segmented_mesh(path)
        segments = list[Segment]()
        for segment in mesh.segments:
            fewer, way = simplified(segment)
            segments.append(fewer)
            if fewer is not segment:
                text = f"{path} has {len(segment.faces):,} faces in {segment.name!r}; it is taken with "
                text += f"{len(fewer.faces):,}, at most {way:.2g} of its units away from them"
                warnings.warn(text, MeshWarning, stacklevel=4)
    return replace(mesh, segments=tuple(segments))


Part = tuple[str, Color | None, AnyPoints, AnyFaces]
"""Part of a mesh file: name, colour if known, vertices, faces."""


def _parts(path: Path) -> list[Part]:
    suffix = path.suffix.lower()
    check_suffix(path, MESH_SUFFIXES, "mesh")
    if suffix in EXTRAS:
        library(*EXTRAS[suffix], path)
    with readable(path, "mesh"):
        if suffix == ".ply":
            check_ply(path)
        if suffix == ".off":
            _check_off(path)
        if suffix == ".3mf":
            with ZipFile(path) as archive:  # no more than it states can come out of it
                check_size(path, sum(entry.file_size for entry in archive.infolist()))
        parts = _obj_parts(path) if suffix == ".obj" else _scene_parts(path)
        if not any(len(faces) for _, _, _, faces in parts):
            raise ValueError("it has no faces of three different places" if parts else "it has no faces")
        for name, _, vertices, _ in parts:
            _check_places(name, vertices)
    return parts


def _check_places(name: str, vertices: Vertices) -> None:
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


Owners = list[tuple[str, str, str]]
"""Of each face of an OBJ file its object, group and material."""


def _obj_parts(path: Path) -> list[Part]:
    """Parts of an OBJ file, parsed here because trimesh gives them in no stable order. Polygons become fans."""
    positions = list[list[float]]()
    faces = list[list[int]]()
    owners: Owners = []
    name = {"o": "", "g": "", "usemtl": "", "mtllib": ""}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        kind, *cells = line.split() or [""]
        if kind in ("v", "f") and len(cells) < 3:
            raise ValueError(f"its line {number} is {line.strip()[:40]!r}; a vertex or face has three entries or more")
        if kind == "v":
            positions.append([float(cell) for cell in cells[:3]])
        elif kind in name:
            name[kind] = " ".join(cells)
        elif kind == "f":
            corners = [_obj_index(cell, len(positions)) for cell in cells]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
            owners += [(name["o"], name["g"], name["usemtl"])] * (len(corners) - 2)
    colors = _material_colors(path, name["mtllib"])
    vertices, triangles = np.asarray(positions), np.asarray(faces, np.int64)
    if materials := _material_parts(vertices, triangles, owners, path):
        owners = materials
    return _split_parts(vertices, triangles, owners, colors, path.stem)


def _material_parts(vertices: Vertices, faces: Faces, owners: Owners, path: Path) -> Owners:
    """Owners of which materials are the objects, in a file without others; none where these are not closed parts."""
    names = list(dict.fromkeys(material for _, _, material in owners))
    if len(names) < 2 or any(name or group for name, group, _ in owners):
        return []
    index = np.array([names.index(material) for _, _, material in owners])
    _, place = _distinct(vertices)
    if all(edge_imbalance(place[faces[index == each]]) == (0, 0) for each in range(len(names))):
        return [(material or path.stem, "", material) for _, _, material in owners]
    text = f"{path} has {len(names)} materials, which are no closed parts, but no objects or groups; it is one segment"
    warnings.warn(f"{text}: where it is several, export each as an object", MeshWarning, stacklevel=5)
    return []


def _obj_index(cell: str, count: int) -> int:
    """Index of a vertex from ``vertex/texture/normal``, counted from 1, or from the end when negative."""
    index = int(cell.split("/")[0])
    index += -1 if index > 0 else count
    if not 0 <= index < count:
        raise ValueError(f"a face refers to vertex {cell} of {count}")
    return index


def _split_parts(
    vertices: Vertices,
    faces: Faces,
    owners: Owners,
    colors: dict[str, Color],
    stem: str,
) -> list[Part]:
    """Parts of a file, with the colour of all faces: one per object, or per group where there is only one object."""
    level = 0 if len({key[0] for key in owners}) > 1 else 1
    labels = [key[level] or key[0] for key in owners]
    names = list(dict.fromkeys(labels))
    parts = list[Part]()
    for name in names:
        rows = [row for row, label in enumerate(labels) if label == name]
        worn = {colors.get(owners[row][2]) for row in rows}
        color = worn.pop() if len(worn) == 1 else None
        title = name if name and len(names) > 1 else stem
        parts.append((title, color, *merge_positions(*with_used_vertices(vertices, faces[rows]))))
    return parts


def _material_colors(mesh: Path, library: str) -> dict[str, Color]:
    """Diffuse colour (``Kd``, taken as that on the screen) of each material without a texture in an OBJ file's library.

    A library that is no file in the mesh's folder or below is left alone, as if the materials had no colours.
    """
    path = None
    with suppress(ValueError, OSError, RuntimeError):  # the last of links in a circle
        path = _neighbour(mesh, library)
    if path is None:
        return {}
    colors = dict[str, Color]()
    textured = set[str]()
    name = ""
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


def _neighbour(path: Path, name: str) -> Path:
    """File that a mesh file names; raises ``ValueError`` (its reason only) unless it lies in its folder or below."""
    file = path.parent / name
    if not lies_below(path.parent, file):
        raise ValueError(f"it names {name[:100]!r}, which is no regular file in its folder or below")
    return file


def _scene_parts(path: Path) -> list[Part]:
    scene = _load_scene(path)
    base = VIEWER_ROOT if VIEWER_ROOT in scene.graph.nodes else scene.graph.base_frame
    nodes = _nodes_with_faces(scene)
    parts = list[Part]()
    is_dae = path.suffix.lower() == ".dae"
    unit_m = trimesh.units.unit_conversion(scene.units, "meters") if is_dae and nodes else 1.0
    for node in nodes:
        vertices, faces, geometry = _in_frame(scene, node, base)
        vertices *= unit_m
        # a file without names gets its own name as the node's
        is_unnamed = len(nodes) == 1 and (node.startswith("geometry_") or Path(node).stem == path.stem)
        parts.append((path.stem if is_unnamed else node, _color(geometry), *merge_positions(vertices, faces)))
    nodes_parts = [list(group) for _, group in groupby(parts, (lambda _: "") if is_dae else _node_of)]
    parts = [part for group in nodes_parts for part in _whole_parts(group)]  # trimesh does not name the nodes of DAE
    names = _numbered([name for name, *_ in parts])
    parts = [(name, *rest) for name, (_, *rest) in zip(names, parts, strict=True)]  # type: ignore[misc]
    if path.suffix.lower() == ".stl":
        with path.open("rb") as file:
            header = file.read(80)
        name = header.removeprefix(STL_NAME).decode("utf-8", errors="replace").strip()
        if header.startswith(STL_NAME) and name:
            return [(name, *rest) for _, *rest in parts]  # type: ignore[misc]
    return parts


def _load_scene(path: Path) -> Any:
    """trimesh's scene of a file; no other file is opened but the buffers of glTF."""
    if path.suffix.lower() not in (".glb", ".gltf"):
        strict: JsonObject = {"ignore_broken": False} if path.suffix.lower() == ".dae" else {}
        return trimesh.load_scene(path, resolver={}, process=False, **strict)
    tree, buffers = _plain_gltf(path)
    return trimesh.load_scene(BytesIO(json.dumps(tree).encode()), "gltf", buffers, process=False)


def _node_of(part: Part) -> str:
    """Name of a node with its number, of which the part may be one material."""
    return part[0].rpartition(MATERIAL)[0] or part[0]


def _joined(name: str) -> str:
    """Name of a node and of its material in one."""
    node, *more = name.split(MATERIAL)
    return "_".join((node, *more[1:]))


def _whole_parts(materials: list[Part]) -> list[Part]:
    """Materials of a node where each is closed by itself, else all of them as one part."""
    if len(materials) == 1 or all(edge_imbalance(faces) == (0, 0) for _, _, _, faces in materials):
        return [(_joined(name), *rest) for name, *rest in materials]  # type: ignore[misc]
    pieces = [Segment(name, color or PALETTE[0], vertices, faces) for name, color, vertices, faces in materials]
    vertices, faces, _ = SegmentedMesh(tuple(pieces)).merged()
    colors = {color for _, color, _, _ in materials}
    return [
        (
            materials[0][0].partition(MATERIAL)[0],
            colors.pop() if len(colors) == 1 else None,
            *merge_positions(vertices, faces),
        )
    ]


def _nodes_with_faces(scene: Any) -> list[str]:
    """Nodes with faces in the file's order, which makes the labels; the graph has them in none."""
    order = {key: index for index, key in enumerate(scene.geometry)}
    keys = {node: scene.graph[node][1] for node in scene.graph.nodes_geometry}
    nodes = [node for node, key in keys.items() if len(getattr(scene.geometry[key], "faces", ())) > 0]
    return sorted(nodes, key=lambda node: (order[keys[node]], node))


def _in_frame(scene: Any, node: str, base: str) -> tuple[Vertices, Faces, Any]:
    """Vertices of a node in the frame of another one, its faces, and trimesh's geometry."""
    transform, key = scene.graph.get(node, frame_from=base)
    geometry = scene.geometry[key]
    vertices = transform_points(transform, np.asarray(geometry.vertices, float))
    faces = np.asarray(geometry.faces, np.int64)
    if det(transform[:3, :3]) < 0:
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


def merge_positions(vertices: Vertices, faces: Faces) -> ChangedMesh:
    """Merge vertices at exactly the same position, in order of first use, and drop the faces this collapses."""
    first, index = _distinct(vertices)
    if len(first) == len(vertices):
        return vertices, faces
    merged = index[faces]
    return vertices[first], merged[three_cornered(merged)]


def _distinct(rows: Float[ndarray, "v k"]) -> tuple[Int[ndarray, " w"], Int[ndarray, " v"]]:
    """First of each group of equal rows, in their order, and which of these each row is."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.reshape(-1)]


# --- glTF as trimesh reads all of it ----------------------------------------------------------------------------------

MATERIAL = "\0"
"""What stands between the name of a node, its number, and that of a material where the node has several."""

INSTANCES = "EXT_mesh_gpu_instancing"

KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Components of glTF's accessors."""

Buffers = dict[str, bytes]
"""Content of the buffers of a glTF file, by their names."""


def _plain_gltf(path: Path) -> tuple[JsonObject, Buffers]:
    """JSON of a GLB or glTF file and its buffers, without what trimesh leaves out or takes for something else.

    Instances and the materials of a mesh become nodes of their own, and normalized or sparse positions become floats.
    Images in other files are not opened: shapes do not need them.
    """
    content = path.read_bytes()
    chunk = b""
    if content[:4] == b"glTF":
        start = 28 + int.from_bytes(content[12:16], "little")
        size = int.from_bytes(content[start - 8 : start - 4], "little")
        content, chunk = content[20 : start - 8], content[start : start + size]
        check_count(size, len(chunk), "bytes")
    tree = json.loads(content)
    for extension in (*tree.get("extensionsUsed", ()), *tree.get("extensionsRequired", ())):
        if "compression" in extension:
            raise ValueError(
                f"it is compressed by {extension}, which is not read: export it without compression, or open it in "
                "https://threejs.org/editor and export it there as GLB"
            )
    buffers = {str(n): _buffer(path, each.get("uri"), chunk) for n, each in enumerate(tree.get("buffers", ()))}
    for name, buffer in zip(buffers, tree.get("buffers", ()), strict=True):
        buffer["uri"] = name
    for mesh in tree.get("meshes", ()):
        for part in mesh["primitives"]:
            if part.get("mode") == 6:
                raise ValueError("it has triangle fans, which are not read: export triangles")
            accessor = tree["accessors"][part["attributes"]["POSITION"]]
            if accessor.get("normalized") or "sparse" in accessor:
                accessor.update(_stored(tree, buffers, _values(tree, buffers, accessor)), normalized=False)
                accessor.pop("sparse", None)
    for node in list(tree.get("nodes", ())):
        node.pop("camera", None)  # of the first one trimesh loses the children
        if "mesh" in node:
            _spread(tree, buffers, node)
    return tree, buffers


def _buffer(path: Path, uri: str | None, chunk: bytes) -> bytes:
    """Content of a buffer: the file's second chunk, text in it, or another file."""
    if uri is None:
        return chunk
    return b64decode(uri.partition(",")[2]) if uri.startswith("data:") else _neighbour(path, unquote(uri)).read_bytes()


def _values(tree: JsonObject, buffers: Buffers, accessor: JsonObject) -> Float[ndarray, "n k"]:
    """Values of an accessor (glTF 2.0, sections 3.6.2 and 5.1)."""
    kind = np.dtype(KINDS[accessor["componentType"]])
    width = WIDTHS[accessor["type"]]
    shape = accessor["count"], width
    values = np.zeros(shape)
    if "bufferView" in accessor:
        view = tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = view.get("byteStride", width * kind.itemsize), kind.itemsize
        values = ndarray(shape, kind, buffers[str(view["buffer"])], start, strides).astype(float)
    if sparse := accessor.get("sparse"):
        count = {"count": sparse["count"]}
        rows = _values(tree, buffers, {"type": "SCALAR"} | sparse["indices"] | count)[:, 0].astype(np.int64)
        same = {key: accessor[key] for key in ("componentType", "type")}
        values[rows] = _values(tree, buffers, same | sparse["values"] | count)
    return np.maximum(values / np.iinfo(kind).max, -1.0) if accessor.get("normalized") else values


def _stored(tree: JsonObject, buffers: Buffers, values: Points) -> JsonObject:
    """Accessor of values in a new buffer."""
    content = values.astype("<f4").tobytes()
    tree["bufferViews"].append({"buffer": len(buffers), "byteLength": len(content)})
    buffers[str(len(buffers))] = content
    tree["buffers"].append({"uri": str(len(buffers) - 1), "byteLength": len(content)})
    return {"bufferView": len(tree["bufferViews"]) - 1, "byteOffset": 0, "componentType": 5126}


def _spread(tree: JsonObject, buffers: Buffers, node: JsonObject) -> None:
    """Give a node's mesh to children, one for each instance and each of its materials, where it has several."""
    mesh = tree["meshes"][node["mesh"]]
    stated = node.get("extensions", {}).pop(INSTANCES, None)
    materials = mesh["primitives"]
    if mesh.get("name"):
        node.setdefault("name", mesh["name"])
    if stated is None and len(materials) == 1:
        return
    number = node.pop("mesh")
    title = node.get("name", "part")
    places = {
        key.lower(): _values(tree, buffers, tree["accessors"][index])
        for key, index in (stated or {}).get("attributes", {}).items()
        if key in ("TRANSLATION", "ROTATION", "SCALE")
    }
    for row in range(max(map(len, places.values()), default=1)):
        place = {key: values[row].tolist() for key, values in places.items()}
        name = title if stated is None else f"{title}_{row + 1}"
        first = str(len(tree["nodes"]))
        for index, part in enumerate(materials):
            child = {"mesh": number, "name": name, **place}
            if len(materials) > 1:
                look = tree["materials"][part["material"]] if "material" in part else {}
                words = name, first, look.get("name") or str(index + 1)
                child |= {"mesh": len(tree["meshes"]), "name": MATERIAL.join(words)}
                tree["meshes"].append({**mesh, "primitives": [part]})
            node.setdefault("children", []).append(len(tree["nodes"]))
            tree["nodes"].append(child)


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
    colors: tuple[UInt8[ndarray, "_ 3"] | None, ...]
    radii: Radii | None
    rotation: Matrix
    unit_m: float
    is_ours: bool


def is_glb(path: Path) -> bool:
    """Whether a path names a GLB file."""
    return path.suffix.lower() == ".glb"


def read_glb(path: AnyPath) -> GlbScene:
    """Meshes of any GLB file; raises ``FileNotFoundError``, and ``ValueError`` where it is damaged or has no faces."""
    path = Path(path)
    with readable(path, "GLB file"):
        scene = _load_scene(path)
        is_ours = VIEWER_ROOT in scene.graph.nodes
        base = VIEWER_ROOT if is_ours else scene.graph.base_frame
        root = np.asarray(scene.graph.get(VIEWER_ROOT)[0] if is_ours else np.eye(4), float)[:3, :3]
        nodes = _nodes_with_faces(scene)
        if not nodes:
            raise ValueError("it has no faces")
        parts = (_glb_part(scene, node, base, number, path.stem) for number, node in enumerate(nodes))
        segments, colors, radii, calibrated = zip(*parts, strict=True)
        unit_m = float(abs(det(root)) ** (1 / 3))
        if not unit_m > 0:
            raise ValueError("its root node has a scale of 0")
        names = _numbered([segment.name for segment in segments])
        mesh = SegmentedMesh(tuple(replace(each, name=name) for each, name in zip(segments, names, strict=True)))
        return GlbScene(mesh, colors, _radii(segments, radii, all(calibrated)), root / unit_m, unit_m, is_ours)


def _glb_part(
    scene: Any, node: str, base: str, number: int, stem: str
) -> tuple[Segment, UInt8[ndarray, "v 3"] | None, Float[ndarray, " v"] | None, bool]:
    """Segment of a node with faces, colours of its vertices, their radii, and whether these are calibrated."""
    vertices, faces, geometry = _in_frame(scene, node, base)
    _check_places(node, vertices)
    color, colors = _colors(geometry, palette_color(number))
    radii = geometry.vertex_attributes.get("_RADIUS95")
    facts = geometry.metadata.get("radius95")
    name = stem if node.startswith("geometry_") else _joined(node)
    kept, index = _distinct(vertices if colors is None else np.column_stack([vertices, colors]))
    return (
        Segment(name, color, vertices[kept], index[faces], solid=False),
        None if colors is None else colors[kept],
        None if radii is None else np.asarray(radii, float).reshape(-1)[kept],
        isinstance(facts, dict) and facts.get("calibrated") is True,
    )


def _colors(geometry: Any, plain: Color) -> tuple[Color, UInt8[ndarray, "v 3"] | None]:
    """One colour of a mesh, and those of its vertices where they have several; as a screen shows them."""
    visual = geometry.visual
    count = len(geometry.vertices)
    material = getattr(visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    tint = np.ones(3) if factor is None else np.asarray(factor, float)[:3] / 255.0
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


def _screen(linear: Points) -> Colors:
    """Colours of a screen from linear light (glTF 2.0, section 3.9.2)."""
    light = np.clip(linear, 0.0, 1.0)
    share = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * share).astype(np.uint8)


def _numbered(given: Sequence[str]) -> list[str]:
    """Names of which no two are the same: repeated ones are numbered."""
    names = list[str]()
    for name in given:
        tries = (name if n == 1 else f"{name} ({n})" for n in range(1, len(given) + 1))
        names.append(next(name for name in tries if name not in names))
    return names


def _radii(segments: Sequence[Segment], radii: Sequence[Float[ndarray, " _"] | None], calibrated: bool) -> Radii | None:
    values = [each for each in radii if each is not None and np.isfinite(each).all()]
    if len(values) < len(segments):
        return None
    counts = tuple(len(value) for value in values)
    labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
    points = np.concatenate([segment.vertices for segment in segments])
    return Radii(points, labels, np.concatenate(values), counts, calibrated)
