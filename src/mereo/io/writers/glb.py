"""GLB: binary glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html), metres and y up."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.geometry.radii import STOPS, Radii
from mereo.geometry.subdivision import split_at_creases
from mereo.io.atomic_files import atomic_file
from mereo.io.mesh_formats import VIEWER_ROOT
from mereo.io.writers.meshes import OUTER_OPACITY, with_faces

GLTF_CAMERA_ROTATION = np.diag([1.0, -1.0, -1.0])
"""Rotation by half a turn about x: from the camera frame (y down, z forward) to glTF (y up, z toward the viewer)."""


def viewer_rotation(frame: CloudAxes) -> Float[np.ndarray, "3 3"]:
    """Rotation from the input's axes to glTF's, which a scanner's already are."""
    return GLTF_CAMERA_ROTATION if frame == "camera" else np.eye(3)


def write_segments_glb(
    path: str | Path,
    surfaces: SegmentedMesh,
    frame_rotation: Float[np.ndarray, "3 3"] = GLTF_CAMERA_ROTATION,
    unit_m: float = 1.0,
    radii: Radii | None = None,
    colored: bool = False,
) -> None:
    """Write a GLB file: one named, coloured node per segment, below a root node that turns the frame for viewers.

    Vertices stay as they are (rounded to float32, all that glTF holds), each with its normal; where faces meet at a
    crease (``geometry.subdivision``), copies follow them, with the same attributes but normals of their own. Segments
    without faces are left out; those around a nested segment that was found are translucent.

    Args:
        path: the .glb file.
        surfaces: segments in the input's frame and units.
        frame_rotation: rotation of the root node, from the input's frame to glTF's (y up).
        unit_m: metres per unit of the input, the scale of the root node, because glTF is in metres.
        radii: how sure the surfaces are: the vertex attribute ``_RADIUS95``, in the unit of the vertices, of which
            ``extras`` of the meshes say the metres.
        colored: colour the vertices by these, and not by their segments.

    Raises ``ValueError`` where no segment has faces.
    """
    document, binary = _gltf_document(surfaces, frame_rotation, unit_m, radii, colored)
    text = json.dumps(document, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def _gltf_document(
    surfaces: SegmentedMesh,
    frame_rotation: Float[np.ndarray, "3 3"],
    unit_m: float,
    radii: Radii | None = None,
    colored: bool = False,
) -> tuple[dict[str, Any], bytes]:
    """Document and its one buffer."""
    solid = with_faces(surfaces)
    chunks: list[bytes] = []
    document = _gltf_skeleton(solid, surfaces.opaque, np.asarray(frame_rotation) * unit_m)
    creased = [split_at_creases(segment) for _, segment in solid]
    for segment, _ in creased:
        _add_array(document, chunks, segment.vertices.astype("<f4"), "VEC3", 34962)
        _add_array(document, chunks, _unit_normals(segment).astype("<f4"), "VEC3", 34962)
        _add_array(document, chunks, segment.faces.astype("<u4").reshape(-1, 1), "SCALAR", 34963)
    for index, (label, segment) in enumerate(solid if radii is not None else ()):
        assert radii is not None
        values = radii.at(segment.vertices, label)[creased[index][1]]
        _add_radii(document, chunks, index, radii, values, unit_m, colored)
    binary = b"".join(chunks)
    document["buffers"] = [{"byteLength": len(binary)}]
    return document, binary


def _gltf_skeleton(
    solid: list[tuple[int, Segment]], opaque: tuple[bool, ...], linear: Float[np.ndarray, "3 3"]
) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    children = list(range(1, len(solid) + 1))
    return {
        "asset": {"version": "2.0", "generator": "mereo"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # glTF matrices are column-major
        "nodes": [{"name": VIEWER_ROOT, "matrix": matrix.T.ravel().tolist(), "children": children}]
        + [{"name": segment.name, "mesh": index} for index, (_, segment) in enumerate(solid)],
        "meshes": [_gltf_mesh(index, label, segment) for index, (label, segment) in enumerate(solid)],
        "materials": [_gltf_material(segment, opaque[label - 1]) for label, segment in solid],
        "accessors": [],
        "bufferViews": [],
    }


def _gltf_mesh(index: int, label: int, segment: Segment) -> dict[str, Any]:
    """Mesh of a segment; ``extras`` keep the label and the exact colour, which a material's factors approximate."""
    primitive = {
        "attributes": {"POSITION": 3 * index, "NORMAL": 3 * index + 1},
        "indices": 3 * index + 2,
        "material": index,
    }
    return {"name": segment.name, "primitives": [primitive], "extras": {"label": label, "color": list(segment.color)}}


def _gltf_material(segment: Segment, opaque: bool) -> dict[str, Any]:
    """Material of a segment's colour; glTF's factors are linear light, ours are sRGB (glTF 2.0, section 3.9.2)."""
    color = [*_linear(np.array(segment.color, dtype=np.uint8)).round(6).tolist(), 1.0 if opaque else OUTER_OPACITY]
    surface = {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    material = {"name": segment.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    return material if opaque else {**material, "alphaMode": "BLEND"}


def _add_radii(
    document: dict[str, Any],
    chunks: list[bytes],
    index: int,
    radii: Radii,
    values: Float[np.ndarray, " v"],
    unit_m: float,
    colored: bool,
) -> None:
    """Attribute of a mesh's radii, and with ``colored`` their colours in place of the segment's."""
    mesh = document["meshes"][index]
    attributes = mesh["primitives"][0]["attributes"]
    attributes["_RADIUS95"] = len(document["accessors"])
    _add_array(document, chunks, values.astype("<f4").reshape(-1, 1), "SCALAR", 34962)
    mesh["extras"]["radius95"] = {"unit_m": unit_m, "calibrated": radii.calibrated}
    if colored:
        attributes["COLOR_0"] = len(document["accessors"])
        _add_array(document, chunks, _linear(radii.colors(values)).astype("<f4"), "VEC3", 34962)
        mesh["extras"]["radius95"] |= {"color_0_at": 0.0, "color_1_at": radii.high, "stops": [list(c) for c in STOPS]}
        surface = document["materials"][index]["pbrMetallicRoughness"]
        surface["baseColorFactor"] = [1.0, 1.0, 1.0, surface["baseColorFactor"][3]]


def _linear(srgb: UInt8[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Linear light of screen colours (glTF 2.0, section 3.9.2)."""
    share = srgb / 255.0
    linear: np.ndarray = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return linear


def _unit_normals(segment: Segment) -> Float[np.ndarray, "v 3"]:
    """Normals of the vertices; glTF wants unit length, so those of vertices without a face's area point up."""
    normals = vertex_normals(segment)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)
    return normals


def _add_array(document: dict[str, Any], chunks: list[bytes], array: np.ndarray, kind: str, target: int) -> None:
    """Append an accessor; all components are four bytes wide, so every view starts aligned."""
    start = sum(len(chunk) for chunk in chunks)
    chunks.append(array.tobytes())
    view = len(document["bufferViews"])
    document["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
    accessor = {
        "bufferView": view,
        "componentType": 5126 if array.dtype.kind == "f" else 5125,
        "count": len(array),
        "type": kind,
    }
    low, high = array.min(axis=0).tolist(), array.max(axis=0).tolist()
    document["accessors"].append({**accessor, "min": low, "max": high})
