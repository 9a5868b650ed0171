"""Objects in scans whose poses are known, for the tests of ``mereo align``."""

import json
from pathlib import Path

import numpy as np
from scene_files import write_bar
from scipy.spatial.transform import Rotation
from shapes import box

from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.synthesis.depth_sensor import render_depth
from mereo_learning.icp import moved

CAMERA = Camera.from_fov(160, 160, float(np.deg2rad(30.0)))


def object_at_rest() -> SegmentedMesh:
    """A base, an arm beside it, and a peg behind the base (farther along z)."""
    base, arm = box((0, 0, 0), (20, 12, 8), "base"), box((21, 2, 1), (38, 9, 7), "arm", 1)
    return SegmentedMesh((base, arm, box((8, 5, 8.5), (12, 8, 11), "peg", 2)))


def true_poses() -> np.ndarray:
    """In a camera frame: three sides of base and arm are seen; the arm is bent away by 25 degrees."""
    turn = Rotation.from_euler("yx", [-35, 25], degrees=True).as_matrix()
    whole = rigid(turn, np.array([-8.0, -2.0, 110.0]))
    bend, joint = Rotation.from_rotvec(np.deg2rad(25) * np.array([0.1, 0.3, 1.0])).as_matrix(), np.array([20.5, 6, 4])
    return np.stack([whole, whole @ rigid(bend, joint - bend @ joint), whole])


def scan_of(mesh: SegmentedMesh, noise: float, seed: int = 0) -> np.ndarray:
    """What ``CAMERA`` sees of a mesh in its frame, noise in the mesh's unit."""
    points = render_depth(mesh, CAMERA).to_points().points
    return points + np.random.default_rng(seed).normal(scale=noise, size=points.shape)


def perturbed(pose: np.ndarray, middle: np.ndarray, degrees: float, shift: float, seed: int) -> np.ndarray:
    """``pose``, then a turn about ``middle`` (model coordinates) and a shift, both in a random direction."""
    rng = np.random.default_rng(seed)
    axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn, place = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix(), transform_points(pose, middle)
    return rigid(turn, place - turn @ place + shift * way) @ pose


def pose_error(found: np.ndarray, true: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """Distance of the segment's middle from where it belongs, and the turn in degrees."""
    shift = np.linalg.norm(transform_points(found, middle) - transform_points(true, middle))
    turn = Rotation.from_matrix((found @ np.linalg.inv(true))[:3, :3])
    return float(shift), float(np.rad2deg(turn.magnitude()))


def bar_scan(folder: Path) -> tuple[Path, Path, Path, Scene, np.ndarray]:
    """Files of a scan (mm), a scene and a start of pairs picked to 1.5 mm; the scene, and the true pose."""
    path = write_bar(folder)
    scene = load_scene(path)
    assert scene.unit_m is not None
    low, high = scene.rest.bounds
    turn = 1000 * scene.unit_m * Rotation.from_euler("yx", [40, 30], degrees=True).as_matrix()
    pose = rigid(turn, np.array([2.0, 1.0, 90.0]) - turn @ (low + high) / 2)
    points = scan_of(moved(scene.rest, np.stack([pose, pose])), 0.02)
    np.save(folder / "scan.npy", points)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])[[0, 3, 5, 6]]
    model = low + corners * (high - low)
    picked = transform_points(pose, model) + np.random.default_rng(1).normal(scale=1.5, size=(4, 3))
    start = folder / "start.json"
    start.write_text(json.dumps({"object": {"model": model.tolist(), "scan": picked.tolist()}}))
    return folder / "scan.npy", path, start, scene, pose
