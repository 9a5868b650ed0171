"""Frames of a simulation in VTK's formats, and meshes of Gmsh and Abaqus, read by pyvista in a process of its own.

VTK takes seconds to load, and a damaged file can end the process that reads it. So a child process runs ``main``
and hands arrays over in a folder.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from mereo.geometry.conventions import Names
from mereo.geometry.mesh import Elements
from mereo.io.atomic_files import JsonObject
from mereo.io.errors import limited_memory, printable_line, readable, reason

VTK_SUFFIXES = (".vtk", ".vtu", ".vtp")
"""Suffixes of files with one frame each."""

MESHIO_SUFFIXES = (".msh", ".inp")
"""Suffixes of one frame's meshes that pyvista reads by meshio: of Gmsh and of Abaqus."""

COLLECTION_SUFFIXES = (".pvd", ".xdmf", ".pvtu")
"""Suffixes of files that name others: in PVD and XDMF files each time step is a frame."""

DISPLACEMENTS = ("displacement", "displacements", "disp", "u")
"""Names, in small letters, of point data that are displacements, the first first."""

CHILD = f"import sys; sys.path.append(sys.argv[2]); from {__name__} import main; main(sys.argv[1])"

FramePoints = Float[ndarray, "f n 3"]
"""Positions in each frame of a sequence."""

ANSWER, REFUSAL = "frames.npz", "refusal.txt"
"""Files of the child's answer, one of which it writes."""


@dataclass(frozen=True, eq=False)
class MeshFrames:
    """Points of a mesh in all frames of a sequence.

    Attributes:
        points: as stored, in the file's unit.
        displacements: point data of that name, in the same unit; None where a frame has none.
        tetrahedra: four points each; other solid cells of the first frame are divided into tetrahedra.
        frames: their names, for messages.
    """

    points: FramePoints
    displacements: FramePoints | None
    tetrahedra: Elements
    frames: Names


def read_vtk_frames(files: Sequence[Path]) -> MeshFrames:
    """Frames of VTK, VTU, VTP, MSH and INP files, one each, or the time steps of a PVD or XDMF file.

    Raises ``FileNotFoundError`` and ``ValueError`` naming the file, ``ImportError`` without the extra `simulation`.
    """
    place = files[0] if len(files) == 1 else files[0].parent
    readers = ("pyvista", "meshio") if files[0].suffix.lower() in MESHIO_SUFFIXES else ("pyvista",)
    if missing := [name for name in readers if find_spec(name) is None]:
        raise ImportError(f"{place} needs {missing[0]}, which is not installed: pip install 'mereo[simulation]'")
    for file in files:
        with readable(file, "mesh"):
            pass
    with TemporaryDirectory() as folder, limited_memory(place):  # the child inherits the limit
        # -P: what lies in the working directory is data, and no module
        child = [sys.executable, "-P", "-c", CHILD, folder, str(Path(__file__).parents[2])]
        subprocess.run(child, input=json.dumps([str(file.absolute()) for file in files]).encode(), capture_output=True)
        refusal, answer = Path(folder, REFUSAL), Path(folder, ANSWER)
        if not answer.exists():
            number, why = refusal.read_text("utf-8").split(" ", 1) if refusal.exists() else ("", "it ends VTK's reader")
            wrong = files[int(number)] if number else place
            raise ValueError(f"{wrong} cannot be read as a mesh ({printable_line(why)}): export or download it again")
        with np.load(answer) as stored:
            arrays = dict(stored)
    names = tuple(f"frame {name}" for name in arrays["names"].tolist())
    counts = arrays["counts"]
    if (differs := counts != counts[0]).any():
        other = int(np.argmax(differs))
        raise ValueError(
            f"{place}: {names[other]} has {counts[other]} nodes but {names[0]} has {counts[0]}; the topology must stay "
            "the same: export without remeshing"
        )
    shape = (len(counts), -1, 3)
    moved = arrays["displacements"].reshape(shape) if len(arrays["displacements"]) else None
    return MeshFrames(arrays["points"].reshape(shape), moved, arrays["tetrahedra"], names)


# --- the child --------------------------------------------------------------------------------------------------------


def main(place: str) -> None:
    """Read files and write the arrays of ``MeshFrames`` into a folder, or the number of a bad file and the reason.

    Args:
        place: the folder. The files are a JSON list on the standard input.
    """
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    folder = Path(place)
    files = json.load(sys.stdin)
    log = vtkStringOutputWindow()
    read = list[str]()
    vtkOutputWindow.SetInstance(log)
    try:
        answer = _answer(files, log, read)
    except Exception as error:
        why = ValueError(_complaint(text)) if "ERROR: In" in (text := f"{log.GetOutput()}{error}") else error
        (folder / REFUSAL).write_text(f"{len(read)} {reason(why)}", "utf-8")
        return
    partial = folder / f"partial-{ANSWER}"
    np.savez(partial, **answer)
    partial.rename(folder / ANSWER)  # VTK may still crash at its end, but not before all is written


def _answer(files: Sequence[str], log: Any, read: list[str]) -> JsonObject:
    """Arrays of all frames; ``read`` grows by each file that is done."""
    names = list[str]()
    points = list[ndarray]()
    moved = list[ndarray]()
    tetrahedra = np.empty((0, 4), np.int64)
    for file in files:
        for step, data in enumerate(_steps(file)):
            if "ERROR: In" in log.GetOutput():
                raise ValueError("VTK reports an error")
            mesh, displacement = _whole(data)
            if mesh.n_cells == 0:  # so VTK reads files that were cut short
                raise ValueError("it has no cells")
            if not points:
                tetrahedra = _tetrahedra(mesh)
            names.append(Path(file).name if len(files) > 1 else f"{step}")
            points.append(np.array(mesh.points, float))
            if displacement is not None:
                moved.append(np.array(mesh.point_data[displacement], float))
        read.append(file)
    if not points:
        raise ValueError("it has no frames")
    return {
        "names": np.array(names),
        "counts": np.array([len(each) for each in points]),
        "points": np.concatenate(points),
        "displacements": np.concatenate(moved) if len(moved) == len(points) else np.empty((0, 3)),
        "tetrahedra": tetrahedra,
    }


def _complaint(text: str) -> str:
    """First message of VTK's log, which names a line of VTK's source and an address before it."""
    messages = [line for line in text.splitlines() if line.strip() and "ERROR: In" not in line]
    return re.sub(r"^\w+ \(0x[0-9a-f]+\): | \(0x[0-9a-f]+\)", "", messages[0]) if messages else "VTK reports an error"


def _steps(file: str) -> Iterator[Any]:
    """Data sets of a file, one for each of its time steps."""
    import pyvista

    if file.lower().endswith(".xdmf"):
        yield from _xdmf_steps(file)
        return
    if file.lower().endswith(MESHIO_SUFFIXES):
        yield pyvista.read_meshio(file)
        return
    reader = pyvista.get_reader(file)
    times = reader.time_values if file.lower().endswith(".pvd") else [None]
    for time in times:
        if time is not None:
            reader.set_active_time_value(time)
        yield reader.read()


def _xdmf_steps(file: str) -> Iterator[Any]:
    """Data sets of an XDMF file. pyvista's own reader needs times, and VTK crashes at the namespace of dolfinx."""
    import pyvista
    from vtkmodules.vtkCommonExecutionModel import vtkCompositeDataPipeline
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    text = Path(file).read_text("utf-8", errors="replace")
    os.chdir(Path(file).parent)  # where the names of HDF5 files start
    reader = vtkXdmfReader()
    reader.SetFileName(file)
    reader.SetReadFromInputString(True)
    reader.SetInputString(text.replace("https://www.w3.org/2001/XInclude", "http://www.w3.org/2001/XInclude"))
    reader.UpdateInformation()
    for time in reader.GetOutputInformation(0).Get(vtkCompositeDataPipeline.TIME_STEPS()) or [None]:
        if time is None:
            reader.Update()
        else:
            reader.UpdateTimeStep(time)
        yield pyvista.wrap(reader.GetOutputDataObject(0))


def _whole(data: Any) -> tuple[Any, str | None]:
    """One mesh of a data set's blocks, those with displacements where there are any, and the name of these."""
    import pyvista

    if data is None:
        raise ValueError("VTK finds no mesh in it")
    blocks = [data]
    if isinstance(data, pyvista.MultiBlock):
        blocks = [block for block in data.recursive_iterator() if block is not None]
    named = [(block, name) for block in blocks if (name := _displacement(block)) is not None]
    chosen = [block for block, name in named if name == named[0][1]] if named else blocks
    mesh = chosen[0] if len(chosen) == 1 else pyvista.MultiBlock(chosen).combine()
    return mesh, named[0][1] if named else None


def _displacement(mesh: Any) -> str | None:
    """Name of the point data that are displacements."""
    names = {name.lower(): name for name in mesh.point_data if np.shape(mesh.point_data[name]) == (mesh.n_points, 3)}
    return next((names[name] for name in DISPLACEMENTS if name in names), None)


def _tetrahedra(mesh: Any) -> ndarray:
    """Tetrahedra [m, 4] of a mesh; hexahedra, wedges and pyramids are divided, their nodes stay."""
    import pyvista

    if not isinstance(mesh, pyvista.UnstructuredGrid):
        return np.empty((0, 4), np.int64)
    kind = pyvista.CellType.TETRA
    solid = mesh if kind in mesh.celltypes else mesh.triangulate()
    cells: Any = solid.cells_dict
    return np.asarray(cells[kind] if kind in cells else np.empty((0, 4)), np.int64)
