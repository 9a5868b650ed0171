"""What a user of Open3D, trimesh, FoundationPose, Ultralytics, viser, scikit-learn or ROS tries first, line by line.

Each line stands in a table: what goes in, options by their names, what comes out, and what is refused in a sentence.
"""

import copy
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh
from answers import answer_to
from memory_frames import Tensor, TensorMap, Vectors
from PIL import Image
from scipy.spatial.transform import Rotation
from toy_frames import MODEL, seen

import mereo
from mereo.api.result import Result, StoredResult
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, DepthImage
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.transforms import fit_rigid, rigid, transform_points
from mereo.io.readers import InputWarning
from mereo.io.sensor_frame import SensorFrame
from mereo.models.model import Model
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.scene import SourceFrame
from mereo.synthesis.sample_views import load_view
from mereo.visualization.result_files import to_viewer_of

# --- what goes in: a depth image and its camera -----------------------------------------------------------------------

K = np.array([[80.0, 0.0, 15.5], [0.0, 90.0, 11.5], [0.0, 0.0, 1.0]])
"""Of OpenCV, whose first pixel has its centre at 0."""

WIDTH, HEIGHT = 32, 24
MILLIMETRES = (500 + np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 50).astype(np.uint16)
METRES = MILLIMETRES / 1000
IMAGE = DepthImage(METRES, Camera(WIDTH, HEIGHT, 80.0, 90.0, 16.0, 12.0))
NUMBERS = {"fx": 80.0, "fy": 90.0, "cx": 15.5, "cy": 11.5}
SIZE = {"width": WIDTH, "height": HEIGHT}


def camera_info(**changes: Any) -> SimpleNamespace:
    """Message of ROS 2."""
    fields = {"k": K.ravel(), "d": np.zeros(5), "distortion_model": "plumb_bob", **SIZE}
    return SimpleNamespace(**{**fields, "p": np.hstack([K, np.zeros((3, 1))]).ravel(), **changes})


def depth_message(values: np.ndarray, encoding: str) -> SimpleNamespace:
    """Message of ROS with a depth image."""
    return SimpleNamespace(
        encoding=encoding, step=values.strides[0], is_bigendian=0, data=values.tobytes(), height=HEIGHT, width=WIDTH
    )


def load(depth: Any = METRES, intrinsics: Any = K, **options: Any) -> SensorFrame:
    return mereo.load_frame(depth, intrinsics=intrinsics, **options)


DEPTH: dict[str, Callable[[], SensorFrame]] = {
    "metres and a matrix": lambda: load(METRES, K),
    "nested lists": lambda: load(METRES.tolist(), K.tolist()),
    "float32": lambda: load(METRES.astype(np.float32)),
    "millimetres": lambda: load(MILLIMETRES),
    "signed millimetres": lambda: load(MILLIMETRES.astype(np.int32), depth_scale=1000),
    "another scale": lambda: load(MILLIMETRES * 5, depth_scale=5000),
    "a tensor with a channel": lambda: load(torch.tensor(METRES)[None], torch.tensor(K)),
    "a channel behind": lambda: load(METRES[..., None]),
    "an image of Pillow": lambda: load(Image.fromarray(MILLIMETRES)),
    "an image with color": lambda: load(SimpleNamespace(depth=METRES.astype(np.float32), color=METRES)),
    "an Image message": lambda: load(depth_message(MILLIMETRES, "16UC1"), camera_info()),
    "an Image message of floats": lambda: load(depth_message(METRES.astype(np.float32), "32FC1"), camera_info()),
    "a CameraInfo of ROS 2": lambda: load(intrinsics=camera_info()),
    "a CameraInfo of ROS 1": lambda: load(intrinsics=SimpleNamespace(K=K.ravel().tolist(), D=[0.0] * 5, **SIZE)),
    "the projection of a CameraInfo": lambda: load(intrinsics=np.reshape(camera_info().p, (3, 4))),
    "four numbers": lambda: load(intrinsics=(80.0, 90.0, 15.5, 11.5)),
    "a dict of four": lambda: load(intrinsics=NUMBERS),
    "a dict with a size": lambda: load(intrinsics={**NUMBERS, **SIZE}),
    "a dict of BOP": lambda: load(MILLIMETRES, {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}),
    "a dict of Open3D": lambda: load(intrinsics={"intrinsic": {"intrinsic_matrix": K.T.ravel().tolist(), **SIZE}}),
    "intrinsics of Open3D": lambda: load(intrinsics=SimpleNamespace(intrinsic_matrix=K, **SIZE)),
    "intrinsics of RealSense": lambda: load(
        intrinsics=SimpleNamespace(fx=80.0, fy=90.0, ppx=15.5, ppy=11.5, coeffs=[0.0] * 5, model="brown", **SIZE)
    ),
    "a camera": lambda: load(intrinsics=IMAGE.camera),
    "a camera of a matrix": lambda: load(intrinsics=mereo.Camera.from_K(K, WIDTH, HEIGHT)),
    "a mask of ones": lambda: load(mask=np.ones((HEIGHT, WIDTH), np.uint8)),
    "a depth image": lambda: mereo.load_frame(IMAGE),
}


@pytest.mark.parametrize("line", DEPTH)
def test_every_depth_image_with_every_camera_is_one_frame(line: str) -> None:
    frame = DEPTH[line]()
    assert frame.unit_m == (None if line == "a depth image" else 1.0) and frame.whole is not None
    assert frame.whole.camera == IMAGE.camera
    np.testing.assert_allclose(frame.cloud.points, IMAGE.to_points().points, rtol=1e-6)


@pytest.mark.parametrize("intrinsics", [K, camera_info(), NUMBERS, IMAGE.camera, tuple(NUMBERS.values())])
def test_a_file_of_depth_takes_a_camera_in_memory(intrinsics: Any, tmp_path: Any) -> None:
    Image.fromarray(MILLIMETRES).save(tmp_path / "depth.png")
    frame = mereo.load_frame(tmp_path / "depth.png", intrinsics=intrinsics)
    np.testing.assert_allclose(frame.cloud.points, IMAGE.to_points().points, rtol=1e-6)
    np.save(tmp_path / "cloud.npy", seen())
    with pytest.raises(ValueError, match="cloud.npy is read as a point cloud; leave out intrinsics"):
        mereo.load_frame(tmp_path / "cloud.npy", intrinsics=intrinsics)


# --- what goes in: clouds with more columns ---------------------------------------------------------------------------

NORMALS = np.array([0.0, 0.6, -0.8]) * np.ones((1200, 1))


def test_columns_behind_positions_are_normals_or_colours() -> None:
    points = seen()
    for normals in (np.hstack([points, NORMALS]), np.hstack([points, NORMALS]).reshape(30, 40, 6)):
        cloud = mereo.load_frame(normals).cloud
        np.testing.assert_array_equal(cloud.points, points)
        np.testing.assert_allclose(cloud.normals, NORMALS)
    for colors in (np.abs(NORMALS), 255 * (NORMALS > 0)):
        with pytest.warns(
            InputWarning, match=r"^the last three columns of the ndarray .* are colours, which are left ou"
        ):
            cloud = mereo.load_frame(np.hstack([points, colors])).cloud
        np.testing.assert_array_equal(cloud.points, points)
        assert cloud.normals is None
    gaps = np.where(np.arange(1200)[:, None] % 7, np.hstack([points, NORMALS]), np.nan)
    assert len(mereo.load_frame(gaps, drop_invalid=True).cloud) == np.isfinite(gaps[:, 0]).sum()


# --- what goes in: meshes ---------------------------------------------------------------------------------------------

LEFT, RIGHT = (
    trimesh.creation.box((20, 30, 10), trimesh.transformations.translation_matrix((x, 0, 0))) for x in (0, 20)
)
BOXES = {"left": LEFT, "right": RIGHT}


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def legacy(mesh: trimesh.Trimesh) -> SimpleNamespace:
    """Stand-in of a TriangleMesh of Open3D."""
    return SimpleNamespace(vertices=Vectors(arrays(mesh)[0]), triangles=Vectors(arrays(mesh)[1]))


def tensors(mesh: trimesh.Trimesh) -> SimpleNamespace:
    """Stand-in of its tensor mesh."""
    vertices, faces = arrays(mesh)
    return SimpleNamespace(
        vertex=TensorMap(positions=Tensor(vertices)), triangle=TensorMap(indices=Tensor(faces)), device="CUDA:0"
    )


def polydata(mesh: trimesh.Trimesh) -> SimpleNamespace:
    """Stand-in of a PolyData of PyVista."""
    vertices, faces = arrays(mesh)
    flat = np.hstack([np.full((len(faces), 1), 3), faces]).ravel()
    return SimpleNamespace(points=vertices, faces=flat, regular_faces=faces)


def named(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    changed = mesh.copy()
    changed.metadata["name"] = name
    return changed


def segment(name: str) -> Segment:
    return Segment(name, PALETTE[0], *arrays(BOXES[name]))


MESHES: dict[str, Callable[[], Any]] = {
    "a dict of trimesh": lambda: BOXES,
    "a scene of trimesh": lambda: trimesh.Scene(BOXES),
    "a moved scene": lambda: moved_scene(),
    "a list with names": lambda: [named(mesh, name) for name, mesh in BOXES.items()],
    "a dict of Open3D": lambda: {name: legacy(mesh) for name, mesh in BOXES.items()},
    "a dict of tensor meshes": lambda: {name: tensors(mesh) for name, mesh in BOXES.items()},
    "a dict of PyVista": lambda: {name: polydata(mesh) for name, mesh in BOXES.items()},
    "a dict of arrays": lambda: {name: arrays(mesh) for name, mesh in BOXES.items()},
    "a dict of lists": lambda: {name: tuple(part.tolist() for part in arrays(mesh)) for name, mesh in BOXES.items()},
    "segments": lambda: [segment(name) for name in BOXES],
    "a segmented mesh": lambda: SegmentedMesh(tuple(segment(name) for name in BOXES)),
}


def moved_scene() -> trimesh.Scene:
    scene = trimesh.Scene()
    for name, x in (("left", 0), ("right", 20)):
        placed = trimesh.transformations.translation_matrix((x, 0, 0))
        scene.add_geometry(LEFT, node_name=name, geom_name="box", transform=placed)
    return scene


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def boxes(cache: None) -> mereo.Object:
    return mereo.load_object(BOXES, units="mm", deformations="rigid")


@pytest.mark.parametrize("line", MESHES)
def test_every_kind_of_meshes_is_one_object(line: str, boxes: mereo.Object) -> None:
    known = mereo.load_object(MESHES[line](), units="mm", deformations="rigid")
    assert known.names == ("left", "right") and known.scene is not None and known.scene.file is None
    assert known.model is not None and boxes.model is not None
    np.testing.assert_allclose(known.model.rest_points, boxes.model.rest_points, rtol=1e-6)


def test_one_mesh_is_an_object_too(cache: None) -> None:
    for line in (LEFT, legacy(LEFT), arrays(LEFT), [LEFT], [arrays(LEFT)]):
        assert mereo.load_object(line, units="mm", deformations="rigid").names == ("part1",)


# --- what comes out ---------------------------------------------------------------------------------------------------

UNIT_M, SCALE = 0.01, 4.0
"""Metres per scene unit of the rope, and scene units per unit of its files."""

T_BASE = rigid(Rotation.from_euler("xyz", [100, 20, -60], degrees=True).as_matrix(), np.array([5.0, -3.0, 2.0]))
"""Pose of the frame in that of a robot's base."""

FITTED = ("metres", "a scanner's millimetres", "an unknown unit")


class Waiting(Executor):
    """Searches for nothing."""

    def submit(self, *_: Any, **__: Any) -> Future[Any]:
        return Future()


@pytest.fixture(scope="module")
def results(rope: Model) -> dict[str, Result]:
    """Registered in frames of all kinds; a network's with a segment that was not found; lost."""
    assert rope.statistical_model is not None
    T_scene_source = np.array([[0.0, -SCALE, 0, 1], [SCALE, 0, 0, 2], [0, 0, SCALE, 3], [0, 0, 0, 1]])
    sized = replace(rope.statistical_model, source_frame=SourceFrame(T_scene_source, UNIT_M))
    free = replace(rope.statistical_model, source_frame=SourceFrame(T_scene_source, None))
    cloud = load_view("rope").depth.to_points().points
    scan = 1000 * UNIT_M * cloud @ SCANNER_TO_CAMERA[:3, :3]
    known = Registrar(rope, sized, "modes")
    answers = (
        answer_to(UNIT_M * cloud, rope, known, 16, unit_m=1.0),
        answer_to(scan, rope, known, 16, "scanner", 0.001),
        answer_to(cloud, rope, Registrar(rope, free, "modes"), 16),
    )
    fitted = dict(zip(FITTED, map(Result.of, answers), strict=True))
    alone, pose = mereo.Object(None, None, model=sized), fitted["metres"].pose
    with mereo.Tracker(alone, "modes", executor=Waiting(), initial_pose=pose) as tracker:
        tracker.follow(UNIT_M * cloud, 0.0, unit_m=1.0)
        lost = tracker.follow(UNIT_M * (cloud + 40), 0.03, unit_m=1.0)
    network = mereo.reconstruct(seen(), MODEL, resolution=24, unit_m=1.0, label_points=True)
    return {**fitted, "a network": network, "lost": lost}


ORIGIN = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]


def correlation(covariance: np.ndarray, std: np.ndarray | None = None) -> np.ndarray:
    std = np.sqrt(np.diag(covariance)) if std is None else std
    return covariance / np.outer(std, std)


OUTPUT: dict[str, Callable[[Result], object]] = {
    "a name in it": lambda r: "base" in r and "head" not in r,
    "its length": lambda r: len(r) == len(list(r)) == 9,
    "a loop": lambda r: [segment.name for segment in r] == list(r.names),
    "how much is explained": lambda r: (
        0.9 < r.explained <= 1 and r.explained == r.to_dict()["registration"]["explained"]
    ),
    "how near": lambda r: 0 < r.residual < 0.02 * np.ptp(r.seen.cloud.points),
    "a covariance": lambda r: (
        np.linalg.eigvalsh(r.covariance / np.outer(*2 * [np.sqrt(np.diag(r.covariance))])).min() > 0
    ),
    "JSON": lambda r: json.loads(json.dumps(r.to_dict(), allow_nan=False)) == r.to_dict(),
    "copies": lambda r: copy.copy(r) is r and copy.deepcopy([r])[0] is r,
    "labels": lambda r: r.labels.labels.max() == 9,
    "a segment in itself": lambda r: np.allclose(r["base"].pose_in("base"), np.eye(4), atol=1e-9),
    "a segment in another": lambda r: np.allclose(
        r["base"].pose @ r["segment_8"].pose_in("base"), r["segment_8"].pose, atol=1e-9 * np.ptp(r.pose)
    ),
    "one point": lambda r: np.array_equal(r.carry([0.0, 0.1, 0.0]), r.carry(ORIGIN)[2]),
    "one pose": lambda r: np.allclose(r.carry(np.eye(4))[:3, 3], r.carry([0, 0, 0])),
    "a pose turns as its place": lambda r: np.allclose(
        r.carry(np.eye(4))[:3, :2] * r.model_scale,
        (r.carry(1e-4 * np.array(ORIGIN))[1:] - r.carry([0, 0, 0])).T / 1e-5,
        atol=0.3 * r.model_scale,
    ),
    "poses": lambda r: r.carry(np.tile(np.eye(4), (3, 1, 1))).shape == (3, 4, 4),
    "a mesh of trimesh": lambda r: isinstance(r.carry(trimesh.creation.box((0.1, 0.1, 0.1))), trimesh.Trimesh),
    "vertices and faces": lambda r: len(r.carry(arrays(trimesh.creation.box((0.1, 0.1, 0.1))))) == 2,
    "a dict": lambda r: np.array_equal(r.carry({"grasp": ORIGIN})["grasp"], r.carry(ORIGIN)),
    "short texts": lambda r: all(
        len(repr(each).splitlines()) <= 10 and len(repr(each)) < 1000
        for each in (
            r,
            r["base"],
            r.registered,
            r.registrar,
            r.recognition,
            r.seen,
            r.model,
            r.joints,
            r.candidate,
            r.registered.uncertainty,
        )
    ),
}


@pytest.mark.parametrize("kind", FITTED)
@pytest.mark.parametrize("line", OUTPUT)
def test_what_is_asked_of_a_result_comes_out(line: str, kind: str, results: dict[str, Result]) -> None:
    assert OUTPUT[line](results[kind])


@pytest.mark.parametrize("kind", FITTED)
def test_the_covariance_is_that_of_the_pose_under_the_posterior(kind: str, results: dict[str, Result]) -> None:
    """By differences of the pose along each of the posterior's independent numbers."""
    fit = results[kind].registered
    assert fit is not None and fit.uncertainty is not None
    sure, unit = fit.uncertainty, fit.uncertainty.optimum.unit
    posterior, source = sure.posterior, fit.model.source_points(fit.scene_unit)
    turn = unit * fit_rigid(unit * posterior.material, fit.material)[:3, :3]
    moves = [sure.factor * posterior.posed.rotation @ posterior.motion, posterior.open]
    changes = list[np.ndarray]()
    for step in np.moveaxis(np.concatenate(moves, axis=2), 2, 0) @ turn.T:
        one, other = (fit_rigid(source, fit.material + sign * step) for sign in (-1e-3, 1e-3))
        turned = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).as_rotvec()
        changes.append(np.concatenate([turned, other[:3, 3] - one[:3, 3]]) / 2e-3)
    expected = np.transpose(changes) @ np.array(changes)
    std = np.sqrt(np.diag(expected))
    covariance = results[kind].covariance
    assert covariance is not None
    np.testing.assert_allclose(correlation(covariance, std), correlation(expected), atol=1e-4)


def same(stored: StoredResult, result: Result) -> None:
    """Everything that a stored result says is what the result says, up to the digits of surfaces in files."""
    assert stored.names == result.names and repr(stored).startswith(f"StoredResult({result.seen.frame.source!r}: ")
    ours, theirs = ({**each.to_dict(), "timings_s": 0} for each in (stored, result))
    assert ours == theirs
    for name in ("unit_m", "known", "explained", "residual", "model_scale", "pose", "covariance", "joints"):
        np.testing.assert_equal(getattr(stored, name), getattr(result, name), name)
    for one, other in zip(stored, result, strict=True):
        for name in ("name", "label", "centroid", "volume", "confidence", "error_radius", "is_present", "pose"):
            np.testing.assert_equal(getattr(one, name), getattr(other, name), name)
        corners, goal = (np.ptp(each.mesh.vertices, axis=0) if each.is_present else 0.0 for each in (one, other))
        np.testing.assert_allclose(corners, goal, atol=1e-6 * np.abs(other.mesh.vertices).max(initial=0.0))
        assert one.mesh.volume == pytest.approx(other.mesh.volume, rel=1e-4) and one.mesh.color == other.mesh.color
    if stored.labels is not None:
        np.testing.assert_equal(vars(stored.labels), vars(result.labels))


def test_a_result_goes_to_another_process_and_back(results: dict[str, Result]) -> None:
    code = (
        "import pickle, sys; r = pickle.load(sys.stdin.buffer); assert [len(x) for x in r.values()] == [9, 9, 9, 3, 0]"
    )
    code += "; import copy; pickle.dump(copy.deepcopy(r), sys.stdout.buffer)"
    sent = pickle.dumps(results)
    assert len(sent) < 3e6
    back = subprocess.run([sys.executable, "-c", code], input=sent, capture_output=True, check=True).stdout
    for kind, stored in pickle.loads(back).items():
        assert isinstance(stored, StoredResult) and stored.instances == (stored,)
        same(stored, results[kind])


def test_a_lost_object_says_so_in_every_form(results: dict[str, Result]) -> None:
    lost = results["lost"]
    facts = lost.to_dict()
    assert lost.tracking == facts["tracking"] == "lost" and facts["verdict"] == "no" and facts["segments"] == []
    assert facts["registration"]["answer"] is None and lost.known is False and not lost and list(lost) == []
    assert lost.pose is lost.covariance is lost.explained is lost.residual is None and "base" not in lost
    assert "the object is lost" in repr(lost.transformed(T_BASE)) and facts["recognition"]["reason"] in repr(lost)
    with pytest.raises(ValueError, match="^the object is lost: "):
        _ = lost["base"]
    with pytest.raises(ValueError, match="the network's answer is kept, but carry needs a registration"):
        results["a network"].carry([0, 0, 0])
    with pytest.raises(ValueError, match="needs a registration"):
        results["a network"]["big"].pose_in("big")


@pytest.mark.usefixtures("small_previews")
@pytest.mark.parametrize("kind", [*FITTED, "a network"])
def test_a_folder_is_loaded_as_it_was_saved(kind: str, results: dict[str, Result], tmp_path: Path) -> None:
    for number, result in enumerate((results[kind], results[kind].transformed(T_BASE))):
        folder = result.save(tmp_path / str(number))
        same(mereo.load_result(folder), result)
    damages: dict[str, tuple[Callable[[bytes], bytes], str]] = {
        "labels.npz": (lambda b: b[: len(b) // 2], "labels.npz cannot be read as a label grid"),
        "segments.glb": (lambda b: b[:-9], "segments.glb cannot be read as a GLB file"),
        "summary.json": (lambda b: b.replace(result.names[0].encode(), b"x"), "segments are not those of segments.glb"),
    }
    for name, (damage, sentence) in damages.items():
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(damage(whole))
        with pytest.raises(ValueError, match=sentence):
            mereo.load_result(folder)
        (folder / name).unlink()
        with pytest.raises(FileNotFoundError, match=f"{name} does not exist; a .* is needed: check"):
            mereo.load_result(folder)
        (folder / name).write_bytes(whole)


@pytest.mark.parametrize("kind", [*FITTED, "a network"])
def test_a_result_in_a_robots_frame_is_the_same_there(kind: str, results: dict[str, Result]) -> None:
    result, moved = results[kind], results[kind].transformed(T_BASE)
    length = np.ptp(result.surfaces.merged()[0])
    near = partial(np.testing.assert_allclose, atol=1e-9 * length, rtol=1e-9)
    for one, other in zip(moved, result, strict=True):
        near(one.centroid, transform_points(T_BASE, other.centroid))
        near(one.mesh.vertices, transform_points(T_BASE, other.mesh.vertices))
        assert one.error_radius == pytest.approx(other.error_radius) and one.volume == other.volume
        if one.is_present:
            voxel = np.rint((one.centroid - moved.labels.origin) / moved.labels.spacing).astype(int)
            assert moved.labels.labels[tuple(voxel)] in (one.label, 0)
    volume = (moved.labels.labels > 0).sum() * moved.labels.spacing.prod()
    assert volume == pytest.approx(sum(segment.volume for segment in result), rel=0.2)
    facts = moved.to_dict()
    assert facts["frame"] == "other" and facts["depth_m"] is None
    near(facts["T_input_result"], np.linalg.inv(T_BASE))
    near(moved.seen.cloud.points, transform_points(T_BASE, result.seen.cloud.points))
    near(to_viewer_of(moved.seen.frame) @ T_BASE[:3, :3], to_viewer_of(result.seen.frame))
    back = moved.transformed(np.linalg.inv(T_BASE))
    near(back.surfaces.merged()[0], result.surfaces.merged()[0])
    if result.pose is None or moved.pose is None:
        return
    near(moved.pose, T_BASE @ result.pose)
    near(moved.carry(np.eye(4)), T_BASE @ result.carry(np.eye(4)))
    turn = np.kron(np.eye(2), T_BASE[:3, :3])
    near(moved.covariance, turn @ result.covariance @ turn.T, rtol=1e-4, atol=1e-4 * np.ptp(result.covariance))
    assert moved.registered is not None and result.registered is not None
    place = result["base"].mesh.vertices[:5]
    asked, known = moved.registered.query(transform_points(T_BASE, place)), result.registered.query(place)
    near(asked.rest, known.rest, atol=1e-6)
    with pytest.raises(ValueError, match="the pose is of the shape .3, 3., and must be 4 x 4"):
        result.transformed(np.eye(3))


# --- what is refused, in a sentence -----------------------------------------------------------------------------------

OPEN = trimesh.Trimesh(LEFT.vertices[:3], [[0, 1, 2]])

REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "distortion": (
        lambda: load(intrinsics=camera_info(d=np.array([0.1, 0.0, 0.0, 0.0, 0.0]))),
        r"^the intrinsics state lens distortion \(up to .* pixels in the corners\), .* must have none: rectify it",
    ),
    "an empty CameraInfo": (
        lambda: load(intrinsics=camera_info(k=np.zeros(9))), "^intrinsics cannot be used: the last row of its matrix"
    ),
    "a camera of another size": (
        lambda: load(intrinsics=camera_info(width=64)), "is 32 x 24 pixels but the intrinsics say 64 x 24"
    ),
    "two numbers": (lambda: load(intrinsics=(80, 90)), r"^intrinsics is \(80, 90\); it must be a camera: give"),
    "a set": (lambda: load(intrinsics={80, 90}), "^intrinsics is {.*}; it must be a camera: give 3 x 3 numbers, "),
    "a dict of other names": (lambda: load(intrinsics={"f": 80}), "^intrinsics cannot be used: it has neither fx, "),
    "a color image": (lambda: load(np.ones((24, 32, 3))), r"has the shape \(24, 32, 3\); it must be rows of pixels"),
    "a color message": (
        lambda: load(depth_message(MILLIMETRES, "bgr8")), "^the Image message cannot be read .*'bgr8'"
    ),
    "an image of depths alone": (lambda: mereo.load_frame(METRES), "give intrinsics=, a mereo.Camera or a file of"),
    "columns of anything": (lambda: mereo.load_frame(np.hstack([seen(), 7.5 * NORMALS])), "six columns.* as points"),
    "an open mesh": (lambda: mereo.load_object({"lid": OPEN}, units="mm"), "^segment 'lid' of lid.obj .* solids"),
    "a dict of other things": (
        lambda: mereo.load_object({"left": LEFT, "right": 3}), "^the part 'right' of the object is no mesh, as all must"
    ),
    "quadrangles": (
        lambda: mereo.load_object((LEFT.vertices, [[0, 1, 2, 3]])), r"faces of \(1, 4\); they must be v x 3 .* into triangles$"
    ),
    "a step out of bounds": (
        lambda: mereo.reconstruct(seen(), MODEL, isolation={"cluster_gap": -1.0}), "^cluster_gap is -1.0; it must be"
    ),
    "units of a loaded object": (
        lambda: mereo.reconstruct(seen(), mereo.Object(MODEL), units="mm"),
        "^units is given for an object that is loaded already: give it to load_object$",
    ),
}  # fmt: skip

NAMES: dict[str, tuple[Callable[[], object], str]] = {
    "unitm": (lambda: mereo.reconstruct(seen(), MODEL, unitm=1.0), r"is unit_m meant\?$"),
    "Unit_M": (lambda: mereo.load_frame(seen(), Unit_M=1.0), r"is unit_m meant\?$"),
    "largest_clusters": (
        lambda: mereo.reconstruct(seen(), MODEL, isolation={"largest_clusters": True}), "is largest_cluster meant"
    ),
    "frame": (lambda: mereo.load_frame(seen(), frame="scanner"), "axes='scanner' states the axes"),
    "output": (lambda: mereo.reconstruct(seen(), MODEL, output="x"), r"result.save\(path, .* has it"),
    "carry": (lambda: mereo.reconstruct(seen(), MODEL, carry="x.stl"), r"result.carry\(what, .* has it"),
    "threads": (lambda: mereo.reconstruct(seen(), MODEL, threads=2), "the command alone has it"),
    "xyzzy": (lambda: mereo.load_frame(seen(), xyzzy=1), "the options are axes, camera_pose, depth_along, "),
    "exmples": (lambda: mereo.evaluate(MODEL, exmples=1), "is examples meant"),
    "epoch": (lambda: mereo.train("data", "run", epoch=1.0), "is epochs meant"),
    "exampels": (lambda: mereo.generate("rope", "data", exampels=1), "is examples meant"),
}  # fmt: skip
"""Options that there are none of."""


@pytest.mark.parametrize("line", [*REFUSED, *NAMES])
def test_what_cannot_be_is_refused_in_a_sentence(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the check of types that tests put before it
    call, sentence = {**REFUSED, **NAMES}[line]
    kind, start = (TypeError, f"^there is no option '{line}' here: ") if line in NAMES else (ValueError, "")
    with pytest.raises(kind, match=start + sentence) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1
