"""Frames that are already in memory: what other libraries call a point cloud, as mereo's own types.

    anything -points_of-> PointCloud (or the DepthImage that it was), number of points left out

Libraries are recognized by what their objects have, so that none of them is imported. What could be meant in two ways
is refused: an image of depths has no positions without its camera, and the columns of a table name no axes.
"""

from contextlib import suppress
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.conventions import LARGEST, check_real
from mereo.io.errors import reason
from mereo.io.readers import valid_points
from mereo.io.ros_recordings import cloud_points


def points_of(source: object, drop_invalid: bool = False) -> tuple[PointCloud | DepthImage, int]:
    """Observed points of whatever holds a frame in memory, and how many points were left out.

    A ``PointCloud`` and a ``DepthImage`` are returned as they are. Everything else becomes a new ``PointCloud`` of
    64-bit floats in the source's order, axes and unit; grids are flattened row by row:

    - arrays n x 3 or h x w x 3 of integers or floats: numpy's, torch's of any device, and whatever else converts
      itself into a numpy array; masked values are points without a measurement;
    - lists or tuples of rows of three numbers;
    - structured arrays with fields x, y and z in any order among others, in one or two dimensions;
    - objects with ``points`` or ``vertices`` (Open3D and its tensors, trimesh, PyVista), with their ``normals`` or
      ``vertex_normals`` where they have some;
    - messages of the type sensor_msgs/PointCloud2, of ROS 1, ROS 2 or rosbags.

    Args:
        source: one frame; a list of frames is recognized by ``is_frame_list`` and refused here.
        drop_invalid: leave out points that are NaN, infinite, beyond 1e12 or exactly (0, 0, 0), as sensors mark them.

    Raises ``ValueError`` where the source is none of these, empty, of another shape or not of real numbers, or has
    points without a measurement that are not to be dropped, or no others.
    """
    if isinstance(source, PointCloud | DepthImage):
        return source, 0
    with np.errstate(over="ignore", invalid="ignore"):  # infinite values are counted below, whoever made them
        points, name, organized = _positions(source)
        cure = "leave them out with drop_invalid=True"
        if organized:
            cure = "organized clouds mark pixels without a measurement so, and drop_invalid=True leaves them out"
        kept = valid_points(_with_normals(points, source), name, drop_invalid, cure)
    return PointCloud.of(kept), len(points) - len(kept)


def _with_normals(points: Float[np.ndarray, "n 3"], source: Any) -> Float[np.ndarray, "n c"]:
    """Points, with the normals that an object of Open3D or trimesh has for each of them, if it has."""
    for name in ("normals", "vertex_normals"):
        with suppress(Exception):  # of what else has such a name
            normals = np.asarray(getattr(source, name), dtype=np.float64)
            if normals.shape == points.shape and np.isfinite(normals).all():
                return np.hstack([points, normals])
    return points


def model_points(source: object) -> Float[np.ndarray, "n 3"]:
    """Points of a model, of whatever ``points_of`` takes but depth images; its origin is a point like any other.

    Raises ``ValueError`` as that does, and for points that are not finite.
    """
    if isinstance(source, DepthImage):
        raise ValueError("a depth image is no part of an object's files: carry points, a mesh or a file")
    if isinstance(source, PointCloud):
        return source.points
    with np.errstate(over="ignore", invalid="ignore"):
        points, name, _ = _positions(source)
        if not len(points) or not (np.abs(points) <= LARGEST).all():
            raise ValueError(
                f"{name} has no points, or some that are NaN, infinite or beyond {LARGEST:g}: correct them"
            )
    return points


def is_frame_list(source: object) -> bool:
    """Whether a list or tuple holds frames, and not the rows of one cloud.

    It does where at least one element cannot be a row of numbers, but is a frame: a path, what ``points_of`` takes, an
    array of two or more dimensions (of one, where it is structured), or a list or tuple of such rows. So ``[a, b]`` of
    two arrays n x 3 are two frames, ``[[x, y, z], [x, y, z]]`` is one cloud of two points, and ``[[[x, y, z]]]`` is one
    frame of one point. What is no list or tuple, an array among them, and what is empty is no list of frames.
    """
    return isinstance(source, list | tuple) and any(map(_is_frame, source))


def _is_frame(item: object) -> bool:
    if isinstance(item, list | tuple):
        return bool(item) and (isinstance(item[0], list | tuple) or getattr(item[0], "ndim", 0) > 0)
    if isinstance(item, str | PathLike | PointCloud | DepthImage):
        return True
    dimensions = getattr(item, "ndim", None)
    if isinstance(dimensions, int):
        return dimensions >= (1 if getattr(getattr(item, "dtype", None), "names", None) else 2)
    return _is_cloud_message(item) or _carried(item) is not None


def _positions(source: Any) -> tuple[Float[np.ndarray, "n 3"], str, bool]:
    """All points of a source, what to call it in sentences, and whether it is a grid of pixels."""
    kind = f"the {type(source).__name__}"
    if is_frame_list(source):
        raise ValueError(f"{kind} holds {counted(len(source), 'frame')}; one is needed: give its elements one by one")
    if _is_cloud_message(source):
        try:
            return cloud_points(source), "the PointCloud2 message", source.height > 1
        except Exception as error:  # whatever a broken message makes of the parser
            raise ValueError(
                f"the PointCloud2 message cannot be read ({reason(error)}): take another message"
            ) from error
    if not isinstance(source, np.ndarray | list | tuple):
        if hasattr(source, "columns"):
            raise ValueError(
                f"{kind} is a table, whose columns may come in any order; x, y and z are needed in this one: give "
                "table[['x', 'y', 'z']].to_numpy()"
            )
        carried = _carried(source)
        if carried is None and not any(hasattr(source, name) for name in ("__array__", "numpy")):
            raise ValueError(
                f"{kind} cannot be read as a frame; one of these is needed: an array, tensor or nested list of n x 3 "
                "numbers, an organized array of h x w x 3, a structured array with fields x, y and z, an object with "
                "points or vertices (Open3D, trimesh, PyVista), a PointCloud2 message, or a mereo.PointCloud or "
                "mereo.DepthImage"
            )
        source = source if carried is None else carried
    values = _array(source, kind)
    name = f"{kind} of shape {values.shape}"
    if values.dtype.names is not None:
        return _structured_points(values, name), name, values.ndim > 1
    check_real(values, name)
    if values.size == 0:
        return np.empty((0, 3)), name, False
    if wrong := _what_else(values):
        raise ValueError(f"{name} {wrong}")
    return _floats(values).reshape(-1, 3), name, values.ndim == 3


def _is_cloud_message(source: object) -> bool:
    fields = ("fields", "point_step", "row_step", "data", "is_bigendian", "width", "height")
    return all(hasattr(source, name) for name in fields)


def _carried(source: Any) -> Any:
    """Positions that an object carries, as Open3D, trimesh and PyVista call them; None where it has none."""
    if isinstance(source, type):  # the class, not one of its objects
        return None
    for name in ("point", "vertex"):  # Open3D's tensor geometries: a map from names to tensors
        try:
            return getattr(source, name)["positions"]
        except (AttributeError, LookupError, TypeError, RuntimeError):
            continue
    attributes = (getattr(source, name, None) for name in ("points", "vertices"))
    return next((values for values in attributes if values is not None and not callable(values)), None)


def _structured_points(records: np.ndarray, name: str) -> Float[np.ndarray, "n 3"]:
    fields = records.dtype.names or ()
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"{name} has the fields {listed(fields)}; x, y and z are needed: rename the fields")
    for axis in "xyz":
        what = f"the field {axis!r} of {name}"
        check_real(records[axis], what)
        if records[axis].shape != records.shape:
            raise ValueError(f"{what} holds several numbers; x, y and z are one each: name the fields of the positions")
    return np.stack([_floats(records[axis]).reshape(-1) for axis in "xyz"], axis=1)


def mask_image(mask: Any) -> Image.Image:
    """Image of a mask in memory: of truth values or whole numbers, as they are, or of a segmentation network's floats.

    Args:
        mask: an image of Pillow; or h x w numbers, or 1 x h x w, of whatever library. Floats with negative ones are
            logits, and show the object where they are positive; from 0 to 1 they are probabilities, and do from 0.5.

    Raises ``ValueError`` for several masks, other shapes, and floats that are neither.
    """
    if isinstance(mask, Image.Image):
        return mask
    values = _array(mask, f"the mask, a {type(mask).__name__},", "pixels are needed: give h x w truth values")
    name = f"the mask of shape {values.shape}"
    if values.dtype != np.bool_:
        check_real(values, name)
    while values.ndim > 2 and len(values) == 1:
        values = values[0]
    if values.ndim != 2 or not values.size:
        raise ValueError(
            f"{name} is not one mask of h x w pixels; of several one is needed: choose it, as masks[scores.argmax()]"
        )
    if values.dtype.kind != "f":
        return Image.fromarray(values if values.dtype in (np.bool_, np.uint8) else values.astype(np.int32))
    low, high = float(values.min()), float(values.max())
    if not (low < 0 or high <= 1):
        raise ValueError(
            f"{name} has floats from {low:g} to {high:g}; they must be logits, or probabilities from 0 to 1: give "
            "truth values, as mask > 127"
        )
    return Image.fromarray(values > 0 if low < 0 else values >= 0.5)


def _array(
    source: Any, kind: str, cure: str = "n x 3 numbers are needed: make it a numpy array of rows of x, y and z"
) -> np.ndarray:
    if isinstance(source, np.ma.MaskedArray):
        return source
    try:
        for step in ("detach", "cpu"):  # torch's tensors need both before numpy takes them, Open3D's the second
            source = getattr(source, step)() if hasattr(source, step) else source
        with suppress(TypeError):  # of bfloat16 and 8-bit floats, which numpy does not have
            return np.asarray(source.numpy() if hasattr(source, "numpy") else source)
        return np.asarray(source.double().numpy())
    except Exception as error:  # whatever the library says of values that it does not hand over
        ragged = isinstance(source, list | tuple) and isinstance(error, ValueError)
        why = "its rows differ in length" if ragged else reason(error)
        raise ValueError(f"{kind} is no array ({why}); {cure}") from error


def _floats(values: np.ndarray) -> Float[np.ndarray, "..."]:
    return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))


def _what_else(values: np.ndarray) -> str:
    """What numbers are instead of points, and what to do: the end of a sentence about them; empty for points."""
    if values.ndim in (2, 3):
        flat, rows, columns = values.ndim == 2, values.shape[0], values.shape[-1]
        if not flat and columns in (3, 4) and values.dtype == np.uint8:
            return "is a color image, which shows no positions; a depth image or cloud is needed: give one of these"
        if columns == 3:
            return ""
        wide = columns > 16  # more than a point's position, normal, colour and labels: a row of pixels
        if (wide and rows != 3) if flat else (columns == 1 or (wide and rows == 1)):
            return (
                "is an image of depths, which needs the camera's intrinsics: give intrinsics=, a mereo.Camera or a "
                "file of one, or mereo.DepthImage(depth, camera)"
            )
        if rows == 3:
            cure = "points.T" if flat else "np.moveaxis(points, 0, -1)"
            return f"has x, y and z on its first axis; they must be on the last: give {cure}"
    return (
        "is not a point cloud; that is n x 3, or h x w x 3 where it is organized: reshape or select its values, as "
        "points[..., :3]"
    )
