"""Messages of ROS 2 as frames of mereo, and its results as messages; nothing here needs rclpy.

    Image and CameraInfo -depth_frame-> DepthImage (a PointCloud2 is a frame as it is)
    Result -transforms, markers, joint_state, pose, status-> messages with the frame's stamp

A header's frame is optical (REP 103: x right, y down, z forward), lengths are metres, so results need no turning.
"""

import re
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

import mereo
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.ros_recordings import camera_of_info, depth_image

# --- frames -----------------------------------------------------------------------------------------------------------


def seconds(header: Any) -> float:
    """Time of a message, seconds."""
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def nearest(states: list[Any], time_s: float) -> Any:
    """Message whose time is nearest to that of a frame; None of none."""
    return min(states, key=lambda state: abs(seconds(state.header) - time_s), default=None)


def depth_frame(image: Any, info: Any, rectified: bool) -> mereo.DepthImage:
    """Depth image in metres with its camera; ``ValueError`` says in one sentence what is wrong with a message."""
    try:
        return depth_image(image, camera_of_info(info, rectified, "the depth topic"))
    except Exception as error:  # whatever a broken message makes of the parser
        raise ValueError(f"the depth image cannot be read ({error}): check the driver and its CameraInfo") from error


# --- results ----------------------------------------------------------------------------------------------------------


def is_pose(result: mereo.Result, unsure_too: bool) -> bool:
    """Whether a robot may act on the pose of a result: that of a known object, or of an unsure one where it may be."""
    return result.pose is not None and (result.known is True or (unsure_too and result.known == "unsure"))


def transforms(result: mereo.Result, header: Any, object_frame: str) -> list[TransformStamped]:
    """Transform of the object's own files in metres, from the camera, and of each segment of theirs from the object."""
    assert result.pose is not None
    away = inverse_rigid(result.pose)
    segments = [
        (away @ part.pose, f"{object_frame}/{frame_name(part.name)}") for part in result if part.pose is not None
    ]
    return [
        TransformStamped(
            header=Header(stamp=header.stamp, frame_id=parent),
            child_frame_id=child,
            transform=Transform(translation=_point(Vector3, T[:3, 3]), rotation=_quaternion(T)),
        )
        for T, parent, child in (
            (result.pose, header.frame_id, object_frame),
            *((T, object_frame, child) for T, child in segments),
        )
    ]


def frame_name(segment: str) -> str:
    """Name of a segment as a part of a frame's."""
    return re.sub(r"\W+", "_", segment)


def markers(result: mereo.Result, header: Any, object_frame: str) -> MarkerArray:
    """Surfaces of all segments, hidden side included, in the object's frame."""
    assert result.pose is not None
    away = inverse_rigid(result.pose)
    header = Header(stamp=header.stamp, frame_id=object_frame)
    shown = list[Marker]()
    for part in result:
        # vertices are shared by their triangles: a message for each corner would take six times as long
        vertices = [_point(Point, each) for each in transform_points(away, part.mesh.vertices)]
        red, green, blue = (channel / 255 for channel in part.mesh.color)
        shown.append(
            Marker(
                header=header,
                ns=object_frame,
                id=part.label,
                type=Marker.TRIANGLE_LIST,
                action=Marker.ADD,
                pose=Pose(orientation=Quaternion(w=1.0)),
                scale=Vector3(x=1.0, y=1.0, z=1.0),
                color=ColorRGBA(r=red, g=green, b=blue, a=1.0),
                points=[vertices[index] for index in part.mesh.faces.ravel().tolist()],
            )
        )
    return MarkerArray(markers=shown)


def no_markers(header: Any, object_frame: str) -> MarkerArray:
    """Message that takes all surfaces away, as nothing is known of where the object is."""
    gone = Header(stamp=header.stamp, frame_id=header.frame_id)
    return MarkerArray(markers=[Marker(header=gone, ns=object_frame, action=Marker.DELETEALL)])


def joint_state(result: mereo.Result, header: Any) -> JointState:
    """Values of the joints by the names of the object's file, radians and metres."""
    joints = {name: joint.value for name, joint in result.joints.items() if joint.unit}
    return JointState(
        header=Header(stamp=header.stamp, frame_id=header.frame_id), name=list(joints), position=list(joints.values())
    )


def pose(result: mereo.Result, header: Any) -> PoseWithCovarianceStamped:
    """Pose of the object with the covariance of its origin and of turns about the camera's axes."""
    assert result.pose is not None
    covariance = result.covariance
    known = {} if covariance is None else {"covariance": np.roll(covariance, 3, axis=(0, 1)).ravel()}  # shift first
    placed = Pose(position=_point(Point, result.pose[:3, 3]), orientation=_quaternion(result.pose))
    return PoseWithCovarianceStamped(
        header=Header(stamp=header.stamp, frame_id=header.frame_id), pose=PoseWithCovariance(pose=placed, **known)
    )


def _point(kind: Any, position: np.ndarray) -> Any:
    x, y, z = position.tolist()
    return kind(x=x, y=y, z=z)


def _quaternion(T: np.ndarray) -> Quaternion:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


# --- trust ------------------------------------------------------------------------------------------------------------


def judge(result: mereo.Result) -> tuple[bytes, str, dict[str, Any]]:
    """Level, sentence and values of a result, for ``status``: an error where it is lost or not the object."""
    level = {True: DiagnosticStatus.OK, "unsure": DiagnosticStatus.WARN}.get(result.known, DiagnosticStatus.ERROR)
    registered = result.registered
    sure = None if registered is None else registered.uncertainty
    facts = {
        "known": result.known,
        "tracking": result.tracking,
        "explained": None if registered is None else round(registered.explained, 4),
        "radius95_m": None if sure is None else round(sure.summary(sure.outline)["median"], 6),
    }
    return level, result.recognition.reason or result.tracking, facts


def status(stamp: Any, object_frame: str, level: bytes, message: str, facts: dict[str, Any]) -> DiagnosticArray:
    """Diagnostics of the object; a value that is not known is empty."""
    values = [KeyValue(key=key, value="" if value is None else str(value)) for key, value in facts.items()]
    known = DiagnosticStatus(level=level, name=f"mereo: {object_frame}", message=message, values=values)
    return DiagnosticArray(header=Header(stamp=stamp), status=[known])
