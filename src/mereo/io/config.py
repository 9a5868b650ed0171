"""Settings of reading a frame and of writing results; light, so that the command line may import them."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mereo.geometry.conventions import CloudAxes, LengthUnit, Way, WholeNumbers
from mereo.io.bounds import IndexOrNone, PositiveOrUnknown, check_bounds, check_value

CONFIG = "config.json"
"""Name of the file of options that a folder of results was made with; ``--config`` reads it."""

Format = Literal["glb", "ply", "obj", "stl", "npz", "vti", "nifti", "seg.nrrd", "points", "json"]


@dataclass(frozen=True)
class FilesConfig:
    """Files that a reconstruction becomes; where and in which unit: docs/files.md.

    Attributes:
        formats: surfaces as glb, ply, obj, stl; labels as npz, vti (ParaView), nifti, seg.nrrd (3D Slicer); points,
            the observed ones with their segments; json, the figures; or all.
        millimetres: write ply, obj, stl, vti and points.ply, which have no unit, in millimetres and not in the input's.
    """

    formats: tuple[Format | Literal["all"], ...] = ("glb", "npz", "json")
    millimetres: bool = False


RobotMeshes = Literal["visual", "collision"]
"""Meshes of a robot's links, see ``MeshesConfig.robot_meshes``."""


@dataclass(frozen=True)
class MeshesConfig:
    """Settings of an object's meshes: what their files do not say.

    Attributes:
        units: of the object's meshes; guessed where not given.
        deformations: how an object of meshes moves: rigid, soft or stiff (as an elastic solid), or articulated (by the
            joints that its contacts suggest); auto is articulated where there are such joints, else soft.
        robot_meshes: which of a robot's file stand for its links: visual, or collision; a link without them has the
            others.
    """

    units: LengthUnit | None = None
    deformations: Way = "auto"
    robot_meshes: RobotMeshes = "visual"

    def __post_init__(self) -> None:
        if self.units is not None:
            check_value("units", self.units, LengthUnit, "mm")
        check_bounds(self)


Space = Literal["RAS", "LPS"]
"""Anatomical frame: x to the patient's right, y to the front, z to the head; or x to the left, y to the back."""

CarryFrame = Literal["source", "scene", "RAS", "LPS"]
"""Frame and unit of files that are carried: those of the object's own files, which may be said to lie in RAS or LPS, or
scene units."""

DEFAULT_FILES = FilesConfig()


Viewpoint = Literal["auto", "pose", "ignored"]
"""Use of the pose in a PCD file's header, see ``InputConfig.viewpoint``."""


DepthAlong = Literal["z", "ray"]
"""Direction along which a depth image measures, see ``InputConfig.depth_along``."""


@dataclass(frozen=True)
class InputConfig:
    """Settings of reading a frame.

    Attributes:
        intrinsics: the depth camera, JSON or YAML; recordings have their own.
        depth_scale: pixel value of one metre; by default what the intrinsics say, else 1000 (floats: 1).
        mask: image that is not 0 on the object, or opaque there where it has transparent parts.
        frame: axes of a point cloud: camera is x right, y down, z forward; scanner is y up, z toward the scanner.
        drop_invalid: leave out NaN, infinite and all-zero points instead of refusing the file.
        unit_m: metres per unit of a point cloud: 0.001 for millimetres (ZDF has it). Without it lengths of options are
            in the cloud's unit, and the fit finds the unit where the object's true size is known.
        topic: of a ROS recording; by default its first depth image topic, else its first cloud topic.
        frame_index: which frame of a ROS recording, from 0, or of an intrinsics file that describes many.
        depth_along: z, or ray where the image holds distances along each pixel's ray (many renderers and simulators).
        mask_value: values of the object's pixels in a mask that holds ids of several things; by default all but 0.
        camera_pose: pose of the camera in the frame of a point cloud, such as a robot's base: 4 x 4 numbers (text, NPY,
            JSON) that take camera coordinates to the cloud's, in its unit. The cloud is moved into the camera's axes,
            in which all options count and results come out; their summary.json has it as T_input_result.
        viewpoint: the pose in a PCD file's header: pose is used as a camera pose, ignored means that the points are in
            the camera's axes already; auto takes what the points fit, and refuses the file where they fit both.
    """

    intrinsics: Path | None = None
    depth_scale: PositiveOrUnknown = None
    mask: Path | None = None
    frame: CloudAxes = "camera"
    drop_invalid: bool = False
    unit_m: PositiveOrUnknown = None
    topic: str | None = None
    frame_index: IndexOrNone = None
    depth_along: DepthAlong = "z"
    mask_value: WholeNumbers = ()
    camera_pose: Path | None = None
    viewpoint: Viewpoint = "auto"

    def __post_init__(self) -> None:
        if isinstance(self.unit_m, int | float) and not 0 < self.unit_m < math.inf:
            raise ValueError(f"the unit is {self.unit_m} m; it must be positive: give 0.001 for millimetres")
        if not all(isinstance(value, int) and 0 <= value < 2**16 for value in self.mask_value):
            raise ValueError(
                f"the mask's values are {self.mask_value}; they must be whole numbers from 0 to 65535: give for "
                "example --mask-value 3"
            )
        check_bounds(self, "--")
