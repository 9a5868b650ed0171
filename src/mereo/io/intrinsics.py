"""Intrinsics of depth cameras as other programs write them: ROS, RealSense, Open3D, BOP, nerfstudio, 3DObjectTracking.

Three conventions differ between them and are settled here:

- Pixel centres: OpenCV, ROS, RealSense, Open3D and BOP put the centre of the first pixel at 0, we and nerfstudio put it
  at 0.5 (see ``mereo.geometry.camera``). 0.5 is therefore added to the principal point, unless the file is
  nerfstudio's or says ``"pixel_center": 0.5``.
- Depth scale: ours is **units per metre**, so metres = value / depth_scale (1000 for millimetres, 5000 for TUM). BOP's
  multiplies and gives millimetres (0.1, 1), RealSense's multiplies and gives metres (0.001, 0.00025). They are orders
  of magnitude apart, so the number itself tells which it is.
- Lens distortion: a pinhole camera has none. It is ignored with a warning that says how much it matters.
"""

import json
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mereo.geometry.camera import Camera, Size
from mereo.geometry.transforms import Values
from mereo.io.errors import AnyPath, readable, value_text

NAMED = (
    ("fx", "fy", "cx", "cy"),
    ("fx", "fy", "ppx", "ppy"),
    ("fl_x", "fl_y", "cx", "cy"),
    ("f_u", "f_v", "pp_x", "pp_y"),
)
"""Names of focal lengths and principal point: plain, RealSense, nerfstudio, 3DObjectTracking."""

MATRICES = ("intrinsic_matrix", "K", "k", "cam_K", "camera_matrix")
"""Names of camera matrices, 3 x 3 or 9 numbers, row by row or column by column."""

OFF_MIDDLE = 0.15
"""Distance of the principal point from the image's middle, in its sides, beyond which it is another image's."""

SIDES = (("width", "height"), ("image_width", "image_height"), ("w", "h"))
"""Names of the size in pixels."""

DISTORTION = ("D", "d", "distortion_coefficients", "coeffs", "distortion")
"""Names of distortion coefficients."""

MODELS = ("distortion_model", "camera_model", "model")
"""Names of the lens's model."""

NESTED = ("intrinsic", "intrinsics", "depth_intrinsics")
"""Names of the blocks in which files that hold more keep intrinsics."""

Fields = dict[str, Any]
"""Names and values of a file of intrinsics."""


class CameraWarning(UserWarning):
    """Warning that something about a camera is not used, so that what is measured with it may be off."""


@dataclass(frozen=True)
class Intrinsics:
    """Statements of a file about a depth camera: the pinhole, and the pixel value of one metre where it is stated."""

    camera: Camera
    depth_scale: float | None = None


def read_camera(path: AnyPath, size: Size | None = None) -> Camera:
    """Pinhole camera from a JSON or ROS YAML file, see ``read_intrinsics``."""
    return read_intrinsics(path, size).camera


def written_intrinsics(camera: Camera) -> dict[str, float]:
    """Content of a JSON file of intrinsics, as ``read_intrinsics`` reads them."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.focal_x_px,
        "fy": camera.focal_y_px,
        "cx": camera.center_x_px,
        "cy": camera.center_y_px,
        "pixel_center": 0.5,
    }


def stated_fields(source: Any) -> Fields:
    """Fields of intrinsics in memory: of a mapping, of a message or object of another library, or of numbers.

    Understood: names as of ``read_intrinsics``, as keys or as attributes (ROS ``CameraInfo``, Open3D's and RealSense's
    intrinsics); 3 x 3, 3 x 4 or 4 x 4 numbers; fx, fy, cx, cy. Raises ``ValueError`` for what is none of these.
    """
    known = (*MATRICES, *DISTORTION, *MODELS, *(name for names in (*NAMED, *SIDES) for name in names))
    if isinstance(source, Mapping):
        return _flat(dict(source))
    stated = {name: getattr(source, name) for name in known if getattr(source, name, None) is not None}
    if _states_a_camera(stated):
        return stated
    try:
        numbers = np.asarray(source, float)
        return {"K": numbers.tolist()} if numbers.shape == (3, 3) else _fields_of_numbers(numbers.ravel().tolist())
    except (TypeError, ValueError):
        raise ValueError(
            f"intrinsics is {value_text(source)}; it must be a camera: give 3 x 3 numbers, (fx, fy, cx, cy), a dict of "
            "these, a CameraInfo, a mereo.Camera, or the path of a file"
        ) from None


def intrinsics_of(source: Any, size: Size | None = None) -> Intrinsics:
    """Intrinsics of a camera, or of what ``stated_fields`` makes of one in memory; ``size`` as of ``read_intrinsics``.

    Raises ``ValueError`` for other fields, and for lens distortion: of a file it may be that of the colour image, of a
    camera in memory it would be a wrong result.
    """
    if isinstance(source, Camera):
        return Intrinsics(source)
    fields = stated_fields(source)
    try:
        intrinsics = Intrinsics(camera_from_fields(fields, size), _depth_scale(fields))
    except (TypeError, ValueError) as error:
        raise ValueError(f"intrinsics cannot be used: {error}; give 3 x 3 numbers, or these fields") from None
    if amount := _distortion(intrinsics.camera, fields):
        raise ValueError(
            f"the intrinsics state lens distortion ({amount}), and a depth image must have none: rectify it and give "
            "the camera of the rectified one (ROS: the matrix P), or set the coefficients to 0 where that is done"
        )
    return intrinsics


def read_intrinsics(
    path: AnyPath, size: Size | None = None, image: AnyPath | None = None, index: int | None = None
) -> Intrinsics:
    """Pinhole intrinsics, and the depth scale where it is stated, from JSON, ROS YAML or a text of numbers.

    Understood: the names in ``NAMED`` and ``MATRICES``, ROS CameraInfo as YAML or JSON, files of many frames (BOP's
    scene_camera.json, and transforms.json with intrinsics for each frame), and numbers alone: a matrix of 3 x 3
    (cam_K.txt), 3 x 4 or 4 x 4 in any number of rows, or fx fy cx cy, with distortion behind them (TUM).

    Args:
        path: the file.
        size: (width, height) in pixels where the file does not say.
        image: the depth image, whose name picks the frame of a file with many.
        index: or the frame itself: BOP's number, or the place in nerfstudio's list from 0.

    Raises ``FileNotFoundError`` or ``ValueError``. Warns with ``CameraWarning`` where it states lens distortion.
    """
    path = Path(path)
    with readable(path, "camera intrinsics file"):
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() == ".json":
            fields = json.loads(text)
        elif (numbers := _bare_numbers(text)) is not None:
            fields = _fields_of_numbers(numbers)
        else:  # the first document; OpenCV's header and type tags are not YAML to others
            plain = re.sub(r"^%YAML.*$|!!opencv-matrix", "", text, flags=re.MULTILINE)
            fields = next(iter(yaml.safe_load_all(plain.removeprefix("\n---"))), None)
        if not isinstance(fields, dict):
            raise ValueError("it is not an object with named fields")
        fields = _flat(_frame(fields, Path(image or "").stem, index))
        intrinsics = Intrinsics(camera_from_fields(fields, size), _depth_scale(fields))
        warn_of_distortion(intrinsics.camera, fields, str(path))
    camera = intrinsics.camera
    u, v, width, height = camera.center_x_px, camera.center_y_px, camera.width, camera.height
    if _names_of_sides(fields) is None and max(abs(u / width - 0.5), abs(v / height - 0.5)) > OFF_MIDDLE:
        raise ValueError(
            f"the principal point of {path} is in the middle of about {2 * u:.0f} x {2 * v:.0f} pixels, the image is "
            f"{width} x {height}; they must agree: give the intrinsics of this image, or state its width and height in "
            "JSON where it was cropped"
        )
    return intrinsics


def _flat(fields: Fields) -> Fields:
    """Fields with those of the blocks in ``NESTED`` among them."""
    for key in NESTED:
        fields = {**fields, **fields[key]} if isinstance(fields.get(key), dict) else fields
    return fields


def _names_of_sides(fields: Fields) -> tuple[str, str] | None:
    return next((names for names in SIDES if all(fields.get(name) is not None for name in names)), None)


def camera_from_fields(fields: Fields, size: Size | None = None) -> Camera:
    """Pinhole camera that these fields of a file state; ``size`` is (width, height) in pixels where they do not say.

    Raises ``ValueError`` that says which fields are missing.
    """
    focal_x, focal_y, center_x, center_y = _pinhole(fields)
    sides = _names_of_sides(fields)
    if sides is None and size is None:
        raise ValueError("it has no width and height")
    width, height = size if sides is None else [int(fields[name]) for name in sides]  # type: ignore[misc]
    shift = 0.5 - float(fields.get("pixel_center", 0.5 if "fl_x" in fields else 0.0))
    return Camera(width, height, focal_x, focal_y, center_x + shift, center_y + shift)


def _bare_numbers(text: str) -> list[float] | None:
    """Numbers of a text that holds nothing else but comments; None of others."""
    try:
        return [float(word) for word in re.split(r"[\s,;\[\]]+", re.sub(r"#.*", "", text)) if word]
    except ValueError:
        return None


def _fields_of_numbers(numbers: list[float]) -> Fields:
    """Fields that numbers alone state; raises ``ValueError`` (its reason only) for other counts of them."""
    count = len(numbers)
    if count in (12, 16) or (count == 9 and 0 in (numbers[1], numbers[3])):
        return {"K": np.reshape(numbers, (3, 3) if count == 9 else (-1, 4))[:3, :3]}
    if count in (4, 8, 9):
        return dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=False)) | {"D": numbers[4:]}
    raise ValueError(
        f"it has {count} numbers, not a matrix of 3 x 3, 3 x 4 or 4 x 4, nor fx fy cx cy with 4 or 5 of distortion"
    )


def _frame(fields: Fields, stem: str, index: int | None) -> Fields:
    """Fields of one frame; ``fields`` itself where it describes one camera."""
    frames = fields.get("frames")
    chosen = index
    if _states_a_camera(fields):
        return fields
    if isinstance(frames, list) and any(map(_states_a_camera, frames)):
        numbered = {number: {**fields, **frame} for number, frame in enumerate(frames)}
        names = [Path(str(f.get("depth_file_path", f.get("file_path", "")))).stem for f in frames]
        if index is None and stem in names:
            chosen = names.index(stem)
    elif fields and all(key.isdecimal() for key in fields) and all(map(_states_a_camera, fields.values())):
        numbered = {int(key): value for key, value in fields.items()}
        if index is None and (digits := re.search(r"\d+$", stem)):
            chosen = int(digits.group())
    else:
        return fields
    if chosen is None and len(numbered) == 1:
        chosen = min(numbered)
    if chosen not in numbered:
        wanted = "no frame is named" if chosen is None else f"frame {chosen} is not there"
        raise ValueError(
            f"it has {len(numbered)} frames from {min(numbered)} to {max(numbered)} and {wanted}; give one with "
            "--frame-index"
        )
    return numbered[chosen]


def _states_a_camera(fields: object) -> bool:
    return isinstance(fields, dict) and (
        any(all(name in fields for name in names) for names in NAMED)
        or any(key in fields for key in MATRICES)
        or any(isinstance(fields.get(key), dict) for key in NESTED)
    )


def _pinhole(fields: Fields) -> tuple[float, float, float, float]:
    for names in NAMED:
        if all(name in fields for name in names):
            focal_x, focal_y, center_x, center_y = (float(fields[name]) for name in names)
            return focal_x, focal_y, center_x, center_y
    key = next((key for key in MATRICES if fields.get(key) is not None), None)
    if key is None:
        raise ValueError("it has neither fx, fy, cx, cy nor intrinsic_matrix, K, cam_K or camera_matrix")
    values = fields[key]
    matrix = np.asarray(values["data"] if isinstance(values, dict) else values, float)
    if matrix.size != 9:
        raise ValueError(f"its matrix has {matrix.size} numbers instead of 9")
    matrix = matrix.reshape(3, 3)
    if matrix.T[2].tolist() == [0, 0, 1] != matrix[2].tolist():  # Open3D and Record3D go column by column
        matrix = matrix.T
    if matrix[2, 2] != 1 or np.any(matrix[2, :2]):
        raise ValueError(f"the last row of its matrix is {matrix[2].tolist()} instead of 0, 0, 1")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _depth_scale(fields: Fields) -> float | None:
    """Pixel value of one metre, whatever the file means by its number (the module's note)."""
    if "depth_units" in fields:  # RealSense's option: metres of one unit
        value = float(fields["depth_units"])
        per_metre = 1.0
    elif "depth_scale" in fields:
        value = float(fields["depth_scale"])
        if value >= 100:
            return value
        per_metre = 1.0 if value < 0.01 else 1000.0
    else:
        return None
    if not 0 < value <= 10:
        raise ValueError(
            f"its depth scale is {value:g}; units per metre (1000), metres per unit (0.001) or BOP's millimetres per "
            "unit (0.1) are known; correct it there"
        )
    return per_metre / value


def warn_of_distortion(camera: Camera, fields: Fields, source: str) -> None:
    """Warn with one ``CameraWarning`` where coefficients are not zero: the image is taken as rectified."""
    if not (amount := _distortion(camera, fields)):
        return
    warnings.warn(
        f"{source} states lens distortion ({amount}), which is ignored: rectify the depth image and give the "
        "intrinsics of the rectified one (ROS: the matrix P), or set the coefficients to 0 where that is done already",
        CameraWarning,
        stacklevel=4,
    )


def _distortion(camera: Camera, fields: Fields) -> str:
    """Phrase on how far a lens bends the image; empty where it does not."""
    coefficients, model = _coefficients(fields)
    if not coefficients.any():
        return ""
    fisheye = any(word in model.lower() for word in ("fisheye", "equidistant", "kannala"))
    return "a fisheye lens" if fisheye else f"up to {_shift_px(camera, coefficients):.2g} pixels in the corners"


def _coefficients(fields: Fields) -> tuple[Values, str]:
    """Distortion coefficients k1, k2, p1, p2, k3 ... as OpenCV orders them, and the model's name."""
    model = next((str(fields[name]) for name in MODELS if name in fields), "")
    for key in DISTORTION:
        values = fields.get(key)
        values = values.get("data") if isinstance(values, dict) else values
        if values is not None and not isinstance(values, str) and np.size(values):
            return np.asarray(values, float).reshape(-1), model
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return np.array([float(fields.get(name, 0.0)) for name in names]), model


def _shift_px(camera: Camera, coefficients: Values) -> float:
    """Pixels by which the lens moves the farthest corner (OpenCV's Brown-Conrady or rational model)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(coefficients[:8], (0, 8 - len(coefficients[:8])))
    u, v = np.array([0, camera.width] * 2), np.array([0, 0, camera.height, camera.height])
    x, y = (u - camera.center_x_px) / camera.focal_x_px, (v - camera.center_y_px) / camera.focal_y_px
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    moved_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    moved_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return float(np.hypot(camera.focal_x_px * (moved_x - x), camera.focal_y_px * (moved_y - y)).max())
