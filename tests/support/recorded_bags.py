"""Recordings of a depth camera as ROS bags, written message by message."""

import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.random import default_rng
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from mereo.geometry.conventions import Range

STAMPS = (10**9, 2 * 10**9, 3 * 10**9)


class Messages:
    """Messages of one ROS version."""

    def __init__(self, ros: int) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        self.types = self.store.types
        self.ros = ros

    def header(self) -> Any:
        time = self.types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
        more = {"seq": 0} if self.ros == 1 else {}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **more)

    def image(self, values: ndarray, encoding: str, padding: int = 0, big: bool = False) -> Any:
        rows = values.astype(values.dtype.newbyteorder(">" if big else "<")).view(np.uint8).reshape(len(values), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        height, width = values.shape[:2]
        kind = self.types["sensor_msgs/msg/Image"]
        return kind(
            header=self.header(), height=height, width=width, encoding=encoding, is_bigendian=int(big),
            step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def compressed(self, values: ndarray, format_: str, quantization: Range = (0.0, 0.0)) -> Any:
        """As compressed_depth_image_transport writes it: 12 bytes, then a 16-bit PNG."""
        png = BytesIO()
        Image.fromarray(values.astype(np.uint16)).save(png, format="PNG")
        data = np.frombuffer(struct.pack("<iff", 0, *quantization) + png.getvalue(), np.uint8)
        return self.types["sensor_msgs/msg/CompressedImage"](header=self.header(), format=format_, data=data)

    def info(self, focal: float = 10.0, distortion: float = 0.0) -> Any:
        """Principal point 3.5, 2.5 with pixel centres at whole numbers is the middle of 8 x 6 pixels."""
        matrix = np.array([focal, 0, 3.5, 0, 11.0, 2.5, 0, 0, 1.0])
        projection = np.array([10.0, 0, 3.5, 0, 0, 11.0, 2.5, 0, 0, 0, 1.0, 0])
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        values = {"d": np.array([distortion, 0, 0, 0, 0]), "k": matrix, "r": np.eye(3).ravel(), "p": projection}
        values = {name.upper() if self.ros == 1 else name: value for name, value in values.items()}
        kind = self.types["sensor_msgs/msg/CameraInfo"]
        return kind(
            header=self.header(), height=6, width=8, distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi,
            **values,
        )  # fmt: skip

    def joints(self, names: list[str], values: list[float]) -> Any:
        return self.types["sensor_msgs/msg/JointState"](self.header(), names, np.array(values), *[np.empty(0)] * 2)

    def cloud(self, points: ndarray) -> Any:
        """Two rows; x, y, z as floats after four bytes of something else, and four of padding at the end of a row."""
        field = self.types["sensor_msgs/msg/PointField"]
        rows = np.zeros((2, len(points) // 2, 4), "<f4")
        rows[..., 1:] = points.reshape(2, -1, 3)
        data = np.pad(rows.view(np.uint8).reshape(2, -1), ((0, 0), (0, 4)))
        kind = self.types["sensor_msgs/msg/PointCloud2"]
        return kind(
            header=self.header(), height=2, width=len(points) // 2, is_bigendian=False, point_step=16,
            fields=[field(name, 4 * (i + 1), 7, 1) for i, name in enumerate("xyz")],
            row_step=data.shape[1], data=data.reshape(-1), is_dense=False,
        )  # fmt: skip


Topics = dict[str, list[Any]]
"""Messages of each topic."""


def write_bag(path: Path, ros: int, topics: Callable[[Messages], Topics]) -> Path:
    """``topics`` makes the messages of each topic; they are recorded a second apart."""
    make = Messages(ros)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("") if ros == 2 else path
    writer = Writer1(folder) if ros == 1 else Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        for topic, messages in topics(make).items():
            kind = messages[0].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=make.store)
            serialize = make.store.serialize_ros1 if ros == 1 else make.store.serialize_cdr
            for stamp, message in zip(STAMPS, messages, strict=False):
                writer.write(connection, stamp, serialize(message, kind))
    return next(folder.glob("*.mcap")) if path.suffix == ".mcap" else folder


DEPTH_MM = default_rng(0).integers(500, 2000, (3, 6, 8)).astype(np.uint16)
DEPTH_MM[:, 0, 0] = 0


def depth_topics(make: Messages) -> Topics:
    color = np.zeros((6, 8), np.uint8)
    return {
        "/camera/color/image_raw": [make.image(color, "mono8")],
        "/camera/color/camera_info": [make.info(focal=99.0)],
        "/camera/depth/image_raw": [make.image(depth, "16UC1", padding=6) for depth in DEPTH_MM],
        "/camera/depth/camera_info": [make.info()] * 3,
    }
