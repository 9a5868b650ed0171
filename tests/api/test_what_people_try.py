"""What a user of Open3D, trimesh, FoundationPose, Ultralytics, viser, scikit-learn or ROS tries first, line by line.

Each line stands in a table: what goes in, options by their names, what comes out, and what is refused in a sentence.
"""

import copy
import json
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
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
from numpy.testing import assert_allclose, assert_equal
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
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
    return SimpleNamespace(**{**fields, **changes})


def depth_message(values: np.ndarray, encoding: str) -> SimpleNamespace:
    """Message of ROS with a depth image."""
    return SimpleNamespace(
        encoding=encoding, step=values.strides[0], is_bigendian=0, data=values.tobytes(), height=HEIGHT, width=WIDTH
    )


def load(intrinsics: Any, depth: Any = METRES) -> SensorFrame:
    return mereo.load_frame(depth, intrinsics=intrinsics)


OPEN3D = {"intrinsic": {"intrinsic_matrix": K.T.ravel().tolist(), **SIZE}}
REALSENSE = {"fx": 80.0, "fy": 90.0, "ppx": 15.5, "ppy": 11.5, "coeffs": [0.0] * 5, "model": "brown", **SIZE}

DEPTH: dict[str, tuple[Any, Any]] = {
    "metres and a matrix": (METRES, K),
    "nested lists": (METRES.tolist(), K.tolist()),
    "millimetres": (MILLIMETRES, K),
    "a tensor with a channel": (torch.tensor(METRES)[None], torch.tensor(K)),
    "a channel behind": (METRES[..., None], K),
    "an image of Pillow": (Image.fromarray(MILLIMETRES), K),
    "an image with color": (SimpleNamespace(depth=METRES, color=METRES), K),
    "an Image message": (depth_message(MILLIMETRES, "16UC1"), camera_info()),
    "a CameraInfo of ROS 1": (METRES, SimpleNamespace(K=K.ravel().tolist(), D=[0.0] * 5, **SIZE)),
    "four numbers": (METRES, (80.0, 90.0, 15.5, 11.5)),
    "a dict of four": (METRES, NUMBERS),
    "a dict of Open3D": (METRES, OPEN3D),
    "intrinsics of Open3D": (METRES, SimpleNamespace(intrinsic_matrix=K, **SIZE)),
    "intrinsics of RealSense": (METRES, SimpleNamespace(**REALSENSE)),
    "a camera": (METRES, IMAGE.camera),
    "a camera of a matrix": (METRES, mereo.Camera.from_K(K, WIDTH, HEIGHT)),
}


@pytest.mark.parametrize("line", DEPTH)
def test_every_depth_image_with_every_camera_is_one_frame(line: str, tmp_path: Path) -> None:
    depth, intrinsics = DEPTH[line]
    file = tmp_path / "depth.png"
    Image.fromarray(MILLIMETRES).save(file)
    for source in (depth, file):
        frame = mereo.load_frame(source, intrinsics=intrinsics)
        assert frame.whole is not None and frame.whole.camera == IMAGE.camera
        assert_allclose(frame.cloud.points, IMAGE.to_points().points, rtol=1e-6)


# --- what goes in: clouds with more columns ---------------------------------------------------------------------------

NORMALS = np.array([0.0, 0.6, -0.8]) * np.ones((1200, 1))


def test_columns_behind_positions_are_normals_or_colours() -> None:
    points = seen()
    oriented = np.hstack([points, NORMALS])
    cloud = mereo.load_frame(oriented.reshape(30, 40, 6)).cloud
    assert_allclose(np.hstack([cloud.points, cloud.normals]), oriented)
    for colors in (np.abs(NORMALS), 255 * (NORMALS > 0)):
        with pytest.warns(InputWarning, match="^the last three columns of the ndarray .* are colours, which are lef"):
            cloud = mereo.load_frame(np.hstack([points, colors])).cloud
        assert cloud.normals is None and np.array_equal(cloud.points, points)


# --- what goes in: meshes ---------------------------------------------------------------------------------------------

LEFT, RIGHT = (
    trimesh.creation.box((20, 30, 10), trimesh.transformations.translation_matrix((x, 0, 0))) for x in (0, 20)
)
BOXES = {"left": LEFT, "right": RIGHT}
LEFT.metadata["name"], RIGHT.metadata["name"] = BOXES
SMALL = trimesh.creation.box((0.1, 0.1, 0.1))


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
    return SimpleNamespace(points=arrays(mesh)[0], faces=np.zeros(96, int), regular_faces=arrays(mesh)[1])


def segment(name: str) -> Segment:
    return Segment(name, PALETTE[0], *arrays(BOXES[name]))


def moved_scene() -> trimesh.Scene:
    scene = trimesh.Scene({name: mesh.copy().apply_translation([-5, 0, 0]) for name, mesh in BOXES.items()})
    return scene.apply_translation([5, 0, 0])


MESHES: dict[str, Any] = {
    "a dict of trimesh": BOXES,
    "a scene of trimesh": moved_scene(),
    "a list with names": [LEFT, RIGHT],
    "a dict of Open3D": {name: legacy(mesh) for name, mesh in BOXES.items()},
    "a dict of tensor meshes": {name: tensors(mesh) for name, mesh in BOXES.items()},
    "a dict of PyVista": {name: polydata(mesh) for name, mesh in BOXES.items()},
    "a dict of arrays": {name: arrays(mesh) for name, mesh in BOXES.items()},
    "a segmented mesh": SegmentedMesh(tuple(segment(name) for name in BOXES)),
}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[mereo.Object]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield mereo.load_object(BOXES, units="mm", deformations="rigid")


@pytest.mark.parametrize("line", MESHES)
def test_every_kind_of_meshes_is_one_object(line: str, boxes: mereo.Object) -> None:
    known = mereo.load_object(MESHES[line], units="mm", deformations="rigid")
    assert known.names == ("left", "right") and known.scene is not None and known.scene.file is None
    assert known.model is not None and boxes.model is not None
    assert_allclose(known.model.rest_points, boxes.model.rest_points, rtol=1e-6)


def test_one_mesh_is_an_object_too(boxes: mereo.Object) -> None:
    for line, name in ((LEFT, "left"), ([LEFT], "left"), (legacy(LEFT), "part1"), ([arrays(LEFT)], "part1")):
        assert mereo.load_object(line, units="mm", deformations="rigid").names == (name,)


# --- what comes out ---------------------------------------------------------------------------------------------------

UNIT_M, FILES = 0.01, np.diag([4.0, 4.0, 4.0, 1.0])
"""Metres per scene unit of the rope, and what brings its files to the scene."""

T_BASE = rigid(Rotation.from_euler("xyz", [100, 20, -60], degrees=True).as_matrix(), np.array([5.0, -3.0, 2.0]))
"""Pose of the frame in that of a robot's base."""

FITTED = ("metres", "a scanner's millimetres", "an unknown unit")
ANSWERED = (*FITTED, "a network")


@pytest.fixture(scope="module")
def results(rope: Model) -> dict[str, Any]:
    """Registered in frames of all kinds; a network's with a segment that was not found; lost."""
    assert rope.statistical_model is not None
    sized, free = (replace(rope.statistical_model, source_frame=SourceFrame(FILES, unit)) for unit in (UNIT_M, None))
    cloud = load_view("rope").depth.to_points().points
    scan, known = 1000 * UNIT_M * cloud @ SCANNER_TO_CAMERA[:3, :3], Registrar(rope, sized, "modes")
    answers = (
        answer_to(UNIT_M * cloud, rope, known, 16, unit_m=1.0),
        answer_to(scan, rope, known, 16, "scanner", 0.001),
        answer_to(cloud, rope, Registrar(rope, free, "modes"), 16),
    )
    made: dict[str, Any] = dict(zip(FITTED, map(Result.of, answers), strict=True))
    made["a network"] = mereo.reconstruct(seen(), MODEL, resolution=24, unit_m=1.0, label_points=True)
    waiting = type("Waiting", (Executor,), {"submit": lambda *_, **__: Future()})()
    alone, pose = mereo.Object(None, None, model=sized), made["metres"].pose
    with mereo.Tracker(alone, "modes", executor=waiting, initial_pose=pose) as tracker:
        for step in range(2):
            made["lost"] = tracker.follow(UNIT_M * (cloud + 40 * step), 0.03 * step, unit_m=1.0)
    return made


POINTS = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]

OUTPUT: dict[str, Callable[[Any], object]] = {
    "a name in it": lambda r: "base" in r and "head" not in r,
    "its length": lambda r: len(r) == 9 and [segment.name for segment in r] == list(r.names),
    "JSON": lambda r: json.loads(json.dumps(r.to_dict(), allow_nan=False)) == r.to_dict(),
    "copies": lambda r: copy.copy(r) is r and copy.deepcopy([r])[0] is r,
    "a segment in another": lambda r: np.allclose(
        r["base"].pose @ r["segment_8"].pose_in("base"), r["segment_8"].pose, atol=1e-9 * np.ptp(r.pose)
    ),
    "one point": lambda r: np.array_equal(r.carry(POINTS[2]), r.carry(POINTS)[2]),
    "how much is explained, how well": lambda r: 0.9 < r.explained <= 1 and 0 < r.residual < np.ptp(r.pose),
    "poses": lambda r: np.allclose(r.carry([np.eye(4)] * 3)[2, :3, 3], r.carry(POINTS[0])),
    "a mesh of trimesh": lambda r: isinstance(r.carry(SMALL), trimesh.Trimesh),
    "a dict": lambda r: np.array_equal(r.carry({"grasp": POINTS})["grasp"], r.carry(POINTS)),
    "short texts": lambda r: all(
        len(repr(each).splitlines()) <= 10 and len(repr(each)) < 1000
        for each in (r.candidate, r.registered.uncertainty, r.registered, r["base"])
    ),
}


@pytest.mark.parametrize("kind", FITTED)
@pytest.mark.parametrize("line", OUTPUT)
def test_what_is_asked_of_a_result_comes_out(line: str, kind: str, results: dict[str, Any]) -> None:
    assert OUTPUT[line](results[kind])


@pytest.mark.parametrize("kind", FITTED)
def test_the_covariance_is_that_of_the_pose_under_the_posterior(kind: str, results: dict[str, Any]) -> None:
    """By differences of the pose along each of the posterior's independent numbers, and towards other states."""
    fit = results[kind].registered
    sure, posterior, unit = fit.uncertainty, fit.uncertainty.posterior, fit.uncertainty.optimum.unit
    turn = unit * fit_rigid(unit * posterior.material, fit.material)[:3, :3]
    own = sure.factor * posterior.posed.rotation @ posterior.motion
    moves = np.concatenate([own, posterior.open, posterior.ways], axis=2)
    expected = np.zeros((6, 6))
    for step in 1e-3 * np.moveaxis(moves, 2, 0) @ turn.T:
        one, other = (replace(fit, material=fit.material + side).pose() for side in (-step, step))
        turned = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).as_rotvec()
        change = np.concatenate([turned, other[:3, 3] - one[:3, 3]]) / 2e-3
        expected += np.outer(change, change)
    expected[range(3, 6), range(3, 6)] += (unit * sure.extra_radius) ** 2 / chi2.ppf(0.95, 3)  # as of every position
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert_allclose(results[kind].covariance / scale, expected / scale, atol=1e-4)


FACTS = ("unit_m", "known", "explained", "residual", "model_scale", "pose", "covariance", "joints", "names")
SEGMENT = ("name", "label", "centroid", "volume", "confidence", "error_radius", "is_present", "pose", "poses")


def same(stored: Any, result: Any) -> None:
    """Everything that a stored result says is what the result says, up to the digits of surfaces in files."""
    assert isinstance(stored, StoredResult) and len(repr(stored)) < 120
    assert {**stored.to_dict(), "timings_s": 0} == {**result.to_dict(), "timings_s": 0}
    for names, pairs in ((FACTS, [(stored, result)]), (SEGMENT, zip(stored, result, strict=True))):
        for one, other in pairs:
            assert_equal(*({name: getattr(each, name) for name in names} for each in (one, other)))
    for one, other in zip(stored, result, strict=True):
        assert_allclose(one.mesh.bounds, other.mesh.bounds, rtol=1e-5)
    assert not result or np.array_equal(stored.labels.labels, result.labels.labels)


def test_a_result_goes_to_another_process_and_back(results: dict[str, Any]) -> None:
    code = (
        "import copy, pickle, sys; r = pickle.load(sys.stdin.buffer); assert [*map(len, r.values())] == [9, 9, 9, 3, 0]"
    )
    code += "; pickle.dump(copy.deepcopy(r), sys.stdout.buffer)"
    back = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(results), capture_output=True, check=True
    ).stdout
    for kind, stored in pickle.loads(back).items():
        same(stored, results[kind])


@pytest.mark.usefixtures("small_previews")
@pytest.mark.parametrize("kind", ANSWERED)
def test_a_folder_is_loaded_as_it_was_saved(kind: str, results: dict[str, Any], tmp_path: Path) -> None:
    for number, result in enumerate((results[kind], results[kind].transformed(T_BASE))):
        folder = result.save(tmp_path / str(number))
        same(mereo.load_result(folder), result)
    for name in ("labels.npz", "segments.glb", "summary.json"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match=f"{name} cannot be read as a "):
            mereo.load_result(folder)
        (folder / name).write_bytes(whole)
    (folder / name).write_bytes(whole.replace(result.names[0].encode(), b"x"))
    with pytest.raises(ValueError, match="its segments are not those of segments.glb and labels.npz"):
        mereo.load_result(folder)


def test_a_lost_object_says_so_in_every_form(results: dict[str, Any]) -> None:
    lost = results["lost"]
    facts = lost.to_dict()
    assert (facts["tracking"], facts["verdict"], facts["segments"]) == ("lost", "no", [])
    assert facts["registration"]["answer"] is None and not lost and list(lost) == [] and "base" not in lost
    assert lost.pose is lost.covariance is lost.explained is lost.residual is None
    assert "the object is lost" in repr(lost.transformed(T_BASE))
    with pytest.raises(ValueError, match="^the object is lost: "):
        _ = lost["base"]
    with pytest.raises(ValueError, match="the network's answer is kept, but .*carry needs a registration"):
        results["a network"]["big"].pose_in("big")


@pytest.mark.parametrize("kind", ANSWERED)
def test_a_result_in_a_robots_frame_is_the_same_there(kind: str, results: dict[str, Any]) -> None:
    result, moved = results[kind], results[kind].transformed(T_BASE)
    near = partial(assert_allclose, atol=1e-9 * np.ptp(result.surfaces.merged()[0]), rtol=1e-9)
    place, facts, labels = partial(transform_points, T_BASE), moved.to_dict(), moved.labels
    near(moved.surfaces.merged()[0], place(result.surfaces.merged()[0]))
    near(moved.transformed(facts["T_input_result"]).surfaces.bounds, result.surfaces.bounds)
    assert facts["frame"] == "other"
    for one, other in zip(moved, result, strict=True):
        near(one.centroid, place(other.centroid))
        assert (one.error_radius, one.volume) == (pytest.approx(other.error_radius), other.volume)
        voxels = labels.positions(np.argwhere(labels.labels == one.label))
        assert one.is_present == (len(voxels) > 0)
        assert (voxels >= one.mesh.bounds[0]).all() and (voxels <= one.mesh.bounds[1]).all()
    if result.pose is not None:
        near(moved.pose, T_BASE @ result.pose)
        near(moved.carry(np.eye(4)), T_BASE @ result.carry(np.eye(4)))
        turn = np.kron(np.eye(2), T_BASE[:3, :3])
        near(moved.covariance, turn @ result.covariance @ turn.T, rtol=1e-4, atol=1e-4 * np.ptp(result.covariance))


# --- what is refused, in a sentence -----------------------------------------------------------------------------------

OPEN = trimesh.Trimesh(LEFT.vertices[:3], [[0, 1, 2]])

REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "a camera of a cloud": (lambda: load(K, "bun000.ply"), "bun000.ply is read as a point cloud; leave out intrinsics"),
    "distortion": (
        lambda: load(camera_info(d=np.array([0.1, 0.0, 0.0, 0.0, 0.0]))),
        r"^the intrinsics state lens distortion \(up to .* pixels in the corners\), .* must have none: rectify it",
    ),
    "two numbers": (lambda: load((80, 90)), r"^intrinsics is \(80, 90\); it must be a camera: give"),
    "a dict of other names": (lambda: load({"f": 80}), "^intrinsics cannot be used: it has neither fx, "),
    "a color image": (lambda: load(K, np.ones((24, 32, 3))), r"has the shape \(24, 32, 3\); it must be rows of pixels"),
    "a color message": (
        lambda: load(K, depth_message(MILLIMETRES, "bgr8")), "^the Image message cannot be read .*'bgr8'"
    ),
    "columns of anything": (lambda: mereo.load_frame(np.hstack([seen(), 7.5 * NORMALS])), "six columns.* as points"),
    "an open mesh": (lambda: mereo.load_object({"lid": OPEN}, units="mm"), "^segment 'lid' of lid.obj .* solids"),
    "a dict of other things": (
        lambda: mereo.load_object({"left": LEFT, "right": 3}), "^the part 'right' of the object is no mesh, as"
    ),
    "quadrangles": (
        lambda: mereo.load_object((LEFT.vertices, [[0, 1, 2, 3]])), r"faces of \(1, 4\); they must be v x 3 "
    ),
    "units of a loaded object": (
        lambda: mereo.reconstruct(seen(), mereo.Object(MODEL), units="mm"),
        "^units is given for an object that is loaded already: give it to load_object$",
    ),
    "a misspelled option": (
        lambda: mereo.reconstruct(seen(), MODEL, unitm=1.0), "^there is no option 'unitm' here: is unit_m meant"
    ),
    "a misspelled step": (
        lambda: mereo.reconstruct(seen(), MODEL, isolation={"largest_clusters": True}), "is largest_cluster meant"
    ),
    "a misspelled field": (lambda: mereo.evaluate(MODEL, exmples=1), "^there is no option 'exmples' here: is examples"),
    "axes as the command has them": (lambda: mereo.load_frame(seen(), frame="scanner"), "axes='scanner' states"),
    "an output": (lambda: mereo.reconstruct(seen(), MODEL, output="x"), r"'output' here: result.save\(path, "),
    "an unlike name": (lambda: mereo.load_frame(seen(), xyzzy=1), "'xyzzy' here: the options are axes, camera_pose, d"),
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the check of types that tests put before it
    call, sentence = REFUSED[line]
    with pytest.raises((ValueError, TypeError), match=sentence) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1
