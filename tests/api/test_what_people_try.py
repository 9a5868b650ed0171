"""What a user of Open3D, trimesh, FoundationPose, Ultralytics, viser, scikit-learn or ROS tries first, line by line.

Each line stands in a table: what goes in, options by their names, what comes out, and what is refused in a sentence.
"""

import copy
import json
import pickle
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh
from analytic import untrained
from answers import answer_to
from memory_frames import Tensor, TensorMap, Vectors
from numpy import ndarray
from numpy.testing import assert_allclose, assert_equal
from PIL import Image
from scipy.spatial.transform import Rotation
from toy_frames import MODEL, NAMES, seen
from toy_scene import toy_scene
from trimesh.creation import box

import mereo
from mereo import load_frame, load_object, reconstruct
from mereo.api.result import Result, StoredResult
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, DepthImage, PointCloud
from mereo.geometry.labels import SegmentedCloud
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.transforms import fit_rigid, rigid, transform_points
from mereo.io.readers import InputWarning
from mereo.io.sensor_frame import SensorFrame
from mereo.models.model import Model
from mereo.reconstruction.config import IsolationConfig
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


def depth_message(values: ndarray, encoding: str) -> SimpleNamespace:
    """Message of ROS with a depth image."""
    return SimpleNamespace(
        encoding=encoding, step=values.strides[0], is_bigendian=0, data=values.tobytes(), height=HEIGHT, width=WIDTH
    )


def load(intrinsics: Any, depth: Any = METRES) -> SensorFrame:
    return load_frame(depth, intrinsics=intrinsics)


OPEN3D = {"intrinsic": {"intrinsic_matrix": K.T.ravel().tolist(), **SIZE}}
REALSENSE = {"fx": 80.0, "fy": 90.0, "ppx": 15.5, "ppy": 11.5, "coeffs": [0.0] * 5, "model": "brown", **SIZE}

DEPTH = {
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
    "a camera of a matrix": (METRES, Camera.from_K(K, WIDTH, HEIGHT)),
}


@pytest.mark.parametrize("line", DEPTH)
def test_every_depth_image_with_every_camera_is_one_frame(line: str, tmp_path: Path) -> None:
    depth, intrinsics = DEPTH[line]
    file = tmp_path / "depth.png"
    Image.fromarray(MILLIMETRES).save(file)
    for source in (depth, file):
        frame = load_frame(source, intrinsics=intrinsics)
        assert frame.whole is not None and frame.whole.camera == IMAGE.camera
        assert_allclose(frame.cloud.points, IMAGE.to_points().points, rtol=1e-6)


def test_masks_of_all_kinds_in_memory_agree() -> None:
    truth = np.zeros((32, 32), bool)
    truth[4:20, 6:17] = True
    logits = np.where(truth, 3.5, -8.0).astype(np.float32)
    for mask in (
        *(truth, truth[None], truth.astype(np.uint8), 255 * truth.astype(np.uint8), 7 * truth.astype(np.int64)),
        *(logits, logits[None, None], torch.tensor(logits[None]), truth.astype(np.float32), 0.9 * truth + 0.05),
        *(Image.fromarray(truth), Image.fromarray(truth).convert("RGB"), truth.tolist()),
    ):
        frame = masked(mask)
        assert frame.depth is not None and np.array_equal(frame.depth.valid, truth)
        assert frame.whole is ONES and len(frame.cloud) == truth.sum()
    ids = masked(np.where(truth, 3, 5), mask_value=3)
    assert ids.depth is not None and np.array_equal(ids.depth.valid, truth)


# --- what goes in: clouds with more columns ---------------------------------------------------------------------------

NORMALS = np.array([0.0, 0.6, -0.8]) * np.ones((1200, 1))


def test_columns_behind_positions_are_normals_or_colours() -> None:
    points = seen()
    oriented = np.hstack([points, NORMALS])
    with pytest.warns(InputWarning, match="^the last three columns of the ndarray .* are normals, which are used$"):
        cloud = load_frame(oriented.reshape(30, 40, 6)).cloud
    assert_allclose(np.hstack([cloud.points, cloud.normals]), oriented)
    for colors in (np.abs(NORMALS), 255 * (NORMALS > 0)):
        with pytest.warns(InputWarning, match="^the last three columns of the ndarray .* are colours, which are lef"):
            cloud = load_frame(np.hstack([points, colors])).cloud
        assert cloud.normals is None and np.array_equal(cloud.points, points)


# --- what goes in: meshes ---------------------------------------------------------------------------------------------

LEFT, RIGHT = (box((20, 30, 10), trimesh.transformations.translation_matrix((x, 0, 0))) for x in (0, 20))
BOXES = {"left": LEFT, "right": RIGHT}
LEFT.metadata["name"], RIGHT.metadata["name"] = BOXES
SMALL = box((0.1, 0.1, 0.1))


def arrays(mesh: trimesh.Trimesh) -> tuple[ndarray, ndarray]:
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


MESHES = {
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
        yield load_object(BOXES, units="mm", deformations="rigid")


@pytest.mark.parametrize("line", MESHES)
def test_every_kind_of_meshes_is_one_object(line: str, boxes: mereo.Object) -> None:
    known = load_object(MESHES[line], units="mm", deformations="rigid")
    assert known.names == ("left", "right") and known.scene is not None and known.scene.file is None
    assert known.model is not None and boxes.model is not None
    assert_allclose(known.model.rest_points, boxes.model.rest_points, rtol=1e-6)


def test_one_mesh_is_an_object_too(boxes: mereo.Object) -> None:
    for line, name in (
        (LEFT, "left"),
        ({7: LEFT}, "7"),
        (legacy(LEFT), "part1"),
        ([arrays(LEFT)], "part1"),
    ):
        assert load_object(line, units="mm", deformations="rigid").names == (name,)


# --- what comes out ---------------------------------------------------------------------------------------------------

UNIT_M = 0.01
FILES = np.diag([4.0, 4.0, 4.0, 1.0])
"""Metres per scene unit of the rope, and what brings its files to the scene."""

T_BASE = rigid(Rotation.from_euler("xyz", [100, 20, -60], degrees=True).as_matrix(), np.array([5.0, -3.0, 2.0]))
"""Pose of the frame in that of a robot's base."""

FITTED = ("metres", "a scanner's millimetres", "an unknown unit")
ANSWERED = (*FITTED, "a network")


Results = dict[str, Any]
"""A result of each kind."""


@pytest.fixture(scope="module")
def results(rope: Model) -> Results:
    """Registered in frames of all kinds; a network's with a segment that was not found; lost."""
    assert rope.statistical_model is not None
    sized, free = (replace(rope.statistical_model, source_frame=SourceFrame(FILES, unit)) for unit in (UNIT_M, None))
    cloud = load_view("rope").depth.to_points().points
    scan = 1000 * UNIT_M * cloud @ SCANNER_TO_CAMERA[:3, :3]
    known = Registrar(rope, sized, "modes")
    answers = (
        answer_to(UNIT_M * cloud, rope, known, 16, unit_m=1.0),
        answer_to(scan, rope, known, 16, "scanner", 0.001),
        answer_to(cloud, rope, Registrar(rope, free, "modes"), 16),
    )
    made = dict(zip(FITTED, map(Result.of, answers), strict=True))
    made["a network"] = answered(resolution=24, unit_m=1.0, label_points=True)
    waiting = type("Waiting", (Executor,), {"submit": lambda *_, **__: Future()})()
    alone = mereo.Object(None, None, model=sized)
    pose = made["metres"].pose
    with mereo.Tracker(alone, "modes", executor=waiting, initial_pose=pose) as tracker:
        for step in range(2):
            made["lost"] = tracker.follow(UNIT_M * (cloud + 40 * step), 0.03 * step, unit_m=1.0)
    return made


POINTS = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]

OUTPUT = {
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
def test_what_is_asked_of_a_result_comes_out(line: str, kind: str, results: Results) -> None:
    assert OUTPUT[line](results[kind])


@pytest.mark.parametrize("kind", FITTED)
def test_the_covariance_is_that_of_the_pose_under_the_posterior(kind: str, results: Results) -> None:
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
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert_allclose(results[kind].covariance / scale, expected / scale, atol=1e-4)


FACTS = (
    "unit_m",
    "known",
    "explained",
    "residual",
    "expected_iou",
    "model_scale",
    "pose",
    "covariance",
    "joints",
    "names",
)
SEGMENT = (
    "name",
    "label",
    "centroid",
    "volume",
    "confidence",
    "error_radius",
    "expected_iou",
    "is_present",
    "pose",
    "poses",
)


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


def test_a_result_goes_to_another_process_and_back(results: Results) -> None:
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
def test_a_folder_is_loaded_as_it_was_saved(kind: str, results: Results, tmp_path: Path) -> None:
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


@pytest.mark.usefixtures("small_previews")
@pytest.mark.parametrize("kind", ANSWERED)
def test_what_was_loaded_is_transformed_saved_and_carries_as_the_result_does(
    kind: str, results: Results, tmp_path: Path
) -> None:
    whole = results[kind]
    moved = results[kind].transformed(T_BASE)
    known = mereo.Object(None, model=whole.registrar.model) if kind in FITTED else None
    stored = mereo.load_result(whole.save(tmp_path / "whole"), known).transformed(T_BASE)
    again = mereo.load_result(stored.save(tmp_path / "again", millimetres=True), known)
    near = partial(assert_allclose, rtol=1e-4, atol=1e-5 * np.ptp(moved.surfaces.merged()[0]))
    assert again.facts.keys() == moved.to_dict().keys() and again.facts["frame"] == "other"
    for one, other in zip(again, moved, strict=True):
        near([one.centroid, *one.mesh.bounds], [other.centroid, *other.mesh.bounds])
    if known is not None:
        near([again.carry(np.eye(4)), again["base"].pose], [moved.carry(np.eye(4)), moved["base"].pose])
        near(again.covariance, moved.covariance, atol=1e-6)
    with pytest.raises(ValueError, match="^a stored result holds no model of its object"):
        mereo.load_result(tmp_path / "again").carry(np.eye(4))
    with pytest.raises(ValueError, match="a.png shows the observed points, which a stored result does not have"):
        stored.save(tmp_path / "a.png")


def test_a_lost_object_says_so_in_every_form(results: Results) -> None:
    lost = results["lost"]
    facts = lost.to_dict()
    assert (facts["tracking"], facts["verdict"], facts["segments"]) == ("lost", "no", [])
    assert "registration" not in facts and not lost and list(lost) == [] and "base" not in lost
    assert lost.pose is lost.covariance is lost.explained is lost.residual is None
    assert "the object is lost" in repr(lost.transformed(T_BASE))
    with pytest.raises(ValueError, match="^the object is lost: "):
        _ = lost["base"]
    with pytest.raises(ValueError, match="the network alone answers, and .*carry needs a registration"):
        results["a network"]["big"].pose_in("big")


@pytest.mark.parametrize("kind", ANSWERED)
def test_a_result_in_a_robots_frame_is_the_same_there(kind: str, results: Results) -> None:
    result = results[kind]
    moved = results[kind].transformed(T_BASE)
    near = partial(assert_allclose, atol=1e-9 * np.ptp(result.surfaces.merged()[0]), rtol=1e-9)
    place = partial(transform_points, T_BASE)
    facts = moved.to_dict()
    labels = moved.labels
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

LINE = np.linspace(0.1, 1.0, 99)[:, None] * [1.0, 0.5, 2.0]
SQUARE = Camera(32, 32, 40.0, 40.0, 16.0, 16.0)
ONES = DepthImage(np.ones((32, 32)), SQUARE)


def masked(mask: object, **options: object) -> SensorFrame:
    """The image of ones within a mask."""
    return load_frame(ONES, mask=mask, **options)


def queried(points: ndarray) -> object:
    """Answer of a network at these points."""
    model = untrained(NAMES)
    return model.query(model.encode(seen()), points)


def answered(**options: Any) -> Result:
    return reconstruct(seen(), MODEL, **options)


GRID = "resolution is .*; it must be a whole number, from 4 to 4096: give for example 128"


REFUSED = {
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
    "columns of anything": (lambda: load_frame(np.hstack([seen(), 7.5 * NORMALS])), "six columns.* as points"),
    "an open mesh": (lambda: load_object({"lid": OPEN}, units="mm"), "^segment 'lid' of lid.obj .* solids"),
    "a dict of other things": (
        lambda: load_object({"left": LEFT, "right": 3}), "^the part 'right' of the object is no mesh, as"
    ),
    "quadrangles": (
        lambda: load_object((LEFT.vertices, [[0, 1, 2, 3]])), r"faces of \(1, 4\); they must be v x 3 "
    ),
    "units of a loaded object": (
        lambda: reconstruct(seen(), mereo.Object(MODEL), units="mm"),
        "^units is given for an object that is loaded already: give it to load_object$",
    ),
    "a misspelled option": (
        lambda: answered(unitm=1.0), "^there is no option 'unitm' here: is unit_m meant"
    ),
    "a misspelled step": (
        lambda: answered(isolation={"largest_clusters": True}), "is largest_cluster meant"
    ),
    "a misspelled field": (lambda: mereo.evaluate(MODEL, exmples=1), "^there is no option 'exmples' here: is examples"),
    "joints of a tracker": (lambda: mereo.Tracker(MODEL, joint={}), "^there is no option 'joint' here: is joints mea"),
    "a format of a file": (lambda: Result.save(MagicMock(), "x", format="glb"), "'format' here: is formats meant"),
    "a browser": (lambda: Result.show(MagicMock(), browser=True), "no option 'browser' here: .* block, port$"),
    "a transform": (lambda: Result.transformed(MagicMock(), T=T_BASE), "'T' here: the options are T_new_frame$"),
    "a name with the same letters": (lambda: load_object("rope", quiet=True), "'quiet' here: the options are defor"),
    "an object of a file": (lambda: mereo.Object("x.stl"), "^the network of an object is 'x.stl'; .* use load_object$"),
    "an object of an array": (lambda: load_object(np.eye(4)), r"^the object is array\(\[\[1., 0.*\.\.\.; it must be"),
    "a path of an array": (lambda: Result.save(MagicMock(), np.eye(9)), r"^path is array\(\[\[1., 0.*\.\.\.; it must"),
    "axes as the command has them": (lambda: load_frame(seen(), frame="scanner"), "axes='scanner' states"),
    "an output": (lambda: answered(output="x"), r"'output' here: result.save\(path, "),
    "an unlike name": (lambda: load_frame(seen(), xyzzy=1), "'xyzzy' here: the options are axes, camera_pose, d"),
    **{
        f"axes {axes!r}": (lambda axes=axes: load_frame(seen(), axes=axes), "^axes is .* one of camera, scanner")
        for axes in ("Camera", 3, "")
    },
    **{
        f"resolution {n}": (lambda n=n: answered(resolution=n), GRID)
        for n in (0.5, np.nan, -5, True, 1_000_000, None)
    },
    "a large grid": (lambda: answered(resolution=4096).surfaces, "at most 80000000 fit: lower"),
    "an index": (lambda: load_frame(seen(), frame_index=-1), "^frame_index is -1; it must be a whole number, at"),
    "a complex cloud": (lambda: PointCloud(seen() * 1j), "values of type complex128; they must be real numbers"),
    "pairs": (lambda: PointCloud(seen()[:, :2]), r"have the shape \(\d+, 2\); they must be n x 3"),
    "complex depth": (lambda: DepthImage(np.ones((32, 32)) * 1j, SQUARE), "the depth image has values of type complex"),
    "boolean depth": (
        lambda: load_frame(np.ones((32, 32), bool), intrinsics=SQUARE), "the depth image has values of type bool"
    ),
    "a line": (lambda: reconstruct(LINE, MODEL), "the 99 points of cloud lie on a line or at one place; the obj"),
    "one place": (lambda: reconstruct(np.ones((500, 3)), MODEL), "the 500 points of .* at one place"),
    **{
        f"an image of {width} columns": (lambda width=width: replace(SQUARE, width=width), f"size is {width} x 32;")
        for width in (2.5, True, 0, "32", None)
    },
    "a complex focal length": (lambda: replace(SQUARE, focal_x_px=40j), "the camera has values of type complex128"),
    "a matrix of four": (lambda: Camera.from_K(np.eye(4), 32, 32), "the camera matrix is .*; it must be 3 x 3 numbers"),
    "a column-wise matrix": (lambda: Camera.from_K([40, 0, 0, 0, 40, 0, 16, 16, 1], 32, 32), "0 0 1 in the last row"),
    "depths in a row": (lambda: DepthImage(np.ones(5), SQUARE), r"has the shape \(5,\); it must be rows of pixels"),
    "another image's mask": (lambda: ONES.to_points(np.ones((3, 4), bool)), r"has the shape \(3, 4\)"),
    "a mask of numbers": (lambda: ONES.to_points(np.ones((32, 32), int)), "type int64; it must be .* mask > 0"),
    "a complex pose": (lambda: load_frame(seen(), camera_pose=np.eye(4) * 1j), "the pose is not of real numbers"),
    "a far pose": (
        lambda: load_frame(seen(), camera_pose=np.eye(4) + np.eye(4, k=3) * 1e300), "translation of 1e.12 at most"
    ),
    "labels of other points": (
        lambda: SegmentedCloud(seen(), np.ones(4, np.uint8), np.ones(4), np.ones(4), ("a",), ((0, 0, 0),)),
        "points have 4 labels, 4 confidences and 4 occupancies; each point needs one"
    ),
    "no query": (lambda: queried(np.empty((0, 3))), "0 points are queried; at least one is needed"),
    "a query of NaN": (lambda: queried(np.full((2, 3), np.nan)), "2 of 2 points are NaN or infinite"),
    "a query of pairs": (lambda: queried(np.ones((2, 2))), r"the shape \(2, 2\); they must be n x 3"),
    "no path": (lambda: Result.save(MagicMock(), 3), "^path is 3; it must be a path: give a text or a p"),
    "formats": (
        lambda: Result.save(MagicMock(), "x", formats="glb"), "^formats is 'glb'; it must be a list of names: g"
    ),
    **{
        f"an object of {given!r}": (lambda given=given: load_object(given), "^(the|no) object is .*; .*name its meshes")
        for given in ([None], b"bytes", [], {}, {"a.stl"}, 3, "", ["a.stl", ""], [b"a.stl"])
    },
    "no object's name": (lambda: load_object("nothing"), "there is no object 'nothing': name its meshes, its scene fi"),
    "no file": (lambda: load_object("missing.stl"), "missing.stl does not exist"),
    "a folder of others": (
        lambda: load_object(Path(__file__).parent), "holds no meshes .*: name the folder of an object, or its files"
    ),
    "weights": (lambda: load_object(weights=3), "^weights is 3; it must be a path"),
    "a scene": (lambda: load_object("rope", scene=3), "^scene is 3; it must be a path"),
    "units": (
        lambda: load_object("x.stl", units="feet"), "^units is 'feet'; it must be one of mm, cm, m, in: give"
    ),
    "deformations": (
        lambda: load_object("x.stl", deformations="hard"),
        "^deformations is 'hard'; it must be one of auto, rigid, soft, stiff, articulated: give for example 'auto'$",
    ),
    "robot meshes": (lambda: load_object("x.urdf", robot_meshes=3), "is 3; it must be one of visual, collision"),
    "deformations of a scene": (
        lambda: load_object(toy_scene(), deformations="stiff"),
        "^the deformations are stiff, but .* says its own: l"
    ),
    "units of weights": (
        lambda: load_object("rope", units="mm"), "^the units are mm, but rope says its own: leave"
    ),
    "units of a scene": (lambda: load_object("rope.yaml", units="mm"), "rope.yaml says its own: leave them out"),
    "isolation": (
        lambda: answered(isolation=3), "^isolation is 3; it must be an IsolationConfig"
    ),
    "an extent": (
        lambda: answered(extent="half"),
        "^extent is 'half'; it must be one of auto, whole, partial"
    ),
    "a box": (
        lambda: answered(box=3), r"^the box is 3; it must be 6 numbers: give them in metres$"
    ),
    "a short range": (
        lambda: answered(depth_range=(1,)), r"^the depth range is \(1,\); it must be 2 numbers"
    ),
    "a pose": (
        lambda: answered(initial_pose="x"), "^the pose is of the shape .*must be 4 x 4 finite"
    ),
    "a ragged pose of a tracker": (
        lambda: mereo.Tracker(MODEL, initial_pose=[[1], [1, 2]]), "^the pose is of the shape .*must be 4 x"
    ),
    "what to view": (lambda: mereo.view(3, block=False), "^input is 3; it must be a path"),
    "a port": (
        lambda: mereo.view("x.glb", port=-1), "^port is -1; it must be a whole number, from 0 to 65535: give for"
    ),
    "a folder": (lambda: mereo.generate("rope", 3, examples=1), "^the folder is 3; it must be a path: give a text"),
    "minutes": (lambda: mereo.learn("rope", "x", minutes=-1), "^minutes is -1; it must be greater than 0: give for"),
    "what to learn": (lambda: mereo.learn(3, "x"), "^object is 3; it must be a path"),
    "a unit of what is learned": (
        lambda: mereo.learn("rope", "x", units="feet"), "^units is 'feet'; it must be one of mm, cm"
    ),
    "a format": (
        lambda: mereo.export("rope", "x", "onxx"), "^format is 'onxx'; it must be one of onnx, torch: give for"
    ),
    "a unit in words": (lambda: load_frame(seen(), unit_m="mm"), "^unit_m is 'mm'; it must be greater than 0"),
    "a negative id": (lambda: load_frame(seen(), mask_value=-1), "values are .-1,.; they must be whole numb"),
    "a mask's id without one": (lambda: load_frame(seen(), mask_value=1), "mask_value is given for a frame"),
    "three masks": (lambda: masked(np.ones((3, 32, 32), bool)), r"\(3, 32, 32\) .* masks\[scores.argmax\(\)\]"),
    "floats of a byte": (lambda: masked(np.eye(32) * 255), "from 0 to 255; they must be logits, or probabilities from"),
    "a small mask": (lambda: masked(np.arange(4).reshape(2, 2)), "^the mask is 2 x 2 pixels but the depth image is "),
    "an empty mask": (lambda: masked(np.zeros((32, 32))), "measures 0 pixels inside the mask"),
    "ids": (lambda: masked(np.arange(1024).reshape(32, 32)), "^the mask has the values 0, .* give mask_value=1023 or"),
    "a mask that is none": (lambda: masked([[1], [1, 0]]), "^the mask, a list, is no array .*: give h x w truth"),
    "a mask of a cloud": (lambda: load_frame(seen(), mask=np.eye(32)), "is a point cloud, which has no pixels"),
    "a point in space": (lambda: IsolationConfig(point=(1, 2, 3)), "it must be the column and the row of a pixel"),
    "axes of a frame": (
        lambda: reconstruct(load_frame("rope"), MODEL, axes="scanner"),
        "axes is given for a frame that is read already: give it where",
    ),
    "a misspelled method": (
        lambda: answered(method="fulll"), "^method is 'fulll'; it must be one of auto, .*: give for example 'auto'"
    ),
    "a unit below zero": (lambda: answered(unit_m=-1), "the unit is -1 m; it must be positive"),
    "a misspelled frame": (lambda: load_frame("bunnny"), "there is no frame 'bunnny'; give a file or one of the sh"),
    "a unit of a shipped frame": (
        lambda: load_frame("rope", unit_m=0.001), "the shipped frame 'rope' is in metres and needs no options"
    ),
    "a mask's file": (lambda: load_frame(seen(), mask="m.png"), "mask is given for a frame that is no file's: leave"),
    "a preset": (lambda: mereo.train("x", "x", "tinny"), "the preset is 'tinny'; it must be one of paper, .*: correct"),
    "a train": (lambda: mereo.learn("rope", "x", train="once"), "train is 'once'; it must be one of auto, always, n"),
    "another suffix": (
        lambda: Result.save(MagicMock(), "x.stl"), r"x.stl has the suffix '.stl'; one file is .glb, .ply, .*: choose"
    ),
    "two formats": (lambda: Result.save(MagicMock(), "x.glb", formats=("ply",)), "one file, whose suffix says its"),
    "a format's name": (lambda: Result.save(MagicMock(), "x", formats=("plx",)), "there is no format 'plx'"),
    "a matrix by its name": (lambda: load_frame(METRES, K=K), "there is no option 'K' here: intrinsics=K has it"),
    "a masked array": (lambda: load(K, np.ma.masked_all((24, 32))), "depth image measures 0 pixels in the image"),
    "no vertex": (lambda: load_object((POINTS, [[0, 1, 7]])), "^segment 'part1' has a face that refers to vertex 7 of"),
    "no face": (lambda: load_object({"lid": trimesh.Trimesh()}), "^segment 'lid' has no faces; it must be"),
    "a negative unit": (lambda: replace(load_frame(seen()), unit_m=-1.0), "unit_m is -1.0; it must be greater"),
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the check of types that tests put before it
    call, sentence = REFUSED[line]
    with pytest.raises((ValueError, TypeError, OSError), match=sentence) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1
