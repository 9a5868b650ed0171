"""GLB: binary glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html), metres and y up."""

import json
import struct

import numpy as np
from jaxtyping import Shaped, UInt8
from numpy import ndarray
from numpy.linalg import norm

from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.geometry.radii import STOPS, Radii
from mereo.geometry.subdivision import split_at_creases
from mereo.geometry.transforms import Matrix, PointArray
from mereo.io.atomic_files import JsonObject, atomic_file
from mereo.io.errors import AnyPath
from mereo.io.mesh_formats import VIEWER_ROOT
from mereo.io.writers.meshes import OUTER_OPACITY, with_faces

GLTF_CAMERA_ROTATION = np.diag([1.0, -1.0, -1.0])
"""Rotation by half a turn about x: from the camera frame (y down, z forward) to glTF (y up, z toward the viewer)."""


def viewer_rotation(frame: CloudAxes) -> Matrix:
    """Rotation from the input's axes to glTF's, which a scanner's already are."""
    return GLTF_CAMERA_ROTATION if frame == "camera" else np.eye(3)


def write_segments_glb(
    path: AnyPath,
    surfaces: SegmentedMesh,
    frame_rotation: Matrix = GLTF_CAMERA_ROTATION,
    unit_m: float = 1.0,
    radii: Radii | None = None,
    colored: bool = False,
) -> None:
    """Write a GLB file: one named, coloured node per segment, below a root node that turns the frame for viewers.

    Vertices stay as they are (rounded to float32), each with its normal; where faces meet at a crease
    (``geometry.subdivision``), copies follow them, with normals of their own. Segments without faces are left out;
    those around a nested segment that was found are translucent.

    Args:
        path: the .glb file.
        surfaces: segments in the input's frame and units.
        frame_rotation: rotation of the root node, from the input's frame to glTF's (y up).
        unit_m: metres per unit of the input, the scale of the root node, because glTF is in metres.
        radii: how sure the surfaces are, in the same unit: the vertex attribute ``_RADIUS95``.
        colored: colour the vertices by these, and not by their segments.

    Raises ``ValueError`` where no segment has faces.
    """
    solid = with_faces(surfaces)
    arrays = _Arrays()
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(frame_rotation) * unit_m
    root = {"name": VIEWER_ROOT, "matrix": matrix.T.ravel().tolist(), "children": list(range(1, len(solid) + 1))}
    nodes: list[JsonObject] = [root]  # glTF matrices are column-major
    meshes, materials = [], []
    for index, (label, segment) in enumerate(solid):
        creased, source = split_at_creases(segment)
        normals = vertex_normals(creased)
        normals[norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)  # of no face's area; glTF wants unit length
        attributes = {"POSITION": arrays.add(creased.vertices, "VEC3"), "NORMAL": arrays.add(normals, "VEC3")}
        primitive = {
            "attributes": attributes,
            "indices": arrays.add(creased.faces.reshape(-1, 1), "SCALAR"),
            "material": index,
        }
        # the exact colour, which a material's factors approximate
        extras: JsonObject = {"label": label, "color": list(segment.color)}
        material = _material(segment, surfaces.opaque[label - 1])
        if radii is not None:
            values = radii.at(segment.vertices, label)[source]
            attributes["_RADIUS95"] = arrays.add(values[:, None], "SCALAR")
            extras["radius95"] = {"unit_m": unit_m, "calibrated": radii.calibrated}
            if colored:
                attributes["COLOR_0"] = arrays.add(_linear(radii.colors(values)), "VEC3")
                scale = {"color_0_at": 0.0, "color_1_at": radii.high, "stops": [list(color) for color in STOPS]}
                extras["radius95"] |= scale
                material["pbrMetallicRoughness"]["baseColorFactor"][:3] = [1.0, 1.0, 1.0]
        nodes.append({"name": segment.name, "mesh": index})
        meshes.append({"name": segment.name, "primitives": [primitive], "extras": extras})
        materials.append(material)
    binary = b"".join(arrays.chunks)
    document = {
        "asset": {"version": "2.0", "generator": "mereo"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "accessors": arrays.accessors,
        "bufferViews": arrays.views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


class _Arrays:
    """Arrays of the file's one buffer; all components are four bytes wide, so every view starts aligned."""

    def __init__(self) -> None:
        self.chunks, self.views, self.accessors = list[bytes](), list[JsonObject](), list[JsonObject]()

    def add(self, values: Shaped[ndarray, "n k"], kind: str) -> int:
        """Number of the accessor of vertices' attributes, as single floats, or of faces' corners."""
        is_faces = values.dtype.kind == "i"
        component, target = (5125, 34963) if is_faces else (5126, 34962)
        array = values.astype("<u4" if is_faces else "<f4")
        start = sum(len(chunk) for chunk in self.chunks)
        number = len(self.accessors)
        self.chunks.append(array.tobytes())
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        low = array.min(axis=0).tolist()
        high = array.max(axis=0).tolist()
        head = {"bufferView": number, "componentType": component, "count": len(array), "type": kind}
        self.accessors.append({**head, "min": low, "max": high})
        return number


def _material(segment: Segment, opaque: bool) -> JsonObject:
    color = [*_linear(np.array(segment.color, np.uint8)).round(6).tolist(), 1.0 if opaque else OUTER_OPACITY]
    surface = {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    material = {"name": segment.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    return material if opaque else {**material, "alphaMode": "BLEND"}


def _linear(srgb: UInt8[ndarray, "*n 3"]) -> PointArray:
    """Linear light of screen colours (glTF 2.0, section 3.9.2)."""
    share = srgb / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
