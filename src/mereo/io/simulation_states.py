"""Recorded states from files: vertex or node positions per frame, as simulators export them.

The formats are in docs/scene-file.md. This module reads and checks what files say by themselves;
``mereo.scenes.recorded_states`` fits them to an object.
"""

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from mereo.geometry.conventions import Names
from mereo.geometry.mesh import Elements
from mereo.geometry.transforms import AnyPoints, Indices, Points, longest_side
from mereo.io.errors import readable
from mereo.io.readers import Arrays, read_arrays
from mereo.io.vtk_frames import (
    COLLECTION_SUFFIXES,
    DISPLACEMENTS,
    MESHIO_SUFFIXES,
    VTK_SUFFIXES,
    FramePoints,
    MeshFrames,
    read_vtk_frames,
)

FRAME_SUFFIXES = (".ply", ".obj", ".stl", ".off", *VTK_SUFFIXES, *MESHIO_SUFFIXES)
"""Suffixes of meshes that hold a state each."""

TETRAHEDRAL = ("rest_nodes", "tetrahedra", "nodes", "displacements")
"""Names of the arrays of tetrahedral states."""

REST = ".rest"
"""End of an array's name that holds a segment at rest."""

STILL = 1e-5
"""Points are the same where they differ by less than this, of the longest side: single precision leaves as much."""

NAMED = re.compile(r'[^"<>:\s][^"<>:\r\n]*\.(?:vt\w+|h5|hdf5?|bin|raw|xml)(?=["<:\s])')
"""Names of other files in PVD and XDMF files."""


@dataclass(frozen=True, eq=False)
class TetrahedralRecord:
    """Node positions of one volume mesh.

    Attributes:
        rest_nodes: positions at rest.
        tetrahedra: four node indices each, counted from 0.
        displacements: of the nodes from rest, in the precision of the file.
        frames: their names, for messages.
    """

    rest_nodes: Points
    tetrahedra: Elements
    displacements: FramePoints
    frames: Names


@dataclass(frozen=True, eq=False)
class SurfaceRecord:
    """Vertex positions of the segments' surfaces.

    Attributes:
        vertices: for each segment by name its positions in all frames, in its file's order.
        rest: for some of them the same vertices at rest.
        frames: their names, for messages.
    """

    vertices: dict[str, Float[ndarray, "f _ 3"]]
    rest: dict[str, AnyPoints]
    frames: Names


def read_states(path: Path, names: Names, mesh: Path | None = None) -> TetrahedralRecord | SurfaceRecord:
    """States in a file, a directory or the files of a pattern.

    Args:
        path: an NPZ file, an NPY file of positions, a mesh for each frame (by a directory or a pattern such as
            ``*.vtu``), or a PVD or XDMF file.
        names: the object's segments.
        mesh: file of the same nodes at rest, with their tetrahedra where it has some; not for NPZ files.

    Raises ``FileNotFoundError`` and ``ValueError`` naming the file, the array and the frame, ``ImportError`` without
    the extra `simulation` where the format is one of VTK's.
    """
    if path.suffix.lower() == ".npz":
        if mesh is not None:
            raise ValueError(f"{path} is an NPZ file, which holds its own rest; `mesh` is not for it: leave it out")
        record = _archive(path, names)
        if not record.frames:
            raise ValueError(f"{path} has no frames; at least one state is needed: export some")
        return record
    if path.is_dir() and not frame_files(path):
        return _folders(path, names)
    return _sequence(path, names, mesh)


def read_tetrahedra(path: Path) -> tuple[Points, Elements, Indices]:
    """Nodes, tetrahedra, four node indices each, and the nodes' numbers in a VTK, VTU, MSH or INP file, or an NPZ.

    An NPZ has them as `rest_nodes` and `tetrahedra`.

    Nodes of no tetrahedron are left out; other solid cells are divided into tetrahedra.

    Raises ``FileNotFoundError`` and ``ValueError`` naming the file, ``ImportError`` without the extra `simulation`
    where the format is another one.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with readable(path, "NPZ file"):
            arrays = read_arrays(path)
        if missing := [key for key in TETRAHEDRAL[:2] if key not in arrays]:
            raise ValueError(
                f"{path} has the arrays {', '.join(map(repr, sorted(arrays)))} but not {missing[0]}; a volume mesh "
                "is rest_nodes and tetrahedra: add it"
            )
        nodes, elements = _volume(path, arrays)
    elif suffix in (*VTK_SUFFIXES, *MESHIO_SUFFIXES):
        frames = _mesh_frames(path)
        nodes = frames.points[0]
        elements = frames.tetrahedra
    else:
        known = ", ".join((".npz", *VTK_SUFFIXES[:2], *MESHIO_SUFFIXES))
        raise ValueError(f"{path} has the suffix {path.suffix!r}; a volume mesh is one of {known}: convert it")
    if not len(elements):
        raise ValueError(f"{path} has no tetrahedra, nor other solid cells: export the volume mesh, not its surface")
    if elements.min() < 0 or elements.max() >= len(nodes):
        return nodes, elements, np.arange(len(nodes))  # the mesh's own check names the index
    used, corners = np.unique(elements, return_inverse=True)  # flat before numpy 2
    return nodes[used], corners.reshape(elements.shape), used


def frame_files(path: Path) -> list[Path]:
    """Files of frames in natural order, 2 before 10.

    They are the path itself, the meshes in a directory but ``rest.*``, or what a pattern in the path's last part names.
    """
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.stem != "rest"]
    elif path.exists() or not path.parent.is_dir():
        return [path] if path.exists() else []
    else:
        files = [file for file in path.parent.iterdir() if fnmatchcase(file.name, path.name) and file.is_file()]
    return sorted(files, key=lambda file: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", file.name)])


def files_of_states(path: Path, mesh: Path | None = None) -> list[Path]:
    """Every file that ``read_states`` may read, in a fixed order, with those that PVD and XDMF files name."""
    files = sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else frame_files(path)
    if mesh is not None:
        files = [*files, mesh]
    texts = [file for file in files if file.suffix.lower() in COLLECTION_SUFFIXES and file.is_file()]
    named = [file.parent / name for file in texts for name in NAMED.findall(file.read_text("utf-8", errors="replace"))]
    return [*files, *(file for file in dict.fromkeys(named) if file.is_file() and file not in files)]


# --- sequences --------------------------------------------------------------------------------------------------------


def _sequence(path: Path, names: Names, mesh: Path | None) -> TetrahedralRecord | SurfaceRecord:
    """States of one mesh that moves all segments, or of the surface of the only one."""
    frames = _mesh_frames(path)
    if 0 in frames.points.shape:
        raise ValueError(f"{path} has no frames, or none with nodes; at least one state is needed: export some")
    tetrahedra = frames.tetrahedra
    rest = None
    if mesh is None:
        mesh = _rest_file(path)
    if mesh is not None:
        at_rest = _mesh_frames(mesh)
        rest = at_rest.points[0]
        tetrahedra = at_rest.tetrahedra
        if len(rest) != frames.points.shape[1]:
            raise ValueError(
                f"{path} has {frames.points.shape[1]} nodes a frame but {mesh} {len(rest)}; both need the same nodes, "
                "in one order: name the mesh that was simulated"
            )
    positions, start = _positions(path, frames, rest)
    rest = start if rest is None else rest
    if len(tetrahedra):
        rest = positions[0] if rest is None else rest
        return TetrahedralRecord(rest, tetrahedra, positions - rest, frames.frames)
    if rest is None and len(names) > 1:
        raise ValueError(
            f"{path} has no tetrahedra and one surface for {len(names)} segments; it must be known which vertices are "
            f"whose: name the mesh at rest, as `states: {{positions: {path.name}, mesh: rest.vtk}}`, or give each "
            "segment a folder"
        )
    return SurfaceRecord(
        dict.fromkeys(names, positions), {} if rest is None else dict.fromkeys(names, rest), frames.frames
    )


def _positions(path: Path, frames: MeshFrames, rest: Points | None) -> tuple[FramePoints, Points | None]:
    """Positions in all frames, and those at rest where displacements say them.

    Points that stay are moved by their displacements. Of points that move, displacements tell the rest, if they agree.
    """
    points, moved = frames.points, frames.displacements
    start = points[0] if rest is None else rest
    size = longest_side(start)
    if np.abs(points - start).max() <= STILL * size:
        if moved is not None:
            return points + moved, points[0]
        if len(points) > 1:
            raise ValueError(
                f"{path} has the same points in all {len(points)} frames and no displacements; points must move, or "
                f"have point data of 3 components called {', '.join(DISPLACEMENTS)}: export or rename them"
            )
    elif moved is not None and np.abs((back := points - moved) - back[0]).max() <= STILL * size:
        return points, back[0]
    return points, None


def _mesh_frames(path: Path) -> MeshFrames:
    """Frames of the files that a path stands for, all of one format."""
    files = frame_files(path)
    if not files:
        raise FileNotFoundError(f"{path} does not exist; a simulation's frames are needed: check the path")
    kinds = sorted({file.suffix.lower() for file in files})
    if len(kinds) > 1:
        raise ValueError(
            f"{path} has files of the formats {', '.join(kinds)}; all frames must have one: name them by a pattern, as "
            f"{path / f'*{kinds[0]}'}"
        )
    if kinds[0] in (*VTK_SUFFIXES, *MESHIO_SUFFIXES, *COLLECTION_SUFFIXES):
        frames = read_vtk_frames(files)
        for key in ("points", "displacements"):
            if (array := getattr(frames, key)) is not None:
                _floats(path, key, array, 3)
        return frames
    if kinds == [".npy"] and len(files) == 1:
        with readable(path, "NPY file"), path.open("rb") as file:
            points = np.asarray(np.load(file, allow_pickle=False))
        names = _numbered(len(_floats(path, "the array", points, 3)))
    elif kinds[0] in FRAME_SUFFIXES:
        meshes = {f"frame {file.name}": _floats(file, "the mesh", mesh_vertices(file), 2) for file in files}
        _check_topology(path, meshes)
        points = np.stack(list(meshes.values()))
        names = tuple(meshes)
    else:
        raise ValueError(
            f"{path} has the suffix {kinds[0]!r}; states are an NPZ or NPY file, a PVD or XDMF file, or meshes "
            f"({', '.join(FRAME_SUFFIXES)}) in a directory or of a pattern: convert or rename it"
        )
    return MeshFrames(points, None, np.empty((0, 4), np.int64), names)


def _rest_file(path: Path) -> Path | None:
    """The mesh ``rest.*`` of a directory of frames."""
    files = sorted(path.glob("rest.*")) if path.is_dir() else []
    return next((file for file in files if file.suffix.lower() in FRAME_SUFFIXES), None)


# --- NPZ --------------------------------------------------------------------------------------------------------------


def _archive(path: Path, names: Names) -> TetrahedralRecord | SurfaceRecord:
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


def _tetrahedral(path: Path, arrays: Arrays) -> TetrahedralRecord:
    if unknown := sorted(set(arrays) - set(TETRAHEDRAL)):
        raise ValueError(
            f"{path} has the array {unknown[0]!r}; known are {', '.join(TETRAHEDRAL)}: remove or rename it"
        )
    if "rest_nodes" not in arrays or ("nodes" in arrays) == ("displacements" in arrays):
        raise ValueError(
            f"{path} has the arrays {', '.join(map(repr, sorted(arrays)))}; tetrahedral states need rest_nodes, "
            "tetrahedra and one of nodes or displacements: add or remove what differs"
        )
    rest, elements = _volume(path, arrays)
    key = "nodes" if "nodes" in arrays else "displacements"
    moved = _floats(path, key, arrays[key], 3)
    if moved.shape[1] != len(rest):
        raise ValueError(
            f"{path}: {key} has {moved.shape[1]} nodes a frame but rest_nodes {len(rest)}; both need the same nodes"
        )
    frames = _numbered(len(moved))
    return TetrahedralRecord(rest, elements, moved - rest if key == "nodes" else moved, frames)


def _volume(path: Path, arrays: Arrays) -> tuple[Points, Elements]:
    """Nodes and tetrahedra of an archive."""
    rest = _floats(path, "rest_nodes", arrays["rest_nodes"], 2).astype(float)
    elements = arrays["tetrahedra"]
    if elements.ndim != 2 or elements.shape[1] != 4 or not np.issubdtype(elements.dtype, np.integer):
        raise ValueError(
            f"{path}: tetrahedra has the shape {list(elements.shape)} and the type {elements.dtype}; it must be "
            "integers [m, 4]: give four node indices for each"
        )
    return rest, elements.astype(np.int64)


def _floats(path: Path, key: str, array: ndarray, axes: int) -> ndarray:
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


def _check_names(path: Path, stated: set[str], names: Names) -> None:
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


def _numbered(count: int) -> Names:
    return tuple(f"frame {index}" for index in range(count))


# --- directories ------------------------------------------------------------------------------------------------------


def _folders(path: Path, names: Names) -> SurfaceRecord:
    """States in a directory with a folder of meshes for each segment."""
    folders = {item.name: item for item in path.iterdir() if item.is_dir() and not item.name.startswith(".")}
    if not folders:
        raise ValueError(
            f"{path} is no directory of states for {len(names)} segments; it must hold one folder of mesh files for "
            f"each segment ({', '.join(names)}), or a mesh for each frame: arrange it so, or make one NPZ file"
        )
    _check_names(path, set(folders), names)
    records = {name: _surface(folders[name], name) for name in names}
    counts = {name: len(record.frames) for name, record in records.items()}
    if len(set(counts.values())) > 1:
        text = ", ".join(f"{count} of {name!r}" for name, count in counts.items())
        raise ValueError(f"{path} has {text} frames; all segments need the same number: export them together")
    vertices = {name: record.vertices[name] for name, record in records.items()}
    rest = {name: record.rest[name] for name, record in records.items() if name in record.rest}
    return SurfaceRecord(vertices, rest, records[names[0]].frames)


def _surface(folder: Path, name: str) -> SurfaceRecord:
    """States of one segment in its own folder; of tetrahedra their nodes are taken for vertices."""
    if not frame_files(folder):
        raise ValueError(f"{folder} has no frames; at least one state is needed: export some")
    record = _sequence(folder, (name,), None)
    if isinstance(record, SurfaceRecord):
        return record
    nodes = record.rest_nodes + record.displacements
    return SurfaceRecord({name: nodes}, {name: record.rest_nodes}, record.frames)


def _check_topology(path: Path, states: Arrays) -> None:
    """Raise ``ValueError`` where states have other numbers of vertices than the first of them."""
    first = next(iter(states))
    for state, vertices in states.items():
        if len(vertices) != len(states[first]):
            raise ValueError(
                f"{path}: {state} has {len(vertices)} vertices but {first} has {len(states[first])}; the topology must "
                "stay the same: export without remeshing"
            )


def mesh_vertices(path: Path) -> AnyPoints:
    """Vertices of a mesh file in its own order; an STL file has three for each face."""
    with readable(path, "mesh"):
        if path.suffix.lower() == ".obj":  # trimesh orders an OBJ file's vertices by faces and texture seams
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            rows = [line.split()[1:4] for line in lines if line.startswith(("v ", "v\t"))]
            vertices = np.array(rows, float).reshape(-1, 3)
        else:
            vertices = np.asarray(trimesh.load_mesh(path, process=False).vertices, float)
        if len(vertices) == 0:
            raise ValueError("it has no vertices")
    return vertices
