"""Range scans: the four real ones of the Stanford bunny with their truth.

Scanner frame: x right, y up, z toward the scanner, the origin somewhere near the object. The scans' poses are known, so
the rest-pose segments of the scene "bunny", brought into a scan's frame, are its exact answer.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.io.readers import read_point_cloud
from mereo_objects import assets


def _pose(*rows: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    pose = np.array([*rows, (0.0, 0.0, 0.0, 1.0)])
    pose.setflags(write=False)
    return pose


BUNNY_SCAN_POSES: Mapping[str, Float[np.ndarray, "4 4"]] = MappingProxyType(
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


def bunny_scan(name: str) -> tuple[PointCloud, Float[np.ndarray, "4 4"]]:
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

    def in_camera(self) -> tuple[PointCloud, SegmentedMesh, Float[np.ndarray, "4 4"]]:
        """Scan and truth in a camera frame, in the scan's unit, and ``T_camera_scan``."""
        T_camera_scan = into_camera(self.cloud.points, self.frame)
        cloud = PointCloud(transform_points(T_camera_scan, self.cloud.points))
        return cloud, self.truth.transformed(T_camera_scan), T_camera_scan


def bunny_posed(name: str) -> PosedScan:
    """Real scan of the bunny with its truth; raises as ``bunny_scan`` does."""
    from mereo_objects.bunny import model_to_scene

    return PosedScan(name, bunny_scan(name)[0], bunny_truth(name), "scanner", 1 / model_to_scene()[1])


def scan_in_camera(name: str) -> tuple[PointCloud, SegmentedMesh, Float[np.ndarray, "4 4"]]:
    """Real scan of the bunny and its truth in a camera frame, metres, and ``T_camera_scan``."""
    return bunny_posed(name).in_camera()
