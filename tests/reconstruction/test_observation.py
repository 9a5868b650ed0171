"""One frame from any kind of file, with the options that belong to it, and its size against that of training."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from camera_files import write_camera
from folder_contents import read_json
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from point_files import save_pcd
from scipy.spatial.transform import Rotation

import mereo
from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.transforms import rigid, transform_points, unit_rows
from mereo.io.atomic_files import JsonObject
from mereo.io.config import InputConfig
from mereo.io.readers import InputWarning
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.models.trained import checked_points
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object, hidden_share, observe, size_warning

CAMERA = Camera(20, 10, 30.0, 30.0, 10.0, 5.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """d.png shows 50 pixels at the value 2500; k.json is its camera."""
    write_camera(tmp_path / "k.json", CAMERA)
    depth = np.zeros((10, 20), np.uint16)
    depth[2:7, 5:15] = 2500
    Image.fromarray(depth).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", depth.astype(np.float32) / 5000)
    return tmp_path


def test_a_depth_image_becomes_the_points_it_shows(folder: Path) -> None:
    seen = find_object(read_frame(folder / "d.png", InputConfig(intrinsics=folder / "k.json", depth_scale=5000.0)))
    points = seen.cloud.points
    assert len(points) == 50 and seen.frame.unit_m == 1.0 and seen.depth_m == (0.5, 0.5, 0.5)
    assert_allclose(points[:, 2], 0.5)
    assert_allclose(CAMERA.project(points)[0], [5.5, 2.5])
    assert seen.size_m == pytest.approx((0.15, 4 / 60, 0.0))
    assert str(seen).splitlines() == [
        "the object has 50 points, depth 0.5 to 0.5 m (middle 0.5 m)",
        "its visible part is 0.15 x 0.0667 x 0 m",
    ]


def test_lengths_along_rays_become_depths(folder: Path) -> None:
    """Distances from the camera to a plane at half a metre are the plane again, from a file and in memory."""
    lengths = 0.5 * norm(CAMERA.directions(), axis=-1)
    np.save(folder / "r.npy", lengths)
    reading = InputConfig(intrinsics=folder / "k.json", depth_along="ray")
    for frame in (
        read_frame(folder / "r.npy", reading),
        mereo.load_frame(lengths, intrinsics=CAMERA, depth_along="ray"),
        mereo.load_frame(DepthImage(lengths, CAMERA), depth_along="ray"),
    ):
        assert_allclose(frame.cloud.points[:, 2], 0.5)
        assert frame.whole is not None
        assert_allclose(frame.whole.depth, 0.5)
    assert np.ptp(read_frame(folder / "r.npy", replace(reading, depth_along="z")).cloud.points[:, 2]) > 0.02
    with pytest.raises(ValueError, match="depth_along is given for points"):
        mereo.load_frame(frame.cloud, depth_along="ray")


def test_the_objects_id_in_a_mask(folder: Path) -> None:
    ids = np.ones((10, 20), np.uint8)
    ids[2:5, 5:15] = 2
    Image.fromarray(ids).save(folder / "ids.png")
    reading = InputConfig(intrinsics=folder / "k.json", depth_scale=5000.0, mask=folder / "ids.png")
    with pytest.raises(ValueError, match="has the values 1, 2, which may be ids"):
        read_frame(folder / "d.png", reading)
    assert len(read_frame(folder / "d.png", replace(reading, mask_value=(2,))).cloud) == 30
    array = mereo.load_frame(
        np.load(folder / "d.npy"), intrinsics=folder / "k.json", mask=folder / "ids.png", mask_value=2
    )
    assert len(array.cloud) == 30
    with pytest.raises(ValueError, match="--mask-value says which pixels of a mask are the object, and none is given"):
        read_frame(folder / "d.png", replace(reading, mask=None, mask_value=(2,)))


def test_the_depth_scale_of_the_intrinsics_is_for_integers_and_gives_way(folder: Path) -> None:
    fields = read_json(folder / "k.json")
    (folder / "bop.json").write_text(json.dumps({**fields, "depth_scale": 0.2}))
    for name, scale, expected in (("d.png", None, 0.5), ("d.png", 2500.0, 1), ("d.npy", None, 0.5), ("d.npy", 0.5, 1)):
        seen = find_object(read_frame(folder / name, InputConfig(intrinsics=folder / "bop.json", depth_scale=scale)))
        assert seen.depth_m[1] == pytest.approx(expected), (name, scale)


FILE = Path("k.json")


@pytest.mark.parametrize(
    "name, options, text",
    [
        ("d.png", {}, "is a depth image without intrinsics; they are needed: give --intrinsics FILE"),
        ("d.png", {"intrinsics": FILE, "frame": "scanner"}, "is a depth image; those are always in the camera frame"),
        ("d.png", {"intrinsics": FILE, "unit_m": 0.001}, "comes in metres: leave out --unit-m"),
        ("d.png", {"intrinsics": FILE, "topic": "/d"}, "is no ROS recording and has no topics"),
        ("c.ply", {"intrinsics": FILE}, "is read as a point cloud; leave out intrinsics, mask and depth scale"),
        ("c.ply", {"mask": FILE}, "is read as a point cloud"),
        ("c.ply", {"depth_along": "ray"}, "is read as a point cloud; leave out .* depth scale or direction"),
        ("c.ply", {"viewpoint": "pose"}, "is no PCD file, which alone states a viewpoint: leave out --viewpoint"),
        ("d.png", {"intrinsics": FILE, "viewpoint": "pose"}, "is no PCD file"),
        ("c.ply", {"depth_scale": 1000.0}, "is read as a point cloud"),
    ],
)
def test_contradictory_inputs(name: str, options: JsonObject, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        read_frame(Path(name), InputConfig(**options))


BASE = rigid(Rotation.from_euler("xyz", [-110.0, 20.0, 5.0], degrees=True).as_matrix(), np.array([1.5, -0.5, 0.3]))
"""Pose of a camera in a robot's base frame, at the side of the points."""

CAP = default_rng(3).uniform((-0.1, -0.1, 0.5), (0.1, 0.1, 0.7), (60, 3)).astype(np.float32)


def stored_at(pose: ndarray, points: ndarray) -> bytes:
    """A PCD file with a camera's pose in its header."""
    qx, qy, qz, qw = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    words = " ".join(map(repr, [*pose[:3, 3].tolist(), qw, qx, qy, qz]))
    content = save_pcd(points.astype(np.float32), "binary")
    return content.replace(b"VIEWPOINT 0 0 0 1 0 0 0", f"VIEWPOINT {words}".encode())


def test_a_stated_viewpoint_is_used_where_the_points_fit_it(tmp_path: Path) -> None:
    path = tmp_path / "c.pcd"
    based = transform_points(BASE, CAP.astype(float))
    path.write_bytes(stored_at(BASE, based))
    with pytest.warns(
        InputWarning, match=r"c.pcd states a camera's pose \(VIEWPOINT\); .* moved into the camera's axes"
    ):
        frame = read_frame(path)
    assert_allclose(frame.cloud.points, CAP, atol=1e-6)
    assert_allclose(find_object(frame).facts()["T_input_result"], BASE, atol=1e-9)
    assert_allclose(read_frame(path, InputConfig(viewpoint="pose")).cloud.points, CAP, atol=1e-6)
    ignored = read_frame(path, InputConfig(viewpoint="ignored"))
    assert_allclose(ignored.cloud.points, based, atol=1e-6)
    assert ignored.T_input_result is None and find_object(ignored).facts()["T_input_result"] is None
    path.write_bytes(stored_at(BASE, CAP))  # next to what the sensor measured, as other programs do
    with pytest.warns(InputWarning, match="its points are taken to be in the camera's axes$"):
        assert_array_equal(read_frame(path).cloud.points, CAP)
    ahead = rigid(np.eye(3), np.array([0.0, 0.0, -0.2]))
    for points, fit in ((CAP, "both"), (-CAP, "neither")):
        path.write_bytes(stored_at(ahead, points))
        with pytest.raises(ValueError, match=f"they fit {fit}: give --viewpoint pose or --viewpoint ignored"):
            read_frame(path)
    path.write_bytes(stored_at(BASE, CAP).replace(b"VIEWPOINT", b"VIEWPOINT 7"))
    with pytest.raises(ValueError, match=r"its VIEWPOINT is 7 1.5 .*, not x y z and a unit quaternion"):
        read_frame(path)


def test_a_camera_pose_moves_any_cloud_into_the_cameras_axes(folder: Path) -> None:
    based = transform_points(BASE, CAP.astype(float))
    np.save(folder / "c.npy", based)
    np.savetxt(folder / "pose.txt", BASE)
    for frame in (
        read_frame(folder / "c.npy", InputConfig(camera_pose=folder / "pose.txt")),
        mereo.load_frame(folder / "c.npy", camera_pose=BASE),
        mereo.load_frame(based, camera_pose=folder / "pose.txt"),
        mereo.load_frame(PointCloud(based), camera_pose=BASE.tolist()),
    ):
        assert_allclose(frame.cloud.points, CAP, atol=1e-7)
        assert_allclose(frame.T_input_result, BASE)
    for name, options in (("d.png", {"intrinsics": folder / "k.json"}), ("c.npy", {"frame": "scanner"})):
        with pytest.raises(ValueError, match="a camera pose is given, but .* leave out --camera-pose"):
            read_frame(folder / name, InputConfig(camera_pose=folder / "pose.txt", **options))
    with pytest.raises(ValueError, match="the pose is .*rotation and a translation"):
        mereo.load_frame(based, camera_pose=2 * BASE)


def test_coordinates_of_a_map_keep_their_digits(tmp_path: Path) -> None:
    offset = np.array([500000.25, 5400000.5, 300.125])
    path = tmp_path / "c.xyz"
    np.savetxt(path, CAP + offset, fmt="%.6f")
    with pytest.raises(
        ValueError, match=r"lie around \(50000.*, .* times their extent from the origin, .*--camera-pose F"
    ):
        read_frame(path)
    with pytest.raises(ValueError, match=r"has to be, as in a map: give the camera's pose .* with camera_pose=file"):
        mereo.load_frame(CAP + offset)
    with pytest.warns(InputWarning, match=r"lie around \(.*\); 500000 5400000 30[01] is taken away, .*T_input_result"):
        scan = read_frame(path, InputConfig(frame="scanner"))
    assert scan.T_input_result is not None
    for frame in (scan, mereo.load_frame(CAP + offset, camera_pose=rigid(np.eye(3), offset))):
        assert np.abs(frame.cloud.points).max() < 1.0
        assert_allclose(transform_points(frame.T_input_result, frame.cloud.points), CAP + offset, atol=1e-6)
    with pytest.raises(ValueError, match="they|times their extent"):
        mereo.load_frame(CAP + offset, camera_pose=BASE)


@pytest.mark.parametrize(
    "turn, cure",
    [
        (
            [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
            "like x forward, y left, z up .*: write the rows 0 0 1 0, -1 0 0 0, 0 -1",
        ),
        ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], "like x right, y forward, z up .*: write the rows 1 0 0 0, 0 0 1 0, 0 -1"),
        ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], "like x right, y up, z backward .* rows 1 0 0 0, 0 -1 0 0, 0 0 -1 0"),
    ],
)
def test_points_behind_the_camera_get_the_cure_of_their_axes(turn: list[list[int]], cure: str) -> None:
    matrix = np.array(turn, float)
    with pytest.raises(ValueError, match=f"points have z <= 0, behind the camera; .*{cure}") as caught:
        checked_points(PointCloud(CAP @ matrix.T))
    rows = str(caught.value).partition("rows ")[2].partition(" and")[0].split(", ")
    pose = np.array([row.split() for row in [*rows, "0 0 0 1"]], float)
    frame = mereo.load_frame(CAP @ matrix.T, camera_pose=pose)
    assert_allclose(checked_points(frame.cloud), CAP)
    with pytest.raises(ValueError, match=r"--camera-pose FILE\) for a cloud in a robot's base or a map, or .*scanner"):
        checked_points(PointCloud(CAP - CAP.mean(axis=0)))


def test_a_merged_cloud_is_known_by_what_it_hides() -> None:
    """Of a sphere's surface all but the cap that faces the camera is hidden; a single view hides nothing of itself."""
    rng, (x, y) = default_rng(0), np.meshgrid(*[(np.arange(80) - 39.5) / 200] * 2)
    normals = unit_rows(rng.normal(size=(6000, 3)))
    sphere = normals + np.array([0.0, 0.0, 5.0])
    front = sphere[(normals * sphere).sum(axis=1) < 0]
    opposite = front * [1.0, 1.0, -1.0] + [0.0, 0.0, 10.0]  # as a camera on the other side sees it
    side = (front - [0.0, 0.0, 5.0]) @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) + [0.0, 0.0, 5.0]
    wall = np.where(np.arange(80) // 4 % 2, 1.0, 1.5) + 0 * y  # bars, four pixels wide, in front of it
    single = {
        "sphere": front,
        "few points": front[:200],
        "noisy": front * rng.normal(1.0, 0.004, (len(front), 1)),
        "in steps": front * np.round(1 / norm(front, axis=1)[:, None], 2) * 5,
        "strays": np.concatenate([front, rng.uniform((-1.2, -1.2, 4), (1.2, 1.2, 7), (80, 3))]),
        "bars": np.stack([x * wall, y * wall, wall], axis=-1).reshape(-1, 3),
        "one place": np.ones((500, 3)),
    }
    for name, points in single.items():
        assert observe(PointCloud(points)).doubt is None and hidden_share(points) < 0.05, name
    for points, least, most in (
        (sphere, 0.2, 0.6),
        (sphere[:600], 0.2, 0.6),
        (np.concatenate([front, opposite]), 0.2, 0.5),
        (np.concatenate([front, side]), 0.15, 0.3),
    ):
        assert least < hidden_share(points) < most and hidden_share(1000 * points) == pytest.approx(
            hidden_share(points)
        )
    merged = observe(PointCloud(sphere))
    assert merged.doubt is not None and re.match(
        r"2\d% of the points lie behind others, .*: give one view", merged.doubt
    )
    image = DepthImage(np.full((10, 20), 2.0), CAMERA)
    assert replace(merged, frame=replace(merged.frame, depth=image)).self_hidden == 0.0


def test_a_scan_has_no_depth(tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", default_rng(0).normal(size=(100, 3)))
    with pytest.raises(ValueError, match="scanner's frame, in which depth is not known.*crop with --box"):
        find_object(read_frame(tmp_path / "c.npy", InputConfig(frame="scanner")), IsolationConfig(depth_range=(0.1, 1)))
    seen = find_object(read_frame(tmp_path / "c.npy", InputConfig(frame="scanner")))
    assert "depth" not in str(seen) and seen.facts()["depth_m"] is None


def test_size_against_training(tmp_path: Path) -> None:
    """The Stanford Bunny is 15 cm long; the same cloud read as millimetres cannot be it."""
    np.save(tmp_path / "c.npy", default_rng(0).uniform((0, 0, 1), (0.1, 0.05, 1.1), (400, 3)))
    seen = find_object(read_frame(tmp_path / "c.npy", InputConfig(unit_m=1.0)))
    unknown = find_object(read_frame(tmp_path / "c.npy"))
    for visible_m, fits in (([0.08, 0.2], True), ([0.15, 0.3], True), ([0.25, 0.5], False), ([0.01, 0.04], False)):
        text = size_warning(seen, {"visible_m": visible_m})
        assert (text is None) == fits, visible_m
        assert size_warning(unknown, {"visible_m": visible_m}) is None, "what has no unit may be of any size"
        assert fits or (text and "m in training: other things are in the cloud" in text and "--unit-m 0.001" in text)
    assert size_warning(seen, {"scene": "bunny"}) is None and size_warning(seen, {"visible_m": None}) is None
    assert load_model("bunny").provenance["visible_m"] == pytest.approx([0.12, 0.254], abs=0.001)


def test_missing_extras_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, library in (("a.zdf", "netCDF4"), ("a.mcap", "rosbags")):
        (tmp_path / name).write_bytes(b"anything")
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(ImportError, match=rf"{name} needs {library}.*: pip install 'mereo\[sensors\]'"):
            read_frame(tmp_path / name)


def test_a_surface_that_no_camera_can_have_seen_is_known_by_its_normals() -> None:
    rng = default_rng(0)
    normals = unit_rows(rng.normal(size=(3000, 3)))
    sphere = normals + np.array([0.0, 0.0, 5.0])
    ahead = (normals * sphere).sum(axis=1) < 0
    whole = PointCloud(sphere, normals)
    cap = whole.rows(ahead)
    inward = PointCloud(sphere[ahead], -normals[ahead])
    torn = PointCloud(sphere, normals * rng.choice([-1.0, 1.0], (3000, 1)))
    for name, cloud, extent in (
        ("all around", whole, "surface"),
        ("from where the object is", PointCloud(normals, normals), "surface"),
        ("as a camera sees it", cap, "auto"),
        ("with normals into the surface", inward, "auto"),
        ("with normals of random signs", torn, "auto"),
        ("without normals", PointCloud(sphere), "auto"),
    ):
        assert find_object(SensorFrame(Path(name), cloud, 1.0, "camera")).extent == extent, name
    seen = find_object(SensorFrame(Path("a.ply"), whole, 1.0, "camera"))
    assert "it is a surface that no single camera saw" in str(seen) and "depth" not in str(seen)
    assert seen.facts()["extent"] == "surface" and seen.facts()["depth_m"] is None and seen.doubt is None
    assert seen.lines.other_lines == "none" and len(seen.readings()) == 1
    stated = find_object(
        SensorFrame(Path("a.ply"), PointCloud(sphere), 1.0, "camera"), IsolationConfig(extent="surface")
    )
    assert stated.extent == "surface" and stated.doubt is None
    assert (
        find_object(SensorFrame(Path("a.ply"), whole, 1.0, "camera"), IsolationConfig(extent="whole")).doubt is not None
    )
    image = DepthImage(np.full((10, 20), 2.0), CAMERA)
    with pytest.raises(
        ValueError, match="a surface without a camera, but a.png is a depth image, which a camera saw: l"
    ):
        find_object(
            SensorFrame(Path("a.png"), image.to_points(), 1.0, "camera", image), IsolationConfig(extent="surface")
        )


def test_mesh_files_are_frames_with_the_normals_of_their_faces(tmp_path: Path) -> None:
    box = trimesh.creation.box((2.0, 4.0, 6.0))
    fine = box.subdivide_to_size(0.2)
    for name, mesh in (("box.stl", box), ("box.ply", box), ("fine.obj", fine), ("fine.ply", fine)):
        mesh.export(tmp_path / name)
        cloud = read_frame(tmp_path / name).cloud
        assert cloud.normals is not None
        side = np.abs(cloud.points / [1.0, 2.0, 3.0]).argmax(axis=1)
        assert_allclose(np.abs(cloud.points[np.arange(len(cloud)), side]), np.array([1, 2, 3])[side], atol=1e-6)
        assert len(cloud) == (2500 if mesh is box else len(fine.vertices))
        assert ((cloud.normals * cloud.points).sum(axis=1) > 0).all()
        again = read_frame(tmp_path / name).cloud
        assert_array_equal(cloud.points, again.points)
        assert find_object(read_frame(tmp_path / name)).extent == "surface"
    far = trimesh.Trimesh(fine.vertices + np.array([1e6, 0, 0]), fine.faces, process=False)
    far.export(tmp_path / "far.ply")
    with pytest.warns(InputWarning, match="1000000 0 0 is taken away"):
        assert np.abs(read_frame(tmp_path / "far.ply").cloud.points).max() < 3.1
    turned = read_frame(
        tmp_path / "fine.ply", T_input_camera=rigid(np.diag([1.0, -1, -1]), np.array([0, 0, 9.0]))
    ).cloud
    assert turned.normals is not None and ((turned.normals * (turned.points - [0, 0, 9])).sum(axis=1) > 0).all()
