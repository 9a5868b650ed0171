"""Real scans with their truth: the four range scans of the Stanford bunny, and those of ``mereo align``.

Scanner frame: x right, y up, z toward the scanner, the origin somewhere near the object. The scans' poses are known, so
the rest-pose segments of the scene "bunny", brought into a scan's frame, are its exact answer.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

import numpy as np

from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import LARGEST, UNITS_M, CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import Transform, transform_points
from mereo.io.atomic_files import write_json
from mereo.io.errors import readable
from mereo.io.readers import read_point_cloud
from mereo.scenes.registry import scene_named_in
from mereo.scenes.scene import SCENES, Scene
from mereo_learning.icp import diagonal, moved
from mereo_learning.placement import Placement
from mereo_objects import assets


def _pose(*rows: tuple[float, ...]) -> Transform:
    pose = np.array([*rows, (0.0, 0.0, 0.0, 1.0)])
    pose.setflags(write=False)
    return pose


BUNNY_SCAN_POSES: Mapping[str, Transform] = MappingProxyType(
    {
        "bun000": _pose((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
        "bun090": _pose(
            (-0.003101617, 0.000374929, 0.99999512, 2.2076e-05),
            (-0.001326438, 0.999999048, -0.000379044, -3.3461e-05),
            (-0.99999431, -0.001327608, -0.003101117, -7.2088e-05),
        ),
        "bun270": _pose(
            (0.000263461, -0.00406004, -0.999991723, 0.000130273),
            (0.005368373, 0.999977354, -0.004058567, 1.5862e-05),
            (0.999985555, -0.005367259, 0.000285251, 0.000406764),
        ),
        "chin": _pose(
            (0.909091601, -0.175642136, -0.37775958, 0.00435102),
            (-0.200252705, 0.610904628, -0.765959783, 0.0882863),
            (0.365309888, 0.771974984, 0.520195453, -0.108853),
        ),
    }
)
"""``T_model_scan`` of each scan: scanner coordinates (metres, y up, z toward the scanner) to those of ``bunny.off``.

The file published with the scans stores conjugated quaternions; these matrices have been corrected, and the scans lie
within 0.1 mm (median) of the mesh. Rotations are given to nine decimals, so orthonormal to about 1e-6.
"""


SCANS = tuple(BUNNY_SCAN_POSES)
"""Names of the bunny's scans."""


def bunny_scan(name: str) -> tuple[PointCloud, Transform]:
    """Real scan of the bunny in its scanner frame, metres, and ``T_model_scan`` into the frame of bunny.off.

    Raises ``ValueError`` for an unknown name and ``AssetUnavailable`` where the scan cannot be had.
    """
    if name not in SCANS:
        raise ValueError(f"there is no scan {name!r}; it must be one of {', '.join(SCANS)}: check the spelling")
    return read_point_cloud(assets.get(f"bunny/{name}.ply")), BUNNY_SCAN_POSES[name]


def bunny_truth(name: str) -> SegmentedMesh:
    """Segments of the scanned bunny in the scanner frame, metres.

    Accuracy: the scan lies within 0.1 mm (median) of this surface.
    """
    from mereo_objects.bunny import model_to_scene, rest_mesh

    center, scale = model_to_scene()
    T_model_scene = np.eye(4)
    T_model_scene[:3, :3] /= scale
    T_model_scene[:3, 3] = center
    # the published rotations are orthonormal to 1e-6 only, so a general inverse
    return rest_mesh().transformed(np.linalg.inv(BUNNY_SCAN_POSES[name]) @ T_model_scene)


@dataclass(frozen=True, eq=False)
class PosedScan:
    """Real scan with its truth: the object's segments where they are in it.

    Attributes:
        name: name in tables.
        cloud: the scan, in its own frame and unit.
        truth: the segments, in the same.
        frame: axes of both: "camera" (x right, y down, z forward from the camera at the origin) or "scanner".
        scene_unit: length of a unit of the object's scene in the scan's unit, where it is known.
    """

    name: str
    cloud: PointCloud
    truth: SegmentedMesh
    frame: CloudAxes
    scene_unit: float | None = None

    def in_camera(self) -> tuple[PointCloud, SegmentedMesh, Transform]:
        """Scan and truth in a camera frame, in the scan's unit, and ``T_camera_scan``."""
        T_camera_scan = into_camera(self.cloud.points, self.frame)
        cloud = PointCloud(transform_points(T_camera_scan, self.cloud.points))
        return cloud, self.truth.transformed(T_camera_scan), T_camera_scan


def bunny_posed(name: str) -> PosedScan:
    """Real scan of the bunny with its truth; raises as ``bunny_scan`` does."""
    from mereo_objects.bunny import model_to_scene

    return PosedScan(name, bunny_scan(name)[0], bunny_truth(name), "scanner", 1 / model_to_scene()[1])


def scan_in_camera(name: str) -> tuple[PointCloud, SegmentedMesh, Transform]:
    """Real scan of the bunny and its truth in a camera frame, metres, and ``T_camera_scan``."""
    return bunny_posed(name).in_camera()


# --- truth files ------------------------------------------------------------------------------------------------------

TRUTH = "truth.json"
"""Name of the file."""

FORMAT = 1
"""Version of the file's format; others are not read."""


@dataclass(frozen=True)
class ScanFile:
    """File of the scan that a truth belongs to, and how to read it.

    Attributes:
        path: file of the point cloud.
        unit: unit of its coordinates.
        frame: its axes, as in ``mereo reconstruct``.
        drop_invalid: whether points without a measurement are left out on reading.
    """

    path: Path
    unit: str = "m"
    frame: CloudAxes = "camera"
    drop_invalid: bool = False


def write_truth(
    directory: Path, place: Path, scan: ScanFile, scene: str, rest: SegmentedMesh, placement: Placement, start: str
) -> None:
    """Write truth.json into ``directory``, which will be renamed to ``place``; files are named relative to that."""
    facts = {
        "format": FORMAT,
        "scene": scene if scene in SCENES else _relative(Path(scene), place),
        "scan": _relative(scan.path, place),
        "scan_sha256": hashlib.sha256(scan.path.read_bytes()).hexdigest(),
        "unit": scan.unit,
        "frame": scan.frame,
        "drop_invalid": scan.drop_invalid,
        "start": start,
        "limit": placement.limit,
        "points_within_limit": placement.explained,
        "segments": {
            segment.name: {
                "rest_box": rest.segments[index].bounds,
                "T_scan_segment": segment.T_scan_segment,
                "placed_by": segment.placed_by,
                "points": segment.points,
                "residual": {"median": segment.median, "rms": segment.rms, "p95": segment.p95},
                "moved": {"shift": segment.shift, "turn_deg": segment.turn_deg},
                "held_directions": segment.held,
            }
            for index, segment in enumerate(placement.segments)
        },
    }
    write_json(directory / TRUTH, facts)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def read_truth(path: str | Path, scene: Scene | None = None) -> PosedScan:
    """Scan with its placed segments, from truth.json or the folder that holds it.

    Args:
        path: the file or its folder.
        scene: the scene that the scan was aligned with, which has to be given where it is a Python file.

    Raises ``FileNotFoundError`` where the file, its scan or its scene is missing, and ``ValueError`` where one of them
    is not what it was, or where the file names a Python scene and ``scene`` is not given.
    """
    path = Path(path)
    path = path / TRUTH if path.is_dir() else path
    with readable(path, "truth file of mereo align"):
        facts = json.loads(path.read_text(encoding="utf-8"))
        if facts["format"] != FORMAT:
            raise ValueError(f"its format is {facts['format']}, this mereo reads {FORMAT}")
        poses = {name: _array(entry["T_scan_segment"], (4, 4)) for name, entry in facts["segments"].items()}
        boxes = {name: _array(entry["rest_box"], (2, 3)) for name, entry in facts["segments"].items()}
        scan = ScanFile(path.parent / facts["scan"], facts["unit"], facts["frame"], facts["drop_invalid"])
        if not str(scan.path).isprintable() or len(facts["scan"]) > 1000:
            raise ValueError(f"the name of its scan is {facts['scan']!r:.40}")
        if scan.unit not in UNITS_M or scan.frame not in get_args(CloudAxes):
            raise ValueError(f"its unit is {scan.unit!r:.40} and its frame {scan.frame!r:.40}, which are unknown")
        name = str(facts["scene"])
        scan_sha256 = facts["scan_sha256"]
    loaded = scene_named_in(path, name) if scene is None else scene
    rest, unit_m = loaded.rest, loaded.unit_m
    # not the same bytes: other versions of the libraries cut the same solid into other triangles
    slack = 1e-3 * diagonal(rest)
    if rest.names != tuple(poses) or not all(np.allclose(s.bounds, boxes[s.name], 0, slack) for s in rest.segments):
        raise ValueError(f"the meshes of the scene {name!r} are not those that {path} was made with: align again")
    if not scan.path.is_file():
        raise FileNotFoundError(f"{scan.path}, the scan of {path}, does not exist: put it there, or align again")
    if hashlib.sha256(scan.path.read_bytes()).hexdigest() != scan_sha256:
        raise ValueError(f"{scan.path} is not the file that {path} was made from (another SHA-256): align it again")
    cloud = read_point_cloud(scan.path, scan.drop_invalid)
    title = path.resolve().parent.name if path.name == TRUTH else path.stem
    scene_unit = None if unit_m is None else unit_m / UNITS_M[scan.unit]
    return PosedScan(title, cloud, moved(rest, np.stack(list(poses.values()))), scan.frame, scene_unit)


def _array(value: Any, shape: tuple[int, int]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"an array in it is not {shape[0]} x {shape[1]} numbers up to {LARGEST:g}")
    return array
