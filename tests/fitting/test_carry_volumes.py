"""Volumes along a registration: the value at a material point is that which it had at rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from carried_cases import SCENE, T, registered
from toy_scene import Shear

from mereo.fitting.registration import carry as carrying
from mereo.fitting.registration.carry import CarriedVolume, carry, place, resampled
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points
from mereo.io.attachments import Attachment, read_attachments, write_attachment
from mereo.io.volume_files import Volume, is_labels, read_label_volume, read_volume
from mereo.scenes.random_states import state_points
from mereo.scenes.statistical_model import StatisticalModel

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")

TURN = np.array([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])
"""Axes of the voxels of ``around``, which are not those of the object."""

SPACING = 0.7

RAMP = np.array([3.0, -2.0, 5.0])


@pytest.fixture(scope="module")
def bent(model: StatisticalModel) -> Registration:
    """Bent, turned, and in a unit of which ten are one of the scene's."""
    shear = Shear(2.0, 0.2, 0.1)
    state = SCENE.deform((shear,) * 4)
    return registered(model, transform_points(T, state_points(state, model.nodes, model.node_labels)), 10.0)


@pytest.fixture(scope="module")
def registrar(model: StatisticalModel) -> Registrar:
    return Registrar(untrained(model.rest.names, "mine"), model)


def around(spacing: float = SPACING, margin: float = 4.0) -> Volume:
    """Grid over the object at rest, with x, y and z of each voxel's centre as its (three) values."""
    low, high = SCENE.rest.bounds
    shape = np.ceil(np.abs(TURN.T @ (high - low + 2 * margin)) / spacing).astype(int) + 1
    matrix = np.eye(4)
    matrix[:3, :3] = spacing * TURN
    matrix[:3, 3] = (low + high) / 2 - matrix[:3, :3] @ (shape - 1) / 2
    index = np.indices(tuple(shape), dtype=float).reshape(3, -1).T
    return Volume(transform_points(matrix, index).reshape(*shape, 3), matrix)


def ramp(dtype: str = "float64", **changes: object) -> Volume:
    grid = around()
    values = grid.values @ RAMP + 100
    return replace(grid, values=(np.rint(values) if dtype.startswith("int") else values).astype(dtype), **changes)


def halves(dtype: str = "int16") -> Volume:
    """Labels 3 for x < 0 and 7 for the rest of the object, 0 outside."""
    grid = around()
    # not on the faces between two boxes
    inside = Solids(SCENE.rest).label(grid.values.reshape(-1, 3) + 0.01).reshape(grid.values.shape[:3]) > 0
    return replace(grid, values=np.where(inside, np.where(grid.values[..., 0] < 0, 3, 7), 0).astype(dtype))


def at_points(volume: Volume, points: np.ndarray) -> np.ndarray:
    index = np.rint(volume.index_of(points)).astype(int)
    return np.asarray(volume.values[tuple(index.T)])


def test_a_material_point_keeps_its_value(bent: Registration) -> None:
    found = resampled(ramp(), bent)
    assert found.interpolation == "linear" and found.within == found.inside > 5000
    np.testing.assert_allclose(found.content.spacing, 10 * SPACING)
    points = np.random.default_rng(0).uniform((-15, -4, -4), (15, 4, 4), size=(300, 3))
    index = np.rint(found.content.index_of(bent.to_camera(points)))
    centers = transform_points(found.content.T_world_index, index.astype(float))
    truth = bent.to_rest(centers) @ RAMP + 100
    error = at_points(found.content, centers) - truth
    assert np.abs(error).max() < 0.1 * SPACING * np.linalg.norm(RAMP)  # a tenth of a voxel
    # and the point's own value is less than a voxel away
    assert np.abs(at_points(found.content, centers) - (points @ RAMP + 100)).max() < SPACING * np.linalg.norm(RAMP)


def test_far_from_the_object_there_is_background(model: StatisticalModel) -> None:
    here = registered(model, transform_points(T, model.rest_points))
    source = ramp("int16")
    found = resampled(source, here)
    assert found.content.values.dtype == np.int16
    index = np.argwhere(np.ones(found.content.values.shape, dtype=bool))
    centers = transform_points(found.content.T_world_index, index.astype(float))
    distance = here.solids.nearest(centers).distance * (here.solids.label(centers) == 0)
    width = carrying.MARGIN * model.half
    assert (found.content.values.ravel()[distance > 1.001 * width] == source.values.min()).all()
    assert (found.content.values.ravel()[distance < 0.999 * width] > source.values.min()).all()
    half = replace(source, values=source.values[:, :, : source.values.shape[2] // 2])
    cut = resampled(half, here)
    assert 0.4 < cut.within / cut.inside < 0.6 and cut.content.values.min() == half.values.min()
    scaled = resampled(replace(source, slope=-1.0), here)
    assert scaled.content.values[0, 0, 0] == source.values.max()  # the least of what they mean


def test_labels_keep_their_values(bent: Registration) -> None:
    source = halves()
    found = resampled(source, bent)
    assert found.interpolation == "nearest" and found.content.values.dtype == np.int16
    assert set(np.unique(found.content.values)) == {0, 3, 7}
    points = np.random.default_rng(2).uniform((-15, -4, -4), (15, 4, 4), size=(300, 3))
    points = points[np.abs(points[:, 0]) > 1.5]
    np.testing.assert_array_equal(at_points(found.content, bent.to_camera(points)), np.where(points[:, 0] < 0, 3, 7))


def test_the_grid_has_so_many_voxels_at_most(bent: Registration) -> None:
    found = resampled(ramp(), bent, most=20_000).content
    assert 10_000 < found.values.size <= 20_000
    assert found.spacing.min() > 10 * SPACING
    low, high = found.bounds
    assert (low < bent.mesh.bounds[0]).all() and (high > bent.mesh.bounds[1]).all()


RAS_OF_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def write(path: Path, volume: Volume) -> Path:
    """A file in the frame of ``volume``, RAS, by other libraries' own writers."""
    if ".nii" in path.name:
        nibabel.save(nibabel.Nifti1Image(volume.values, volume.T_world_index), path)
    else:
        matrix = RAS_OF_LPS @ volume.T_world_index
        fields = {"space": "left-posterior-superior", "space directions": matrix[:3, :3].T}
        nrrd.write(str(path), volume.values, {**fields, "space origin": matrix[:3, 3]})
    return path


@pytest.mark.parametrize("name", ["ct.nii", "ct.nii.gz", "ct.nrrd"])
def test_a_file_comes_back_in_its_format_and_overlays_the_labels(
    tmp_path: Path, registrar: Registrar, bent: Registration, name: str
) -> None:
    """Whatever the format, LPS coordinates in millimetres are the input's: here one unit is a centimetre."""
    (read,) = read_attachments([write(tmp_path / name, ramp("int16"))])
    (placed,) = place([read], registrar, "scene")
    found = carry(placed, bent)
    assert isinstance(found, CarriedVolume) and isinstance(found.content, Volume)
    direct = resampled(ramp("int16"), bent).content
    np.testing.assert_array_equal(found.content.values, direct.values)
    write_attachment(tmp_path / "out" / name, found.content, 1000.0, np.eye(3), 0.01)
    again = read_volume(tmp_path / "out" / name)
    assert again.values.dtype == np.int16
    np.testing.assert_array_equal(again.values, direct.values)
    in_mm = np.diag([10.0, 10, 10, 1]) @ direct.T_world_index
    np.testing.assert_allclose(RAS_OF_LPS @ again.T_world_index, in_mm, rtol=1e-5, atol=1e-3)
    first = (tmp_path / "out" / name).read_bytes()
    write_attachment(tmp_path / "out" / name, found.content, 1000.0, np.eye(3), 0.01)
    assert (tmp_path / "out" / name).read_bytes() == first


def test_a_segmentation_of_slicer_keeps_its_segments(tmp_path: Path, registrar: Registrar, bent: Registration) -> None:
    path = write(tmp_path / "plan.seg.nrrd", halves("uint8"))
    values, header = nrrd.read(str(path))
    for number, (value, name) in enumerate([(3, "left"), (7, "right")]):
        for key, text in {"LabelValue": str(value), "Name": name, "Extent": "0 1 0 1 0 1"}.items():
            header[f"Segment{number}_{key}"] = text
    nrrd.write(str(path), values, header)
    (placed,) = place(read_attachments([path]), registrar, "scene")
    write_attachment(tmp_path / "out.seg.nrrd", carry(placed, bent).content, 1.0, np.eye(3), 0.001)
    assert read_label_volume(tmp_path / "out.seg.nrrd").names == {3: "left", 7: "right"}
    values, header = nrrd.read(str(tmp_path / "out.seg.nrrd"))
    assert header["Segment1_Extent"] == " ".join(f"0 {n - 1}" for n in values.shape)


def test_a_volume_beside_the_object_is_refused(registrar: Registrar) -> None:
    moved = ramp().T_world_index.copy()
    moved[:3, 3] += 1000
    with pytest.raises(
        ValueError, match=r"far.nii holds nothing of the object: in RAS its voxels lie from \[.*\] to \[.*, and the obj"
    ):
        place([Attachment("far.nii", replace(ramp(), T_world_index=moved))], registrar, "scene")
    small = np.diag([0.1, 0.1, 0.1, 1.0])  # between all material points, and inside
    small[:3, 3] = (2.0, 1.0, 1.0)
    place([Attachment("in.nii", Volume(np.zeros((2, 2, 2)), small))], registrar, "scene")


def test_labels_are_told_from_intensities() -> None:
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.permutation(216).reshape(6, 6, 6), np.ones((8, 8, 8), dtype=int))
    noise = rng.integers(0, 256, size=(40, 40, 40))

    def of(values: np.ndarray) -> bool:
        return is_labels(Volume(values, np.eye(4)))

    assert of(blocks.astype(np.uint8)) and of((noise > 128).astype(np.int32))
    assert not of(noise.astype(np.uint8)) and not of(blocks.astype(np.float32))


def test_nifti_keeps_its_scaling(tmp_path: Path, registrar: Registrar, bent: Registration) -> None:
    volume = ramp("int16")
    image = nibabel.Nifti1Image(volume.values, volume.T_world_index)
    image.header.set_slope_inter(0.5, -1024.0)
    nibabel.save(image, tmp_path / "ct.nii.gz")
    (placed,) = place(read_attachments([tmp_path / "ct.nii.gz"]), registrar, "scene")
    write_attachment(tmp_path / "out.nii.gz", carry(placed, bent).content, 1.0, np.eye(3), 1.0)
    again = nibabel.load(tmp_path / "out.nii.gz")
    np.testing.assert_allclose(again.get_fdata(), 0.5 * resampled(volume, bent).content.values - 1024)


def test_a_volume_that_cannot_be_carried_says_why(tmp_path: Path) -> None:
    four = np.zeros((4, 5, 6, 2), np.float32)
    color = np.zeros((4, 5, 6), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    for values, message in (
        (four, "a.nii.gz has 4 dimensions; a volume that is carried has 3, with one number"),
        (four[..., 0] + np.nan, "a.nii.gz has NaN or infinite values; all must be finite"),
        (color, "has voxels of the type .*; each must be one real number: export one channel"),
    ):
        nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), tmp_path / "a.nii.gz")
        with pytest.raises(ValueError, match=message):
            read_attachments([tmp_path / "a.nii.gz"])
    nrrd.write(str(tmp_path / "d.nrrd"), four[..., 0], {"space directions": np.diag([1.0, 1.0, 0.0]), "space": "RAS"})
    with pytest.raises(ValueError, match="d.nrrd has voxels whose axes are .*; they must span space"):
        read_attachments([tmp_path / "d.nrrd"])
    with pytest.raises(FileNotFoundError, match="f.nrrd does not exist; a volume is needed"):
        read_attachments([tmp_path / "f.nrrd"])
