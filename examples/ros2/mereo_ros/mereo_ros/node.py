"""Node that finds an object in the newest frame of a topic, again and again, and publishes where it is.

    depth and camera_info, or points; joint_states -> tf, ~/markers, ~/joint_states, ~/pose, /diagnostics

The executor's thread takes messages; a thread of the node answers the newest, and others are dropped. What a robot acts
on is published for a known object alone: one that is lost or refused has no transform, and diagnostics say why.
"""

import queue
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from tf2_ros import TransformBroadcaster
from visualization_msgs.msg import MarkerArray

import mereo
from mereo_ros import messages

PARAMETERS: dict[str, tuple[Any, str]] = {
    "object": ([""], "files of the object: its meshes, or one URDF, SDF or scene file; a name of mereo's own objects"),
    "weights": ("", "weights of the object, a name or a file; without them a search finds it"),
    "units": ("", "unit of the meshes: m, cm, mm or in; guessed where empty"),
    "deformations": ("auto", "how an object of meshes moves: rigid, soft, stiff, articulated, or auto"),
    "method": ("auto", "auto, or search to leave out the network"),
    "input": ("depth", "depth for an image and its camera_info, points for a cloud in an optical frame"),
    "rectified": (True, "the depth image is rectified, so that its intrinsics are the matrix P, and not K"),
    "object_frame": ("object", "frame of the object's files, in metres; its segments are below it"),
    "publish_unsure": (False, "publish the pose of an object that is unsure, too"),
    "known_joints": (
        False,
        "the topic joint_states has the object's joints, as of encoders: only the rest is looked for",
    ),
    "silent_s": (2.0, "seconds without a frame after which diagnostics are stale"),
}
"""Default and description of each parameter; they are read once, when the node starts."""

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""As of sensor data, which a driver may publish either way, but of one message: older ones would be dropped here."""

STATES = 1000
"""Values of joints that are kept: a frame takes those nearest to its own time."""


class ObjectTracker(Node):
    """Tracks one object; ``destroy_node`` ends its thread."""

    def __init__(self) -> None:
        super().__init__("mereo")
        for name, (default, text) in PARAMETERS.items():
            any_type = name == "object"  # one file need not be a list
            descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=any_type)
            self.declare_parameter(name, default, descriptor)
        stated = {name: self.get_parameter(name).value for name in PARAMETERS}
        if stated["input"] not in ("depth", "points"):
            raise ValueError(f"the input is {stated['input']!r}; it must be depth or points: correct the parameter")
        named = stated["object"]
        if not isinstance(named, str | list):
            raise ValueError(
                f"the object is {named!r}; it must be the name of a file, or a list of such: correct the parameter"
            )
        files = [file for file in ([named] if isinstance(named, str) else named) if file]
        known = mereo.load_object(
            files[0] if len(files) == 1 else files or None,
            weights=stated["weights"] or None,
            units=stated["units"] or None,
            deformations=stated["deformations"],
        )
        self.tracker, self.known_names = mereo.Tracker(known, stated["method"]), set(known.joints)
        self.states: deque[JointState] = deque(maxlen=STATES)
        self.stated, self.object_frame = stated, stated["object_frame"]
        self.info: Any = None
        self.dropped, self.last_s, self.arrived_s = 0, float("-inf"), time.monotonic()
        self.newest: queue.Queue[Any] = queue.Queue(maxsize=1)
        self.transforms = TransformBroadcaster(self)
        self.markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self.joints = self.create_publisher(JointState, "~/joint_states", 1)
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 1)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.thread = threading.Thread(target=self._answer_newest, daemon=True, name="answers")
        self.thread.start()
        if stated["known_joints"]:
            self.create_subscription(JointState, "joint_states", self._keep_joints, STATES)
        if stated["input"] == "depth":
            self.create_subscription(CameraInfo, "camera_info", self._keep_info, NEWEST)
            self.create_subscription(Image, "depth", self._receive, NEWEST)
        else:
            self.create_subscription(PointCloud2, "points", self._receive, NEWEST)
        self.create_timer(1.0, self._check_silence)

    def destroy_node(self) -> None:
        """End the thread, after the frame that it answers, and the node."""
        self._put(None)
        self.thread.join()
        self.tracker.close()
        super().destroy_node()

    def _keep_info(self, info: CameraInfo) -> None:
        self.info = info

    def _keep_joints(self, state: JointState) -> None:
        if self.known_names.intersection(state.name):  # others publish there, too
            self.states.append(state)

    def _receive(self, message: Any) -> None:
        self.arrived_s = time.monotonic()
        self._put(message)

    def _put(self, message: Any) -> None:
        """Let a message take the place of one that still waits."""
        with suppress(queue.Empty):
            self.newest.get_nowait()
            self.dropped += 1
        self.newest.put_nowait(message)

    def _check_silence(self) -> None:
        silent_s = time.monotonic() - self.arrived_s
        if silent_s >= self.stated["silent_s"]:
            words = f"no {self.stated['input']} for {silent_s:.0f} s: check the driver, the remapping and its QoS"
            stamp = self.get_clock().now().to_msg()
            self.diagnostics.publish(messages.status(stamp, self.object_frame, DiagnosticStatus.STALE, words, {}))

    def _answer_newest(self) -> None:
        while (message := self.newest.get()) is not None:
            self._answer_or_say(message)

    def _answer_or_say(self, message: Any) -> None:
        try:
            self.answer(message)
        except Exception as error:  # a bad frame stops nothing but itself
            if rclpy.ok():  # else nothing can be published any more
                self._publish_status(message.header, DiagnosticStatus.ERROR, " ".join(str(error).split()), {})
                self._clear(message.header)

    def answer(self, message: Any) -> None:
        """Find the object in a message, and publish all that is known; ``ValueError`` for an unusable one."""
        header = message.header
        if not header.frame_id:
            raise ValueError("the message names no frame; poses need one: set frame_id in the driver")
        reading: dict[str, Any] = {"drop_invalid": True}
        frame = message
        if self.stated["input"] == "depth":
            if self.info is None:
                raise ValueError("no camera_info has come; a depth image needs it: remap camera_info")
            frame = messages.depth_frame(message, self.info, self.stated["rectified"])
            reading = {}
        time_s = messages.seconds(header)
        begun = time.perf_counter()
        if time_s < self.last_s:  # a recording that starts again
            self.tracker.forget()
        self.last_s = time_s
        joints = messages.nearest(list(self.states), time_s)
        result = self.tracker.follow(frame, time_s, unit_m=1.0, joints=joints, **reading)
        level, words, facts = messages.judge(result)
        facts |= {"work_s": round(time.perf_counter() - begun, 4), "dropped": self.dropped}
        self._publish_status(header, level, words, facts)
        if not messages.is_pose(result, self.stated["publish_unsure"]):
            self._clear(header)
            return
        self.transforms.sendTransform(messages.transforms(result, header, self.object_frame))
        if result.joints:
            self.joints.publish(messages.joint_state(result, header))
        if self.poses.get_subscription_count():
            self.poses.publish(messages.pose(result, header))
        if self.markers.get_subscription_count():  # thousands of triangles
            self.markers.publish(messages.markers(result, header, self.object_frame))

    def _clear(self, header: Any) -> None:
        self.markers.publish(messages.no_markers(header, self.object_frame))

    def _publish_status(self, header: Any, level: bytes, words: str, facts: dict[str, Any]) -> None:
        self.diagnostics.publish(messages.status(header.stamp, self.object_frame, level, words, facts))


def main(args: list[str] | None = None) -> None:
    """Run the node until Ctrl-C; a parameter that is wrong ends it with one sentence."""
    rclpy.init(args=args)
    try:
        node = ObjectTracker()
    except (ValueError, OSError, ImportError, ParameterException) as error:
        rclpy.try_shutdown()
        raise SystemExit(f"mereo_ros: error: {error}") from None
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
