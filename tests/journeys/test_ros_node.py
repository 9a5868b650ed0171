"""The node of ROS 2, without ROS: messages by their published definitions, which refuse other fields and types."""

import runpy
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml
from robot_files import write_gripper
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import mereo
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.robots import read_robot
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

PACKAGE = Path(__file__).parents[2] / "examples/ros2/mereo_ros"
DEFINITIONS = get_typestore(Stores.ROS2_HUMBLE).fielddefs
ZEROS = {"float32": 0.0, "float64": 0.0, "bool": False, "string": "", "byte": b"\0"}


class Message:
    """Message as rosidl makes it: each field has a value from the start, and takes those of its type alone."""

    _kinds: dict[str, Any]

    def __init__(self, **values: Any) -> None:
        for name, value in {**{name: zero(*kind) for name, kind in self._kinds.items()}, **values}.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        assert fits(value, *self._kinds[name]), f"{type(self).__name__}.{name} is {value!r}"
        object.__setattr__(self, name, value)


def zero(node: Any, what: Any) -> Any:
    if node.name == "BASE":
        return ZEROS.get(what[0], 0)
    return message(what)() if node.name == "NAME" else [] if node.name == "SEQUENCE" else np.zeros(what[1])


def fits(value: Any, node: Any, what: Any) -> bool:
    is_like = type(value) is type(zero(node, what))
    return is_like and (node.name != "SEQUENCE" or all(fits(each, *what[0]) for each in value))


def message(name: str, known: dict[str, Any] = {}) -> Any:  # noqa: B006 (made once)
    if name not in known:
        constants, fields = DEFINITIONS[name]
        stated = {key: bytes([value]) if kind == "byte" else value for key, kind, value in constants}
        known[name] = type(name.rpartition("/")[2], (Message,), {"_kinds": dict(fields), **stated})
    return known[name]


class Node:
    """What of ``rclpy.node.Node`` is used; ``stated`` are the parameters that a launch file gives."""

    stated: ClassVar[dict[str, Any]] = {}
    destroy_node = create_timer = MagicMock()

    def __init__(self, name: str) -> None:
        self.sent, self.create_subscription, self.get_clock, self.values = list[Any](), MagicMock(), MagicMock(), {}
        self.get_clock().now().to_msg.return_value = header(99).stamp

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> None:
        assert type(descriptor) is message("rcl_interfaces/msg/ParameterDescriptor") and descriptor.description
        self.values[name] = SimpleNamespace(value=self.stated.get(name, value))

    def get_parameter(self, name: str) -> Any:
        return self.values[name]

    def create_publisher(self, kind: Any, topic: str, qos: int) -> Any:
        def publish(message: Any) -> None:
            assert type(message) is kind
            self.sent.append(message)

        return SimpleNamespace(publish=publish, get_subscription_count=lambda: 1)


@pytest.fixture(scope="module")
def ros() -> Iterator[Any]:
    """Module of the node, among stand-ins of the modules that it imports."""
    rclpy, tf = MagicMock(**{"node.Node": Node, "qos.QoSProfile": dict}), MagicMock()
    tf.TransformBroadcaster = lambda node: SimpleNamespace(sendTransform=node.sent.extend)
    modules: dict[str, Any] = {"tf2_ros": tf, "rclpy": rclpy, "rclpy.executors": rclpy}
    modules |= {"rclpy.node": rclpy.node, "rclpy.qos": rclpy.qos}
    for name in DEFINITIONS:
        package, _, kind = name.split("/")
        setattr(modules.setdefault(f"{package}.msg", SimpleNamespace()), kind, message(name))
        modules[package] = None if package == "mereo_ros" else SimpleNamespace()
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


def image(values: np.ndarray, time_s: float, encoding: str = "32FC1", kind: str = "<f4") -> Any:
    """Message of an image, with padding behind each row."""
    rows = np.pad(values.astype(kind).view(np.uint8), ((0, 0), (0, 8)))
    made = message("sensor_msgs/msg/Image")(header=header(time_s), encoding=encoding, is_bigendian=int(kind[0] == ">"))
    made.height, made.width, made.step, made.data = *values.shape, rows.shape[1], rows.ravel().tolist()
    return made


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("kind", ["<u2", ">u2", "<f4", ">f4"])
def test_a_depth_image_of_either_encoding_and_byte_order_is_metres(ros: Any, kind: str, rectified: bool) -> None:
    depth, is_float = np.random.default_rng(0).integers(300, 900, (120, 160)) / 1000, kind[1] == "f"
    stored = np.where(depth > 0.8, np.nan, depth) if is_float else np.where(depth > 0.8, 0, np.rint(1000 * depth))
    read = ros.messages.depth_frame(image(stored, 1.0, "32FC1" if is_float else "16UC1", kind), INFO, rectified)
    np.testing.assert_allclose(read.depth, np.where(depth > 0.8, 0, depth), atol=1e-7)
    assert read.camera == CAMERA


# --- the node ---------------------------------------------------------------------------------------------------------


def taken(node: Any) -> dict[str, Any]:
    """Messages that were sent since the last call, by their types; transforms as poses in the camera's frame."""
    sent: dict[str, Any] = {FRAME: np.eye(4)}
    for each in node.sent:
        sent[type(each).__name__] = each
        if isinstance(each, message("geometry_msgs/msg/TransformStamped")):
            turn, step = vars(each.transform.rotation), vars(each.transform.translation)
            R = Rotation.from_quat([turn[axis] for axis in "xyzw"]).as_matrix()
            sent[each.child_frame_id] = sent[each.header.frame_id] @ rigid(R, np.array([step[axis] for axis in "xyz"]))
    node.sent.clear()
    return sent


def test_a_gripper_is_published_with_its_joints_until_it_is_lost(
    ros: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = write_gripper(tmp_path)
    monkeypatch.setattr(Node, "stated", {"object": [str(robot)]})
    T = rigid(Rotation.from_euler("xyz", [195, 30, 200], degrees=True).as_matrix(), np.array([0.0, 0.0, 0.45]))
    parts = zip(read_robot(robot).mesh.segments, (0.0, -0.02, 0.012), strict=True)  # the fingers are so far open
    moved = [SegmentedMesh((part,)).transformed(T @ rigid(np.eye(3), np.array([x, 0, 0]))) for part, x in parts]
    mesh = SegmentedMesh(tuple(each.segments[0] for each in moved))
    depth = add_depth_noise(render_depth(mesh, CAMERA), 2e-4, np.random.default_rng(0)).depth
    node = ros.ObjectTracker()
    node._keep_info(INFO)
    for number, tracking in enumerate(("found", "followed")):
        frame = image(depth, 5.5 + number / 15)
        node.answer(frame)
        assert all(each.header.stamp is frame.header.stamp for each in node.sent if "header" in vars(each))
        sent = taken(node)
        np.testing.assert_allclose(sent["object/palm"], T, atol=0.01)
        assert sent["JointState"].name == ["other finger", "finger"]
        assert sent["JointState"].position == pytest.approx([0.012, 0.02], abs=0.001)
        for marker, part in zip(sent["MarkerArray"].markers, mesh.segments, strict=True):
            corners = np.array([[each.x, each.y, each.z] for each in marker.points])
            corners = transform_points(sent[marker.header.frame_id], corners)
            np.testing.assert_allclose(corners, part.vertices[part.faces].reshape(-1, 3), atol=0.002)
            assert (marker.type, marker.action, marker.color.a, marker.scale.x) == (11, 0, 1, 1)
        (status,) = sent["DiagnosticArray"].status
        values = {each.key: each.value for each in status.values}
        assert (status.level, values["known"], values["tracking"]) == (b"\0", "True", tracking)
        assert float(values["explained"]) > 0.95 and 0 < float(values["radius95_m"]) < 0.001
        assert np.linalg.eigvalsh(sent["PoseWithCovarianceStamped"].pose.covariance.reshape(6, 6)).min() > 0
    assert said(node, image(2 * ONES, 5.7)).startswith("\2the object is lost: ")
    node.destroy_node()


def said(node: Any, frame: Any) -> str:
    """Level and words of the diagnostics of a frame by which nothing is known: surfaces go, and no pose is published."""
    node._answer_or_say(frame)
    sent = taken(node)
    assert set(sent) == {FRAME, "DiagnosticArray", "MarkerArray"} and sent["MarkerArray"].markers[0].action == 3
    return sent["DiagnosticArray"].status[0].level.decode() + sent["DiagnosticArray"].status[0].message


@pytest.fixture
def node(ros: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Node whose tracker is a stand-in, which is always unsure."""
    for name in ("load_object", "Tracker"):
        monkeypatch.setattr(mereo, name, MagicMock(), raising=False)
    made = ros.ObjectTracker()
    result = made.tracker.follow.return_value = MagicMock(known="unsure", registered=None)
    result.recognition.reason = "4 % are not its"
    yield made
    made.destroy_node()
    made.tracker.close.assert_called_once()


def test_only_the_newest_of_the_frames_that_wait_is_answered(node: Any) -> None:
    begun, released, answered = threading.Semaphore(0), threading.Semaphore(0), []

    def slow(message: Any) -> None:
        answered.append(message.header.stamp.sec)
        begun.release()
        released.acquire(timeout=10)

    node.answer = slow
    for second in (1, 2, 3, 4):
        node._receive(image(ONES, second))
        if second == 1:
            begun.acquire(timeout=10)
    released.release(2)
    begun.acquire(timeout=10)
    assert answered == [1, 4] and node.dropped == 2


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
    assert ros.messages.is_pose(node.tracker.follow.return_value, True), "where that is wanted"
    node.stated |= {"silent_s": 0.0, "input": "points"}
    node._check_silence()
    silence = taken(node)["DiagnosticArray"]
    assert (silence.status[0].level, silence.status[0].message[:14], silence.header.stamp.sec) == (
        b"\3",
        "no points for ",
        99,
    )
    cloud = message("sensor_msgs/msg/PointCloud2")(header=header(4))
    node.answer(cloud)
    node.tracker.follow.assert_called_with(cloud, 4.0, unit_m=1.0, drop_invalid=True)


def test_the_package_has_what_ros2_run_and_launch_need(ros: Any, node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PACKAGE)
    parameters = yaml.safe_load(Path("config/mereo.yaml").read_text())["/**"]["ros__parameters"]
    assert {name: type(value) for name, value in parameters.items()} == {
        name: type(default) for name, (default, _) in ros.PARAMETERS.items()
    }
    monkeypatch.setattr(Node, "stated", {"input": "cloud"})
    with pytest.raises(SystemExit, match="^mereo_ros: error: the input is 'cloud'; it must be depth or points"):
        ros.main()
    setup, launch = MagicMock(), MagicMock()
    monkeypatch.setattr("setuptools.setup", setup)
    runpy.run_path("setup.py")
    assert setup.call_args.kwargs["entry_points"]["console_scripts"] == ["track = mereo_ros.node:main"]
    assert all(Path(file).is_file() for _, files in setup.call_args.kwargs["data_files"] for file in files)
    for name in (
        "launch",
        "launch.actions",
        "launch.substitutions",
        "launch_ros.actions",
        "ament_index_python.packages",
    ):
        monkeypatch.setitem(sys.modules, name, launch)
    launch.get_package_share_directory.return_value = "."
    runpy.run_path("launch/mereo.launch.py")["generate_launch_description"]()
    remapped = {name for name, _ in launch.Node.call_args.kwargs["remappings"]}
    assert remapped == {"points", *(call.args[1] for call in node.create_subscription.call_args_list)}
