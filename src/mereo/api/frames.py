"""Frames from whatever holds one: a file, a shipped name, arrays, and the clouds and messages of other libraries.

source -load_frame-> SensorFrame
"""

from pathlib import Path

import numpy as np
from jaxtyping import Num

from mereo.api.words import python_words
from mereo.evaluation.sample_views import shipped_frame, shipped_frames
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import CloudAxes
from mereo.io.config import InputConfig
from mereo.io.intrinsics import read_intrinsics
from mereo.io.point_arrays import points_of
from mereo.io.readers import depth_of, usable_depth
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction.observation import CLOUD

DEPTH = Path("depth image")
"""Name of a depth image that comes from no file."""


@python_words()
def load_frame(
    source: object,
    *,
    axes: CloudAxes | None = None,
    unit_m: float | None = None,
    intrinsics: Camera | str | Path | None = None,
    depth_scale: float | None = None,
    mask: str | Path | None = None,
    drop_invalid: bool = False,
    topic: str | None = None,
    frame_index: int | None = None,
) -> SensorFrame:
    """Load one frame of a depth camera or scanner.

    Args:
        source: a file (depth image, point cloud, ROS recording) or the name of a shipped frame (``shipped_frames``);
            or points as n x 3 numbers, as a cloud of Open3D or trimesh, as a structured array or a ROS ``PointCloud2``;
            or a depth image, as ``DepthImage`` or as an array of h x w pixels with ``intrinsics``.
        axes: of points: "camera" (default) is x right, y down, z forward; "scanner" is y up, z toward the scanner.
        unit_m: metres per unit of points: 0.001 for millimetres; without it the fit finds the unit.
        intrinsics: of a depth image: a camera, or a file of one.
        depth_scale: stored values per metre: 1000 for millimetres.
        mask: file of an image that is not 0 where the object is.
        drop_invalid: leave out points without a measurement, which are refused otherwise.
        topic: of a recording.
        frame_index: of a recording's frames, or of an entry of the intrinsics.

    Raises ``FileNotFoundError`` where there is no such file or name; ``ValueError`` for what is damaged or no frame,
    and for options that do not belong to this kind of frame.
    """
    if isinstance(source, str | Path):
        given = (axes, unit_m, intrinsics, depth_scale, mask, topic, frame_index)
        path = Path(source)
        if str(source) in shipped_frames() and not (path.is_file() or is_recording(path)):
            if any(value is not None for value in given):
                raise ValueError(f"the shipped frame {str(source)!r} is in metres and needs no options: leave them out")
            return shipped_frame(str(source))
        if not path.exists() and path.suffix == "":
            known = ", ".join(shipped_frames())
            raise FileNotFoundError(f"there is no frame {str(source)!r}; give a file or one of the shipped: {known}")
        if isinstance(intrinsics, Camera):
            raise ValueError(f"{source} is a file; its intrinsics are read from one as well: give the path of that")
        return read_frame(
            source,
            InputConfig(
                intrinsics=None if intrinsics is None else Path(intrinsics),
                depth_scale=depth_scale,
                mask=None if mask is None else Path(mask),
                frame=axes or "camera",
                unit_m=unit_m,
                drop_invalid=drop_invalid,
                topic=topic,
                frame_index=frame_index,
            ),
        )
    for name, value in (("mask", mask), ("topic", topic), ("frame_index", frame_index)):
        if value is not None and not (name == "mask" and intrinsics is not None):
            raise ValueError(f"{name} is given for a frame that is no file's: leave it out, or name the file")
    if intrinsics is not None:
        if axes == "scanner" or unit_m is not None:
            raise ValueError("a depth image is in metres and in the camera's axes: leave out axes and unit_m")
        return _depth_frame(np.asarray(source), intrinsics, depth_scale, mask)
    if depth_scale is not None:
        raise ValueError("depth_scale is given without intrinsics; a depth image needs both: give intrinsics=...")
    if unit_m is not None and not 0 < unit_m < np.inf:
        raise ValueError(f"the unit is {unit_m} m; it must be positive: give 0.001 for millimetres")
    observed, invalid = points_of(source, drop_invalid)
    if isinstance(observed, DepthImage):
        if axes == "scanner":
            raise ValueError("a depth image is in the camera's axes: leave out axes")
        return SensorFrame(CLOUD, observed.to_points(), unit_m, "camera", observed, whole=observed)
    return SensorFrame(CLOUD, observed, unit_m, axes or "camera", invalid=invalid)


def _depth_frame(
    raw: Num[np.ndarray, "h w"], intrinsics: Camera | str | Path, depth_scale: float | None, mask: str | Path | None
) -> SensorFrame:
    """Frame of a depth image that is an array of stored values."""
    if raw.ndim != 2:
        raise ValueError(f"the depth image has the shape {raw.shape}; it must be rows of pixels: give h x w values")
    camera, stated = intrinsics, None
    if not isinstance(camera, Camera):
        found = read_intrinsics(camera, (raw.shape[1], raw.shape[0]))
        camera, stated = found.camera, None if raw.dtype.kind == "f" else found.depth_scale
    image = depth_of(DEPTH, raw, stated if depth_scale is None else depth_scale, camera)
    usable = usable_depth(image, DEPTH, mask)
    return SensorFrame(DEPTH, usable.to_points(), 1.0, "camera", usable, whole=image)
