"""Label volumes and points as other programs read them: nibabel, pynrrd, VTK, trimesh; frames and units included."""

import base64
import json
import re
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from written_results import CENTER, COLORS, NAMES, centroid, cloud, grid

from mereo.io.readers import read_point_cloud
from mereo.io.volume_files import read_label_volume
from mereo.io.writers.meshes import write_points_ply
from mereo.io.writers.volumes import (
    write_labels_nifti,
    write_labels_npz,
    write_labels_seg_nrrd,
    write_labels_vti,
    write_points_npz,
)

RAS_OF_INPUT = np.array([-1.0, -1.0, 1.0])


def test_a_vti_is_the_format_that_vtk_documents(tmp_path: Path) -> None:
    """Where VTK is absent: its head, decoded by hand, and its one block."""
    write_labels_vti(tmp_path / "l.vti", grid(), COLORS)
    image = ElementTree.parse(tmp_path / "l.vti").getroot()[0]
    assert image.attrib["WholeExtent"] == "0 6 0 10 0 19"
    assert [float(value) for value in image.attrib["Origin"].split()] == grid().origin.tolist()
    block = next(array for array in image.iter("DataArray") if array.attrib["Name"] == "label").text or ""
    head = np.frombuffer(base64.b64decode(block[:44]), "<u8")
    packed = base64.b64decode(block[44:])
    assert head.tolist() == [1, grid().labels.size, 0, len(packed)]
    np.testing.assert_array_equal(np.frombuffer(zlib.decompress(packed), np.uint8), np.ravel(grid().labels, order="F"))


def test_nibabel_sees_the_labels_in_ras_millimetres(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    write_labels_nifti(tmp_path / "l.nii.gz", grid(), COLORS)
    image = nibabel.load(tmp_path / "l.nii.gz")
    values = np.asarray(image.dataobj)
    np.testing.assert_array_equal(values, grid().labels)
    assert values.dtype == np.uint8
    for label in (1, 3):
        index = np.argwhere(values == label).mean(axis=0)
        place = nibabel.affines.apply_affine(image.affine, index)
        np.testing.assert_allclose(place, 1000.0 * centroid(label) * RAS_OF_INPUT, atol=1e-3)
    assert image.header.get_xyzt_units()[0] == "mm"
    assert nibabel.aff2axcodes(image.affine) == ("L", "P", "S")
    for form in (image.get_sform, image.get_qform):
        found, code = form(coded=True)
        assert code == 1
        np.testing.assert_allclose(found, image.affine, atol=1e-4)
    table = json.loads(image.header.extensions[0].text)["segments"]
    assert [(row["label"], row["name"], tuple(row["color"])) for row in table] == [
        (index + 1, name, color) for index, (name, color) in enumerate(zip(NAMES, COLORS, strict=True))
    ]


def test_pynrrd_sees_the_labels_in_lps_millimetres(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason="pynrrd is not installed: pip install 'mereo[medical]'")
    write_labels_seg_nrrd(tmp_path / "l.seg.nrrd", grid(), COLORS)
    values, header = nrrd.read(str(tmp_path / "l.seg.nrrd"))
    np.testing.assert_array_equal(values, grid().labels)
    assert header["space"] == "left-posterior-superior"
    for label in (1, 3):
        place = np.argwhere(values == label).mean(axis=0) @ header["space directions"] + header["space origin"]
        np.testing.assert_allclose(place, 1000.0 * centroid(label), atol=1e-9)


def test_slicer_finds_what_it_looks_for(tmp_path: Path) -> None:
    """The fields that vtkMRMLSegmentationStorageNode reads; its loop over segments ends at the first missing ID."""
    write_labels_seg_nrrd(tmp_path / "l.seg.nrrd", grid(), COLORS)
    head = (tmp_path / "l.seg.nrrd").read_bytes().partition(b"\n\n")[0].decode("utf-8")
    fields = dict(re.findall(r"^(Seg\w+):=(.*)$", head, re.MULTILINE))
    for index, (name, color) in enumerate(zip(NAMES, COLORS, strict=True)):
        own = {key.partition("_")[2]: value for key, value in fields.items() if key.startswith(f"Segment{index}_")}
        assert (own["Name"], own["LabelValue"], own["Layer"]) == (name, str(index + 1), "0")
        np.testing.assert_allclose([255 * float(value) for value in own["Color"].split()], color, atol=1e-3)
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
    write_labels_nifti(tmp_path / "l.nii", grid(), COLORS, unit_m)
    write_labels_seg_nrrd(tmp_path / "l.seg.nrrd", grid(), COLORS, unit_m)
    nifti, nrrd = read_label_volume(tmp_path / "l.nii"), read_label_volume(tmp_path / "l.seg.nrrd")
    np.testing.assert_array_equal(nifti.labels, nrrd.labels)
    np.testing.assert_allclose(nifti.T_world_index, nrrd.T_world_index, atol=1e-3 * unit_m)
    place = nrrd.T_world_index @ [*np.argwhere(nrrd.labels == 3).mean(axis=0), 1.0]
    np.testing.assert_allclose(place[:3], 1000 * unit_m * CENTER * RAS_OF_INPUT, atol=0.5 * unit_m)


def test_the_same_result_gives_the_same_bytes(tmp_path: Path) -> None:
    for number in range(2):
        write_labels_seg_nrrd(tmp_path / f"{number}.seg.nrrd", grid(), COLORS)
        write_labels_nifti(tmp_path / f"{number}.nii.gz", grid(), COLORS)
    for end in ("seg.nrrd", "nii.gz"):
        assert (tmp_path / f"0.{end}").read_bytes() == (tmp_path / f"1.{end}").read_bytes()


def test_a_missing_library_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with pytest.raises(
        ImportError, match=r"NIfTI needs nibabel, which is not installed: pip install 'mereo\[medical\]'"
    ):
        write_labels_nifti(tmp_path / "l.nii.gz", grid(), COLORS)
    assert list(tmp_path.iterdir()) == []


def test_labels_have_names(tmp_path: Path) -> None:
    write_labels_npz(tmp_path / "l.npz", grid())
    with np.load(tmp_path / "l.npz", allow_pickle=False) as loaded:
        assert all(np.array_equal(loaded[name], getattr(grid(), name)) for name in loaded.files) and len(loaded) == 4
    with pytest.raises(ValueError, match="label 3 has no name among 2"):
        write_labels_npz(tmp_path / "l.npz", replace(grid(), names=("a", "b")))


def test_labelled_points_come_back(tmp_path: Path) -> None:
    written = cloud()
    write_points_ply(tmp_path / "p.ply", written)
    write_points_npz(tmp_path / "p.npz", written)
    found = trimesh.load(tmp_path / "p.ply", process=False)
    data = found.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(found.vertices, written.points, atol=1e-7)
    np.testing.assert_array_equal(data["label"], written.labels)
    np.testing.assert_allclose(data["confidence"], written.confidence, atol=1e-7)
    np.testing.assert_allclose(data["occupancy"], written.occupancy, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(found.colors)[:, :3], np.array(COLORS)[written.labels - 1])
    head = (tmp_path / "p.ply").read_bytes().partition(b"end_header")[0].decode("ascii")
    assert tuple(json.loads(row)["name"] for row in re.findall(r"comment segment (.*)", head)) == NAMES
    with np.load(tmp_path / "p.npz") as stored:
        for key in ("points", "labels", "confidence", "occupancy", "names", "colors"):
            np.testing.assert_array_equal(stored[key], np.asarray(getattr(written, key)))
    np.testing.assert_allclose(read_point_cloud(tmp_path / "p.ply").points, written.points, atol=1e-7)
