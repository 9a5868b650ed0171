"""The node of ROS 2, without ROS: messages by their published definitions, which refuse other fields and types."""

import runpy
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml
from numpy.random import default_rng
from numpy.testing import assert_allclose
from robot_files import write_gripper
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import mereo
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.robots import read_robot
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

PACKAGE = Path(__file__).parents[2] / "examples/ros2/mereo_ros"
DEFINITIONS = get_typestore(Stores.ROS2_HUMBLE).fielddefs
PARTS = "exceptions", "executors", "node", "qos"
ZEROS = {"float32": 0.0, "float64": 0.0, "bool": False, "string": "", "byte": b"\0"}


class Message:
    """Message as rosidl makes it: each field has a value from the start, and takes those of its type alone."""

    def __init__(self, **values: Any) -> None:
        for name, value in {**{name: zero(*kind) for name, kind in self._kinds.items()}, **values}.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        assert fits(value, *self._kinds[name]), (name, value)
        object.__setattr__(self, name, value)


def zero(node: Any, what: Any) -> Any:
    if node.name == "BASE":
        return ZEROS.get(what[0], 0)
    return message(what)() if node.name == "NAME" else [] if node.name == "SEQUENCE" else np.zeros(what[1])


def fits(value: Any, node: Any, what: Any) -> bool:
    is_like = type(value) is type(zero(node, what))
    return is_like and (node.name != "SEQUENCE" or all(fits(each, *what[0]) for each in value))


@cache
def message(name: str) -> Any:
    constants, fields = DEFINITIONS[name]
    stated = {key: bytes([value]) if kind == "byte" else value for key, kind, value in constants}
    return type(name.rpartition("/")[2], (Message,), {"_kinds": dict(fields), **stated})


class Node:
    """What of ``rclpy.node.Node`` is used; ``stated`` are the parameters that a launch file gives."""

    stated: ClassVar[JsonObject] = {}
    destroy_node = create_timer = MagicMock()

    def __init__(self, name: str) -> None:
        self.sent, self.create_subscription, self.values = list[Any](), MagicMock(), {}
        self.get_clock = MagicMock(**{"return_value.now.return_value.to_msg.return_value": header(99).stamp})

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> None:
        assert type(descriptor) is message("rcl_interfaces/msg/ParameterDescriptor") and descriptor.description
        stated = self.stated.get(name, value)
        if type(stated) is not type(value) and not descriptor.dynamic_typing:
            raise LookupError(f"{name} is of another type")  # in the place of ParameterException
        self.values[name] = SimpleNamespace(value=stated)

    def get_parameter(self, name: str) -> Any:
        return self.values[name]

    def create_publisher(self, kind: Any, topic: str, qos: int) -> Any:
        return SimpleNamespace(publish=self.sent.append, get_subscription_count=lambda: 1)


@pytest.fixture(scope="module")
def ros() -> Iterator[Any]:
    """Module of the node, among stand-ins of the modules that it imports."""
    tools = MagicMock(Node=Node, QoSProfile=dict, ParameterException=LookupError)
    tools.TransformBroadcaster = lambda node: SimpleNamespace(sendTransform=node.sent.extend)
    modules = dict.fromkeys(("rclpy", *(f"rclpy.{part}" for part in PARTS), "tf2_ros"), tools)
    for name in DEFINITIONS:
        package, _, kind = name.split("/")
        setattr(modules.setdefault(f"{package}.msg", SimpleNamespace()), kind, message(name))
        modules[package] = SimpleNamespace()
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(PACKAGE)
        for name, module in modules.items():
            patched.setitem(sys.modules, name, module)
        from mereo_ros import node  # type: ignore[import-not-found]

        yield node


# --- messages ---------------------------------------------------------------------------------------------------------

FRAME = "camera_depth_optical_frame"
CAMERA = Camera(160, 120, 180.0, 180.0, 80.0, 60.0)
MATRIX = np.array([180.0, 0, 79.5, 0, 0, 180, 59.5, 0, 0, 0, 1, 0])
INFO = message("sensor_msgs/msg/CameraInfo")(width=160, height=120, p=MATRIX, k=np.delete(MATRIX, [3, 7, 11]))
ONES = np.ones((120, 160))


def header(time_s: float) -> Any:
    stamp = message("builtin_interfaces/msg/Time")(sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
    return message("std_msgs/msg/Header")(stamp=stamp, frame_id=FRAME)


def image(depth: np.ndarray, time_s: float, encoding: str = "32FC1") -> Any:
    made = message("sensor_msgs/msg/Image")(header=header(time_s), encoding=encoding, height=120, width=160, step=640)
    made.data = list(depth.astype("<f4").tobytes())
    return made


# --- the node ---------------------------------------------------------------------------------------------------------


def taken(node: Any) -> JsonObject:
    """Messages that were sent since the last call, by their types; transforms as poses in the camera's frame."""
    sent = {FRAME: np.eye(4)}
    for each in node.sent:
        if isinstance(each, message("geometry_msgs/msg/TransformStamped")):
            step, turn = (list(vars(value).values()) for value in vars(each.transform).values())  # as they are defined
            T = rigid(Rotation.from_quat(turn).as_matrix(), np.array(step))
            sent[each.child_frame_id] = sent[each.header.frame_id] @ T
        else:
            sent[type(each).__name__] = each
    node.sent.clear()
    return sent


def test_a_gripper_is_published_with_its_joints_until_it_is_lost(
    ros: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = write_gripper(tmp_path)
    monkeypatch.setattr(Node, "stated", {"object": str(robot), "known_joints": True})  # or a list
    T = rigid(Rotation.from_euler("xyz", [195, 30, 200], degrees=True).as_matrix(), np.array([0.0, 0.0, 0.45]))
    parts = zip(read_robot(robot).mesh.segments, (0.0, -0.02, 0.012), strict=True)  # the fingers are so far open
    moved = [SegmentedMesh((part,)).transformed(T @ rigid(np.eye(3), np.array([x, 0, 0]))) for part, x in parts]
    mesh = SegmentedMesh(tuple(each.segments[0] for each in moved))
    depth = add_depth_noise(render_depth(mesh, CAMERA), 2e-4, default_rng(0)).depth
    node = ros.ObjectTracker()
    frame = image(depth, 5.5)
    node._keep_info(INFO)
    kind, topic, keep, _ = node.create_subscription.call_args_list[0].args
    assert topic == "joint_states"
    for time_s, name, value in ((5.3, "finger", 0.03), (5.48, "finger", 0.0203), (5.5, "wheel", 1.0)):
        keep(kind(header=header(time_s), name=[name], position=[value]))
    node.answer(frame)
    assert all(each.header.stamp is frame.header.stamp for each in node.sent if "header" in vars(each))
    sent = taken(node)
    assert_allclose(sent["object/palm"], T, atol=0.01)
    right = T @ rigid(np.eye(3), np.array([0.012, 0, 0])) @ read_robot(robot).link_frames["right"]
    assert_allclose(sent["object/right"], right, atol=0.01)
    joints = dict(zip(sent["JointState"].name, sent["JointState"].position, strict=True))
    assert joints == pytest.approx({"finger": 0.0203, "other finger": 0.01215}), "as is known at the frame's time"
    for marker, part in zip(sent["MarkerArray"].markers, mesh.segments, strict=True):
        corners = np.array([list(vars(each).values()) for each in marker.points])
        corners = transform_points(sent[marker.header.frame_id], corners)
        assert_allclose(corners, part.vertices[part.faces].reshape(-1, 3), atol=0.002)
        assert (marker.type, marker.scale.x) == (11, 1)
    (status,) = sent["DiagnosticArray"].status
    assert status.level == b"\0" and [each.value for each in status.values][:2] == ["True", "found"]
    assert sent["PoseWithCovarianceStamped"].pose.covariance[0] > 0
    assert said(node, image(2 * ONES, 5.6)).startswith("\2the object is lost: ")
    node.destroy_node()


def said(node: Any, frame: Any) -> str:
    """Level and words of the diagnostics of a frame that has no pose: surfaces go, and no earlier one is published."""
    node._answer_or_say(frame)
    sent = taken(node)
    assert set(sent) == {FRAME, "DiagnosticArray", "MarkerArray"} and sent["MarkerArray"].markers[0].action == 3
    return sent["DiagnosticArray"].status[0].level.decode() + sent["DiagnosticArray"].status[0].message


@pytest.fixture
def node(ros: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Node without a thread, whose tracker is a stand-in that is always unsure."""
    for name in ("load_object", "Tracker"):
        monkeypatch.setattr(mereo, name, MagicMock(), raising=False)
    monkeypatch.setattr(ros.threading, "Thread", MagicMock())
    made = ros.ObjectTracker()
    made.tracker.follow.return_value = MagicMock(known="unsure", registered=None)
    made.tracker.follow.return_value.recognition.reason = "4 % are not its"
    return made


def test_only_the_newest_of_the_frames_that_wait_is_answered(node: Any) -> None:
    answered = list[int]()
    node.answer = lambda frame: (answered.append(frame.header.stamp.sec), node.destroy_node())
    for second in (1, 2, 3):
        node._receive(image(ONES, second))
    node._answer_newest()
    assert answered == [3] and node.dropped == 2


def test_what_is_wrong_is_said_in_diagnostics(ros: Any, node: Any) -> None:
    assert said(node, image(ONES, 9)) == "\2no camera_info has come; a depth image needs it: remap camera_info"
    node._keep_info(INFO)
    assert said(node, image(ONES, 9, "rgb8")).startswith(
        "\2the depth image cannot be read (its encoding is 'rgb8', not"
    )
    nameless = image(ONES, 9)
    nameless.header.frame_id = ""
    assert said(node, nameless).startswith("\2the message names no frame; poses need one")
    assert said(node, image(ONES, 9)) == said(node, image(ONES, 3)) == "\0014 % are not its"
    node.tracker.forget.assert_called_once()  # of a recording that has started again
    assert ros.messages.is_pose(node.tracker.follow.return_value, True)  # where that is wanted
    node.stated |= {"silent_s": 0.0, "input": "points"}
    node._check_silence()
    (silence,) = taken(node)["DiagnosticArray"].status
    assert silence.level == b"\3" and silence.message.startswith("no points for ")
    cloud = message("sensor_msgs/msg/PointCloud2")(header=header(4))
    node.answer(cloud)
    node.tracker.follow.assert_called_with(cloud, 4.0, unit_m=1.0, joints=None, drop_invalid=True)


def test_the_package_has_what_ros2_run_and_launch_need(ros: Any, node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PACKAGE)
    parameters = yaml.safe_load(Path("config/mereo.yaml").read_text())["/**"]["ros__parameters"]
    assert set(parameters) == set(ros.PARAMETERS)
    for stated, words in (
        ({"input": "cloud"}, "the input is 'cloud'; it must be depth or points"),
        ({"object": 5}, "the object is 5; it must be the name of a file, or a list of such"),
        ({"silent_s": 2}, "silent_s is of another type"),
    ):
        monkeypatch.setattr(Node, "stated", stated)
        with pytest.raises(SystemExit, match=f"^mereo_ros: error: {words}"):
            ros.main()
    tools = MagicMock()
    names = "launch", "launch.actions", "launch.substitutions", "launch_ros.actions", "ament_index_python.packages"
    for name in ("setuptools", *names):
        monkeypatch.setitem(sys.modules, name, tools)
    tools.get_package_share_directory.return_value = "."
    runpy.run_path("setup.py")
    assert all(Path(file).is_file() for _, files in tools.setup.call_args.kwargs["data_files"] for file in files)
    runpy.run_path("launch/mereo.launch.py")["generate_launch_description"]()
    remapped = {name for name, _ in tools.Node.call_args.kwargs["remappings"]}
    assert remapped == {"points", "joint_states", *(call.args[1] for call in node.create_subscription.call_args_list)}
