"""GLB files as a viewer shows them: every mesh in its place, with its colours, and how sure our own files are.

    path -read_glb-> GlbScene

``io.mesh_formats`` reads the same files for what they enclose; here is what they look like.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from mereo.geometry.mesh import PALETTE, Color, Segment, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.errors import readable
from mereo.io.mesh_formats import VIEWER_ROOT

MOST_PARTS = 200
"""Meshes that are shown one by one; the others become one part, as labels are few."""

RADIUS = "_RADIUS95"
"""Attribute of the vertices of our own files."""


@dataclass(frozen=True, eq=False)
class GlbScene:
    """Content of a GLB file.

    Attributes:
        mesh: each node with faces as a segment, its vertices merged where they have the same place and colour. Those of
            our own files are in the input's frame and unit, others in glTF's, metres and y up.
        colors: of the vertices of each, where it has several; None where it has one.
        radii: how sure the surfaces are, where our own file says it.
        rotation: from the vertices' frame to glTF's.
        unit_m: metres per unit of the vertices.
        is_own: whether mereo wrote the file.
    """

    mesh: SegmentedMesh
    colors: tuple[UInt8[np.ndarray, "_ 3"] | None, ...]
    radii: Radii | None
    rotation: Float[np.ndarray, "3 3"]
    unit_m: float
    is_own: bool


@dataclass(frozen=True, eq=False)
class _Part:
    """Node with faces: its segment, colours of its vertices, their radii, and whether these are calibrated."""

    segment: Segment
    colors: UInt8[np.ndarray, "v 3"] | None
    radii: Float[np.ndarray, " v"] | None
    calibrated: bool


def is_glb(path: Path) -> bool:
    """Whether a path names a GLB file."""
    return path.suffix.lower() == ".glb"


def read_glb(path: str | Path) -> GlbScene:
    """Meshes of any GLB file.

    Raises ``FileNotFoundError`` where there is none, and ``ValueError`` for a damaged file or one without faces.
    """
    path = Path(path)
    with readable(path, "GLB file"):
        scene: Any = trimesh.load_scene(path, process=False)
        own = VIEWER_ROOT in scene.graph.nodes
        base = VIEWER_ROOT if own else scene.graph.base_frame
        root = np.asarray(scene.graph.get(VIEWER_ROOT)[0] if own else np.eye(4), dtype=np.float64)[:3, :3]
        order = {key: index for index, key in enumerate(scene.geometry)}
        nodes = [node for node in scene.graph.nodes_geometry if _has_faces(scene, node)]
        nodes.sort(key=lambda node: (order[scene.graph[node][1]], node))
        if not nodes:
            raise ValueError("it has no faces")
        parts = [_part(scene, node, base, number, path.stem) for number, node in enumerate(nodes)]
        unit_m = float(abs(np.linalg.det(root)) ** (1 / 3))
        if not unit_m > 0:
            raise ValueError("its root node has a scale of 0")
        parts = _few(parts)
        mesh = SegmentedMesh(tuple(_renamed([part.segment for part in parts])))
        return GlbScene(mesh, tuple(part.colors for part in parts), _radii(parts), root / unit_m, unit_m, own)


def _has_faces(scene: Any, node: str) -> bool:
    return len(getattr(scene.geometry[scene.graph[node][1]], "faces", ())) > 0


def _part(scene: Any, node: str, base: str, number: int, stem: str) -> _Part:
    transform, key = scene.graph.get(node, frame_from=base)
    geometry = scene.geometry[key]
    vertices = np.asarray(geometry.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]
    if not np.isfinite(vertices).all():
        raise ValueError(f"its mesh {node!r} has places that are not finite")
    faces = np.asarray(geometry.faces, dtype=np.int64)
    faces = faces[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0 else faces
    color, colors = _colors(geometry, PALETTE[number % len(PALETTE)])
    radii = geometry.vertex_attributes.get(RADIUS)
    told = geometry.metadata.get("radius95")
    kept, index = _merged(vertices, colors)
    return _Part(
        Segment(stem if node.startswith("geometry_") else node, color, vertices[kept], index[faces], solid=False),
        None if colors is None else colors[kept],
        None if radii is None else np.asarray(radii, dtype=np.float64).reshape(-1)[kept],
        isinstance(told, dict) and told.get("calibrated") is True,
    )


def _merged(
    vertices: Float[np.ndarray, "v 3"], colors: UInt8[np.ndarray, "v 3"] | None
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " v"]]:
    """First of each group of vertices with one place and colour, in their order, and which of these each is."""
    rows = vertices if colors is None else np.column_stack([vertices, colors])
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.reshape(-1)]


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
    own = geometry.metadata.get("color")
    if each is None:
        chosen = own if own is not None else plain if factor is None else _screen(tint[None])[0]
        return (int(chosen[0]), int(chosen[1]), int(chosen[2])), None
    mean = own if own is not None else each.mean(axis=0)
    return (int(mean[0]), int(mean[1]), int(mean[2])), each if (each != each[0]).any() else None


def _screen(linear: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a screen from linear light (glTF 2.0, section 3.9.2)."""
    light = np.clip(linear, 0.0, 1.0)
    share = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * share).astype(np.uint8)


def _few(parts: list[_Part]) -> list[_Part]:
    """The first ``MOST_PARTS`` of them, and all others as one."""
    if len(parts) <= MOST_PARTS:
        return parts
    rest = [part.segment for part in parts[MOST_PARTS:]]
    starts = np.cumsum([0, *(len(segment.vertices) for segment in rest)])
    vertices = np.concatenate([segment.vertices for segment in rest])
    faces = np.concatenate([segment.faces + start for segment, start in zip(rest, starts, strict=False)])
    joined = Segment(f"{len(rest)} more", rest[0].color, vertices, faces, solid=False)
    return [*parts[:MOST_PARTS], _Part(joined, None, None, False)]


def _renamed(segments: list[Segment]) -> list[Segment]:
    """The same with names of their own: repeated ones are numbered."""
    taken: set[str] = set()
    result = []
    for segment in segments:
        name, number = segment.name, 1
        while name in taken:
            number += 1
            name = f"{segment.name} ({number})"
        taken.add(name)
        result.append(Segment(name, segment.color, segment.vertices, segment.faces, segment.solid))
    return result


def _radii(parts: list[_Part]) -> Radii | None:
    """Radii of all parts; None where one of them has none."""
    values = [part.radii for part in parts if part.radii is not None and np.isfinite(part.radii).all()]
    if len(values) < len(parts):
        return None
    counts = tuple(len(value) for value in values)
    labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
    points = np.concatenate([part.segment.vertices for part in parts])
    return Radii(points, labels, np.concatenate(values), counts, all(part.calibrated for part in parts))
