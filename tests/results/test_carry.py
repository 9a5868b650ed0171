"""Carrying what is defined in the rest model to where the object is: theorems."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import untrained
from folder_contents import read_json, run_mereo
from numpy import ndarray
from numpy.linalg import det, norm, svd
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scene_files import write_bar
from scipy.spatial.transform import Rotation
from toy_scene import Lift, Shear, toy_scene

from mereo.api.words import python_words
from mereo.deformation.maps import Deformation
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration, nearest_labels
from mereo.geometry.conventions import Names
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.attachments import (
    Attachment,
    PoseTable,
    Positions,
    SpaceWarning,
    Surfaces,
    read_attachments,
    read_pose_table,
    write_attachment,
)
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.volume_files import Volume, is_labels, read_label_volume, read_volume
from mereo.io.writers.volumes import write_volume
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.results import carry as carrying
from mereo.results.carry import CarriedVolume, Placed, carry, local_rotations, place, resampled
from mereo.scenes.random_states import scene_model, state_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SourceFrame, State
from mereo.scenes.statistical_model import StatisticalModel, pack_model, unpack_model
from mereo.synthesis.sample_views import load_view

SCENE = toy_scene()
T = rigid(Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([5.0, -3.0, 90.0]))


def registered(model: StatisticalModel, material: ndarray, unit: float = 1.0) -> Registration:
    return Registration(model, unit * material, "modes", np.zeros(model.count), unit, True, 1.0, True, 0.0)


@pytest.fixture(scope="module")
def registrar(model: StatisticalModel) -> Registrar:
    return Registrar(untrained(model.rest.names, "mine"), model)


@pytest.fixture(scope="module")
def state() -> State:
    shear = Shear(3.0, 0.3, 0.1)
    return SCENE.deform((shear, shear, shear, Lift(2.0, shear)))


@pytest.fixture(scope="module")
def bent(model: StatisticalModel, state: State) -> Registration:
    return registered(model, transform_points(T, state_points(state, model.nodes, model.node_labels)))


def table(points: ndarray, rotations: ndarray | None = None) -> PoseTable:
    rows = tuple(("0",) * 7 for _ in points)
    return PoseTable(("x", "y", "z", "qx", "qy", "qz", "qw"), rows, ",", points, rotations)


def placed_one(registrar: Registrar, content: Surfaces | Positions | PoseTable, frame: str = "scene") -> Placed:
    return place([Attachment("one", content)], registrar, frame)[0]  # type: ignore[arg-type]


def test_a_rigid_pose_carries_everything_rigidly(model: StatisticalModel, registrar: Registrar) -> None:
    rng = default_rng(0)
    points = rng.uniform(*model.rest.bounds, size=(200, 3)) * 1.3
    turns = Rotation.random(200, rng=rng).as_matrix()
    here = registered(model, transform_points(T, model.rest_points), 0.001)
    found = carry(placed_one(registrar, table(points, turns)), here)
    assert_allclose(found.content.points, 0.001 * transform_points(T, points), atol=1.5e-5)
    assert_allclose(found.content.rotations, T[:3, :3] @ turns, atol=5e-3)
    labels = Solids(model.rest).label(points)
    distance = Solids(model.rest).nearest(points).distance * (labels == 0)
    assert found.inside == (labels > 0).sum() and 0 < found.inside < 200
    assert found.farthest == pytest.approx(0.001 * distance.max())


def test_interior_points_follow_the_scenes_own_maps(registrar: Registrar, state: State, bent: Registration) -> None:
    points = default_rng(1).uniform(*SCENE.rest.bounds, size=(500, 3))
    labels = Solids(SCENE.rest).label(points)
    found = carry(placed_one(registrar, Positions(points)), bent)
    for label in range(1, 5):
        truth = transform_points(T, state.deformations[label - 1](points[labels == label]))
        assert norm(found.content.points[labels == label] - truth, axis=1).max() < 0.1


def polar(motion: Deformation, points: ndarray) -> ndarray:
    """Rotation of a map's Jacobian at points, by scipy-free polar decomposition of central differences."""
    columns = [(motion(points + e) - motion(points - e)) / 2e-4 for e in 1e-4 * np.eye(3)]
    u, _, v = svd(np.stack(columns, axis=2))
    return np.asarray(u @ v)


def test_poses_turn_as_their_surroundings_do(state: State, bent: Registration) -> None:
    points = default_rng(2).uniform((-15, -4, -3), (15, 4, 3), size=(50, 3))
    shares = np.eye(4)[nearest_labels(bent.rest_solids, points) - 1]
    found = local_rotations(bent, points, shares)
    truth = T[:3, :3] @ polar(state.deformations[0], points)
    angle = Rotation.from_matrix(found @ truth.transpose(0, 2, 1)).magnitude()
    assert np.rad2deg(angle).max() < 2.0 and det(found).min() > 0.999
    still = np.rad2deg(Rotation.from_matrix(truth @ T[:3, :3].T).magnitude())
    assert np.median(still) > 3.0  # it has turned by more than the tolerance


def test_a_surface_outside_does_not_tear(registrar: Registrar, bent: Registration) -> None:
    """It passes from the boxes' surroundings to the ball's, which is lifted by 2 units: edges of 0.9 stay under 2."""
    corners = np.array([[-15.0, 7, -5], [15, 7, -5], [15, 7, 16], [-15, 7, 16]])
    plane = Segment("plan", (1, 2, 3), corners, np.array([[0, 1, 2], [0, 2, 3]]))
    placed = placed_one(registrar, Surfaces(SegmentedMesh((plane,))))
    assert isinstance(placed.content, Surfaces) and (placed.distance > 0).all()
    # shares fall with the fourth power of the distance
    distance = np.stack([Solids(SCENE.rest).segment_distance(i, placed.content.points) for i in range(4)], axis=1)
    relative = placed.shares / placed.shares.max(axis=1, keepdims=True)
    nearer = distance.min(axis=1, keepdims=True)
    assert_allclose(relative, (nearer / distance) ** 4, atol=2e-3)
    found, faces = carry(placed, bent).content.points, placed.content.mesh.segments[0].faces
    nearest = bent.to_camera(placed.content.points)

    def longest(points: ndarray) -> float:
        return float(norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2).max())

    assert longest(placed.content.points) <= 0.9 + 1e-9
    assert longest(found) < 2.0 < longest(nearest)


def test_far_away_things_are_refused(registrar: Registrar) -> None:
    points = default_rng(0).uniform(*SCENE.rest.bounds, size=(100, 3))
    with pytest.raises(ValueError, match="one: .* of 100 points are farther from the object than it is long"):
        placed_one(registrar, Positions(1000 * points))
    assert placed_one(registrar, Positions(points)).distance.max() < 20


def test_the_frame_of_the_files_must_be_known(registrar: Registrar) -> None:
    older = replace(registrar, model=replace(registrar.model, source_frame=None))
    points = Positions(SCENE.rest.segments[0].vertices)
    with pytest.raises(ValueError, match="do not say how the object's own files lie in the scene: .* with --scene, or"):
        placed_one(older, points, "source")
    assert_array_equal(placed_one(older, points, "scene").content.points, points.points)
    frame = replace(SCENE, T_scene_source=np.diag([10.0, 10.0, 10.0, 1.0]))
    tenth = Positions(points.points / 10)
    named = placed_one(replace(older, given=frame), tenth, "source")
    assert_allclose(named.content.points, points.points)


def test_files_in_millimetres_come_to_the_scene(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path))
    for name, part in zip(("left", "right"), scene.rest.segments, strict=True):
        own = read_segmented_mesh(tmp_path / f"{name}.stl").segments[0].vertices
        # long faces are divided, which adds vertices after the file's own
        assert_allclose(transform_points(scene.T_scene_source, own), part.vertices[: len(own)], atol=1e-9)
    assert scene.source_frame.scale == pytest.approx(2.0)  # 10 mm become 20 units
    assert scene.source_frame.unit_m * scene.source_frame.scale == pytest.approx(0.001)
    model = scene_model(scene, 20)
    assert model.source_frame is not None and model.source_frame.unit_m == scene.unit_m
    registrar = Registrar(untrained(scene.rest.names, "bar"), model)
    middle = Positions(np.array([[120.0, 5.0, 5.0]]))
    (found,) = place([Attachment("middle", middle)], registrar)
    assert_allclose(found.content.points, [[0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "file"),
    [
        ("bunny", "bunny/bunny.off"),
        ("liver", "liver/lapgym_liver_visual.stl"),
        ("tumor", "liver/lapgym_gallbladder_visual.stl"),
        pytest.param("human", "human/makehuman_base.obj", marks=pytest.mark.slow),
    ],
)
def test_built_in_scenes_say_how_their_files_lie_in_them(
    require_asset: Callable[[str], Path], scene: str, file: str
) -> None:
    """Vertices of the source lie on the surface at rest, but for what the scene leaves out or moves."""
    require_asset("human/makehuman_default.mhskel" if scene == "human" else file)
    loaded = load_scene(scene)
    mesh = read_segmented_mesh(require_asset(file))
    own = mesh.segments[0].vertices if scene != "human" else mesh.segments[mesh.names.index("body")].vertices
    distance = Solids(loaded.rest).nearest(transform_points(loaded.T_scene_source, own)).distance
    assert np.median(distance) < 0.05, np.median(distance)


def test_the_frame_survives_weights_and_older_ones_have_none(tmp_path: Path) -> None:
    model = scene_model(replace(load_scene("rope"), unit_m=0.25, T_scene_source=np.diag([2.0, 2.0, 2.0, 1.0])), 10)
    save_model(replace(untrained(model.rest.names), statistical_model=model), tmp_path / "w.safetensors")
    read = load_model(tmp_path / "w.safetensors").statistical_model
    assert_array_equal(read.source_frame.T_scene_source, model.source_frame.T_scene_source)
    assert read.source_frame.unit_m == 0.25 and read.source_frame.scale == pytest.approx(2.0)
    tensors, facts = pack_model(model)
    assert unpack_model(tensors, {key: value for key, value in facts.items() if key != "frame"}).source_frame is None


HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Between RAS and LPS."""


def in_patient(registrar: Registrar, space: str | None) -> tuple[Registrar, ndarray]:
    """The object, whose own files lie far from the middle of a patient, and points inside it in their frame."""
    frame = SourceFrame(rigid(np.eye(3), np.array([-150.0, 40, 0])), 0.001, space)  # type: ignore[arg-type]
    model = replace(registrar.model, source_frame=frame)
    return replace(registrar, model=model), model.nodes - frame.T_scene_source[:3, 3]


@pytest.mark.parametrize("other, space", [("LPS", "RAS"), ("RAS", "LPS")])
def test_what_names_the_other_space_is_turned(registrar: Registrar, other: str, space: str) -> None:
    mine, points = in_patient(registrar, space)
    turns = Rotation.random(len(points), rng=default_rng(0)).as_matrix()
    half = HALF_TURN[:3, :3]
    matrix = HALF_TURN @ rigid(np.eye(3), points.min(axis=0))
    volume = Volume(np.ones((40, 30, 30), np.uint8), matrix)
    turned = [
        Attachment("t.csv", table(points @ half, half @ turns), other),  # type: ignore[arg-type]
        Attachment("ct.nii", volume, other),  # type: ignore[arg-type]
    ]
    straight = [Attachment("t.csv", table(points, turns)), Attachment("t.csv", table(points, turns), space)]  # type: ignore[arg-type]
    for frame in ("source", space):
        (poses, ct), plain = place(turned, mine, frame), place(straight, mine, frame)  # type: ignore[arg-type]
        for each in (poses, *plain):
            assert_allclose(each.content.points, mine.model.nodes, atol=1e-9)
            assert_allclose(each.content.rotations, turns, atol=1e-9)
        assert_allclose(ct.content.bounds[0], mine.model.nodes.min(axis=0) - 0.5)
        assert poses.note == ct.note == f" (turned from {other} to {space})" and {each.note for each in plain} == {""}
    still = registered(mine.model, mine.model.rest_points)
    assert carry(poses, still).description.startswith(f"carried t.csv (turned from {other} to {space}): 600 points, ")
    assert carry(ct, still).description.startswith(f"carried ct.nii (turned from {other} to {space}): ")
    with pytest.raises(ValueError, match=f"--carry-frame is {other}, but the object's own files name {space}: leave"):
        place(turned, mine, other)  # type: ignore[arg-type]


def test_a_space_that_no_file_names_is_stated_or_refused_where_the_other_fits(registrar: Registrar) -> None:
    mine, points = in_patient(registrar, None)
    matrix = rigid(np.eye(3), np.array([-250.0, -150, -60]))
    body = np.zeros((100, 60, 40), np.int16)
    index = np.stack(np.meshgrid(*map(np.arange, body.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    matrix[:3, :3] *= 5
    source = mine.model.source_frame.T_scene_source
    body.reshape(-1)[Solids(mine.model.rest).label(transform_points(source @ matrix, index.astype(float))) > 0] = 1000
    ct = Attachment("ct.nii", Volume(body - 1000, matrix), "RAS")
    with pytest.warns(
        SpaceWarning, match="^ct.nii is in RAS, and the object's own files are taken to be in it too, for"
    ):
        (taken,) = place([ct], mine)
    assert_array_equal(taken.content.T_world_index, source @ matrix)
    plan = Attachment("plan.csv", table(points))
    assert place([plan, replace(ct, content=replace(ct.content), space=None)], mine)[0].note == ""
    wrong = [
        Attachment("plan.csv", table(points @ HALF_TURN[:3, :3])),
        replace(ct, content=replace(ct.content, T_world_index=HALF_TURN @ matrix)),
    ]
    for each in wrong:
        with pytest.raises(
            ValueError, match="does not fit the object, and would with x and y negated, .*--carry-frame"
        ):
            place([each], mine)
    (stated,) = place(wrong[1:], mine, "LPS")
    assert_allclose(stated.content.T_world_index, source @ matrix)
    with pytest.raises(ValueError, match='with files="RAS" or files="LPS", or export both'), python_words():
        place(wrong[1:], mine)


nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")

TURN = np.array([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])
"""Axes of the voxels of ``around``, which are not those of the object."""

SPACING = 0.7

RAMP = np.array([3.0, -2.0, 5.0])


@pytest.fixture(scope="module")
def resized(model: StatisticalModel) -> Registration:
    """Bent, turned, and in a unit of which ten are one of the scene's."""
    state = SCENE.deform((Shear(2.0, 0.2, 0.1),) * 4)
    return registered(model, transform_points(T, state_points(state, model.nodes, model.node_labels)), 10.0)


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


def at_points(volume: Volume, points: ndarray) -> ndarray:
    index = np.rint(volume.index_of(points)).astype(int)
    return np.asarray(volume.values[tuple(index.T)])


def test_a_material_point_keeps_its_value(resized: Registration) -> None:
    found = resampled(ramp(), resized)
    assert found.interpolation == "linear" and found.within == found.inside > 5000
    assert_allclose(found.content.spacing, 10 * SPACING)
    points = default_rng(0).uniform((-15, -4, -4), (15, 4, 4), size=(300, 3))
    index = np.rint(found.content.index_of(resized.to_camera(points)))
    centers = transform_points(found.content.T_world_index, index.astype(float))
    truth = resized.to_rest(centers) @ RAMP + 100
    error = at_points(found.content, centers) - truth
    assert np.abs(error).max() < 0.1 * SPACING * norm(RAMP)  # a tenth of a voxel
    # and the point's own value is less than a voxel away
    assert np.abs(at_points(found.content, centers) - (points @ RAMP + 100)).max() < SPACING * norm(RAMP)


def test_far_from_the_object_there_is_background(model: StatisticalModel) -> None:
    here = registered(model, transform_points(T, model.rest_points))
    source = ramp("int16")
    found = resampled(source, here)
    assert found.content.values.dtype == np.int16
    index = np.argwhere(np.ones(found.content.values.shape, bool))
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


def test_labels_keep_their_values(resized: Registration) -> None:
    source = halves()
    found = resampled(source, resized)
    assert found.interpolation == "nearest" and found.content.values.dtype == np.int16
    assert set(np.unique(found.content.values)) == {0, 3, 7}
    points = default_rng(2).uniform((-15, -4, -4), (15, 4, 4), size=(300, 3))
    points = points[np.abs(points[:, 0]) > 1.5]
    assert_array_equal(at_points(found.content, resized.to_camera(points)), np.where(points[:, 0] < 0, 3, 7))


def test_the_grid_has_so_many_voxels_at_most(resized: Registration) -> None:
    found = resampled(ramp(), resized, most=20_000).content
    assert 10_000 < found.values.size <= 20_000
    assert found.spacing.min() > 10 * SPACING
    low, high = found.bounds
    assert (low < resized.mesh.bounds[0]).all() and (high > resized.mesh.bounds[1]).all()


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
    tmp_path: Path, registrar: Registrar, resized: Registration, name: str
) -> None:
    """Whatever the format, LPS coordinates in millimetres are the input's: here one unit is a centimetre."""
    (read,) = read_attachments([write(tmp_path / name, ramp("int16"))])
    (placed,) = place([read], registrar, "scene")
    found = carry(placed, resized)
    assert isinstance(found, CarriedVolume) and isinstance(found.content, Volume)
    direct = resampled(ramp("int16"), resized).content
    assert_array_equal(found.content.values, direct.values)
    out = tmp_path / "out" / name
    write_attachment(out, found.content, 1000.0, np.eye(3), 0.01)
    again = read_volume(out)
    assert again.values.dtype == np.int16
    assert_array_equal(again.values, direct.values)
    in_mm = np.diag([10.0, 10, 10, 1]) @ direct.T_world_index
    assert_allclose(RAS_OF_LPS @ again.T_world_index, in_mm, rtol=1e-5, atol=1e-3)
    first = out.read_bytes()
    write_attachment(out, found.content, 1000.0, np.eye(3), 0.01)
    assert out.read_bytes() == first


def test_a_segmentation_of_slicer_keeps_its_segments(
    tmp_path: Path, registrar: Registrar, resized: Registration
) -> None:
    path = write(tmp_path / "plan.seg.nrrd", halves("uint8"))
    values, header = nrrd.read(str(path))
    for number, (value, name) in enumerate([(3, "left"), (7, "right")]):
        for key, text in {"LabelValue": str(value), "Name": name, "Extent": "0 1 0 1 0 1"}.items():
            header[f"Segment{number}_{key}"] = text
    nrrd.write(str(path), values, header)
    (placed,) = place(read_attachments([path]), registrar, "scene")
    write_attachment(tmp_path / "out.seg.nrrd", carry(placed, resized).content, 1.0, np.eye(3), 0.001)
    assert read_label_volume(tmp_path / "out.seg.nrrd").names == {3: "left", 7: "right"}
    values, header = nrrd.read(str(tmp_path / "out.seg.nrrd"))
    assert header["Segment1_Extent"] == " ".join(f"0 {n - 1}" for n in values.shape)


def test_a_volume_beside_the_object_is_refused(registrar: Registrar) -> None:
    moved = ramp().T_world_index.copy()
    moved[:3, 3] += 1000
    with pytest.raises(ValueError, match=r"far.nii holds nothing of the object: in RAS its voxels lie from \["):
        place([Attachment("far.nii", replace(ramp(), T_world_index=moved))], registrar, "scene")
    small = np.diag([0.1, 0.1, 0.1, 1.0])  # between all material points, and inside
    small[:3, 3] = (2.0, 1.0, 1.0)
    place([Attachment("in.nii", Volume(np.zeros((2, 2, 2)), small))], registrar, "scene")


def test_labels_are_told_from_intensities() -> None:
    rng = default_rng(0)
    blocks = np.kron(rng.permutation(216).reshape(6, 6, 6), np.ones((8, 8, 8), int))
    noise = rng.integers(0, 256, size=(40, 40, 40))

    def of(values: ndarray) -> bool:
        return is_labels(Volume(values, np.eye(4)))

    assert of(blocks.astype(np.uint8)) and of((noise > 128).astype(np.int32))
    assert not of(noise.astype(np.uint8)) and not of(blocks.astype(np.float32))


def test_nifti_keeps_its_scaling(tmp_path: Path, registrar: Registrar, resized: Registration) -> None:
    volume = ramp("int16")
    image = nibabel.Nifti1Image(volume.values, volume.T_world_index)
    image.header.set_slope_inter(0.5, -1024.0)
    nibabel.save(image, tmp_path / "ct.nii.gz")
    (placed,) = place(read_attachments([tmp_path / "ct.nii.gz"]), registrar, "scene")
    write_attachment(tmp_path / "out.nii.gz", carry(placed, resized).content, 1.0, np.eye(3), 1.0)
    again = nibabel.load(tmp_path / "out.nii.gz")
    assert_allclose(again.get_fdata(), 0.5 * resampled(volume, resized).content.values - 1024)


def test_a_volume_that_cannot_be_carried_says_why(tmp_path: Path) -> None:
    four = np.zeros((4, 5, 6, 2), np.float32)
    color = np.zeros((4, 5, 6), [("R", "u1"), ("G", "u1"), ("B", "u1")])
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


pytestmark = pytest.mark.usefixtures("small_previews")


@pytest.fixture(scope="module")
def weights(rope: Model) -> Model:
    """Those of the rope, whose own files are in centimetres."""
    frame = replace(load_scene("rope"), unit_m=0.01).source_frame
    return replace(rope, statistical_model=replace(rope.statistical_model, source_frame=frame))


@pytest.fixture(scope="module")
def folder(weights: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, a cloud in centimetres that is said to be so, and four files to carry."""
    folder = tmp_path_factory.mktemp("carry")
    save_model(weights, folder / "rope.safetensors")
    np.save(folder / "cloud.npy", load_view("rope").depth.to_points().points)
    rest = load_scene("rope").rest
    part = rest.segments[1]
    for suffix in ("ply", "glb"):
        trimesh.Trimesh(part.vertices, part.faces, process=False).export(folder / f"own.{suffix}")
    x, y, z = part.vertices.mean(axis=0)
    volume = Volume(np.arange(8, dtype=np.int16).reshape(2, 2, 2), np.diag([*np.ptp(rest.bounds, axis=0), 1.0]))
    volume.T_world_index[:3, 3] = rest.bounds[0]  # a voxel at each corner of the rest box
    lps = replace(volume, T_world_index=np.diag([-1.0, -1.0, 1.0, 1.0]) @ volume.T_world_index)  # as it is written
    write_volume(folder / "ct.nrrd", lps, 0.001)
    (folder / "grasp.csv").write_text(f"x,y,z,qx,qy,qz,qw,width\n{x},{y},{z},0,0,0,1,0.02\n", encoding="utf-8")
    return folder


def run(folder: Path, files: Names, *options: str, cloud: str = "cloud.npy", output: str = "out") -> int:
    arguments = ["reconstruct", str(folder / cloud), "--weights", str(folder / "rope.safetensors")]
    carried = [word for name in files for word in ("--carry", str(folder / name))]
    return run_mereo(*arguments, "--output", folder / output, "--resolution", "32", *carried, *options)


def test_the_command_carries_in_the_frame_and_unit_of_its_other_files(folder: Path) -> None:
    options = ["--method", "modes", "--unit-m", "0.01", "--millimetres", "--formats", "ply", "glb", "json"]
    options += ["--carry-frame", "RAS"]  # as ct.nrrd comes out
    files = ("own.ply", "own.glb", "grasp.csv", "ct.nrrd")
    out = folder / "out"
    assert run(folder, files, *options) == 0
    summary = read_json(out / "summary.json")
    assert tuple(one["file"] for one in summary["carried"]) == files
    assert all(one["farthest"] < 0.01 for one in summary["carried"][:3]) and summary["registration"]["unit"] == "known"
    own = read_segmented_mesh(out / "segments.glb").segments[1].vertices
    carried = read_segmented_mesh(out / "carried/own.glb").segments[0].vertices
    assert norm(carried[: len(own)] - own, axis=1).max() < 0.3
    in_mm = read_segmented_mesh(out / "carried/own.ply").segments[0].vertices
    assert_allclose(in_mm, 10 * carried, rtol=1e-4, atol=1e-3)
    grasp = read_pose_table(out / "carried/grasp.csv")
    assert norm(grasp.points[0] / 10 - own.mean(axis=0)) < 1.0
    assert grasp.rows[0][-1] == "0.02" and grasp.rotations is not None
    volume = read_volume(out / "carried/ct.nrrd")  # millimetres: ten of the input's unit
    low, high = (np.diag([-1.0, -1.0, 1.0]) @ bound for bound in read_segmented_mesh(out / "segments.glb").bounds)
    assert (volume.bounds[0] < 10 * np.minimum(low, high)).all()
    assert (volume.bounds[1] > 10 * np.maximum(low, high)).all()
    assert list(volume.values.shape) == summary["carried"][3]["voxels"] and volume.values.dtype == np.int16
    together = read_segmented_mesh(out / "carried.glb")
    assert together.names[:2] == ("own.ply", "own.glb") and len(together.names) == 2 + len(summary["segments"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "network"], "--method is network, but --carry needs a registration"),
        (["--carry", "nowhere.stl"], "nowhere.stl does not exist"),
        (["--carry", "."], "has the suffix ''; a file to carry is one of .stl"),
    ],
)
def test_the_command_refuses_before_any_work(
    folder: Path, capsys: pytest.CaptureFixture, options: list[str], message: str
) -> None:
    assert run(folder, ("grasp.csv",), *options, cloud="no-such-cloud.npy", output="refused") != 0
    assert message in " ".join(capsys.readouterr().err.split()) and not (folder / "refused").exists()
