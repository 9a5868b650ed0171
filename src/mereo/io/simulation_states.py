"""Recorded states from files: vertex or node positions per frame, as simulators export them.

The formats are in docs/own-object.md. This module reads and checks what files say by themselves;
``mereo.scenes.recorded_states`` fits them to an object.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from mereo.io.errors import readable
from mereo.io.readers import read_arrays

FRAME_SUFFIXES = (".ply", ".obj", ".stl", ".off")
"""Suffixes of meshes that hold a state each."""

TETRAHEDRAL = ("rest_nodes", "tetrahedra", "nodes", "displacements")
"""Names of the arrays of tetrahedral states."""

REST = ".rest"
"""End of an array's name that holds a segment at rest."""


@dataclass(frozen=True, eq=False)
class TetrahedralRecord:
    """Node positions of one volume mesh.

    Attributes:
        rest_nodes: positions at rest.
        tetrahedra: four node indices each, counted from 0.
        displacements: of the nodes from rest, in the precision of the file.
        frames: their names, for messages.
    """

    rest_nodes: Float[np.ndarray, "n 3"]
    tetrahedra: Int[np.ndarray, "m 4"]
    displacements: Float[np.ndarray, "f n 3"]
    frames: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SurfaceRecord:
    """Vertex positions of the segments' surfaces.

    Attributes:
        vertices: for each segment by name its positions in all frames, in its file's order.
        rest: for some of them the same vertices at rest.
        frames: their names, for messages.
    """

    vertices: dict[str, Float[np.ndarray, "f _ 3"]]
    rest: dict[str, Float[np.ndarray, "_ 3"]]
    frames: tuple[str, ...]


def read_states(path: Path, names: tuple[str, ...]) -> TetrahedralRecord | SurfaceRecord:
    """States in an NPZ file or a directory; ``names`` are the object's segments.

    Raises ``FileNotFoundError`` and ``ValueError`` naming the file, the array and the frame.
    """
    record: TetrahedralRecord | SurfaceRecord
    if path.is_dir():
        record = _directory(path, names)
    elif path.suffix.lower() == ".npz" or not path.exists():
        record = _archive(path, names)
    else:
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; states are an NPZ file or a directory with one file per frame: "
            "convert or rename it"
        )
    if not record.frames:
        raise ValueError(f"{path} has no frames; at least one state is needed: export some")
    return record


# --- NPZ --------------------------------------------------------------------------------------------------------------


def _archive(path: Path, names: tuple[str, ...]) -> TetrahedralRecord | SurfaceRecord:
    with readable(path, "NPZ file"):
        arrays = read_arrays(path)
    if "tetrahedra" in arrays:
        return _tetrahedral(path, arrays)
    _check_names(path, {key.removesuffix(REST) for key in arrays}, names)
    vertices = {name: _floats(path, name, arrays[name], 3) for name in names}
    rest = {name: _floats(path, name + REST, arrays[name + REST], 2) for name in names if name + REST in arrays}
    lengths = {name: len(array) for name, array in vertices.items()}
    if len(set(lengths.values())) > 1:
        (a, m), (b, n) = min(lengths.items(), key=lambda item: item[1]), max(lengths.items(), key=lambda item: item[1])
        raise ValueError(f"{path} has {m} frames of {a!r} but {n} of {b!r}; all must be equal: export both together")
    return SurfaceRecord(vertices, rest, _numbered(next(iter(lengths.values()))))


def _tetrahedral(path: Path, arrays: dict[str, np.ndarray]) -> TetrahedralRecord:
    if unknown := sorted(set(arrays) - set(TETRAHEDRAL)):
        raise ValueError(
            f"{path} has the array {unknown[0]!r}; known are {', '.join(TETRAHEDRAL)}: remove or rename it"
        )
    if "rest_nodes" not in arrays or ("nodes" in arrays) == ("displacements" in arrays):
        raise ValueError(
            f"{path} has the arrays {', '.join(map(repr, sorted(arrays)))}; tetrahedral states need rest_nodes, "
            "tetrahedra and one of nodes or displacements: add or remove what differs"
        )
    rest = _floats(path, "rest_nodes", arrays["rest_nodes"], 2).astype(np.float64)
    key = "nodes" if "nodes" in arrays else "displacements"
    moved = _floats(path, key, arrays[key], 3)
    if moved.shape[1] != len(rest):
        raise ValueError(
            f"{path}: {key} has {moved.shape[1]} nodes a frame but rest_nodes {len(rest)}; both need the same nodes"
        )
    elements = arrays["tetrahedra"]
    if elements.ndim != 2 or elements.shape[1] != 4 or not np.issubdtype(elements.dtype, np.integer):
        raise ValueError(
            f"{path}: tetrahedra has the shape {list(elements.shape)} and the type {elements.dtype}; it must be "
            "integers [m, 4]: give four node indices for each"
        )
    frames = _numbered(len(moved))
    return TetrahedralRecord(rest, elements.astype(np.int64), moved - rest if key == "nodes" else moved, frames)


def _floats(path: Path, key: str, array: np.ndarray, axes: int) -> np.ndarray:
    """Positions [..., 3] that are finite; the first bad frame or row is named."""
    wanted = "[frames, vertices, 3]" if axes == 3 else "[vertices, 3]"
    if array.ndim != axes or array.shape[-1] != 3 or not np.issubdtype(array.dtype, np.floating):
        raise ValueError(
            f"{path}: {key} has the shape {list(array.shape)} and the type {array.dtype}; it must be floating-point "
            f"numbers {wanted}: export positions"
        )
    finite = np.isfinite(array).all(axis=tuple(range(1, axes)))
    if not finite.all():
        what = "frame" if axes == 3 else "row"
        raise ValueError(
            f"{path}: {what} {int(np.argmin(finite))} of {key} has NaN or infinite values; all must be finite: leave "
            "it out, or simulate with smaller steps"
        )
    return array


def _check_names(path: Path, stated: set[str], names: tuple[str, ...]) -> None:
    if missing := [name for name in names if name not in stated]:
        raise ValueError(
            f"{path} has states of {', '.join(map(repr, sorted(stated))) or 'nothing'} but not of segment "
            f"{missing[0]!r}; every segment needs its own: name each array or folder after its segment"
        )
    if unknown := sorted(stated - set(names)):
        raise ValueError(
            f"{path} has states of {unknown[0]!r}, which is no segment; the segments are {', '.join(names)}: rename or "
            "remove it"
        )


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"frame {index}" for index in range(count))


# --- directories ------------------------------------------------------------------------------------------------------


def _directory(path: Path, names: tuple[str, ...]) -> SurfaceRecord:
    """States in a directory: a folder of meshes per segment, or the meshes of the only segment."""
    folders = {item.name: item for item in path.iterdir() if item.is_dir() and not item.name.startswith(".")}
    if _frame_files(path) and len(names) == 1:
        folders = {names[0]: path}
    elif not folders or _frame_files(path):
        raise ValueError(
            f"{path} is no directory of states for {len(names)} segments; it must hold one folder of mesh files for "
            f"each segment ({', '.join(names)}): arrange it so, or make one NPZ file"
        )
    _check_names(path, set(folders), names)
    vertices, rest, counts = dict[str, np.ndarray](), dict[str, np.ndarray](), dict[str, int]()
    frames: tuple[str, ...] = ()
    for name in names:
        files = _frame_files(folders[name])
        states = {f"frame {file.name}": _floats(file, name, mesh_vertices(file), 2) for file in files}
        for file in sorted(folders[name].glob("rest.*")):
            if file.suffix.lower() in FRAME_SUFFIXES:
                rest[name] = _floats(file, name, mesh_vertices(file), 2)
                break
        reference = {"the rest pose": rest[name]} if name in rest else {}
        _check_topology(path, name, reference | states)
        vertices[name] = np.stack(list(states.values())) if states else np.empty((0, 0, 3))
        frames, counts[name] = frames or tuple(states), len(states)
    if len(set(counts.values())) > 1:
        text = ", ".join(f"{count} of {name!r}" for name, count in counts.items())
        raise ValueError(f"{path} has {text} frames; all segments need the same number: export them together")
    return SurfaceRecord(vertices, rest, frames)


def _check_topology(path: Path, name: str, states: dict[str, np.ndarray]) -> None:
    """Raise ``ValueError`` where states of a segment have other numbers of vertices than the first of them."""
    first = next(iter(states), "")
    for state, vertices in states.items():
        if len(vertices) != len(states[first]):
            raise ValueError(
                f"{path}: {state} of {name!r} has {len(vertices)} vertices but {first} has {len(states[first])}; the "
                "topology must stay the same: export without remeshing"
            )


def _frame_files(path: Path) -> list[Path]:
    """Meshes in a directory but ``rest.*``, in natural order: 2 before 10."""
    files = [file for file in path.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.stem != "rest"]
    return sorted(files, key=lambda file: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", file.name)])


def mesh_vertices(path: Path) -> Float[np.ndarray, "_ 3"]:
    """Vertices of a mesh file in its own order; an STL file has three for each face."""
    with readable(path, "mesh"):
        if path.suffix.lower() == ".obj":  # trimesh orders an OBJ file's vertices by faces and texture seams
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            rows = [line.split()[1:4] for line in lines if line.startswith(("v ", "v\t"))]
            vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
        else:
            vertices = np.asarray(trimesh.load_mesh(path, process=False).vertices, dtype=np.float64)
        if len(vertices) == 0:
            raise ValueError("it has no vertices")
    return vertices
