"""Checks of what headers of mesh files state, before trimesh reads them.

trimesh takes memory for glTF accessors without data, unpacks any zip, and leaves out the faces that a text file was cut
short of. Each check raises ``ValueError`` with its reason only, or ``SizeError``.
"""

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mereo.io.point_cloud_formats import check_ply
from mereo.io.size_limits import check_archive, check_bytes, check_count

COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""Bytes of each of glTF's component types."""

COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Components of each of glTF's element types."""


STL_NAME = b"written by mereo: "
"""What the header of our own STL files says before the name of the segment."""


def stl_segment_name(path: Path) -> str | None:
    """Name of the segment in an STL file that mereo wrote; None for another one."""
    with path.open("rb") as file:
        header = file.read(80)
    if not header.startswith(STL_NAME):
        return None
    return header.removeprefix(STL_NAME).decode("utf-8", errors="replace").strip() or None


def check_mesh(path: Path) -> None:
    """Check the header of a mesh file in one of the formats that have counts."""
    check = CHECKS.get(path.suffix.lower())
    if check is not None:
        check(path)


def _check_off(path: Path) -> None:
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


def _check_stl(path: Path) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(84)
        file.seek(max(0, size - 1024))
        end = file.read().strip().splitlines()[-1:]
    count = int.from_bytes(start[80:84], "little")
    if size == 84 + 50 * count:
        return
    if not start.lstrip().lower().startswith(b"solid"):
        raise ValueError(f"its header states {count} triangles, and its {size} bytes hold {max(size - 84, 0) / 50:g}")
    if not end or not end[0].strip().lower().startswith(b"endsolid"):
        raise ValueError("it is truncated: it does not end in endsolid")


XML_FACTOR = 22
"""Bytes of memory for each byte of 3MF's XML, which lxml keeps as a tree (measured on vertices and triangles)."""


def _check_3mf(path: Path) -> None:
    check_archive(path)
    with zipfile.ZipFile(path) as archive:
        models = [member.file_size for member in archive.infolist() if member.filename.lower().endswith(".model")]
    check_bytes(path, XML_FACTOR * sum(models))


def _check_gltf(path: Path) -> None:
    if path.suffix.lower() == ".gltf":
        document = json.loads(path.read_text("utf-8"))
    else:
        document = json.loads(_glb_text(path.read_bytes()))
    views = document.get("bufferViews", [])
    for view in views:
        room = document["buffers"][view["buffer"]]["byteLength"] - view.get("byteOffset", 0)
        check_count(view["byteLength"], room, "bytes")
    for accessor in document.get("accessors", []):
        _check_accessor(path, accessor, views)


def _glb_text(content: bytes) -> bytes:
    """First chunk of a GLB file, JSON; none may state more bytes than follow, for which trimesh asks at once."""
    at = 12
    while at + 8 <= len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        check_count(length, len(content) - at - 8, "bytes")
        at += 8 + length
    return content[20 : 20 + int.from_bytes(content[12:16], "little")]


def _check_accessor(path: Path, accessor: dict[str, Any], views: list[dict[str, Any]]) -> None:
    """Compare an accessor's count with its view; one without any is all zeros, or compressed elsewhere."""
    count, item = accessor["count"], COMPONENT_BYTES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
    check_count(count, max(count, 0), "elements")
    if "bufferView" not in accessor:
        check_bytes(path, 8 * COMPONENTS[accessor["type"]] * count)
        return
    view = views[accessor["bufferView"]]
    stride = view.get("byteStride", item)
    room = view["byteLength"] - accessor.get("byteOffset", 0)
    check_count(count, max(0, (room - item) // stride + 1), "elements")


CHECKS: dict[str, Callable[[Path], None]] = {
    ".ply": check_ply,
    ".off": _check_off,
    ".stl": _check_stl,
    ".glb": _check_gltf,
    ".gltf": _check_gltf,
    ".3mf": _check_3mf,
}
"""Check of each suffix; OBJ has no counts."""
