"""Results as other programs read them: surfaces, label volumes, points; with frames, units, names and colours."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from written_results import CENTER, COLORS, NAMES, SIDES, centroid, cloud, grid, segments

from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import read_point_cloud
from mereo.io.volume_files import read_label_volume
from mereo.io.writers import meshes, volumes
from mereo.io.writers.glb import write_segments_glb

BOX = np.stack([CENTER - SIDES / 2, CENTER + SIDES / 2])


@pytest.mark.parametrize("write", [write_segments_glb, meshes.write_segments_obj])
def test_a_file_keeps_names_colours_and_vertices(write: Callable[[Path, SegmentedMesh], None], tmp_path: Path) -> None:
    mesh = segments()
    path = tmp_path / ("s.glb" if write is write_segments_glb else "s.obj")
    write(path, mesh)
    back = read_segmented_mesh(path)
    assert back.names == ("zebra head", "Öhrchen")
    assert back.colors == (COLORS[0], COLORS[2])
    for found, written in zip(back.segments, (mesh.segments[0], mesh.segments[2]), strict=True):
        assert_allclose(found.vertices, written.vertices, atol=1e-7)
        assert_array_equal(found.faces, written.faces)


def test_other_programs_see_the_glb_y_up_in_metres(tmp_path: Path) -> None:
    mesh = segments()
    write_segments_glb(tmp_path / "s.glb", mesh, unit_m=0.001)
    scene = trimesh.load_scene(tmp_path / "s.glb", process=False)
    node, key = scene.graph["zebra head"]
    assert_allclose(node, np.diag([0.001, -0.001, -0.001, 1.0]))
    # camera (0.1, 0.2, 0.5): y down and z forward become y up and z toward the viewer
    place = trimesh.transform_points(scene.geometry["Öhrchen"].vertices, scene.graph["Öhrchen"][0])
    assert_allclose(place.mean(axis=0), 0.001 * CENTER * [1, -1, -1], atol=1e-9)
    # glTF factors are linear light: viewers turn them back into the segment's sRGB colour
    linear = np.asarray(scene.geometry[key].visual.material.baseColorFactor[:3]) / 255.0
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert_allclose(255 * srgb, (86, 180, 233), atol=1.5)
    assert scene.geometry[key].visual.material.doubleSided


def test_a_glb_has_normals_that_point_outward(tmp_path: Path) -> None:
    write_segments_glb(tmp_path / "s.glb", segments())
    scene = trimesh.load_scene(tmp_path / "s.glb", process=False)
    assert "vertex_normals" in scene.geometry["zebra head"]._cache.cache, "they are trimesh's own, not the file's"
    for name in ("zebra head", "Öhrchen"):
        part = scene.geometry[name]
        outward = part.vertices - part.vertices.mean(axis=0)
        assert_allclose(norm(part.vertex_normals, axis=1), 1.0, atol=1e-6)
        # at the corners of a long box, whose faces have normals of their own, they are nearly across
        assert (np.einsum("ij,ij->i", part.vertex_normals, outward) > 0.2 * norm(outward, axis=1)).all()


@pytest.mark.parametrize(
    "write", [write_segments_glb, meshes.write_segments_ply, meshes.write_segments_obj, meshes.write_segments_stl]
)
def test_results_without_surfaces_are_refused(tmp_path: Path, write: Callable[[Path, SegmentedMesh], None]) -> None:
    with pytest.raises(ValueError, match="all segments are without faces"):
        write(tmp_path / "s", SegmentedMesh((segments().segments[1],)))
    assert list(tmp_path.iterdir()) == []


def test_a_ply_has_positions_labels_and_colours_of_vertices_and_faces(tmp_path: Path) -> None:
    mesh = segments()
    meshes.write_segments_ply(tmp_path / "s.ply", mesh)
    found = trimesh.load_mesh(tmp_path / "s.ply", process=False)
    raw = found.metadata["_ply_raw"]
    for element, count in (("vertex", len(found.vertices)), ("face", len(found.faces))):
        data = raw[element]["data"]
        assert data.dtype["label"] == np.uint8 and len(data) == count
        assert set(np.unique(data["label"])) == {1, 3}
        colors = np.stack([data[channel] for channel in ("red", "green", "blue")], axis=1)
        assert_array_equal(colors, np.array(COLORS)[data["label"] - 1])
    label = raw["vertex"]["data"]["label"]
    assert_allclose(found.vertices[label == 1], mesh.segments[0].vertices, atol=1e-7)
    box = found.vertices[label == 3]
    assert_allclose([box.min(axis=0), box.max(axis=0)], BOX, atol=1e-7)
    of_faces = raw["face"]["data"]["label"]
    assert_array_equal(label[found.faces], np.repeat(of_faces[:, None], 3, axis=1))
    assert found.submesh([np.flatnonzero(of_faces == 3)], append=True).volume == pytest.approx(SIDES.prod(), rel=1e-5)


def test_an_obj_gives_back_its_colours_from_the_library_beside_it(tmp_path: Path) -> None:
    meshes.write_segments_obj(tmp_path / "s.obj", segments())
    library = (tmp_path / "s.mtl").read_text("utf-8")
    for damaged in (library.replace("Kd", "map_Kd ear.png\nKd"), "newmtl", library.replace("Kd ", "Kd spectral ")):
        (tmp_path / "s.mtl").write_text(damaged, "utf-8")
        assert read_segmented_mesh(tmp_path / "s.obj").colors == PALETTE[:2], "a texture, or damage: none"
    (tmp_path / "s.mtl").unlink()
    assert read_segmented_mesh(tmp_path / "s.obj").colors == PALETTE[:2]


def test_an_obj_does_not_choose_which_other_files_are_opened(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    meshes.write_segments_obj(tmp_path / "s.obj", segments())
    text = (tmp_path / "s.obj").read_text("utf-8").replace("mtllib s.mtl", "mtllib ../s.mtl")
    (tmp_path / "inner/t.obj").write_text(text, "utf-8")
    assert read_segmented_mesh(tmp_path / "inner/t.obj").colors == PALETTE[:2]


def test_other_programs_see_the_obj_in_its_colours(tmp_path: Path) -> None:
    """trimesh splits at materials; each is one segment, at its place, in its colour."""
    meshes.write_segments_obj(tmp_path / "s.obj", segments())
    scene = trimesh.load_scene(tmp_path / "s.obj", process=False, split_object=True, group_material=False)
    parts = {part.visual.material.name: part for part in scene.geometry.values()}
    assert set(parts) == {"zebra_head", "Öhrchen"}
    for name, color in (("zebra_head", COLORS[0]), ("Öhrchen", COLORS[2])):
        assert_allclose(parts[name].visual.material.diffuse[:3], color, atol=1)
    assert_allclose(parts["Öhrchen"].bounds, BOX, atol=1e-7)
    assert parts["Öhrchen"].volume == pytest.approx(SIDES.prod())


def nearly_pinched() -> SegmentedMesh:
    """A ball in metres with edges of a few nanometres, as marching cubes makes them beside a grid's node."""
    ball = trimesh.creation.icosphere(3, radius=0.05)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    for face in (10, 400, 900):
        a, b, _ = faces[face]
        vertices[b] = vertices[a] + 4e-9
    return SegmentedMesh((Segment("ball", (1, 2, 3), vertices + np.array([0.0, 0.0, 0.3]), faces),))


@pytest.mark.parametrize("suffix", ["glb", "obj", "stl"])
def test_what_is_closed_is_closed_again_in_other_programs(tmp_path: Path, suffix: str) -> None:
    mesh = nearly_pinched()
    assert trimesh.Trimesh(mesh.segments[0].vertices, mesh.segments[0].faces, process=False).is_watertight
    writers = {"glb": write_segments_glb, "obj": meshes.write_segments_obj, "stl": meshes.write_segments_stl}
    writers[suffix](tmp_path / f"s.{suffix}", mesh)
    path = tmp_path / (f"s.{suffix}" if suffix != "stl" else "s.stl/1-ball.stl")
    (part,) = trimesh.load_scene(path).geometry.values()
    assert part.is_watertight and part.is_winding_consistent and len(part.faces) == len(mesh.segments[0].faces) - 6
    assert part.volume == pytest.approx(mesh.segments[0].volume, rel=1e-5)
    (back,) = read_segmented_mesh(path).segments
    assert trimesh.Trimesh(back.vertices, back.faces, process=False).is_watertight


def test_only_edges_without_length_are_closed_up() -> None:
    mesh = nearly_pinched().segments[0]
    less = meshes.settled(mesh)
    assert len(less.vertices) == len(mesh.vertices) - 3
    assert {tuple(vertex) for vertex in less.vertices} <= {tuple(vertex) for vertex in mesh.vertices}
    assert meshes.settled(less) is less
    # a whole segment smaller than that keeps its shape
    grain = replace(mesh, vertices=1e-9 * mesh.vertices)
    assert meshes.settled(grain) is grain


def test_stl_files_are_closed_solids_at_their_place(tmp_path: Path) -> None:
    meshes.write_segments_stl(tmp_path / "stl", segments())
    assert sorted(path.name for path in (tmp_path / "stl").glob("[!.]*")) == ["1-zebra-head.stl", "3-Öhrchen.stl"]
    box = trimesh.load_mesh(tmp_path / "stl/3-Öhrchen.stl")
    assert box.is_watertight and box.volume == pytest.approx(SIDES.prod(), rel=1e-5)
    assert_allclose(box.bounds, BOX, atol=1e-7)
    raw = trimesh.load_mesh(tmp_path / "stl/3-Öhrchen.stl", process=False)
    assert_allclose(np.abs(raw.face_normals).max(axis=1), 1.0, atol=1e-5)
    outward = raw.triangles_center - CENTER
    assert (np.einsum("ij,ij->i", raw.face_normals, outward) > 0).all()


def test_an_stl_keeps_the_name_of_its_segment(tmp_path: Path) -> None:
    meshes.write_segments_stl(tmp_path / "stl", segments())
    assert read_segmented_mesh(tmp_path / "stl").names == (NAMES[0], NAMES[2])
    assert (tmp_path / "stl/1-zebra-head.stl").read_bytes().startswith(b"written by mereo: zebra head ")
    # what does not fit, or would break the text, is left to the file's name
    long = SegmentedMesh((replace(segments().segments[0], name="x" * 90),))
    meshes.write_segments_stl(tmp_path / "long", long)
    assert read_segmented_mesh(tmp_path / "long").names == (f"1-{'x' * 90}",)


def test_names_of_files_and_materials_are_safe_and_distinct() -> None:
    assert [meshes.stl_name(*name) for name in ((1, "../../etc/passwd"), (4, "//"))] == ["1-etc-passwd.stl", "4.stl"]
    part = segments().segments[0]
    found = [(label, replace(part, name=name)) for label, name in ((1, "a b"), (2, "a/b"), (3, "//"), (7, "c"))]
    assert meshes.material_names(found) == ["a_b_label_1", "a_b_label_2", "label_3", "c"]


# --- volumes and points -----------------------------------------------------------------------------------------------


RAS_OF_INPUT = np.array([-1.0, -1.0, 1.0])


def test_vtk_sees_the_labels(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed: pip install 'mereo[dev]'")
    volumes.write_labels_vti(tmp_path / "l.vti", grid(), COLORS)
    image = pyvista.read(tmp_path / "l.vti")
    assert_array_equal(image["label"], np.ravel(grid().labels, order="F"))
    assert (image.dimensions, image.origin) == (grid().labels.shape, tuple(grid().origin))
    assert_allclose(image.spacing, grid().spacing)


def test_nibabel_sees_the_labels_in_ras_millimetres(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    volumes.write_labels_nifti(tmp_path / "l.nii.gz", grid(), COLORS)
    image = nibabel.load(tmp_path / "l.nii.gz")
    values = np.asarray(image.dataobj)
    assert_array_equal(values, grid().labels)
    assert values.dtype == np.uint8
    for label in (1, 3):
        index = np.argwhere(values == label).mean(axis=0)
        place = nibabel.affines.apply_affine(image.affine, index)
        assert_allclose(place, 1000.0 * centroid(label) * RAS_OF_INPUT, atol=1e-3)
    assert image.header.get_xyzt_units()[0] == "mm"
    assert nibabel.aff2axcodes(image.affine) == ("L", "P", "S")
    for form in (image.get_sform, image.get_qform):
        found, code = form(coded=True)
        assert code == 1
        assert_allclose(found, image.affine, atol=1e-4)
    table = json.loads(image.header.extensions[0].text)["segments"]
    assert [(row["label"], row["name"], tuple(row["color"])) for row in table] == [
        (index + 1, name, color) for index, (name, color) in enumerate(zip(NAMES, COLORS, strict=True))
    ]


def test_slicer_finds_what_it_looks_for(tmp_path: Path) -> None:
    """The fields that vtkMRMLSegmentationStorageNode reads; its loop over segments ends at the first missing ID."""
    volumes.write_labels_seg_nrrd(tmp_path / "l.seg.nrrd", grid(), COLORS)
    head = (tmp_path / "l.seg.nrrd").read_bytes().partition(b"\n\n")[0].decode("utf-8")
    assert "\nspace: left-posterior-superior\n" in head
    fields = dict(re.findall(r"^(Seg\w+):=(.*)$", head, re.MULTILINE))
    for index, (name, color) in enumerate(zip(NAMES, COLORS, strict=True)):
        own = {key.partition("_")[2]: value for key, value in fields.items() if key.startswith(f"Segment{index}_")}
        assert (own["Name"], own["LabelValue"], own["Layer"]) == (name, str(index + 1), "0")
        assert_allclose([255 * float(value) for value in own["Color"].split()], color, atol=1e-3)
        # Slicer cuts the shared layer to the extent of its first segment: a tight one would cut off the others
        assert own["Extent"] == "0 6 0 10 0 19"
    assert len({fields[f"Segment{index}_ID"] for index in range(3)}) == 3 and "Segment3_ID" not in fields
    assert fields["Segmentation_MasterRepresentation"] == "Binary labelmap"
    assert "Closed surface" in fields["Segmentation_ContainedRepresentationNames"].split("|")
    assert fields["Segmentation_ReferenceImageExtentOffset"] == "0 0 0"


@pytest.mark.parametrize("unit_m", [1.0, 0.001])
def test_both_volumes_coincide(tmp_path: Path, unit_m: float) -> None:
    """Read as anatomical volumes (RAS), and in millimetres whatever the input's unit."""
    pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    pytest.importorskip("nrrd", reason="pynrrd is not installed: pip install 'mereo[medical]'")
    volumes.write_labels_nifti(tmp_path / "l.nii", grid(), COLORS, unit_m)
    volumes.write_labels_seg_nrrd(tmp_path / "l.seg.nrrd", grid(), COLORS, unit_m)
    nifti, nrrd = read_label_volume(tmp_path / "l.nii"), read_label_volume(tmp_path / "l.seg.nrrd")
    assert_array_equal(nifti.labels, nrrd.labels)
    assert_allclose(nifti.T_world_index, nrrd.T_world_index, atol=1e-3 * unit_m)
    place = nrrd.T_world_index @ [*np.argwhere(nrrd.labels[0] == 3).mean(axis=0), 1.0]
    assert_allclose(place[:3], 1000 * unit_m * CENTER * RAS_OF_INPUT, atol=0.5 * unit_m)


def test_the_same_result_gives_the_same_bytes(tmp_path: Path) -> None:
    for number in range(2):
        volumes.write_labels_seg_nrrd(tmp_path / f"{number}.seg.nrrd", grid(), COLORS)
        volumes.write_labels_nifti(tmp_path / f"{number}.nii.gz", grid(), COLORS)
    for end in ("seg.nrrd", "nii.gz"):
        assert (tmp_path / f"0.{end}").read_bytes() == (tmp_path / f"1.{end}").read_bytes()


def test_labels_have_names(tmp_path: Path) -> None:
    volumes.write_labels_npz(tmp_path / "l.npz", grid())
    with np.load(tmp_path / "l.npz", allow_pickle=False) as loaded:
        assert all(np.array_equal(loaded[name], getattr(grid(), name)) for name in loaded.files) and len(loaded) == 4
    with pytest.raises(ValueError, match="label 3 has no name among 2"):
        volumes.write_labels_npz(tmp_path / "l.npz", replace(grid(), names=("a", "b")))


def test_labelled_points_come_back(tmp_path: Path) -> None:
    written = cloud()
    meshes.write_points_ply(tmp_path / "p.ply", written)
    volumes.write_points_npz(tmp_path / "p.npz", written)
    found = trimesh.load(tmp_path / "p.ply", process=False)
    data = found.metadata["_ply_raw"]["vertex"]["data"]
    assert_allclose(found.vertices, written.points, atol=1e-7)
    assert_array_equal(data["label"], written.labels)
    assert_allclose(data["confidence"], written.confidence, atol=1e-7)
    assert_allclose(data["occupancy"], written.occupancy, atol=1e-7)
    assert_array_equal(np.asarray(found.colors)[:, :3], np.array(COLORS)[written.labels - 1])
    head = (tmp_path / "p.ply").read_bytes().partition(b"end_header")[0].decode("ascii")
    assert tuple(json.loads(row)["name"] for row in re.findall(r"comment segment (.*)", head)) == NAMES
    with np.load(tmp_path / "p.npz") as stored:
        for key in ("points", "labels", "confidence", "occupancy", "names", "colors"):
            assert_array_equal(stored[key], np.asarray(getattr(written, key)))
    assert_allclose(read_point_cloud(tmp_path / "p.ply").points, written.points, atol=1e-7)
