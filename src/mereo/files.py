"""Readers: point clouds, depth images, masks, intrinsics and segmented meshes from files.

Every reader raises ``FileNotFoundError`` or a ``ValueError`` of one sentence (value, rule, cure), whatever the parsing
library raised. Nothing is repaired silently: missing points are refused unless the caller asks to drop them.

Two conventions differ between programs and are settled here:

- Depth scale: ours is **units per metre**, so metres = value / depth_scale (1000 for millimetres, 5000 for TUM). BOP's
  ``depth_scale`` multiplies and gives millimetres; pass 1000 / that number.
- Pixel centres: OpenCV, ROS, RealSense and Open3D put the centre of the first pixel at 0, we put it at 0.5 (see
  ``mereo.camera``). 0.5 is therefore added to the principal point, unless the file says ``"pixel_center": 0.5``.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from mereo.camera import Camera, DepthImage, PointCloud
from mereo.mesh_files import read_segmented_mesh, readable
from mereo.point_formats import CLOUD_READERS

__all__ = ["read_camera", "read_depth_image", "read_mask", "read_point_cloud", "read_segmented_mesh"]

PLAUSIBLE_DEPTH_M = (0.05, 20.0)


# --- point clouds ----------------------------------------------------------------------------------------------------


def read_point_cloud(path: str | Path, drop_invalid: bool = False) -> PointCloud:
    """The points of a PLY, PCD, XYZ/TXT/PTS/ASC/CSV, NPY or NPZ file, in the file's units and frame.

    Args:
        path: the file; its suffix names the format. Arrays are [n, 3] or organized [h, w, 3]; text has x, y, z in its
            first three columns or in the columns its header calls x, y, z; NPZ holds ``points`` or one such array.
        drop_invalid: leave out points that are NaN or infinite, and points at exactly (0, 0, 0): sensors mark missing
            measurements with either.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is of another format, empty, truncated or not numeric, or has invalid points and
            ``drop_invalid`` is false.
    """
    path = Path(path)
    reader = CLOUD_READERS.get(path.suffix.lower())
    if reader is None and path.exists():
        known = ", ".join(CLOUD_READERS)
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; a point cloud is one of {known}: convert or rename it"
        )
    with readable(path, "point cloud"):
        assert reader is not None
        points = np.asarray(reader(path), dtype=np.float64).reshape(-1, 3)
    return PointCloud(_valid_points(points, path, drop_invalid))


def _valid_points(points: Float[np.ndarray, "n 3"], path: Path, drop_invalid: bool) -> Float[np.ndarray, "m 3"]:
    if len(points) == 0:
        raise ValueError(f"{path} holds 0 points; the object must be visible: check the export")
    finite = np.isfinite(points).all(axis=1)
    usable = finite & (points != 0).any(axis=1)
    lost = len(points) - int(usable.sum())
    if lost == len(points):
        raise ValueError(
            f"all {lost} points of {path} are NaN, infinite or zero; the object must be visible: record it again"
        )
    if lost and not drop_invalid:
        kind = "NaN or infinite" if not finite.all() else "exactly (0, 0, 0)"
        raise ValueError(
            f"{path} has {lost} of {len(points)} points without a measurement ({kind}); all must be finite positions: "
            "leave them out with --drop-invalid"
        )
    return points[usable]


# --- depth images and intrinsics -------------------------------------------------------------------------------------


def read_depth_image(
    path: str | Path,
    camera: Camera,
    depth_scale: float = 1000.0,
    mask_path: str | Path | None = None,
    plausible_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> DepthImage:
    """A 16-bit grey PNG as depth in metres; 0 where nothing was measured or the mask is 0.

    Args:
        path: the image; 0 means no measurement.
        camera: intrinsics of the same size, see ``read_camera``.
        depth_scale: pixel value of one metre, so that metres = value / depth_scale (the module's note on BOP).
        mask_path: image of the same size, not 0 on the object.
        plausible_m: the median depth must lie in this range, because a wrong unit is otherwise invisible.

    Raises:
        FileNotFoundError, ValueError: the file is missing, damaged, not 16-bit grey, of another size, without any
            measured pixel, or its median depth is not plausible.
    """
    path = Path(path)
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(
            f"the depth scale is {depth_scale}; it must be positive, in units per metre: 1000 for millimetres"
        )
    with readable(path, "depth image"), Image.open(path) as image:
        if image.format != "PNG" or image.mode not in ("I;16", "I;16B", "I"):
            raise ValueError(f"it is {image.format} of mode {image.mode}, not a 16-bit grey PNG")
        depth = np.asarray(image).astype(np.float64) / depth_scale
    measured = DepthImage(depth, camera)
    if mask_path is not None:
        depth = np.where(read_mask(mask_path, (camera.width, camera.height)), depth, 0.0)
    if not (depth > 0).any():
        where = "inside the mask" if measured.valid.any() else "in the image"
        raise ValueError(f"{path} measures 0 pixels {where}; the object must be visible: check the image and the mask")
    median_m = float(np.median(depth[depth > 0]))
    if not plausible_m[0] <= median_m <= plausible_m[1]:
        raise ValueError(
            f"the median depth of {path} is {median_m:.4g} m; it must be between {plausible_m[0]:g} and "
            f"{plausible_m[1]:g} m: give the pixel value of one metre with --depth-scale (1000 for millimetres)"
        )
    return DepthImage(depth, camera)


def read_mask(path: str | Path, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """An image's pixels that are not 0 (in any channel but alpha); ``size`` is the expected (width, height)."""
    path = Path(path)
    with readable(path, "mask image"), Image.open(path) as image:
        # a 1-bit or palette image is taken by what it shows, anything else by its stored values
        pixels = np.asarray(image.convert("RGB") if image.mode in ("1", "P", "RGBA", "LA", "CMYK") else image)
    mask = np.asarray(pixels.reshape(*pixels.shape[:2], -1).any(axis=-1))
    if size is not None and mask.shape != (size[1], size[0]):
        raise ValueError(
            f"the mask {path} is {mask.shape[1]} x {mask.shape[0]} pixels but the depth image is "
            f"{size[0]} x {size[1]}; they must agree: export the mask at the depth image's size"
        )
    return mask


def read_camera(path: str | Path, size: tuple[int, int] | None = None) -> Camera:
    """Pinhole intrinsics from JSON or ROS YAML; lens distortion is ignored, so the image must be rectified.

    Understood: ``fx fy cx cy`` (also ``ppx ppy``), Open3D's column-major ``intrinsic_matrix``, ``K`` or ``k`` as 3 x 3
    or 9 numbers row by row (ROS CameraInfo), ``camera_matrix`` with ``data`` (ROS calibrator); ``width`` and
    ``height`` or ``image_width`` and ``image_height``.

    Args:
        path: the file.
        size: (width, height) in pixels where the file does not say.
    """
    path = Path(path)
    with readable(path, "camera intrinsics file"):
        text = path.read_text(encoding="utf-8-sig")
        fields = json.loads(text) if path.suffix.lower() == ".json" else _yaml_fields(text)
        if not isinstance(fields, dict):
            raise ValueError("it is not an object with named fields")
        focal_x, focal_y, center_x, center_y = _intrinsics(fields)
        width, height = _image_size(fields, size)
        shift = 0.5 - float(fields.get("pixel_center", 0.0))
    return Camera(width, height, focal_x, focal_y, center_x + shift, center_y + shift)


def _intrinsics(fields: dict[str, Any]) -> tuple[float, float, float, float]:
    for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):
        if all(name in fields for name in names):
            fx, fy, cx, cy = (float(fields[name]) for name in names)
            return fx, fy, cx, cy
    column_major = "intrinsic_matrix" in fields
    values = fields.get("intrinsic_matrix", fields.get("K", fields.get("k", fields.get("camera_matrix"))))
    if values is None:
        raise ValueError("it has neither fx, fy, cx, cy nor intrinsic_matrix, K or camera_matrix")
    matrix = np.asarray(values["data"] if isinstance(values, dict) else values, dtype=np.float64)
    if matrix.size != 9:
        raise ValueError(f"its matrix has {matrix.size} numbers instead of 9")
    matrix = matrix.reshape(3, 3).T if column_major and matrix.ndim == 1 else matrix.reshape(3, 3)
    if matrix[2, 2] != 1 or np.any(matrix[2, :2]):
        raise ValueError(f"the last row of its matrix is {matrix[2].tolist()} instead of 0, 0, 1")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _image_size(fields: dict[str, Any], size: tuple[int, int] | None) -> tuple[int, int]:
    width, height = (fields.get(name, fields.get(f"image_{name}")) for name in ("width", "height"))
    if width is not None and height is not None:
        return int(width), int(height)
    if size is None:
        raise ValueError("it has no width and height")
    return size


def _yaml_fields(text: str) -> dict[str, Any]:
    """The few fields of ROS's YAML that matter, without a YAML library."""
    text = re.sub(r"\n\s*-\s+", ", ", text.split("\n---")[0].replace("\r", ""))
    number = r"[-+.\d][-+.\deE]*"
    fields: dict[str, Any] = {}
    for key, value in re.findall(rf"^\s*(\w+):\s*({number})\s*$", text, re.MULTILINE):
        fields.setdefault(key, float(value))
    lists = r"(?:^|\n)\s*(K|k|camera_matrix)\s*:(?:\s*\n(?:\s*(?:rows|cols)\s*:.*\n)+\s*data\s*:)?[\s\[,]*"
    for key, values in re.findall(rf"{lists}((?:{number}[\s,]*){{9}})", text):
        fields.setdefault(key, [float(value) for value in re.findall(number, values)])
    return fields
