"""One frame of a sensor from whatever file holds it: a depth image, a point cloud, a mesh or a ROS recording.

Options that do not belong to a file's kind are refused, because ignored ones are wrong results that nobody notices.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num
from numpy.linalg import inv, norm

from mereo.geometry.brief import counted
from mereo.geometry.camera import Camera, DepthImage, PointCloud, camera_axes
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import FEW_VERTICES, oriented_points
from mereo.geometry.transforms import Points, Rows, Transform, inverse_rigid, longest_side, rigid, transform_points
from mereo.io.bounds import PositiveOrUnknown, check_bounds
from mereo.io.config import InputConfig
from mereo.io.errors import AnyPath
from mereo.io.intrinsics import intrinsics_of, read_intrinsics
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import (
    MESHES,
    InputWarning,
    check_ply,
    depth_of,
    is_depth_image,
    read_points,
    read_pose,
    read_raw_depth,
    read_viewpoint,
    usable_depth,
    valid_points,
)
from mereo.io.ros_recordings import RecordedFrame, is_recording, recorded_frame, recorded_frames

IN_VIEW, MOST_IN_VIEW = 0.5, 0.95
"""Cosine of the angle from the optical axis up to which a camera sees, and the share of points that have to be there.

The widest depth cameras see 60 degrees to either side. Others of a file's points may be stray."""


FAR = 1000.0
"""Distance of a cloud from the origin, in its extent, from which on no camera at the origin has two pixels of it."""


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """Everything that a sensor measured at one moment, before the object is looked for.

    Attributes:
        path: the file, as it was named.
        cloud: the measured points, in the file's axes and unit.
        unit_m: metres per unit; None where neither the file nor an option says it.
        axes: the cloud's.
        depth: the depth image that the points come from, in their unit, without what a mask leaves out.
        message: the recording's message, by topic and time; empty for other files.
        invalid: number of points without a measurement that were left out.
        whole: the whole depth image, without any mask; None for clouds.
        T_input_result: from the coordinates of ``cloud``, in which results come out, to the file's, in its unit: the
            camera's pose, or what was taken away of a map's coordinates; None where nothing was moved.
        T_result_seen: from the coordinates in which the object was looked for, whose axes ``axes`` names, to those of
            ``cloud``, where a result was brought into another frame; None else.
    """

    path: Path
    cloud: PointCloud
    unit_m: PositiveOrUnknown
    axes: CloudAxes
    depth: DepthImage | None = None
    message: str = ""
    invalid: int = 0
    whole: DepthImage | None = None
    T_input_result: Transform | None = None
    T_result_seen: Transform | None = None

    def __post_init__(self) -> None:
        check_bounds(self)

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in np.ptp(self.cloud.points, axis=0) * self.metres)
        points = counted(len(self.cloud), "point")
        return f"SensorFrame({self.source!r}, {points}, {size} {self.length_name}, {self.axes} axes)"

    def seen_from(self, T_input_camera: Transform) -> "SensorFrame":
        """Frame with its cloud in the axes of a camera of this pose; ``ValueError`` where axes are known already."""
        if self.axes != "camera" or self.depth is not None:
            raise ValueError(
                f"a camera pose is given, but {self.path} is a depth image, or a scan that --frame turns; it is for "
                "clouds in another frame, such as a robot's base: leave out --camera-pose"
            )
        cloud = self.cloud.transformed(inv(T_input_camera))  # its digits may be few
        return replace(self, cloud=cloud, T_input_result=T_input_camera)

    def transformed(self, T_new_result: Transform) -> "SensorFrame":
        """Frame in other coordinates, in which it has no pixels."""
        T_input_result, T_result_seen = (
            np.eye(4) if T is None else T for T in (self.T_input_result, self.T_result_seen)
        )
        return replace(
            self,
            cloud=self.cloud.transformed(T_new_result),
            depth=None,
            whole=None,
            T_input_result=T_input_result @ inverse_rigid(T_new_result),
            T_result_seen=T_new_result @ T_result_seen,
        )

    @property
    def T_camera_result(self) -> Transform:
        """From the coordinates of ``cloud`` into the axes of a camera that looks at it (``camera_axes``)."""
        turn = camera_axes(self.axes)
        return turn if self.T_result_seen is None else turn @ inverse_rigid(self.T_result_seen)

    @property
    def metres(self) -> float:
        """Metres per unit; 1 where that is not known, so that lengths are taken for metres."""
        return 1.0 if self.unit_m is None else self.unit_m

    @property
    def length_name(self) -> str:
        """Name of the unit of lengths times ``metres``: "m", or "units" where it is not known."""
        return "units" if self.unit_m is None else "m"

    @property
    def source(self) -> str:
        """Name of the file, and which of its messages."""
        return f"{self.path.name}, {self.message}" if self.message else self.path.name


def read_frame(
    path: AnyPath,
    reading: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    T_input_camera: Transform | None = None,
    camera: Any = None,
) -> SensorFrame:
    """Frame that a depth image, point cloud, mesh or ROS recording holds, or that ``reading`` picks from it.

    Depth images and recordings come in metres and camera axes; point clouds keep their file's unit and axes, unless the
    camera's pose is given, here or by the file's name, or stated in the file: then they are moved into the camera's.
    ``camera`` are intrinsics in memory (``intrinsics_of``) instead of those of a file.

    Warns with ``InputWarning`` where a file states such a pose, and where a map's offset is taken away from a scan.
    Raises ``FileNotFoundError``, ``ImportError`` for a missing extra, and ``ValueError`` for a damaged file and for
    options that do not belong to this kind of file.
    """
    path = Path(path)
    return in_camera(_as_stored(path, reading, camera), reading, T_input_camera)


def _as_stored(path: Path, reading: InputConfig, camera: Any) -> SensorFrame:
    kind = "recording" if is_recording(path) else "depth image" if is_depth_image(path) else "point cloud"
    _check_options(path, kind, reading, camera is not None)
    if kind == "recording":
        options = _recording_options(reading, camera)
        return _recorded(recorded_frame(path, reading.frame_index or 0, *options), path, reading)
    if kind == "depth image":
        return _depth_image(path, reading, camera)
    unit_m = reading.unit_m
    if unit_m is None and path.suffix.lower() == ".zdf":  # in millimetres, by its definition
        unit_m = 0.001
    rows = _cloud_rows(path)
    usable = valid_points(rows, path, reading.drop_invalid or path.suffix.lower() in MESHES)
    return SensorFrame(path, PointCloud.of(usable), unit_m, reading.frame, invalid=len(rows) - len(usable))


def _cloud_rows(path: Path) -> Rows:
    """Rows of ``PointCloud.of`` of a cloud, or of a mesh, where points on few large faces stand for it."""
    if path.suffix.lower() not in MESHES:
        rows = read_points(path)
        is_coarse = path.suffix.lower() == ".ply" and rows.shape[1] == 6 and len(rows) < FEW_VERTICES
        if not is_coarse or not check_ply(path).get("face"):
            return rows
    vertices, faces, _ = read_segmented_mesh(path).merged()
    return oriented_points(vertices, faces)


def in_camera(frame: SensorFrame, reading: InputConfig, pose: Transform | None = None) -> SensorFrame:
    """Frame in the camera's axes, where its pose is given, by an option or by the file."""
    if pose is None:
        pose = _stated_pose(frame, reading) if reading.camera_pose is None else read_pose(reading.camera_pose)
    return _near_origin(frame if pose is None else frame.seen_from(pose))


def _near_origin(frame: SensorFrame) -> SensorFrame:
    """Frame without the offset of a map's coordinates, for which lines of sight and files of 7 digits are not made.

    A scan is moved by whole units, where the origin means nothing. Raises ``ValueError`` where it is to be the camera.
    """
    points = frame.cloud.points
    size = longest_side(frame.cloud.points)
    middle = np.median(points, axis=0)
    times = float(norm(middle)) / size if size > 0 else 0.0
    if frame.depth is not None or times <= FAR:
        return frame
    where = f"the points of {frame.path} lie around ({', '.join(f'{value:.10g}' for value in np.round(middle, 3))})"
    if frame.axes == "camera" and frame.cloud.normals is None:
        raise ValueError(
            f"{where}, {times:.2g} times their extent from the origin, where the camera has to be, as in a map: give "
            "the camera's pose in these coordinates with --camera-pose FILE, or --frame scanner for a scan with y up"
        )
    offset = np.round(middle)
    warnings.warn(
        f"{where}; {' '.join(f'{value:.0f}' for value in offset)} is taken away, and results come out without it, as "
        "their files have 7 digits (T_input_result in summary.json leads back)",
        InputWarning,
        stacklevel=4,
    )
    return replace(frame, cloud=replace(frame.cloud, points=points - offset), T_input_result=rigid(np.eye(3), offset))


def _stated_pose(frame: SensorFrame, reading: InputConfig) -> Transform | None:
    """Pose of the camera that the file states, where its points are in the frame of that; None where they are not.

    Some programs store points as the sensor measured them next to its pose, others points in the frame of the pose.
    """
    path = frame.path
    points = frame.cloud.points
    pose = read_viewpoint(frame.path)
    if pose is None or reading.viewpoint == "ignored" or frame.axes == "scanner":
        return None
    if reading.viewpoint == "pose":
        return pose
    as_stored, moved = _is_in_view(points), _is_in_view(transform_points(inverse_rigid(pose), points))
    if as_stored == moved:
        fit = "fit both" if moved else "fit neither"
        raise ValueError(
            f"{path} states a camera's pose (VIEWPOINT), and its points may be in the frame of that pose or in the "
            f"camera's axes: they {fit}: give --viewpoint pose or --viewpoint ignored"
        )
    taken = "in its frame, from which they were moved into the camera's axes" if moved else "in the camera's axes"
    back = ", where results come out (T_input_result in summary.json leads back)" if moved else ""
    warnings.warn(
        f"{path} states a camera's pose (VIEWPOINT); its points are taken to be {taken}{back}",
        InputWarning,
        stacklevel=3,
    )
    return pose if moved else None


def _is_in_view(points: Points) -> bool:
    """Whether a camera at the origin that looks along z may see these points."""
    return bool((points[:, 2] > IN_VIEW * norm(points, axis=1)).mean() >= MOST_IN_VIEW)


def read_messages(path: Path, reading: InputConfig, joints: str | None = None) -> Iterator[RecordedFrame]:
    """Messages of a ROS recording's topic in their order, for ``message_frame``; raises as ``read_frame``.

    ``joints`` is a topic of joints' values, as in ``recorded_frames``.
    """
    return recorded_frames(path, *_recording_options(reading), joints)


def message_frame(message: RecordedFrame, path: Path, reading: InputConfig) -> SensorFrame:
    """Frame that a message of a recording or of a camera holds; raises ``ValueError`` as ``read_frame``."""
    return in_camera(_recorded(message, path, reading), reading)


def _check_options(path: Path, kind: str, reading: InputConfig, has_camera: bool = False) -> None:
    if reading.topic is not None and kind != "recording":
        raise ValueError(f"{path} is no ROS recording and has no topics: leave out --topic")
    if reading.viewpoint != "auto" and path.suffix.lower() != ".pcd":
        raise ValueError(f"{path} is no PCD file, which alone states a viewpoint: leave out --viewpoint")
    if kind == "point cloud":
        image = reading.intrinsics, reading.mask, reading.mask_value, reading.depth_scale, reading.depth_along
        if has_camera or image != (None, None, (), None, "z"):
            raise ValueError(
                f"{path} is read as a point cloud; leave out intrinsics, mask and depth scale or direction"
            )
        if reading.frame_index is not None:
            raise ValueError(f"{path} is one point cloud, not a recording of many: leave out --frame-index")
        return
    if reading.frame != "camera":
        raise ValueError(f"the frame is {reading.frame!r} but {path} is a {kind}; those are always in the camera frame")
    if reading.unit_m is not None:
        raise ValueError(f"{path} comes in metres: leave out --unit-m, and give --depth-scale if its scale is wrong")


def _depth_image(path: Path, reading: InputConfig, camera: Any) -> SensorFrame:
    if reading.intrinsics is None and camera is None:
        raise ValueError(f"{path} is a depth image without intrinsics; they are needed: give --intrinsics FILE")
    return depth_frame(path, read_raw_depth(path), reading, camera)


def depth_frame(path: Path, raw: Num[np.ndarray, "h w"], reading: InputConfig, camera: Any = None) -> SensorFrame:
    """Frame of a depth image's stored values, with the camera of ``reading``, or ``camera`` in memory.

    Raises ``ValueError`` for values that are no depth, and for intrinsics of another image.
    """
    size = raw.shape[1], raw.shape[0]
    if reading.intrinsics is not None:
        intrinsics = read_intrinsics(reading.intrinsics, size, path, reading.frame_index)
    else:
        intrinsics = intrinsics_of(camera, size)
    stated = None if raw.dtype.kind == "f" else intrinsics.depth_scale
    scale = stated if reading.depth_scale is None else reading.depth_scale
    return _of_image(depth_of(path, raw, scale, intrinsics.camera), path, reading)


def _of_image(depth: DepthImage, path: Path, reading: InputConfig, message: str = "") -> SensorFrame:
    whole = along_z(depth, reading)
    image = usable_depth(whole, path, reading.mask, reading.mask_value)
    return SensorFrame(path, image.to_points(), 1.0, reading.frame, image, message, whole=whole)


def along_z(image: DepthImage, reading: InputConfig) -> DepthImage:
    """Image of depths along z, of one whose values are what ``reading.depth_along`` says."""
    return image.from_ray_lengths() if reading.depth_along == "ray" else image


def _recording_options(reading: InputConfig, camera: Any = None) -> tuple[str | None, Camera | None, float | None]:
    known = None if camera is None else intrinsics_of(camera)
    known = known if reading.intrinsics is None else read_intrinsics(reading.intrinsics)
    scale = known.depth_scale if known and reading.depth_scale is None else reading.depth_scale
    return reading.topic, known.camera if known else None, scale


def _recorded(message: RecordedFrame, path: Path, reading: InputConfig) -> SensorFrame:
    content = message.read()
    if isinstance(content, DepthImage):
        return _of_image(content, path, reading, message.name)
    if reading.mask is not None or reading.depth_along == "ray":
        raise ValueError(
            f"{message.topic} in {path} has point clouds; leave out the mask and --depth-along, or name an image's "
            "--topic"
        )
    cloud = PointCloud(valid_points(content, path, reading.drop_invalid))
    lost = len(content) - len(cloud)
    return SensorFrame(path, cloud, 1.0, reading.frame, message=message.name, invalid=lost)
