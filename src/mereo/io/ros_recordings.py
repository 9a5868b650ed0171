"""ROS recordings: depth images or point clouds, one message at a time, from ROS 1 bags, ROS 2 bags and MCAP files.

A message is only decoded when it is asked for, so that a broken one stops nothing but itself. Depth follows ROS REP
118 (16UC1 in millimetres with 0, or 32FC1 in metres with NaN, where nothing was measured), and compressed depth
compressed_depth_image_transport.
"""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from os.path import commonpath
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num, UInt8
from numpy import ndarray

from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.transforms import Points
from mereo.io.errors import AnyPath, check_count, is_foreseen, limited_memory, reason
from mereo.io.extras import library
from mereo.io.intrinsics import camera_from_fields, warn_of_distortion
from mereo.io.readers import metres, open_image

IMAGE, CLOUD, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
COMPRESSED, JOINTS = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/JointState"
FRAMES = (IMAGE, COMPRESSED, CLOUD)
"""Types of messages that hold frames."""

COMPRESSED_DEPTH, HEADER = "compressedDepth", 12
"""Word in the format of a compressed depth image, and the bytes before its PNG: a number and two quantizations."""

DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Numpy type of each encoding of a depth image."""

FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Numpy type of each datatype of sensor_msgs/PointField."""

Content = DepthImage | Points
"""Content of a message: depth in metres, or points in metres with NaN where nothing was measured."""


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """Message of a recording, decoded when it is asked for.

    Attributes:
        topic: where it was published.
        time_s: when it was recorded, in seconds.
        read: decodes it; raises ``ValueError`` where its content is broken or not a depth.
        joints: reads the last ``JointState`` before it; None where there is none, or none is wanted.
    """

    topic: str
    time_s: float
    read: Callable[[], Content]
    joints: Callable[[], Any] | None = None

    @property
    def name(self) -> str:
        """Topic and time of the message, for people."""
        return f"{self.topic} at {self.time_s:.3f} s"


def is_recording(path: Path) -> bool:
    """Whether a path is a bag: .bag, .mcap, .db3, or the directory of a ROS 2 bag."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def recorded_frames(
    path: AnyPath,
    topic: str | None = None,
    camera: Camera | None = None,
    depth_scale: float | None = None,
    joints: str | None = None,
) -> Iterator[RecordedFrame]:
    """Frames of one topic in the order of recording.

    Args:
        path: the bag.
        topic: by default the first depth image topic by name, else the first of clouds.
        camera: by default the first CameraInfo of the topic nearest by name, for ``image_rect`` topics with its matrix
            P. It is taken to hold for the whole recording.
        depth_scale: value of one metre in integer images; by default what a recording of the RealSense SDK states,
            else 1000.
        joints: topic of joints' values, of which each frame has the last before it.

    Raises ``ImportError`` without the extra `sensors`, ``FileNotFoundError``, and ``ValueError`` where the bag cannot
    be read, has no such topic, or no CameraInfo.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a ROS bag is needed: check the path")
    if not (path.is_dir() or path.is_file()):
        raise ValueError(f"{path} is not a regular file; a ROS bag is needed: name a file")
    library("rosbags", "sensors", path)
    with _opened(path) as reader:
        topic = topic or _depth_topic(reader, path)
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype in FRAMES]
        if not connections:
            known = ", ".join(sorted({c.topic for c in reader.connections if c.msgtype in FRAMES})) or "none"
            raise ValueError(f"{path} has no images or clouds on topic {topic!r}; those it has are on: {known}")
        decode: Callable[[Any], Content] = cloud_points
        if connections[0].msgtype != CLOUD:
            image = depth_image if connections[0].msgtype == IMAGE else _compressed_depth
            scale = depth_scale or _realsense_scale(reader, topic)
            decode = partial(image, camera=camera or _camera(reader, topic, path), depth_scale=scale)
        states = [c for c in reader.connections if c.topic == joints and c.msgtype == JOINTS]
        if joints is not None and not states:
            known = ", ".join(_topics(reader, JOINTS)) or "none"
            raise ValueError(f"{path} has no joint states on topic {joints!r}; those it has are on: {known}")
        store, ros2 = reader.typestore, reader.is2  # a frame may be read when the bag is closed
        state: Callable[[], Any] | None = None
        for connection, stamp_ns, data in _messages(reader, [*connections, *states], path):
            message = partial(store.deserialize_cdr if ros2 else store.deserialize_ros1, data, connection.msgtype)
            if connection.msgtype == JOINTS:
                state = message
                continue
            source = f"{path}, {topic} at {stamp_ns} ns"
            yield RecordedFrame(topic, stamp_ns / 1e9, partial(_read, decode, message, source), state)


def recorded_frame(
    path: AnyPath,
    index: int = 0,
    topic: str | None = None,
    camera: Camera | None = None,
    depth_scale: float | None = None,
) -> RecordedFrame:
    """Frame ``index`` (from 0) of ``recorded_frames``; ``ValueError`` where the recording is shorter."""
    with closing(recorded_frames(path, topic, camera, depth_scale)) as frames:  # type: ignore[type-var]
        count = 0
        for count, frame in enumerate(frames, start=1):
            if count > index:
                return frame
    raise ValueError(f"{path} has {count} frames; frame {index} is asked for: give a lower --frame-index")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Reader of a bag; whatever a damaged one raises, now or while it is read, becomes one sentence."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        # older ROS 2 bags do not hold their message definitions; those used here are the same in all distributions
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        with limited_memory(path):
            reader.open()
        with closing(reader):
            yield reader
    except Exception as error:  # a damaged bag raises whatever its storage format does
        if is_foreseen(error) and not isinstance(error, OSError):
            raise
        raise ValueError(f"{path} cannot be read as a ROS bag ({reason(error)}): record or copy it again") from error


def _messages(reader: Any, connections: list[Any], source: AnyPath) -> Iterator[Any]:
    messages = reader.messages(connections)
    while True:
        with limited_memory(source):
            message = next(messages, None)
        if message is None:
            return
        yield message


def _depth_topic(reader: Any, path: Path) -> str:
    """Topic of depth: the first of images whose first message is one, else of compressed ones, else of clouds."""
    images, compressed, clouds = (_topics(reader, kind) for kind in FRAMES)
    depths = [topic for topic in images if _first(reader, topic).encoding in DEPTH_ENCODINGS]
    depths = depths or [topic for topic in compressed if COMPRESSED_DEPTH in _first(reader, topic).format] or clouds
    if not depths:
        have = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})) or "nothing"
        raise ValueError(
            f"{path} has neither depth images ({', '.join(DEPTH_ENCODINGS)}) nor point clouds, only {have}: record the "
            "depth topic and its camera_info"
        )
    return depths[0]


def _topics(reader: Any, kind: str) -> list[str]:
    """Topics on which there are messages of a type, by name."""
    return sorted({c.topic for c in reader.connections if c.msgtype == kind and c.msgcount})


def _first(reader: Any, topic: str) -> Any:
    connections = [c for c in reader.connections if c.topic == topic]
    connection, _, data = next(_messages(reader, connections, topic))
    return reader.deserialize(data, connection.msgtype)


def _realsense_scale(reader: Any, topic: str) -> float | None:
    """Value of one metre by the option of the sensor, which the RealSense SDK records with its images, if it has."""
    option = f"{topic.partition('/Depth_')[0]}/option/Depth_Units/value"
    is_stated = any(c.topic == option and c.msgcount for c in reader.connections)
    return 1.0 / float(_first(reader, option).data) if is_stated else None


def _camera(reader: Any, topic: str, path: Path) -> Camera:
    """Camera from the CameraInfo topic that shares the most leading names with ``topic``."""
    infos = _topics(reader, INFO)
    if not infos:
        raise ValueError(f"{path} has no CameraInfo; the intrinsics of {topic} are needed: give --intrinsics FILE")
    nearest = max(infos, key=lambda info: len(commonpath([f"/{info}", f"/{topic}"])))
    try:
        return camera_of_info(_first(reader, nearest), "image_rect" in topic, f"{path}, {topic}")
    except Exception as error:  # whatever a broken message makes of the parser
        raise ValueError(
            f"{path}, {nearest} is no camera ({reason(error)}): give --intrinsics FILE, or record it again"
        ) from error


def camera_of_info(info: Any, rectified: bool, source: str) -> Camera:
    """Camera of a CameraInfo message of ROS 1 or 2, for images of its size.

    Args:
        info: anything with the fields of sensor_msgs/CameraInfo.
        rectified: take its matrix P, of the rectified image, else K.
        source: the image, for a warning where K is taken and the lens distorts (``CameraWarning``).

    A broken message raises whatever it makes of the parser.
    """
    # ROS 1 has capital letters
    stated = {name.lower(): np.asarray(getattr(info, name)) for name in "KkPpDd" if hasattr(info, name)}
    matrix = stated["p"].reshape(3, 4)[:, :3] if rectified else stated["k"]
    camera = camera_from_fields({"width": info.width, "height": info.height, "K": matrix})
    if not rectified:
        warn_of_distortion(camera, {"d": stated["d"], "distortion_model": info.distortion_model}, source)
    return camera


def _read(decode: Callable[[Any], Content], message: Callable[[], Any], source: str) -> Content:
    try:
        return decode(message())
    except Exception as error:  # whatever a broken message makes of the parser
        raise ValueError(f"{source} cannot be read ({reason(error)}): take another frame") from error


def depth_image(message: Any, camera: Camera, depth_scale: float | None = None) -> DepthImage:
    """Depth in metres of an Image message of ROS 1 or 2, 16UC1 (or mono16) and 32FC1, of either byte order.

    Args:
        message: anything with the fields of sensor_msgs/Image; ``data`` may be bytes, an array or a list.
        camera: its intrinsics.
        depth_scale: value of one metre in integer images; by default 1000.

    Raises ``ValueError``, whose text is a reason only, and for a broken message whatever it makes of the parser.
    """
    raw = depth_pixels(message)
    return DepthImage(metres(raw, depth_scale if raw.dtype.kind != "f" else None), camera)


def depth_pixels(message: Any) -> Num[ndarray, "h w"]:
    """Stored values of a message of the type sensor_msgs/Image; ``ValueError``, its reason only, for no depth image."""
    kind = DEPTH_ENCODINGS.get(message.encoding)
    if kind is None:
        raise ValueError(f"its encoding is {message.encoding!r}, not one of {', '.join(DEPTH_ENCODINGS)}")
    value = np.dtype(f"{'>' if message.is_bigendian else '<'}{kind}")
    rows = _rows(message, message.step, value.itemsize)
    return np.ascontiguousarray(rows[:, : message.width * value.itemsize]).view(value).astype(kind)


def _compressed_depth(message: Any, camera: Camera, depth_scale: float | None) -> DepthImage:
    """Depth of a compressed image: 16UC1 as it is; 32FC1 as inverse depth, ``a / (value - b)`` metres, 0 if none."""
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    if not codec.startswith(COMPRESSED_DEPTH) or encoding not in DEPTH_ENCODINGS or codec.endswith("rvl"):
        raise ValueError(
            f"its format is {message.format!r}, not PNG-compressed depth ('16UC1; compressedDepth png' or 32FC1)"
        )
    data = np.asarray(message.data, np.uint8).tobytes()
    with open_image(BytesIO(data[HEADER:]), ("PNG",)) as image:
        raw = np.asarray(image).astype(np.uint16)
    if DEPTH_ENCODINGS[encoding] == "u2":
        return DepthImage(metres(raw, depth_scale), camera)
    a, b = np.frombuffer(data[4:HEADER], "<f4").astype(float)
    with np.errstate(divide="ignore"):
        depth = np.where(raw > 0, a / (raw - b), 0.0)
    return DepthImage(depth, camera)


def _rows(message: Any, step: int, item: int) -> UInt8[ndarray, "h s"]:
    """Bytes of each row of an image or cloud; fewer than are stated would come out as fewer pixels or points."""
    # rospy hands over bytes, which np.asarray takes for the digits of one number
    data = np.frombuffer(message.data, np.uint8) if isinstance(message.data, bytes) else np.asarray(message.data, "u1")
    if step < message.width * item:
        raise ValueError(f"its rows have {step} bytes, less than {message.width} of {item}")
    check_count(message.height * step, len(data), "bytes")
    return data[: message.height * step].reshape(message.height, step)


def cloud_points(message: Any) -> Points:
    """Points of a PointCloud2 message of ROS 1 or 2, row by row, NaN where nothing was measured.

    Args:
        message: anything with the fields of sensor_msgs/PointCloud2; ``data`` may be bytes, an array or a list.

    Raises ``ValueError``, whose text is a reason only, and for a broken message whatever it makes of the parser.
    """
    end = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields if field.name in ("x", "y", "z")}
    if len(fields) != 3:
        raise ValueError(f"its fields are {', '.join(f.name for f in message.fields)}, without x, y and z")
    if strange := [field for field in fields.values() if field.datatype not in FIELD_TYPES]:
        raise ValueError(f"its field {strange[0].name!r} is of datatype {strange[0].datatype}, not 1 to 8")
    formats = [f"{end}{FIELD_TYPES[field.datatype]}" for field in fields.values()]
    offsets = [field.offset for field in fields.values()]
    layout: Any = {"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    rows = _rows(message, message.row_step, message.point_step)[:, : message.width * message.point_step]
    points = np.ascontiguousarray(rows).view(np.dtype(layout)).reshape(-1)
    return np.stack([points[axis].astype(float) for axis in "xyz"], axis=1)
