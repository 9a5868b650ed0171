"""Writers: files and directories that appear whole or not at all, and the results of a reconstruction.

Everything is first written beside its destination under a temporary name and renamed at the end, so that a reader never
sees half a file and an error, Ctrl-C or a full disk leaves nothing behind.
"""

import errno
import json
import os
import secrets
import shutil
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from mereo.camera import Camera
from mereo.mesh import Segment, SegmentedMesh
from mereo.mesh_files import VIEWER_ROOT

OUTER_OPACITY = 0.35
"""Of segments with others nested in them, which viewers draw see-through."""

GLTF_CAMERA_ROTATION = np.diag([1.0, -1.0, -1.0])
"""Half a turn about x: from the camera frame (y down, z forward) to glTF (y up, z toward the viewer)."""


@contextmanager
def atomic_file(path: str | Path, *, force: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same suffix; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination; missing parent directories are made (and removed again if the block fails).
        force: replace an existing file.

    Raises:
        FileExistsError: ``path`` exists and ``force`` is false, or it is a directory.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    if path.is_dir():
        raise FileExistsError(f"{path} is a directory; a file is written there: choose another name")
    if path.exists() and not force:
        raise FileExistsError(f"{path} exists; it is not overwritten: choose another name or pass --force")
    with _temporary(path) as partial:
        yield partial
        os.replace(partial, path)


@contextmanager
def new_directory(path: str | Path, force: bool = False) -> Iterator[Path]:
    """Yield an empty temporary directory beside ``path``; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination. An existing empty directory counts as absent.
        force: replace an existing directory and all it holds, once the new one is complete.

    Raises:
        FileExistsError: ``path`` is a file, or a directory with content and ``force`` is false.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; a directory is written there: choose another --output")
    if path.is_dir() and any(path.iterdir()) and not force:
        raise FileExistsError(
            f"{path} exists and is not empty; it is not overwritten: choose another --output or pass --force"
        )
    with _temporary(path) as partial:
        partial.mkdir()
        yield partial
        _swap_directory(partial, path)


def _swap_directory(partial: Path, path: Path) -> None:
    """Put ``partial`` in the place of ``path``; the old content goes only after the new one is there."""
    if not path.exists():
        os.rename(partial, path)
        return
    old = partial.with_name(partial.name + "-old")
    os.rename(path, old)
    try:
        os.rename(partial, path)
    except BaseException:
        os.rename(old, path)
        raise
    shutil.rmtree(old)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A fresh sibling name with the suffix of ``path``; on any exception, Ctrl-C included, what is there is removed."""
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    made: list[Path] = []
    try:
        made = _make_parents(path.parent)
        yield partial
    except BaseException as error:
        _remove(partial, made)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise OSError(
                errno.ENOSPC, f"the disk is full while writing {path}; free space or choose another place"
            ) from error
        if isinstance(error, PermissionError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise PermissionError(
                f"{path} cannot be written; its directory is read-only: choose another place"
            ) from error
        raise


def _make_parents(directory: Path) -> list[Path]:
    """Make ``directory``; returns the directories that were missing, the deepest first."""
    missing = [place for place in (directory, *directory.parents) if not place.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    return missing


def _remove(partial: Path, made: list[Path]) -> None:
    if partial.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
    else:
        partial.unlink(missing_ok=True)
    for directory in made:
        with suppress(OSError):  # another process may have written there meanwhile
            directory.rmdir()


# --- results ---------------------------------------------------------------------------------------------------------


def write_json(path: str | Path, value: Any) -> None:
    """Indented JSON; arrays become lists, NaN and infinity null (JSON has neither)."""
    with atomic_file(path) as partial:
        partial.write_text(json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")


def _plain(value: Any) -> Any:
    """Numpy and path values as what JSON knows."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def write_camera(path: str | Path, camera: Camera) -> None:
    """Intrinsics that ``mereo.files.read_camera`` reads back exactly; pixel centres are stated to be at 0.5."""
    write_json(
        path,
        {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.focal_x_px,
            "fy": camera.focal_y_px,
            "cx": camera.center_x_px,
            "cy": camera.center_y_px,
            "pixel_center": 0.5,
        },
    )


def write_labels_npz(
    path: str | Path,
    labels: UInt8[np.ndarray, "x y z"],
    origin: Float[np.ndarray, "3"],
    spacing: Float[np.ndarray, "3"],
    names: Sequence[str],
) -> None:
    """A label grid: voxel [i, j, k] is centred at ``origin + [i, j, k] * spacing``, in the input's frame and units.

    ``names[k]`` is the segment of label k + 1; label 0 is empty space.
    """
    if labels.size and int(labels.max()) > len(names):
        raise ValueError(f"label {int(labels.max())} has no name among {len(names)}; name every segment")
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            labels=labels,
            origin=np.asarray(origin, dtype=np.float64),
            spacing=np.asarray(spacing, dtype=np.float64),
            names=np.asarray(names),
        )


def write_mesh_ply(path: str | Path, mesh: SegmentedMesh) -> None:
    """All segments as one mesh, its faces in their colours, vertices in double precision."""
    vertices, faces, owner = mesh.merged()
    colors = np.asarray(mesh.colors, dtype=np.uint8)[owner]
    whole = trimesh.Trimesh(vertices, faces, face_colors=colors, process=False)
    with atomic_file(path) as partial:
        whole.export(partial, file_type="ply")


# --- glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html) --------------------------------------------


def write_segments_glb(
    path: str | Path,
    surfaces: SegmentedMesh,
    frame_rotation: Float[np.ndarray, "3 3"] = GLTF_CAMERA_ROTATION,
    unit_m: float = 1.0,
) -> None:
    """One named, coloured, double-sided node per segment, below one root node that turns the frame for viewers.

    Vertices stay as they are (rounded to float32, all that glTF holds). Segments without faces are left out; those
    around a nested segment that was found are translucent.

    Args:
        path: the .glb file.
        surfaces: segments in the input's frame and units.
        frame_rotation: rotation of the root node, from the input's frame to glTF's (y up).
        unit_m: metres per unit of the input, the scale of the root node, because glTF is in metres.
    """
    solid = [(label, segment) for label, segment in enumerate(surfaces.segments, start=1) if len(segment.faces)]
    chunks: list[bytes] = []
    document = _gltf_skeleton(solid, surfaces.opaque, np.asarray(frame_rotation) * unit_m)
    for _, segment in solid:
        _add_array(document, chunks, segment.vertices.astype("<f4"), "VEC3", 34962)
        _add_array(document, chunks, segment.faces.astype("<u4").reshape(-1, 1), "SCALAR", 34963)
    if not solid:
        raise ValueError("all segments are without faces; at least one surface is needed: check the reconstruction")
    binary = b"".join(chunks)
    document["buffers"] = [{"byteLength": len(binary)}]
    text = json.dumps(document, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


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
    """``extras`` keep the label and the exact colour, which the material's linear factors only approximate."""
    primitive = {"attributes": {"POSITION": 2 * index}, "indices": 2 * index + 1, "material": index}
    return {"name": segment.name, "primitives": [primitive], "extras": {"label": label, "color": list(segment.color)}}


def _gltf_material(segment: Segment, opaque: bool) -> dict[str, Any]:
    """glTF colour factors are linear light, ours are sRGB (glTF 2.0, section 3.9.2)."""
    srgb = np.asarray(segment.color) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    color = [*linear.round(6).tolist(), 1.0 if opaque else OUTER_OPACITY]
    surface = {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    material = {"name": segment.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    return material if opaque else {**material, "alphaMode": "BLEND"}


def _add_array(document: dict[str, Any], chunks: list[bytes], array: np.ndarray, kind: str, target: int) -> None:
    """Append an accessor; all components are four bytes wide, so every view starts aligned."""
    start = sum(len(chunk) for chunk in chunks)
    chunks.append(array.tobytes())
    view = len(document["bufferViews"])
    document["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
    accessor = {
        "bufferView": view,
        "componentType": 5126 if kind == "VEC3" else 5125,
        "count": len(array),
        "type": kind,
    }
    low, high = array.min(axis=0).tolist(), array.max(axis=0).tolist()
    document["accessors"].append({**accessor, "min": low, "max": high})
