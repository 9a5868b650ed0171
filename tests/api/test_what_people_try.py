"""What a user of Open3D, trimesh, FoundationPose, Ultralytics, viser, scikit-learn or ROS tries first, line by line.

Each line stands in a table: what goes in, options by their names, what comes out, and what is refused in a sentence.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh
from memory_frames import Tensor, TensorMap, Vectors
from PIL import Image
from toy_frames import MODEL, seen

import mereo
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.readers import InputWarning
from mereo.io.sensor_frame import SensorFrame
from mereo.scenes.random_states import CACHE_VARIABLE

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


def test_one_mesh_is_an_object_too(cache: None, tmp_path: Any) -> None:
    for line in (LEFT, legacy(LEFT), arrays(LEFT), [LEFT], [arrays(LEFT)]):
        assert mereo.load_object(line, units="mm", deformations="rigid").names == ("part1",)
    LEFT.export(tmp_path / "any.stl")
    known = mereo.load_object({"left": str(tmp_path / "any.stl"), "right": RIGHT}, units="mm", deformations="rigid")
    assert known.names == ("left", "right")


# --- what is refused, in a sentence -----------------------------------------------------------------------------------

OPEN = trimesh.Trimesh(LEFT.vertices[:3], [[0, 1, 2]])

REFUSED: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "distortion": (
        lambda: load(intrinsics=camera_info(d=np.array([0.1, 0.0, 0.0, 0.0, 0.0]))),
        ValueError,
        r"^the intrinsics state lens distortion \(up to .* pixels in the corners\), .* must have none: rectify it",
    ),
    "an empty CameraInfo": (
        lambda: load(intrinsics=camera_info(k=np.zeros(9))), ValueError, "^intrinsics is .* .the last row of its matrix is"
    ),
    "a camera of another size": (
        lambda: load(intrinsics=camera_info(width=64)), ValueError, "is 32 x 24 pixels but the intrinsics say 64 x 24"
    ),
    "two numbers": (lambda: load(intrinsics=(80, 90)), ValueError, r"^intrinsics is \(80, 90\); it must be a camera: give"),
    "a set": (lambda: load(intrinsics={80, 90}), ValueError, "^intrinsics is {.*}; it must be a camera: give 3 x 3"),
    "a dict of other names": (lambda: load(intrinsics={"f": 80}), ValueError, "^intrinsics is .*it has neither fx, fy"),
    "a color image": (lambda: load(np.ones((24, 32, 3))), ValueError, r"has the shape \(24, 32, 3\); it must be rows of"),
    "a color message": (
        lambda: load(depth_message(MILLIMETRES, "bgr8")), ValueError, "^the Image message is no depth image .*'bgr8'"
    ),
    "an image of depths alone": (lambda: mereo.load_frame(METRES), ValueError, "give intrinsics=, a mereo.Camera or a"),
    "columns of anything": (
        lambda: mereo.load_frame(np.hstack([seen(), 7.5 * NORMALS])), ValueError, "six columns.* as points"
    ),
    "an open mesh": (
        lambda: mereo.load_object({"lid": OPEN}, units="mm"), ValueError, "^segment 'lid' of lid.obj .* solids"
    ),
    "a dict of other things": (
        lambda: mereo.load_object({"left": LEFT, "right": 3}), ValueError, "^the dict must hold meshes, .*'right' is none"
    ),
    "quadrangles": (
        lambda: mereo.load_object((LEFT.vertices, [[0, 1, 2, 3]])), ValueError, r"faces of \(1, 4\).* into triangles$"
    ),
    "a misspelled option": (
        lambda: mereo.reconstruct(seen(), MODEL, unitm=1.0), TypeError, "^there is no option 'unitm' here: is unit_m mea"
    ),
    "an option in capitals": (
        lambda: mereo.load_frame(seen(), Unit_M=1.0), TypeError, "^there is no option 'Unit_M' here: is unit_m meant"
    ),
    "a misspelled step": (
        lambda: mereo.reconstruct(seen(), MODEL, isolation={"largest_clusters": True}),
        TypeError,
        "no option 'largest_clusters' here: is largest_cluster meant",
    ),
    "a step out of bounds": (
        lambda: mereo.reconstruct(seen(), MODEL, isolation={"cluster_gap": -1.0}), ValueError, "^cluster_gap is -1.0; it"
    ),
    "the command's name of axes": (
        lambda: mereo.load_frame(seen(), frame="scanner"), TypeError, "'frame' here: axes are given as axes='camera'"
    ),
    "an output": (
        lambda: mereo.reconstruct(seen(), MODEL, output="x"), TypeError, "'output' here: result.save.path. writes the fo"
    ),
    "a file to carry": (lambda: mereo.reconstruct(seen(), MODEL, carry="x.stl"), TypeError, "'carry' here: result.carry"),
    "an unlike name": (lambda: mereo.load_frame(seen(), xyzzy=1), TypeError, "no option 'xyzzy' here: the options are axe"),
    "units of a loaded object": (
        lambda: mereo.reconstruct(seen(), mereo.Object(MODEL), units="mm"),
        ValueError,
        "^units is given for an object that is loaded already: give it to load_object$",
    ),
    "a misspelled field": (lambda: mereo.evaluate(MODEL, exmples=1), TypeError, "'exmples' here: is examples meant"),
    "a recipe's": (lambda: mereo.train("data", "run", epoch=1.0), TypeError, "no option 'epoch' here: is epochs meant"),
    "a data set's": (
        lambda: mereo.generate("rope", "data", exampels=1), TypeError, "no option 'exampels' here: is examples meant"
    ),
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the check of types that tests put before it
    call, kind, sentence = REFUSED[line]
    with pytest.raises(kind, match=sentence) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1 and "__init__" not in str(caught.value)
