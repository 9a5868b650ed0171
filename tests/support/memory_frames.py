"""Frames in memory as other libraries hold them: stand-ins of the same layout, and the same points in every form."""

import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import trimesh
from numpy import ndarray
from numpy.random import default_rng

from mereo.geometry.camera import PointCloud

POINTS = default_rng(0).integers(1, 120, (12, 3)).astype(float)
"""Whole numbers, which every numeric type holds exactly."""

GRID = POINTS.reshape(3, 4, 3)
FIELD_CODES = {"f4": 7, "f8": 8, "i2": 3}
"""Datatypes of sensor_msgs/PointField."""


def records(points: ndarray, names: str = "xyz", kind: str = "f4", skip: int = 0) -> ndarray:
    """Structured array of points: ``skip`` bytes, the axes in the order of ``names``, then a colour."""
    size = np.dtype(kind).itemsize
    offsets = [skip + size * index for index in range(3)]
    formats = [kind] * 3 + ["u4"]
    places = [*offsets, skip + 3 * size]
    layout = np.dtype({"names": [*names, "rgb"], "formats": formats, "offsets": places, "itemsize": places[3] + 7})
    made = np.full(points.shape[:-1], 7, layout)
    for index, axis in enumerate("xyz"):
        made[axis] = points[..., index]
    return made


def message(
    points: ndarray, names: str = "xyz", kind: str = "f4", big: bool = False, skip: int = 0, padding: int = 0
) -> SimpleNamespace:
    """What a ROS message of points [n, 3] or [h, w, 3] has, with unused bytes in front of points and behind rows."""
    grid = records(points if points.ndim == 3 else points[None], names, ">"[: int(big)] + kind, skip)
    data = np.pad(np.ascontiguousarray(grid).view(np.uint8).reshape(len(grid), -1), ((0, 0), (0, padding)))
    assert grid.dtype.fields is not None
    fields = [
        SimpleNamespace(name=name, offset=grid.dtype.fields[name][1], datatype=FIELD_CODES.get(kind, 6), count=1)
        for name in names
    ]
    return SimpleNamespace(
        header=None, height=grid.shape[0], width=grid.shape[1], fields=fields, is_bigendian=big,
        point_step=grid.dtype.itemsize, row_step=data.shape[1], data=data.reshape(-1), is_dense=True,
    )  # fmt: skip


def with_data(made: SimpleNamespace, convert: Callable[[ndarray], Any]) -> SimpleNamespace:
    return SimpleNamespace(**{**vars(made), "data": convert(made.data)})


class Tensor:
    """Stand-in of Open3D's tensor: no detach, and to numpy only from the processor's memory."""

    def __init__(self, values: ndarray, device: str = "CUDA:0") -> None:
        self.values, self.device, self.ndim = values, device, values.ndim

    def cpu(self) -> "Tensor":
        return Tensor(self.values, "CPU:0")

    def numpy(self) -> ndarray:
        assert self.device == "CPU:0"
        return self.values


class TensorMap:
    """Stand-in of Open3D's map from names to tensors."""

    def __init__(self, **tensors: Tensor) -> None:
        self.tensors = tensors

    def __getitem__(self, name: str) -> Tensor:
        if name not in self.tensors:
            raise RuntimeError(f"Key {name} not found in TensorMap")
        return self.tensors[name]


class Vectors:
    """Stand-in of Open3D's Vector3dVector: a sequence of rows, not an array."""

    def __init__(self, values: ndarray) -> None:
        self.values = values

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: int) -> ndarray:
        return self.values[index]


class Convertible:
    """An array of a library that is not known, such as jax."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> ndarray:
        return np.array(POINTS, dtype)


FORMS = {
    "cloud": PointCloud(POINTS),
    **{kind: POINTS.astype(kind) for kind in ("f2", "f4", "f8", ">f4", "g", "i1", "u1", "i8", "u2")},
    "fortran": np.asfortranarray(POINTS),
    "masked array": np.ma.masked_array(POINTS),
    "lists": POINTS.tolist(),
    "tuples of whole numbers": tuple(map(tuple, POINTS.astype(int).tolist())),
    "list of rows": list(POINTS),
    "organized": GRID,
    "tensor": torch.tensor(POINTS, requires_grad=True),
    "tensor of this machine's device": torch.tensor(POINTS, device="cuda" if torch.cuda.is_available() else "cpu"),
    "bfloat16": torch.tensor(POINTS, dtype=torch.bfloat16, requires_grad=True),
    "tensor of another library": Tensor(POINTS.astype(np.float32)),
    "convertible": Convertible(),
    "trimesh cloud": trimesh.PointCloud(POINTS),
    "trimesh mesh": trimesh.Trimesh(POINTS, [[0, 1, 2]], process=False),
    "open3d": SimpleNamespace(points=Vectors(POINTS), colors=Vectors(POINTS * 0)),
    "open3d tensors": SimpleNamespace(point=TensorMap(positions=Tensor(POINTS), colors=Tensor(POINTS * 0))),
    "open3d tensor mesh": SimpleNamespace(vertex=TensorMap(positions=Tensor(POINTS))),
    "structured": records(POINTS),
    "structured, shuffled": records(POINTS, "zxy", ">i2", skip=5),
    "list of records": list(records(POINTS)),
    "masked records": np.ma.masked_array(records(POINTS)),
    "message": message(POINTS),
    "big-endian message": message(GRID, big=True, skip=3, padding=2),
    "message of ROS 1": with_data(message(GRID, padding=3), bytes),
    "message of rclpy": with_data(message(GRID), lambda data: array.array("B", data.tobytes())),
    "message as lists": with_data(message(GRID), list),
}
"""The same points in every form."""
