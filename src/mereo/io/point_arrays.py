"""Frames and meshes that are already in memory: what other libraries call a point cloud, as mereo's own types.

    anything -points_of-> PointCloud (or the DepthImage that it was), number of points left out
    meshes, by names or not -mesh_of-> SegmentedMesh

Libraries are recognized by what their objects have, so that none of them is imported. What could be meant in two ways
is refused: an image of depths has no positions without its camera, and the columns of a table name no axes.
"""

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num
from numpy import ndarray
from numpy.linalg import norm
from PIL import Image

from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.conventions import LARGEST, check_real
from mereo.geometry.mesh import Faces, Segment, SegmentedMesh, Vertices, check_segment, palette_color
from mereo.geometry.transforms import Points, Rows
from mereo.io.errors import reason
from mereo.io.readers import InputWarning, valid_points
from mereo.io.ros_recordings import cloud_points, depth_pixels

FACES = ("regular_faces", "faces", "triangles")
"""Attributes with the triangles of a mesh: PyVista's, whose ``faces`` are of another form, trimesh's and Open3D's."""


def points_of(source: object, drop_invalid: bool = False) -> tuple[PointCloud | DepthImage, int]:
    """Observed points of whatever holds a frame in memory, and how many points were left out.

    A ``PointCloud`` and a ``DepthImage`` are returned as they are. Everything else becomes a new ``PointCloud`` of
    64-bit floats in the source's order, axes and unit; grids are flattened row by row:

    - arrays n x 3 or h x w x 3 of integers or floats: numpy's, torch's of any device, and whatever else converts
      itself into a numpy array; masked values are points without a measurement. Of six columns the last three are unit
      normals, which are used, or colours from 0 to 1 or 255, which are left out; an ``InputWarning`` says which;
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
        points, normals, name, organized = _positions(source)
        cure = "leave them out with drop_invalid=True"
        if organized:
            cure = "organized clouds mark pixels without a measurement so, and drop_invalid=True leaves them out"
        rows = _with_normals(points, source) if normals is None else np.hstack([points, normals])
        kept = valid_points(rows, name, drop_invalid, cure)
    return PointCloud.of(kept), len(points) - len(kept)


def _with_normals(points: Points, source: Any) -> Rows:
    """Points, with the normals that an object of Open3D or trimesh has for each of them, if it has."""
    for name in ("normals", "vertex_normals"):
        with suppress(Exception):  # of what else has such a name
            normals = np.asarray(getattr(source, name), float)
            if normals.shape == points.shape and np.isfinite(normals).all():
                return np.hstack([points, normals])
    return points


def model_points(source: object) -> Points:
    """Points of a model, of whatever ``points_of`` takes but depth images; its origin is a point like any other.

    Raises ``ValueError`` as that does, and for points that are not finite.
    """
    if isinstance(source, DepthImage):
        raise ValueError("a depth image is no part of an object's files: carry points, a mesh or a file")
    if isinstance(source, PointCloud):
        return source.points
    with np.errstate(over="ignore", invalid="ignore"):
        points, _, name, _ = _positions(source)
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


def _positions(source: Any) -> tuple[Points, Points | None, str, bool]:
    """All points of a source, normals in its rows, what to call it in sentences, and whether it is a grid of pixels."""
    kind = f"the {type(source).__name__}"
    if is_frame_list(source):
        raise ValueError(f"{kind} holds {counted(len(source), 'frame')}; one is needed: give its elements one by one")
    if _is_cloud_message(source):
        return _decoded(cloud_points, source, "PointCloud2"), None, "the PointCloud2 message", source.height > 1
    if not isinstance(source, ndarray | list | tuple):
        if hasattr(source, "columns"):
            raise ValueError(
                f"{kind} is a table, whose columns may come in any order; x, y and z are needed in this one: give "
                "table[['x', 'y', 'z']].to_numpy()"
            )
        carried = _carried(source)
        if carried is None and not any(hasattr(source, name) for name in ("__array__", "numpy")):
            raise ValueError(
                f"{kind} cannot be read as points; one of these is needed: an array, tensor or nested list of n x 3 "
                "numbers, an organized array of h x w x 3, a structured array with fields x, y and z, an object with "
                "points or vertices (Open3D, trimesh, PyVista), a PointCloud2 message, or a mereo.PointCloud or "
                "mereo.DepthImage"
            )
        source = source if carried is None else carried
    values = _array(source, kind)
    name = f"{kind} of shape {values.shape}"
    if values.dtype.names is not None:
        return _structured_points(values, name), None, name, values.ndim > 1
    check_real(values, name)
    if values.size == 0:
        return np.empty((0, 3)), None, name, False
    normals = None
    if values.ndim in (2, 3) and values.shape[-1] == 6:
        normals = _normals(_floats(values[..., 3:]).reshape(-1, 3), name)
        values = values[..., :3]
    if wrong := _what_else(values):
        raise ValueError(f"{name} {wrong}")
    return _floats(values).reshape(-1, 3), normals, name, values.ndim == 3


def _normals(columns: Points, name: str) -> Points | None:
    """Normals that three more columns of points are; None of colours. Rows that are not finite or 0 say nothing."""
    known = columns[np.isfinite(columns).all(axis=1) & columns.any(axis=1)]
    least = known.min(initial=0)
    most = known.max(initial=0)
    are_normals = least < 0 and (np.abs(norm(known, axis=1) - 1) < 0.01).all()
    if (least < 0 and not are_normals) or most > 255 or (most > 1 and (known != np.rint(known)).any()):
        raise ValueError(
            f"{name} has six columns, of which the last three are neither unit normals nor colours from 0 to 1 or 255: "
            "give the positions alone, as points[:, :3]"
        )
    meant = "normals, which are used" if are_normals else "colours, which are left out"
    warnings.warn(f"the last three columns of {name} are {meant}", InputWarning, stacklevel=7)
    return columns if are_normals else None


def _decoded(decode: Callable[[Any], ndarray], message: Any, kind: str) -> ndarray:
    try:
        return decode(message)
    except Exception as error:  # whatever a broken message makes of the parser
        raise ValueError(f"the {kind} message cannot be read ({reason(error)}): take another message") from error


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


def _structured_points(records: ndarray, name: str) -> Points:
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
    values = values.squeeze() if values.ndim > 2 else values  # of networks
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


def depth_values(source: Any) -> Num[ndarray, "h w"]:
    """Stored values of a depth image in memory, as they are.

    Args:
        source: h x w numbers, 1 x h x w or h x w x 1, of whatever library; an image of Pillow or Open3D, or the
            ``depth`` of an RGB-D image; masked values are pixels without a measurement; a message
            of the type sensor_msgs/Image.

    Raises ``ValueError`` for what is none of these, and for other shapes.
    """
    if all(hasattr(source, name) for name in ("encoding", "step", "data", "height", "width")):
        return _decoded(depth_pixels, source, "Image")
    source = getattr(source, "depth", source)
    kind = f"the depth image, a {type(source).__name__},"
    raw = np.ma.filled(_array(source, kind, "pixels are needed: give h x w values"), 0)
    check_real(raw, "the depth image")
    values = raw.squeeze() if raw.ndim > 2 else raw  # of networks
    if values.ndim != 2:
        raise ValueError(f"the depth image has the shape {raw.shape}; it must be rows of pixels: give h x w values")
    return values


# --- meshes -----------------------------------------------------------------------------------------------------------


def mesh_of(source: Any) -> SegmentedMesh | None:
    """Mesh of whatever holds the parts of an object in memory; None of what holds none.

    Args:
        source: a ``SegmentedMesh``; a mapping of names to parts, or a scene of trimesh; a list of parts, or one alone.
            A part is a ``Segment``, an object with vertices and faces (trimesh, Open3D, PyVista), or a tuple (vertices,
            faces). Parts without a name are called part1, part2, ...

    Raises ``ValueError`` for a mapping or list of which not all are parts, for no faces and others than triangles.
    """
    if isinstance(source, SegmentedMesh):
        return source
    named = parts_of_scene(source)
    if not (is_named := isinstance(named, Mapping)):
        is_list = isinstance(source, list | tuple) and _triangles(source) is None
        named = dict(enumerate(source if is_list else [source]))
        if _triangles(named.get(0)) is None:
            return None
    segments = list[Segment]()
    for index, (key, part) in enumerate(named.items()):
        if (mesh := _triangles(part)) is None:
            raise ValueError(f"the part {key!r} of the object is no mesh, as all must be: give its vertices and faces")
        known = getattr(part, "metadata", None) or {}
        file = known.get("file_name") or f"part{index + 1}"
        name = str(key) if is_named else getattr(part, "name", None) or known.get("name") or Path(file).stem
        color = getattr(part, "color", palette_color(index))
        check_segment(open_segment := Segment(name, color, *mesh, solid=False))
        segments.append(replace(open_segment, solid=getattr(part, "solid", False)))
    return SegmentedMesh(tuple(segments)) if segments else None


def parts_of_scene(source: Any) -> Any:
    """Meshes of a scene of trimesh, where they are in it, by the names of its nodes; anything else as it is."""
    if not (hasattr(source, "geometry") and hasattr(source, "dump")):
        return source
    return {mesh.metadata["node"]: mesh for mesh in source.dump()}


def _triangles(source: Any) -> tuple[Vertices, Faces] | None:
    """Vertices and faces of a mesh of whatever library, or of a tuple of both; None of what is none."""
    faces: Any = None
    if isinstance(source, tuple) and len(source) == 2 and np.ndim(source[0]) == 2:
        vertices, faces = source
    elif (vertices := _carried(source)) is not None:
        faces = next((each for key in FACES if (each := getattr(source, key, None)) is not None), None)
        if faces is None and hasattr(source, "triangle"):  # Open3D's tensor meshes
            faces = source.triangle["indices"]
    if faces is None:
        return None
    points, corners = _array(vertices, "the vertices of the mesh"), _array(faces, "the faces of the mesh")
    if points.shape[1:] != (3,) or corners.shape[1:] != (3,) or corners.dtype.kind not in "iu":
        raise ValueError(
            f"the mesh has vertices of shape {points.shape} and faces of {corners.shape}; they must be "
            "v x 3 numbers and f x 3 whole ones: split its faces into triangles"
        )
    return points.astype(float), corners.astype(np.int64)


# --- arrays of other libraries ----------------------------------------------------------------------------------------


def _array(
    source: Any, kind: str, cure: str = "n x 3 numbers are needed: make it a numpy array of rows of x, y and z"
) -> ndarray:
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


def _floats(values: ndarray) -> Float[ndarray, "..."]:
    return np.asarray(np.ma.filled(values.astype(float), np.nan))


def _what_else(values: ndarray) -> str:
    """What numbers are instead of points, and what to do: the end of a sentence about them; empty for points."""
    if values.ndim in (2, 3):
        flat = values.ndim == 2
        rows = values.shape[0]
        columns = values.shape[-1]
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
