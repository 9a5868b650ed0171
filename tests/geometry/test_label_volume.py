"""Label volumes: surfaces where the voxels are, in millimetres of the patient, closed, smooth, and in contact."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from label_cases import CENTER, ORIGIN, RADIUS, SPACING, halves, nibabel, write_nifti
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from overlapping import check_overlap
from shapes import ball, box
from shapes import segment as segment_of

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.geometry.mesh_check import overlaps
from mereo.geometry.solids import Solids
from mereo.geometry.subdivision import split_at_creases
from mereo.geometry.transforms import unit_rows
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.volume_files import LabelVolume, LabelWarning, is_volume, read_label_volume, segment_surfaces
from mereo.io.writers.glb import write_segments_glb
from mereo.io.writers.volumes import write_labels_seg_nrrd
from mereo.scenes.files.object_files import scene_of_meshes, shapes_in
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.registry import load_scene

nrrd = pytest.importorskip("nrrd")


@pytest.mark.parametrize("cells", [96, 40])
def test_a_nifti_volume_is_in_millimetres_of_ras(cells: int, tmp_path: Path) -> None:
    volume = read_label_volume(write_nifti(tmp_path / "a.nii.gz", halves()))
    mesh = segment_surfaces(volume, {1: "liver", 2: "spleen"}, cells)
    mesh.check()
    check_overlap(mesh)
    assert mesh.names == ("liver", "spleen")
    for label, segment in enumerate(mesh.segments, start=1):
        assert segment.volume == pytest.approx((halves() == label).sum() * SPACING.prod(), rel=0.02)
    low, high = mesh.bounds
    assert_allclose((low + high) / 2, ORIGIN + CENTER, atol=1.0)
    assert_allclose(high - low, 2 * RADIUS, atol=2.5)
    assert mesh.segments[0].bounds[1, 0] == pytest.approx(ORIGIN[0] + CENTER[0], abs=2.0)


def test_nrrd_in_lps_is_the_same_place_as_nifti_in_ras(tmp_path: Path) -> None:
    header = {
        "space": "left-posterior-superior",
        "space directions": np.diag(SPACING * [-1, -1, 1]),
        "space origin": ORIGIN * [-1, -1, 1],
        "Segment0_LabelValue": "2",
        "Segment0_Name": "spleen",
    }
    nrrd.write(str(tmp_path / "a.seg.nrrd"), halves().astype(np.uint8), header)
    volume = read_label_volume(tmp_path / "a.seg.nrrd")
    expected = read_label_volume(write_nifti(tmp_path / "a.nii", halves()))
    assert_allclose(volume.T_world_index, expected.T_world_index)
    assert_array_equal(volume.labels, expected.labels)
    assert volume.names == {2: "spleen"}


def test_surfaces_are_smooth_and_neighbours_touch(tmp_path: Path) -> None:
    volume = read_label_volume(write_nifti(tmp_path / "a.nii", halves()))
    mesh = segment_surfaces(volume, {1: "liver", 2: "spleen"}, 96)
    outer = mesh.merged()[0] - (ORIGIN + CENTER)
    radius = norm(outer[np.abs(outer[:, 0]) > 5], axis=1)
    assert np.abs(radius - RADIUS).max() < 1.25  # slices are 2.5 mm apart; unsmoothed steps would be as high
    assert radius.std() < 0.4
    wall = np.stack(np.meshgrid([-1.0, 1.0], np.linspace(-25, 25, 9), np.linspace(-25, 25, 9), indexing="ij"), axis=-1)
    labels = Solids(mesh).label(wall.reshape(-1, 3) + ORIGIN + CENTER).reshape(2, -1)
    assert (labels[0] == 1).all() and (labels[1] == 2).all()


def test_a_segment_at_the_border_is_closed(tmp_path: Path) -> None:
    labels = np.ones((20, 30, 10), np.int64)
    mesh = segment_surfaces(read_label_volume(write_nifti(tmp_path / "a.nii", labels)), {1: "block"}, 96)
    mesh.check()
    assert_allclose(mesh.bounds[0], ORIGIN - SPACING / 2, atol=0.6)
    assert mesh.segments[0].volume == pytest.approx(labels.size * SPACING.prod(), rel=0.06)  # its edges are rounded


def test_wrong_volumes_are_explained(tmp_path: Path) -> None:
    labels = halves()
    volume = read_label_volume(write_nifti(tmp_path / "a.nii", labels))
    with pytest.raises(ValueError, match=r"no voxel of 'x', value 3; it holds the values 1, 2, 7"):
        segment_surfaces(volume, {3: "x"}, 96)
    with pytest.raises(ValueError, match=r"segment 'speck' would keep 0% .*raise `cells`, or leave"):
        segment_surfaces(volume, {1: "liver", 7: "speck"}, 96)
    nibabel.save(nibabel.Nifti1Image(np.full((4, 4, 4), 0.5, np.float32), np.eye(4)), tmp_path / "b.nii")
    with pytest.raises(ValueError, match="no labels; they must be whole numbers"):
        read_label_volume(tmp_path / "b.nii")
    nrrd.write(str(tmp_path / "c.nrrd"), np.zeros((2, 4, 4, 4), np.uint8))
    with pytest.raises(ValueError, match="has 4 dimensions; a label volume has 3, or the layers of a segmentation of"):
        read_label_volume(tmp_path / "c.nrrd")
    with pytest.raises(FileNotFoundError, match="none.nii does not exist"):
        read_label_volume(tmp_path / "none.nii")
    assert is_volume(Path("A.NII.GZ")) and not is_volume(Path("a.stl"))


def test_a_scene_from_a_label_volume(tmp_path: Path) -> None:
    write_nifti(tmp_path / "ct.nii.gz", halves())
    path = tmp_path / "organs.yaml"
    path.write_text("name: organs\nunits: mm\nlabels: ct.nii.gz\nnames: {1: liver, 2: spleen}\ncells: 48\n")
    scene = load_scene(path)
    assert scene.rest.names == ("liver", "spleen")
    assert scene.unit_m == pytest.approx(0.08 / 20, rel=0.05)
    check_overlap(scene.sample_state(default_rng(0)).mesh)
    path.write_text("name: organs\nunits: mm\nlabels: ct.nii.gz\nnames: {1: liver, 5: spleen}\n")
    with pytest.raises(ValueError, match=r"organs.yaml:3: the volume has no voxel of 'spleen'"):
        load_scene(path)


def sphere(center: tuple[float, ...], radius: float) -> ndarray:
    """Voxels of a ball on a grid of 60 x 60 x 40, which are 1 x 1 x 1.5 mm."""
    axes = [np.arange(n) * s for n, s in zip((60, 60, 40), GRID, strict=True)]
    return norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - center, axis=-1) < radius


GRID = np.array([1.0, 1.0, 1.5])

PARTS = {"liver": sphere((30, 30, 30), 20), "tumor": sphere((24, 30, 30), 6), "kidney": sphere((47, 30, 30), 8)}
"""The tumour lies in the liver, and of the kidney a part."""


def write_layers(path: Path, layers: list[ndarray], fields: dict[str, object]) -> Path:
    """A segmentation as 3D Slicer writes it, with the layers as first axis."""
    header = {"space": "left-posterior-superior", "kinds": ["list", "domain", "domain", "domain"]}
    directions = np.vstack([np.full(3, np.nan), np.diag(GRID * [-1, -1, 1])])
    nrrd.write(str(path), np.stack(layers).astype(np.uint8), {**header, "space directions": directions, **fields})
    return path


def check_parts(mesh: SegmentedMesh) -> None:
    """The segments of ``PARTS``: the smaller one has what two share, unless it is nested."""
    mesh.check()
    check_overlap(mesh)
    assert overlaps(mesh) == () and mesh.nested == (("tumor", "liver"),) and mesh.names.index("tumor") == 0
    apart = {**PARTS, "liver": PARTS["liver"] & ~PARTS["kidney"]}
    for segment in mesh.segments:
        assert segment.volume == pytest.approx(apart[segment.name].sum() * GRID.prod(), rel=0.04)
    assert mesh.owned_volumes.sum() == pytest.approx(np.any([*PARTS.values()], axis=0).sum() * GRID.prod(), rel=0.02)


def test_layers_of_a_segmentation_keep_names_and_colours_and_what_lies_inside_is_nested(tmp_path: Path) -> None:
    fields = {
        "Segment0_Name": "tumor",
        "Segment0_LabelValue": 1,
        "Segment0_Layer": 1,
        "Segment0_Color": "1 0 0.5",
        "Segment1_Name": "liver",
        "Segment1_LabelValue": 1,
        "Segment1_Layer": 0,
        "Segment1_Color": "0 0 2",  # each layer counts by itself
        "Segment2_Name": "kidney",
        "Segment2_LabelValue": 4,
        "Segment2_Layer": 1,
    }
    layers = [PARTS["liver"], PARTS["tumor"] + 4 * PARTS["kidney"]]
    volume = read_label_volume(write_layers(tmp_path / "a.seg.nrrd", layers, fields))
    assert (
        volume.values == (1, 2, 3)
        and set(volume.colors) == {1}
        and volume.names == {1: "tumor", 2: "liver", 3: "kidney"}
    )
    mesh = segment_surfaces(volume, volume.names, 48)
    check_parts(mesh)
    assert mesh.colors[0] == (255, 0, 128)
    alone = segment_surfaces(volume, {2: "liver"}, 48).segments[0]  # what is left out takes nothing
    assert alone.volume == pytest.approx(PARTS["liver"].sum() * GRID.prod(), rel=0.02)
    names = {f"Segment{number}_Name": name for number, name in enumerate(PARTS)}  # of older versions: a layer each
    check_parts(
        segment_surfaces(
            read_label_volume(write_layers(tmp_path / "b.nrrd", [*PARTS.values()], names)),
            {1: "liver", 2: "tumor", 3: "kidney"},
            48,
        )
    )
    scene = load_scene(
        write_scene_file(
            [tmp_path / "a.seg.nrrd"], tmp_path / "a.yaml", report=(said := []).append, deformations="rigid"
        )
    )
    assert scene.rest.nested == (("tumor", "liver"),) and "nested: tumor in liver" in said and scene.space == "RAS"
    for change, message in (
        ({"Segment0_Layer": 5}, "a.seg.nrrd has 2 layers, and 'tumor' in layer 5: save it again"),
        ({"Segment2_LabelValue": 3}, r"a.seg.nrrd has \d+ voxels of no segment that its header lists: save it"),
        ({"Segment2_LabelValue": "x"}, "a.seg.nrrd cannot be read as a label volume .invalid literal"),
    ):
        write_layers(tmp_path / "a.seg.nrrd", layers, {**fields, **change})
        with pytest.raises(ValueError, match=message):
            read_label_volume(tmp_path / "a.seg.nrrd")


def test_a_segment_in_a_nested_one_comes_before_it_whatever_the_order_of_their_labels() -> None:
    balls = [sphere((30, 30, 30), radius) for radius in (12, 20, 6)]
    volume = LabelVolume(np.stack([mask * label for label, mask in enumerate(balls, start=1)]), np.diag([*GRID, 1]), {})
    mesh = segment_surfaces(volume, {1: "b", 2: "c", 3: "a"}, 48)
    assert mesh.names == ("a", "b", "c") and set(mesh.nested) == {("a", "b"), ("b", "c")} and overlaps(mesh) == ()
    owned = np.diff([mask.sum() for mask in sorted(balls, key=np.sum)], prepend=0) * GRID.prod()
    assert_allclose(mesh.owned_volumes, owned, rtol=0.06)


def test_what_mereo_writes_for_slicer_comes_back_with_all_letters_of_its_names_and_its_colours(tmp_path: Path) -> None:
    labels = np.kron(np.eye(2), np.ones((4, 4)))[..., None].repeat(5, axis=2)
    colors = ((250, 1, 2), (3, 128, 5))
    labels[4:] *= 2
    grid = LabelGrid(labels.astype(np.uint8), ORIGIN, SPACING, ("Größe", "肝臓"))
    write_labels_seg_nrrd(tmp_path / "a.seg.nrrd", grid, colors, 0.001)
    volume = read_label_volume(tmp_path / "a.seg.nrrd")
    assert volume.names == {1: "Größe", 2: "肝臓"} and volume.colors == {1: colors[0], 2: colors[1]}
    assert_array_equal(volume.labels[0], labels)


def write_parts(folder: Path, **changes: ndarray) -> list[Path]:
    folder.mkdir(exist_ok=True)
    for name, mask in {**PARTS, **changes}.items():
        image = nibabel.Nifti1Image(mask.astype(np.uint8), np.diag([*GRID, 1.0]))
        nibabel.save(image, folder / f"{name}.nii.gz")
    return sorted(folder.iterdir())


def test_one_volume_for_each_segment_is_one_object(tmp_path: Path) -> None:
    files = write_parts(tmp_path / "ct")
    volume = read_label_volume(*files)
    assert volume.labels.shape == (2, 60, 60, 40) and volume.names == {1: "kidney", 2: "liver", 3: "tumor"}
    check_parts(segment_surfaces(volume, volume.names, 48))
    (tmp_path / "ct/frame.ply").write_bytes(trimesh.PointCloud(np.eye(3)).export(file_type="ply"))
    assert shapes_in(tmp_path / "ct") == files
    scene = load_scene(write_scene_file(files, tmp_path / "ct.yaml", deformations="rigid"))
    assert scene.rest.names == ("tumor", "kidney", "liver") and scene.rest.nested == (("tumor", "liver"),)
    empty = write_parts(tmp_path / "more", heart=np.zeros((60, 60, 40), bool))
    with pytest.warns(LabelWarning, match="1 of 4 label volumes hold only empty space and are left out: heart.nii.gz"):
        assert read_label_volume(*empty).names == {2: "kidney", 3: "liver", 4: "tumor"}
    for changes, message in (
        ({"liver": 2 * PARTS["liver"] + PARTS["tumor"]}, "liver.nii.gz holds the values 1?,? ?2, 3; of several label"),
        ({"tumor": PARTS["tumor"][1:]}, r"tumor.nii.gz has .59, 60, 40. voxels .* share one grid: resample them to it"),
    ):
        with pytest.raises(ValueError, match=message):
            read_label_volume(*write_parts(tmp_path / "wrong", **changes))


@pytest.mark.parametrize("cells", [40, 64, 128])
def test_thin_segments_keep_their_volume_in_thick_slices(cells: int, tmp_path: Path) -> None:
    """A vein of 9 mm along x in a liver, and slices of 5 mm: a smoothing by the slices would leave nothing of it."""
    labels = np.zeros((120, 80, 20), np.uint8)
    x, y, z = np.meshgrid(*(np.arange(n) * s for n, s in zip(labels.shape, (1, 1, 5), strict=True)), indexing="ij")
    labels[((x - 60) / 55) ** 2 + ((y - 40) / 38) ** 2 + ((z - 47) / 45) ** 2 < 1] = 1
    labels[((y - 40) ** 2 + (z - 47) ** 2 < 4.5**2) & (abs(x - 60) < 45)] = 2
    nibabel.save(nibabel.Nifti1Image(labels, np.diag([1.0, 1.0, 5.0, 1.0])), tmp_path / "ct.nii")
    mesh = segment_surfaces(read_label_volume(tmp_path / "ct.nii"), {1: "liver", 2: "vein"}, cells)
    mesh.check()
    check_overlap(mesh)
    for label, segment in enumerate(mesh.segments, start=1):
        assert segment.volume == pytest.approx(5 * (labels == label).sum(), rel=0.05)
    low, high = mesh.segments[1].bounds
    assert_allclose([low[0], high[0]], [15, 105], atol=2.5)


def test_what_is_lost_is_reported_and_what_is_too_thin_can_be_left_out(tmp_path: Path) -> None:
    labels = np.zeros((100, 100, 40), np.int64)
    labels[5:95, 5:95, 5:20], labels[10:90, 10:90, 30], labels[50, 50, 25] = 1, 2, 3
    file = write_nifti(tmp_path / "ct.nii.gz", labels)
    with pytest.warns(LabelWarning, match=r"^segment 'sheet' keeps 8\d% of its volume on a grid of 20 cells: raise"):
        segment_surfaces(read_label_volume(file), {1: "block", 2: "sheet"}, 20)
    path = write_scene_file([file], tmp_path / "ct.yaml", report=(said := []).append, deformations="rigid")
    assert any(
        re.match("left out: segment 'label_3' would keep 0% of its volume on a grid of 192 cells; it must", s)
        for s in said
    )
    assert "  # 3: label_3" in path.read_text() and load_scene(path).rest.names == ("label_1", "label_2")
    with pytest.raises(
        ValueError, match=f"'label_3' would keep 0% .*, or let `mereo scene new {file} --output .* without it"
    ):
        scene_of_meshes([file])


BOX = box((-0.5, -1.0, -1.5), (0.5, 1.0, 1.5))
BALL = ball((4.0, 0.0, 0.0), 1.0, color=1, level=3)


def check(segment: Segment) -> Segment:
    """Split segment, after a check that it is the same surface, with old vertices first."""
    split, source = split_at_creases(segment)
    assert_array_equal(split.vertices, segment.vertices[source])
    assert_array_equal(source[split.faces], segment.faces)
    assert_array_equal(source[: len(segment.vertices)], np.arange(len(segment.vertices)))
    return split


def test_a_box_has_three_normals_at_each_corner() -> None:
    split = check(BOX)
    assert len(split.vertices) == 24
    normals = vertex_normals(split)
    assert_allclose(np.abs(normals).max(axis=1), 1.0)
    faces = split.vertices[split.faces]
    own = unit_rows(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]))
    assert_allclose(normals[split.faces], np.repeat(own[:, None], 3, axis=1), atol=1e-12)


@pytest.mark.parametrize("sides, times", [(12, 2), (24, 2), (8, 3)])
def test_a_cylinder_is_smooth_around_and_has_rims(sides: int, times: int) -> None:
    """Twelve sides meet at exactly 30 degrees, which is no crease; eight at 45, which is one."""
    split = check(segment_of(trimesh.creation.cylinder(1.0, 2.0, sections=sides)))
    assert len(split.vertices) == times * 2 * sides + 2
    round_it = np.abs(vertex_normals(split)[:, 2]) < 0.5
    assert round_it.sum() == (times - 1) * 2 * sides
    assert_allclose(vertex_normals(split)[~round_it, 2], np.sign(split.vertices[~round_it, 2]), atol=1e-9)


def test_faces_without_area_and_edges_of_many_faces_are_no_trouble() -> None:
    thin = np.concatenate([BOX.faces, [[0, 1, 1], [0, 0, 0]]])
    assert len(split_at_creases(Segment("thin", BOX.color, BOX.vertices, thin))[0].vertices) == 24
    shared = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [1, 0, 5]])
    fan = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    check(Segment("fan", BOX.color, fan, shared))
    none = Segment("none", BOX.color, np.empty((0, 3)), np.empty((0, 3), np.int64))
    assert split_at_creases(none)[0] is none


def test_a_glb_has_creases_and_merges_to_the_same_surface(tmp_path: Path) -> None:
    mesh = SegmentedMesh((BOX, BALL))
    write_segments_glb(tmp_path / "s.glb", mesh, np.eye(3))
    read = trimesh.load_scene(tmp_path / "s.glb", process=False).geometry
    assert [len(read[name].vertices) for name in mesh.names] == [24, len(BALL.vertices)]
    assert np.sort(np.abs(read["box"].vertex_normals), axis=1) == pytest.approx(np.tile([0, 0, 1], (24, 1)))
    for segment in read_segmented_mesh(tmp_path / "s.glb").segments:
        assert segment.edge_imbalance() == (0, 0)
