"""Readers of point clouds, depth images and masks; ``mereo.io.sensor_frame`` reads whichever a file holds.

Every reader raises ``FileNotFoundError`` or a ``ValueError`` of one sentence (value, rule, cure), whatever the parsing
library raised. Nothing is repaired silently: missing points are refused unless the caller asks to drop them. Depth
scales and pixel centres are explained in ``mereo.io.intrinsics``.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mereo.geometry.camera import Camera, DepthImage, PointCloud
from mereo.geometry.conventions import LARGEST
from mereo.io.depth_formats import DEPTH_READERS, Raw, metres, open_image, read_raw_depth
from mereo.io.errors import limited_memory, readable
from mereo.io.point_cloud_formats import CLOUD_READERS

PLAUSIBLE_DEPTH_M = (0.05, 20.0)
"""Range of an image's median depth, unless the caller says otherwise; beyond it the unit is wrong."""


# --- point clouds ----------------------------------------------------------------------------------------------------


def read_point_cloud(path: str | Path, drop_invalid: bool = False) -> PointCloud:
    """Points of a PLY, PCD, XYZ/TXT/PTS/ASC/CSV, NPY, NPZ or ZDF file, in the file's units and frame.

    Args:
        path: the file; its suffix names the format. Arrays are [n, 3] or organized [h, w, 3]; text has x, y, z in its
            first three columns or in the columns its header calls x, y, z; NPZ holds ``points`` or one such array; ZDF
            is Zivid's, in millimetres.
        drop_invalid: leave out points that are NaN, infinite or beyond 1e12, and points at exactly (0, 0, 0): sensors
            mark missing measurements so.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is of another format, empty, truncated or not numeric, or has invalid points and
            ``drop_invalid`` is false.
        ImportError: a ZDF file, without the extra `sensors`.
    """
    return PointCloud(valid_points(read_points(path), path, drop_invalid))


def read_points(path: str | Path) -> Float[np.ndarray, "n 3"]:
    """Points of a file as ``read_point_cloud`` reads them, those without a measurement included."""
    path = Path(path)
    reader = CLOUD_READERS.get(path.suffix.lower())
    if reader is None and path.exists():
        known = ", ".join(CLOUD_READERS)
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; a point cloud is one of {known}: convert or rename it"
        )
    with readable(path, "point cloud"):
        assert reader is not None
        return np.asarray(reader(path), dtype=np.float64).reshape(-1, 3)


def valid_points(
    points: Float[np.ndarray, "n 3"],
    path: str | Path,
    drop_invalid: bool,
    cure: str = "leave them out with --drop-invalid",
) -> Float[np.ndarray, "m 3"]:
    """Points that are measurements, as a copy. Raises as ``read_point_cloud`` does.

    Args:
        points: any unit.
        path: where they come from, for the sentences.
        drop_invalid: leave the others out.
        cure: what to do where they are not to be left out, for the end of that sentence.
    """
    if len(points) == 0:
        raise ValueError(f"{path} holds 0 points; the object must be visible: check where they come from")
    finite = (np.abs(points) <= LARGEST).all(axis=1)
    usable = finite & (points != 0).any(axis=1)
    lost = len(points) - int(usable.sum())
    if lost == len(points):
        raise ValueError(
            f"all {lost} points of {path} are NaN, infinite, zero or beyond {LARGEST:g}; the object must be visible: "
            "record it again"
        )
    if lost and not drop_invalid:
        beyond = f"beyond {LARGEST:g}" if np.isfinite(points).all() else "NaN or infinite"
        kind = "exactly (0, 0, 0)" if finite.all() else beyond
        raise ValueError(
            f"{path} has {lost} of {len(points)} points without a measurement ({kind}); all must be finite positions: "
            f"{cure}"
        )
    return points[usable]


# --- depth images ----------------------------------------------------------------------------------------------------


def read_depth_image(
    path: str | Path,
    camera: Camera,
    depth_scale: float | None = None,
    mask_path: str | Path | None = None,
    plausible_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> DepthImage:
    """Depth in metres of a PNG, TIFF, EXR or NPY image; 0 where nothing was measured or the mask is 0.

    Args:
        path: the image, 16-bit or floating; 0 means no measurement, and in floating ones NaN and infinity do too.
        camera: intrinsics of the same size, see ``read_camera``.
        depth_scale: pixel value of one metre, so that metres = value / depth_scale; by default 1000 for integers and 1
            for floats (``mereo.io.intrinsics`` on BOP and RealSense).
        mask_path: image of the same size, not 0 on the object.
        plausible_m: the median depth must lie in this range, because a wrong unit is otherwise invisible.

    Raises:
        FileNotFoundError, ValueError: the file is missing, damaged, of another kind or size, without any measured
            pixel, or its median depth is not plausible.
        ImportError: an EXR file, without the extra `sensors`.
    """
    path = Path(path)
    if path.exists() and path.suffix.lower() not in DEPTH_READERS:
        known = ", ".join(DEPTH_READERS)
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; a depth image is one of {known}: convert or rename it"
        )
    return usable_depth(depth_of(path, read_raw_depth(path), depth_scale, camera), path, mask_path, plausible_m)


def depth_of(path: Path, raw: Raw, depth_scale: float | None, camera: Camera) -> DepthImage:
    """Depth image of stored values; ``ValueError`` names the file where they are negative or of another size."""
    try:
        return DepthImage(metres(raw, depth_scale), camera)
    except ValueError as error:
        raise ValueError(f"{path} cannot be used: {error}") from None


def usable_depth(
    image: DepthImage,
    path: str | Path,
    mask_path: str | Path | None = None,
    plausible_m: tuple[float, float] = PLAUSIBLE_DEPTH_M,
) -> DepthImage:
    """Depth image in metres without what its mask leaves out; raises ``ValueError`` as ``read_depth_image`` does."""
    depth = image.depth
    if mask_path is not None:
        depth = np.where(read_mask(mask_path, (image.camera.width, image.camera.height)), depth, 0.0)
    if not (depth > 0).any():
        where = "inside the mask" if image.valid.any() else "in the image"
        raise ValueError(f"{path} measures 0 pixels {where}; the object must be visible: check the image and the mask")
    median_m = float(np.median(depth[depth > 0]))
    if not plausible_m[0] <= median_m <= plausible_m[1]:
        raise ValueError(
            f"the median depth of {path} is {median_m:.4g} m; it must be between {plausible_m[0]:g} and "
            f"{plausible_m[1]:g} m: give the pixel value of one metre with --depth-scale (1000 for millimetres)"
        )
    return DepthImage(depth, image.camera)


def read_mask(path: str | Path, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Pixels of an image that are not 0 (in any channel but alpha); ``size`` is the expected (width, height)."""
    path = Path(path)
    with readable(path, "mask image"), open_image(path) as image:
        # a 1-bit or palette image is taken by what it shows, anything else by its stored values
        pixels = np.asarray(image.convert("RGB") if image.mode in ("1", "P", "RGBA", "LA", "CMYK") else image)
    mask = np.asarray(pixels.reshape(*pixels.shape[:2], -1).any(axis=-1))
    if size is not None and mask.shape != (size[1], size[0]):
        raise ValueError(
            f"the mask {path} is {mask.shape[1]} x {mask.shape[0]} pixels but the depth image is "
            f"{size[0]} x {size[1]}; they must agree: export the mask at the depth image's size"
        )
    return mask


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an NPZ file; raises ``SizeError``, and whatever damage makes of the parser."""
    # by its name, numpy would leave a damaged file open
    with limited_memory(path), path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    if strange := [key for key, value in arrays.items() if not isinstance(value, np.ndarray)]:
        raise ValueError(f"its entry {strange[0]!r} is no array")
    return arrays
