"""States from files: every format gives the same motion, and what does not fit is named with its cure."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from folder_contents import refusal
from lattice import boxes, lattice, pvd_text, states, xdmf_text
from numpy import ndarray
from numpy.random import default_rng
from numpy.testing import assert_allclose

from mereo.deformation.tetrahedral import Tetrahedra, TetrahedralMap
from mereo.io.simulation_states import TetrahedralRecord, read_states
from mereo.scenes.recorded_states import SplitStates, load_states

SCALE = 0.5
SHIFT = (1.0, -2.0, 3.0)
"""From the files' coordinates to those of the scene, in which ``boxes`` are."""


Arrays = dict[str, ndarray]

Written = tuple[Path, Path]
"""A file of states, and that of the mesh at rest."""


def to_file(points: ndarray) -> ndarray:
    return (points - SHIFT) / SCALE


def moved_vertices() -> Arrays:
    """Positions [frames, vertices, 3] of both segments, scene coordinates."""
    maps = [TetrahedralMap(lattice(), nodes) for nodes in states()]
    return {part.name: np.stack([f(part.vertices) for f in maps]) for part in boxes().segments}


def soup() -> Arrays:
    return {part.name: part.faces.ravel() for part in boxes().segments}


def nodes_npz(path: Path) -> Path:
    mesh = lattice()
    np.savez(path / "s.npz", rest_nodes=to_file(mesh.nodes), tetrahedra=mesh.elements, nodes=to_file(states()))
    return path / "s.npz"


def vertices_npz(path: Path) -> Path:
    np.savez(path / "s.npz", **{name: to_file(moved) for name, moved in moved_vertices().items()})
    return path / "s.npz"


def unmerged_npz(path: Path) -> Path:
    """As exporters write them that split vertices at normals: more of them than the mesh, in another order."""
    rest = {f"{part.name}.rest": to_file(part.vertices[soup()[part.name]]) for part in boxes().segments}
    np.savez(path / "s.npz", **rest, **{name: to_file(v[:, soup()[name]]) for name, v in moved_vertices().items()})
    return path / "s.npz"


def meshes(suffix: str, rest: bool) -> Callable[[Path], Path]:
    """One folder for each segment, a mesh for each frame, numbered without leading zeros."""

    def write(path: Path) -> Path:
        for part in boxes().segments:
            (path / part.name).mkdir()
            poses = {f"{frame + 1}": v for frame, v in enumerate(moved_vertices()[part.name])}
            for stem, vertices in {**poses, **({"rest": part.vertices} if rest else {})}.items():
                mesh = trimesh.Trimesh(to_file(vertices), part.faces, process=False)
                mesh.export(path / part.name / f"{stem}.{suffix}")
        return path

    return write


def grid(nodes: ndarray, **data: ndarray) -> Any:
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'mereo[dev]'")
    made = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: lattice().elements}, to_file(nodes))
    made.point_data.update(data)
    return made


def surface(vertices: ndarray) -> Any:
    """Both boxes as one surface, vertices reversed: no order but that of its own rest."""
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'mereo[dev]'")
    faces = len(vertices) - 1 - boxes().merged()[1]
    return pyvista.PolyData.from_regular_faces(to_file(vertices[::-1]), faces)


DISPLACEMENTS = (states() - lattice().nodes) / SCALE


def numpy_and_volume(path: Path) -> Written:
    """Positions as PyBullet or a script of SOFA records them, beside the simulated mesh with triangles in it."""
    np.save(path / "run.npy", to_file(states()).astype(np.float32))
    mesh = grid(lattice().nodes)
    (mesh + mesh.extract_surface(algorithm="dataset_surface")).save(path / "volume.vtk")
    return path / "run.npy", path / "volume.vtk"


def numpy_and(suffix: str, path: Path) -> Written:
    """Positions beside the simulated mesh as Gmsh or Abaqus writes it."""
    meshio = pytest.importorskip("meshio", reason="meshio is not installed: pip install 'mereo[dev]'")
    np.save(path / "run.npy", to_file(states()))
    faces = ("triangle", lattice().surface)
    meshio.Mesh(to_file(lattice().nodes), [faces, ("tetra", lattice().elements)]).write(path / f"volume{suffix}")
    return path / "run.npy", path / f"volume{suffix}"


def numpy_and_surface(path: Path) -> Written:
    moved = np.concatenate(list(moved_vertices().values()), axis=1)
    np.save(path / "run.npy", to_file(moved[:, ::-1]))
    surface(boxes().merged()[0]).save(path / "rest.ply")
    return path / "run.npy", path / "rest.ply"


def folder_of_displacements(path: Path) -> Path:
    for frame, moved in enumerate(DISPLACEMENTS):
        grid(lattice().nodes, U=moved, velocity=10 * moved).save(path / f"{frame}.vtu")
    return path


def pattern_of_both(path: Path) -> Path:
    """Points that have moved, by displacements that are stored too; other files lie in the folder."""
    for frame, (nodes, moved) in enumerate(zip(states(), DISPLACEMENTS, strict=True)):
        grid(nodes, Displacement=moved).save(path / f"run_{frame}.vtk")
    grid(lattice().nodes).save(path / "other.vtk")
    return path / "run_*.vtk"


def collection(path: Path) -> Written:
    (path / "parts").mkdir()
    for frame, nodes in enumerate(states()):
        grid(nodes).save(path / "parts" / f"{frame}.vtu")
    (path / "run.pvd").write_text(pvd_text([f"parts/{frame}.vtu" for frame in range(10)]), encoding="utf-8")
    from vtkmodules.vtkIOXdmf2 import vtkXdmfWriter

    writer = vtkXdmfWriter()
    folder = os.getcwd()
    os.chdir(path)  # it names the HDF5 file as it is told
    try:
        writer.SetFileName("mesh.xdmf")
        writer.SetInputData(grid(lattice().nodes))
        writer.SetLightDataLimit(1)
        assert writer.Write()
    finally:
        os.chdir(folder)
    assert (path / "mesh.h5").stat().st_size > 0
    return path / "run.pvd", path / "mesh.xdmf"


def fenics(path: Path) -> Path:
    text = xdmf_text(to_file(lattice().nodes), lattice().elements, DISPLACEMENTS)
    (path / "run.xdmf").write_text(text, encoding="utf-8")
    return path / "run.xdmf"


FORMATS = {
    "nodes": nodes_npz,
    "vertices": vertices_npz,
    "unmerged": unmerged_npz,
    "ply": meshes("ply", rest=False),
    "obj": meshes("obj", rest=False),
    "stl": meshes("stl", rest=True),
    "NPY, VTK": numpy_and_volume,
    "NPY, MSH": partial(numpy_and, ".msh"),
    "NPY, INP": partial(numpy_and, ".inp"),
    "NPY, PLY": numpy_and_surface,
    "VTU": folder_of_displacements,
    "VTK": pattern_of_both,
    "PVD, XDMF": collection,
    "XDMF": fenics,
}


ROUNDED = ("ply", "stl", "obj", "NPY, VTK", "NPY, PLY")
"""Those in single precision or of eight digits."""


def load_written(written: Path | Written) -> SplitStates:
    """States from a path, or a path and a mesh beside it."""
    path, mesh = written if isinstance(written, tuple) else (written, None)
    return load_states(path, boxes(), mesh=mesh, scale=SCALE, shift=SHIFT)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_states(name: str, tmp_path: Path) -> None:
    split = load_written(FORMATS[name](tmp_path))
    frames = split.training.frames
    truth = moved_vertices()
    assert frames.count == 10 and (split.training.end, split.testing.first) == (9, 9)
    for frame in range(10):
        for part, deformation in zip(boxes().segments, frames.deformations(frame), strict=True):
            tolerance = 1e-9 if name not in ROUNDED else 1e-5
            assert np.abs(deformation(part.vertices) - truth[part.name][frame]).max() < tolerance


def test_a_sequence_of_positions_starts_at_rest_and_hexahedra_are_divided(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'mereo[dev]'")
    rest = np.stack(np.meshgrid(np.arange(7.0), *[np.arange(4.0)] * 2, indexing="ij"), axis=-1)
    matrix = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.3, 1.0]])
    for frame, turn in enumerate((np.eye(3), matrix, matrix @ matrix)):
        x, y, z = np.moveaxis(rest @ turn.T, -1, 0)
        pyvista.StructuredGrid(x, y, z).cast_to_unstructured_grid().save(tmp_path / f"{frame}.vtu")
    frames = load_states(tmp_path, boxes()).training.frames
    for part, deformation in zip(boxes().segments, frames.deformations(2), strict=True):
        assert_allclose(deformation(part.vertices), part.vertices @ (matrix @ matrix).T, atol=1e-12)
    record = read_states(tmp_path, ("left", "right"))
    assert isinstance(record, TetrahedralRecord) and np.abs(record.displacements[0]).max() == 0
    assert np.abs(Tetrahedra(record.rest_nodes, record.tetrahedra).volumes).sum() == pytest.approx(6 * 3 * 3)


def tetrahedral(**changes: ndarray) -> Arrays:
    return {"rest_nodes": lattice().nodes, "tetrahedra": lattice().elements, "nodes": states()} | changes


def surfaces(**changes: ndarray) -> Arrays:
    return moved_vertices() | changes


def inside_out() -> ndarray:
    moved = moved_vertices()["left"]
    moved[4] = boxes().segments[0].vertices * [1, 1, -1]
    return moved


def shuffled() -> ndarray:
    moved = moved_vertices()["left"]
    return moved[:, default_rng(0).permutation(moved.shape[1])]


def inverted() -> ndarray:
    """Frame 6 pulls node 37 through its neighbours."""
    nodes = states().copy()
    nodes[6, 37] += 1.5
    return nodes


REFUSED = {
    "inverted": (lambda: tetrahedral(nodes=inverted()), r"frame 6 inverts tetrahedron \d+ .* leave the frame out"),
    "quads": (lambda: tetrahedral(tetrahedra=lattice().elements[:, :3]), r"the shape \[270, 3\] .* integers \[m, 4\]"),
    "unknown": (lambda: tetrahedral(velocity=np.zeros(3)), "has the array 'velocity'; known are rest_nodes"),
    "far away": (lambda: tetrahedral(rest_nodes=1e-3 * lattice().nodes), "check the unit, scale and shift"),
    "NaN": (lambda: surfaces(left=moved_vertices()["left"] * np.nan), "frame 0 of left has NaN"),
    "vertex count": (lambda: surfaces(left=moved_vertices()["left"][:, 1:]), "97 vertices .* 98 .*'left.rest'"),
    "order": (lambda: surfaces(left=shuffled()), "seem to be in another order or unit"),
    "inside out": (lambda: surfaces(left=inside_out()), "frame 4 turns 'left' inside out"),
    "stranger": (lambda: surfaces(middle=np.zeros((10, 4, 3))), "'middle', which is no segment"),
    "other rest": (lambda: surfaces(**{"left.rest": 2 * boxes().segments[0].vertices}), "miss a vertex of its mesh by"),
    "none": (lambda: surfaces(left=np.zeros((0, 98, 3)), right=np.zeros((0, 98, 3))), "has no frames"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_states_that_do_not_fit_are_named(case: str, tmp_path: Path) -> None:
    arrays, text = REFUSED[case]
    np.savez(tmp_path / "s.npz", **arrays())
    with refusal(text):
        load_states(tmp_path / "s.npz", boxes())


def test_paths_that_are_no_states_are_explained(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"one folder of mesh files for each segment \(left, right\), or a mesh for"):
        load_states(tmp_path, boxes())
    meshes("ply", rest=False)(tmp_path)
    (tmp_path / "right/10.ply").unlink()
    with pytest.raises(ValueError, match="10 of 'left', 9 of 'right' frames; all segments need the same number"):
        load_states(tmp_path, boxes())
    trimesh.creation.box().export(tmp_path / "right/10.ply")
    with pytest.raises(ValueError, match="right: frame 10.ply has 8 vertices but frame 1.ply has 98; the topology"):
        load_states(tmp_path, boxes())
    (tmp_path / "s.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="cannot be read as a NPZ file"):
        load_states(tmp_path / "s.npz", boxes())
    (tmp_path / "s.csv").write_text("1,2,3")
    with pytest.raises(ValueError, match="has the suffix '.csv'; states are an NPZ or NPY file, a PVD"):
        load_states(tmp_path / "s.csv", boxes())


def remeshed(path: Path) -> Path:
    grid(states()[0]).save(path / "0.vtu")
    grid(states()[1]).extract_cells(range(40)).save(path / "1.vtu")
    return path


def single_surface(path: Path) -> Path:
    surface(boxes().merged()[0]).save(path / "0.vtp")
    return path / "*.vtp"


def other_surface(path: Path) -> Written:
    run, mesh = numpy_and_surface(path)
    surface(1.01 * boxes().merged()[0]).save(mesh)
    return run, mesh


def cut_short(path: Path) -> Path:
    file = folder_of_displacements(path) / "3.vtu"
    file.write_bytes(file.read_bytes()[:600])
    return path


UNUSABLE = {
    "remeshed": (remeshed, r"frame 1.vtu has \d+ nodes but frame 0.vtu has 96; the topology must stay the same"),
    "no tetrahedra": (single_surface, r"no tetrahedra and one surface for 2 segments; .* `states: \{positions: "),
    "other surface": (other_surface, r"miss a vertex of its mesh by .*; without tetrahedra .* or name a mesh with tet"),
    "cut short": (cut_short, r"3.vtu cannot be read as a mesh \(.*\): export or download it again"),
    "mesh of an archive": (
        lambda path: (nodes_npz(path), path / "volume.vtk"),
        r"an NPZ file, which holds its own rest; `mesh` is not for it: leave it",
    ),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_other_programs_files_that_do_not_fit_are_named(case: str, tmp_path: Path) -> None:
    write, text = UNUSABLE[case]
    with refusal(text):
        load_written(write(tmp_path))


def test_a_crash_of_the_reader_and_its_absence_are_sentences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.pvd").write_text(pvd_text([]), encoding="utf-8")
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(ValueError, match=r"run.pvd cannot be read as a mesh \(it ends VTK's reader\): export or"):
        load_states(tmp_path / "run.pvd", boxes())
    monkeypatch.setattr("mereo.io.vtk_frames.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"run.pvd needs pyvista, .* pip install 'mereo\[simulation\]'"):
        load_states(tmp_path / "run.pvd", boxes())
    (tmp_path / "part.msh").write_text("$MeshFormat", encoding="utf-8")
    monkeypatch.setattr("mereo.io.vtk_frames.find_spec", lambda name: None if name == "meshio" else name)
    with pytest.raises(ImportError, match=r"part.msh needs meshio, .* pip install 'mereo\[simulation\]'"):
        load_states(tmp_path / "part.msh", boxes())


def test_too_few_frames_to_split_and_bad_settings_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", **{name: v[:1] for name, v in moved_vertices().items()})
    with pytest.raises(ValueError, match="has 1 frames, of which 1 would be held out .* set held_out to 0"):
        load_states(tmp_path / "s.npz", boxes())
    assert load_states(tmp_path / "s.npz", boxes(), held_out=0.0).testing is None
    with pytest.raises(ValueError, match="held_out is 1.5; the share of frames for testing is from 0"):
        load_states(tmp_path / "s.npz", boxes(), held_out=1.5)
    with pytest.raises(ValueError, match="scale is 0.0 and shift"):
        load_states(tmp_path / "s.npz", boxes(), scale=0.0)
