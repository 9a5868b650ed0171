"""Range scans: from a scanner's frame to a camera's, and the four real scans of the Stanford bunny with their truth.

Scanner frame: x right, y up, z toward the scanner, the origin somewhere near the object. The scans' poses are known, so
the rest-pose segments of the scene "bunny", brought into a scan's frame, are its exact answer.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import Normalizer, rigid, transform_points
from mereo.io.readers import read_point_cloud
from mereo.reconstruction.config import Frame
from mereo.scenes import assets

SCANS = tuple(assets.BUNNY_SCAN_POSES)
"""Names of the bunny's scans."""

SCANNER_TO_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Half a turn about x; its own inverse."""

VIEW_DISTANCE = 8.5
"""Assumed distance of a scanner, in half longest sides of the visible part: within the range of the training views.

Anything from 7 to 16 gives the bunny's scans the same IoU to 0.002."""


def scanner_to_camera(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """``T_camera_scanner`` that turns a scan into a camera frame and puts it on the optical axis.

    The network looks along lines of sight from the camera, but a scan does not say where the scanner stood; it is
    assumed ``VIEW_DISTANCE`` away, in front of the middle of the cloud. Raises ``ValueError`` for a cloud without
    extent.
    """
    normalizer = Normalizer.fit(points)
    target = np.array([0.0, 0.0, VIEW_DISTANCE / normalizer.scale])
    return rigid(SCANNER_TO_CAMERA, target - SCANNER_TO_CAMERA @ normalizer.center)


def into_camera(points: Float[np.ndarray, "n 3"], frame: Frame) -> Float[np.ndarray, "4 4"]:
    """``T_camera_input`` of a cloud in either frame; see ``scanner_to_camera``."""
    return scanner_to_camera(points) if frame == "scanner" else np.eye(4)


def camera_axes(frame: Frame) -> Float[np.ndarray, "4 4"]:
    """Turns a frame's axes into a camera's, about its own origin: for looking, where the distance does not matter."""
    return rigid(SCANNER_TO_CAMERA if frame == "scanner" else np.eye(3), np.zeros(3))


def bunny_scan(name: str) -> tuple[PointCloud, Float[np.ndarray, "4 4"]]:
    """A real scan in its scanner frame, metres, and ``T_model_scan`` into the frame of bunny.off.

    Raises ``ValueError`` for an unknown name and ``assets.AssetUnavailable`` where the scan cannot be had.
    """
    if name not in SCANS:
        raise ValueError(f"there is no scan {name!r}; it must be one of {', '.join(SCANS)}: check the spelling")
    return read_point_cloud(assets.get(f"bunny/{name}.ply")), assets.BUNNY_SCAN_POSES[name]


def bunny_truth(name: str) -> SegmentedMesh:
    """The scanned bunny's segments in the scanner frame, metres.

    Accuracy: the scan lies within 0.1 mm (median) of this surface.
    """
    from mereo.scenes.builtin.bunny import model_to_scene, rest_mesh

    center, scale = model_to_scene()
    T_model_scene = np.eye(4)
    T_model_scene[:3, :3] /= scale
    T_model_scene[:3, 3] = center
    # the published rotations are orthonormal to 1e-6 only, so a general inverse
    return rest_mesh().transformed(np.linalg.inv(assets.BUNNY_SCAN_POSES[name]) @ T_model_scene)


@dataclass(frozen=True, eq=False)
class PosedScan:
    """A real scan with its truth.

    Attributes:
        name: for tables.
        cloud: in the scan's own frame and unit.
        truth: the segments, in the same.
        frame: the axes of both: "camera" (x right, y down, z forward from the camera at the origin) or "scanner".
    """

    name: str
    cloud: PointCloud
    truth: SegmentedMesh
    frame: Frame

    def in_camera(self) -> tuple[PointCloud, SegmentedMesh, Float[np.ndarray, "4 4"]]:
        """Cloud and truth in a camera frame, and ``T_camera_scan``."""
        T_camera_scan = into_camera(self.cloud.points, self.frame)
        cloud = PointCloud(transform_points(T_camera_scan, self.cloud.points))
        return cloud, self.truth.transformed(T_camera_scan), T_camera_scan


def bunny_posed(name: str) -> PosedScan:
    """A real scan of the bunny with its truth; raises as ``bunny_scan``."""
    return PosedScan(name, bunny_scan(name)[0], bunny_truth(name), "scanner")


def scan_in_camera(name: str) -> tuple[PointCloud, SegmentedMesh, Float[np.ndarray, "4 4"]]:
    """A real scan and its truth in a camera frame, metres, and ``T_camera_scan``."""
    return bunny_posed(name).in_camera()
