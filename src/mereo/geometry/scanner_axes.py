"""Axes of clouds: from a scanner's or a camera's frame to the camera frame that networks work in."""

import numpy as np
from jaxtyping import Float

from mereo.geometry.conventions import CloudAxes
from mereo.geometry.normalizer import Normalizer
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import rigid

SCANNER_TO_CAMERA = read_only(np.diag([1.0, -1.0, -1.0]))
"""Half a turn about x; its own inverse."""


VIEW_DISTANCE = 8.5
"""Assumed distance of a scanner, in half longest sides of the visible part: within the range of the training views.

Anything from 7 to 16 gives the bunny's scans the same IoU to 0.002."""


def scanner_to_camera(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """Transform ``T_camera_scanner`` that turns a scan into a camera frame and puts it on the optical axis.

    The network looks along lines of sight from the camera, but a scan does not say where the scanner stood; it is
    assumed ``VIEW_DISTANCE`` away, in front of the middle of the cloud. Raises ``ValueError`` for a cloud without
    extent.
    """
    normalizer = Normalizer.fit(points)
    target = np.array([0.0, 0.0, VIEW_DISTANCE / normalizer.scale])
    return rigid(SCANNER_TO_CAMERA, target - SCANNER_TO_CAMERA @ normalizer.center)


def into_camera(points: Float[np.ndarray, "n 3"], frame: CloudAxes) -> Float[np.ndarray, "4 4"]:
    """Transform ``T_camera_input`` of a cloud in either frame; see ``scanner_to_camera``."""
    return scanner_to_camera(points) if frame == "scanner" else np.eye(4)


def camera_axes(frame: CloudAxes) -> Float[np.ndarray, "4 4"]:
    """Turn of a frame's axes into a camera's, about its own origin: for looking, where distance does not matter."""
    return rigid(SCANNER_TO_CAMERA if frame == "scanner" else np.eye(3), np.zeros(3))
