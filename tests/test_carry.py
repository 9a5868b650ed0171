"""Carrying what is defined in the rest model to where the object is: theorems, then the command."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import untrained
from scene_files import write_bar
from scipy.spatial.transform import Rotation
from toy_scene import Lift, Shear, toy_scene

from mereo import __main__ as command_line
from mereo.deformation.maps import Deformation
from mereo.evaluation.sample_views import SampleView, load_view
from mereo.fitting.carry import Placed, carry, local_rotations, place
from mereo.fitting.fit import fit_frame
from mereo.fitting.register import Registrar
from mereo.fitting.registration import Registration, nearest_labels
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.attachments import Attachment, Positions, Surfaces, read_attachments
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.pose_tables import PoseTable, read_pose_table
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.scenes.random_states import scene_model, state_points, with_frame
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import State
from mereo.scenes.statistical_model import StatisticalModel

SCENE = toy_scene()
T = rigid(Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([5.0, -3.0, 90.0]))


@pytest.fixture(scope="module")
def model() -> StatisticalModel:
    return scene_model(SCENE, count=60)


@pytest.fixture(scope="module")
def registrar(model: StatisticalModel) -> Registrar:
    return Registrar(untrained(model.rest.names, "mine"), model)


def registered(model: StatisticalModel, material: np.ndarray, unit: float = 1.0) -> Registration:
    return Registration(model, unit * material, "modes", np.zeros(model.count), unit, True, 1.0, True, 0.0)


@pytest.fixture(scope="module")
def state() -> State:
    shear = Shear(3.0, 0.3, 0.1)
    return SCENE.deform((shear, shear, shear, Lift(2.0, shear)))


@pytest.fixture(scope="module")
def bent(model: StatisticalModel, state: State) -> Registration:
    return registered(model, transform_points(T, state_points(state, model.nodes, model.node_labels)))


def table(points: np.ndarray, rotations: np.ndarray | None = None) -> PoseTable:
    rows = tuple(("0",) * 7 for _ in points)
    return PoseTable(("x", "y", "z", "qx", "qy", "qz", "qw"), rows, ",", points, rotations)


def placed_one(registrar: Registrar, content: Surfaces | Positions | PoseTable, frame: str = "scene") -> Placed:
    return place([Attachment("one", content)], registrar, frame)[0]  # type: ignore[arg-type]


def test_a_rigid_pose_carries_everything_rigidly(model: StatisticalModel, registrar: Registrar) -> None:
    """Inside, outside and poses, in any unit."""
    rng = np.random.default_rng(0)
    points = rng.uniform(*model.rest.bounds, size=(200, 3)) * 1.3
    turns = Rotation.random(200, rng=rng).as_matrix()
    here = registered(model, transform_points(T, model.rest_points), 0.001)
    found = carry(placed_one(registrar, table(points, turns)), here)
    np.testing.assert_allclose(found.content.points, 0.001 * transform_points(T, points), atol=1.5e-5)
    assert found.content.rotations is not None
    np.testing.assert_allclose(found.content.rotations, T[:3, :3] @ turns, atol=5e-3)
    labels = Solids(model.rest).label(points)
    distance = Solids(model.rest).nearest(points).distance * (labels == 0)
    assert found.inside == (labels > 0).sum() and 0 < found.inside < 200
    assert found.farthest == pytest.approx(0.001 * distance.max())


def test_the_rest_mesh_is_carried_to_the_registered_mesh(registrar: Registrar, bent: Registration) -> None:
    found = carry(placed_one(registrar, Surfaces(SCENE.rest)), bent)
    assert isinstance(found.content, Surfaces)
    for carried, own in zip(found.content.mesh.segments, bent.mesh.segments, strict=True):
        error = np.linalg.norm(carried.vertices[: len(own.vertices)] - own.vertices, axis=1)
        assert error.max() < 0.05 and np.median(error) < 0.005


def test_interior_points_follow_the_scenes_own_maps(registrar: Registrar, state: State, bent: Registration) -> None:
    points = np.random.default_rng(1).uniform(*SCENE.rest.bounds, size=(500, 3))
    labels = Solids(SCENE.rest).label(points)
    found = carry(placed_one(registrar, Positions(points)), bent)
    for label in range(1, 5):
        truth = transform_points(T, state.deformations[label - 1](points[labels == label]))
        assert np.linalg.norm(found.content.points[labels == label] - truth, axis=1).max() < 0.1


def polar(motion: Deformation, points: np.ndarray) -> np.ndarray:
    """Rotation of a map's Jacobian at points, by scipy-free polar decomposition of central differences."""
    columns = [(motion(points + e) - motion(points - e)) / 2e-4 for e in 1e-4 * np.eye(3)]
    u, _, v = np.linalg.svd(np.stack(columns, axis=2))
    return np.asarray(u @ v)


def test_poses_turn_as_their_surroundings_do(state: State, bent: Registration) -> None:
    points = np.random.default_rng(2).uniform((-15, -4, -3), (15, 4, 3), size=(50, 3))
    shares = np.eye(4)[nearest_labels(bent.rest_solids, points) - 1]
    found = local_rotations(bent, points, shares)
    truth = T[:3, :3] @ polar(state.deformations[0], points)
    angle = Rotation.from_matrix(found @ truth.transpose(0, 2, 1)).magnitude()
    assert np.rad2deg(angle).max() < 2.0 and np.linalg.det(found).min() > 0.999
    still = np.rad2deg(Rotation.from_matrix(truth @ T[:3, :3].T).magnitude())
    assert np.median(still) > 3.0  # it has turned by more than the tolerance


def test_a_plane_bends_with_the_object(registrar: Registrar, bent: Registration) -> None:
    corners = np.array([[0.0, -5, -5], [0, 5, -5], [0, 5, 16], [0, -5, 16]])
    plane = Segment("plan", (1, 2, 3), corners, np.array([[0, 1, 2], [0, 2, 3]]))
    found = carry(placed_one(registrar, Surfaces(SegmentedMesh((plane,)))), bent)
    points = found.content.points
    assert len(points) > 100
    centered = points - points.mean(axis=0)
    assert np.linalg.svd(centered)[1][2] / np.sqrt(len(points)) > 0.05  # no longer flat


def test_a_surface_outside_does_not_tear(registrar: Registrar, bent: Registration) -> None:
    """It passes from the boxes' surroundings to the ball's, which is lifted by 2 units: edges of 0.9 stay under 2."""
    corners = np.array([[-15.0, 7, -5], [15, 7, -5], [15, 7, 16], [-15, 7, 16]])
    plane = Segment("plan", (1, 2, 3), corners, np.array([[0, 1, 2], [0, 2, 3]]))
    placed = placed_one(registrar, Surfaces(SegmentedMesh((plane,))))
    assert isinstance(placed.content, Surfaces) and (placed.distance > 0).all()
    found, faces = carry(placed, bent).content.points, placed.content.mesh.segments[0].faces
    nearest = bent.to_camera(placed.content.points)

    def longest(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2).max())

    assert longest(placed.content.points) <= 0.9 + 1e-9
    assert longest(found) < 2.0 < longest(nearest)


def test_far_away_things_are_refused(registrar: Registrar) -> None:
    points = np.random.default_rng(0).uniform(*SCENE.rest.bounds, size=(100, 3))
    with pytest.raises(
        ValueError, match="of 100 points of one are farther from the object than it is long .* bring it"
    ):
        placed_one(registrar, Positions(1000 * points))
    assert placed_one(registrar, Positions(points)).distance.max() < 20


def test_the_frame_of_the_files_must_be_known(registrar: Registrar) -> None:
    older = replace(registrar, model=replace(registrar.model, source_frame=None))
    points = Positions(SCENE.rest.segments[0].vertices)
    with pytest.raises(ValueError, match="do not say how the object's own files lie in the scene, .* with --scene, or"):
        placed_one(older, points, "source")
    np.testing.assert_array_equal(placed_one(older, points, "scene").content.points, points.points)
    frame = replace(SCENE, T_scene_source=np.diag([10.0, 10.0, 10.0, 1.0]))
    tenth = Positions(points.points / 10)
    named = placed_one(replace(older, given=frame), tenth, "source")
    np.testing.assert_allclose(named.content.points, points.points)


# --- the frame of the files -------------------------------------------------------------------------------------------


def test_files_in_millimetres_come_to_the_scene(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path))
    for name, part in zip(("left", "right"), scene.rest.segments, strict=True):
        own = read_segmented_mesh(tmp_path / f"{name}.stl").segments[0].vertices
        np.testing.assert_allclose(transform_points(scene.T_scene_source, own), part.vertices, atol=1e-9)
    assert scene.source_frame.scale == pytest.approx(2.0)  # 10 mm become 20 units
    assert scene.source_frame.source_unit_m == pytest.approx(0.001)
    model = scene_model(scene, 20)
    assert model.source_frame is not None and model.source_frame.unit_m == scene.unit_m
    registrar = Registrar(untrained(scene.rest.names, "bar"), model)
    middle = Positions(np.array([[120.0, 5.0, 5.0]]))
    np.testing.assert_allclose(placed_one(registrar, middle, "source").content.points, [[0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "file"),
    [
        ("bunny", "bunny/bunny.off"),
        ("liver", "liver/lapgym_liver_visual.stl"),
        ("tumor", "liver/lapgym_gallbladder_visual.stl"),
        ("liver-simulated", "liver/lapgym_liver_visual.stl"),
        ("skull", "skull/sofa_skull_and_teeth_coarse.obj"),
        ("human", "human/makehuman_base.obj"),
    ],
)
def test_built_in_scenes_say_how_their_files_lie_in_them(
    require_asset: Callable[[str], Path], scene: str, file: str
) -> None:
    """Vertices of the source lie on the surface at rest, but for what the scene leaves out or moves."""
    require_asset("human/makehuman_default.mhskel" if scene == "human" else file)
    loaded, mesh = load_scene(scene), read_segmented_mesh(require_asset(file))
    own = mesh.segments[0].vertices if scene != "human" else mesh.segments[mesh.names.index("body")].vertices
    if scene == "skull":
        own = next(part.vertices for part in mesh.segments if "skull_bone" in part.name)
    distance = Solids(loaded.rest).nearest(transform_points(loaded.T_scene_source, own)).distance
    assert np.median(distance) < 0.05, np.median(distance)


def test_a_model_from_before_gets_the_frame_of_its_built_in_scene(model: StatisticalModel) -> None:
    rope = load_scene("rope")
    old = replace(scene_model(rope, 10), source_frame=None)
    found = with_frame(old, "rope").source_frame
    assert found is not None
    np.testing.assert_array_equal(found.T_scene_source, np.eye(4))
    assert with_frame(old, "mine").source_frame is None
    assert with_frame(replace(model, source_frame=None), "rope").source_frame is None  # another object


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights() -> Model:
    states = scene_model(replace(load_scene("rope"), unit_m=0.01), 300)
    return replace(load_model("rope"), statistical_model=states)


@pytest.fixture(scope="module")
def view() -> SampleView:
    return load_view("rope")


@pytest.fixture(scope="module")
def folder(weights: Model, view: SampleView, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, a cloud in centimetres that is said to be so, and three files to carry."""
    folder = tmp_path_factory.mktemp("carry")
    save_model(weights, folder / "rope.safetensors")
    np.save(folder / "cloud.npy", view.depth.to_points().points)
    rest = load_scene("rope").rest
    part = rest.segments[1]
    trimesh.Trimesh(part.vertices, part.faces, process=False).export(folder / "own.ply")
    trimesh.Trimesh(part.vertices, part.faces, process=False).export(folder / "own.glb")
    x, y, z = part.vertices.mean(axis=0)
    (folder / "grasp.csv").write_text(f"x,y,z,qx,qy,qz,qw,width\n{x},{y},{z},0,0,0,1,0.02\n", encoding="utf-8")
    return folder


def run(folder: Path, *options: str, cloud: str = "cloud.npy", output: str = "out") -> int:
    arguments = ["reconstruct", str(folder / cloud), "--weights", str(folder / "rope.safetensors")]
    return command_line.main([*arguments, "--output", str(folder / output), "--resolution", "32", *options])


def carrying(folder: Path, *names: str) -> list[str]:
    return [word for name in names for word in ("--carry", str(folder / name))]


def test_the_command_carries_in_the_frame_and_unit_of_its_other_files(folder: Path) -> None:
    options = ["--fit", "modes", "--unit-m", "0.01", "--millimetres", "--formats", "ply", "glb", "json"]
    assert run(folder, *options, *carrying(folder, "own.ply", "own.glb", "grasp.csv")) == 0
    out = folder / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert [one["file"] for one in summary["carried"]] == ["own.ply", "own.glb", "grasp.csv"]
    assert all(one["farthest"] < 0.01 for one in summary["carried"]) and summary["registration"]["unit"] == "known"
    own = read_segmented_mesh(out / "segments.glb").segments[1].vertices
    carried = read_segmented_mesh(out / "carried/own.glb").segments[0].vertices
    assert np.linalg.norm(carried[: len(own)] - own, axis=1).max() < 0.3
    in_mm = read_segmented_mesh(out / "carried/own.ply").segments[0].vertices
    np.testing.assert_allclose(in_mm, 10 * carried, rtol=1e-4, atol=1e-3)
    grasp = read_pose_table(out / "carried/grasp.csv")
    assert np.linalg.norm(grasp.points[0] / 10 - own.mean(axis=0)) < 1.0
    assert grasp.rows[0][-1] == "0.02" and grasp.rotations is not None
    together = read_segmented_mesh(out / "carried.glb")
    assert together.names[:2] == ("own.ply", "own.glb") and len(together.names) == 2 + len(summary["segments"])


def test_a_wrong_unit_is_not_believed(weights: Model, view: SampleView) -> None:
    registrar, cloud = Registrar.of(weights, "modes"), view.depth.to_points()
    free = registrar.register(cloud)
    wrong = registrar.register(cloud, stated_unit=registrar.stated_unit(1.0))  # 0.01: it is said to be in metres
    right = registrar.register(cloud, stated_unit=registrar.stated_unit(0.01))
    np.testing.assert_array_equal(wrong.material, free.material)
    assert not wrong.unit_known and not free.unit_known
    assert right.unit_known and right.scene_unit == pytest.approx(1.0, rel=1e-4)
    assert weights.statistical_model is not None
    near = fit_frame(cloud, weights, weights.statistical_model, stated_unit=0.95)
    assert near.unit == 0.95  # within what the network's own estimate leaves open


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fit", "off"], "--fit is off, but --carry needs a registration"),
        (["--carry", "nowhere.stl"], "nowhere.stl does not exist"),
    ],
)
def test_the_command_refuses_before_any_work(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert run(folder, *carrying(folder, "grasp.csv"), *options, cloud="no-such-cloud.npy", output="refused") != 0
    assert message in " ".join(capsys.readouterr().err.split()) and not (folder / "refused").exists()


def test_without_a_registration_nothing_is_written(
    folder: Path, view: SampleView, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(folder / "stretched.npy", view.depth.to_points().points * np.array([1.0, 1.6, 1.0]))
    assert run(folder, *carrying(folder, "grasp.csv"), cloud="stretched.npy", output="none") != 0
    assert "the network's answer is kept, but --carry needs a registration" in capsys.readouterr().err
    assert not (folder / "none").exists()
    (folder / "far.csv").write_text("x,y,z\n9000,0,0\n", encoding="utf-8")
    assert run(folder, *carrying(folder, "far.csv"), output="none") != 0
    assert "1 of 1 points of far.csv are farther from the object" in capsys.readouterr().err


def test_weights_without_a_model_say_so(
    folder: Path, weights: Model, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    bare = replace(weights, statistical_model=None, provenance={**weights.provenance, "scene": "mine"})
    save_model(bare, tmp_path / "rope.safetensors")
    np.save(tmp_path / "cloud.npy", np.load(folder / "cloud.npy"))
    assert run(tmp_path, *carrying(folder, "grasp.csv")) != 0
    assert "carry no statistical model of their object's states" in capsys.readouterr().err


def test_everything_that_can_be_carried_is_read_by_its_name(folder: Path) -> None:
    kinds = [type(one.content) for one in read_attachments([folder / "own.ply", folder / "grasp.csv"])]
    assert kinds == [Surfaces, PoseTable]
