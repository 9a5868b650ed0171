"""Parsers of depth image formats: PNG, TIFF, EXR and numpy arrays.

Each parser returns the values as stored, integers or floats, or raises any exception whose text completes "cannot be
read as a depth image (...)"; ``read_raw_depth`` turns it into the sentence a user sees. Integers need a depth scale,
floats are metres.
"""

from collections.abc import Callable
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real
from PIL import Image

from mereo.io.errors import quiet, readable, without_output

MILLIMETRES, METRES = 1000.0, 1.0
"""Depth scales of integer and of floating images where nothing else is said, in units per metre."""

NOTHING_M = 1e9
"""Depth from which on nothing was measured: renderers store 1e10 where a ray met nothing."""

NARROWEST = 16
"""Least number of columns of an image; with fewer an array is a list of points, or of points with something else."""

EXR_CHANNELS = ("z", "v", "y", "r", "depth", "distance")
"""Last parts of the names that a depth channel goes by; v is Blender's, r that of an image saved as grey colour."""

Raw = Real[np.ndarray, "h w"]
"""Values of a depth image as they are stored."""


def read_raw_depth(path: Path) -> Raw:
    """Values of a file that ``is_depth_image``, as stored. Raises ``FileNotFoundError`` or ``ValueError``."""
    with readable(path, "depth image"):
        return DEPTH_READERS[path.suffix.lower()](path)


def is_depth_image(path: Path) -> bool:
    """Whether a file is read as a depth image and not as a point cloud: by suffix, and NPY files by their shape."""
    if path.suffix.lower() != ".npy":
        return path.suffix.lower() in DEPTH_READERS
    if not path.is_file():  # a pipe would be waited for
        return False
    try:
        with quiet():
            array = np.lib.format.open_memmap(path, mode="r")
    except Exception:  # a damaged header raises what Python's own parser does, too
        return False  # the reader of clouds says what is wrong
    return array.ndim == 2 and array.shape[1] >= NARROWEST


def metres(raw: Raw, depth_scale: float | None) -> Float[np.ndarray, "h w"]:
    """Depth in metres from stored values, 0 where nothing was measured.

    In floats NaN and infinity say so (ROS REP 118), and values from ``NOTHING_M`` up.

    Args:
        raw: 0 means no measurement.
        depth_scale: pixel value of one metre; by default 1000 for integers and 1 for floats.
    """
    floating = raw.dtype.kind == "f"
    if depth_scale is None:
        depth_scale = METRES if floating else MILLIMETRES
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(
            f"the depth scale is {depth_scale}; it must be positive, in units per metre: 1000 for millimetres"
        )
    with np.errstate(invalid="ignore"):  # a NaN may be of the kind that signals
        values = raw.astype(np.float64)
    return np.where(np.isfinite(values) & (values < NOTHING_M), values, 0.0) / depth_scale


def open_image(source: Path | BytesIO, formats: tuple[str, ...] | None = None) -> Image.Image:
    """Open an image, which is to be closed by the caller; Pillow does not compare the checksums of a PNG by itself.

    Args:
        source: the file.
        formats: those that Pillow may take it for.
    """
    with Image.open(source, formats=formats) as image:
        if image.format == "PNG":
            image.verify()
    if isinstance(source, BytesIO):
        source.seek(0)
    return Image.open(source, formats=formats)


def _png(path: Path) -> Raw:
    with open_image(path) as image:
        if image.format != "PNG" or image.mode not in ("I;16", "I;16B", "I"):
            raise ValueError(f"it is {image.format} of mode {image.mode}, not a 16-bit grey PNG")
        return _native(np.asarray(image))


def _tiff(path: Path) -> Raw:
    with without_output(), open_image(path) as image:  # libtiff prints what Pillow says again
        if image.format != "TIFF" or image.mode not in ("I;16", "I;16B", "I", "F"):
            raise ValueError(f"it is {image.format} of mode {image.mode}, not a grey TIFF of 16-bit or float values")
        if getattr(image, "n_frames", 1) != 1:
            raise ValueError(f"it has {image.n_frames} pages instead of one")  # type: ignore[attr-defined]
        if image.mode == "F" and _byte_order(path) == b"MM" and image.info.get("compression") != "raw":
            # Pillow 13 swaps no bytes here and returns noise
            raise ValueError("it is compressed, floating and big-endian, which is not supported: save it uncompressed")
        return _native(np.asarray(image))


def _byte_order(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(2)


def _native(array: np.ndarray) -> Raw:
    return array.astype(array.dtype.newbyteorder("="))


def _exr(path: Path) -> Raw:
    if find_spec("OpenEXR") is None:
        raise ImportError(f"{path} needs OpenEXR, which is not installed: pip install 'mereo[sensors]'")
    import OpenEXR

    with without_output(), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {str(name): np.array(channel.pixels) for name, channel in file.channels().items()}
    found = [name for last in EXR_CHANNELS for name in channels if name.lower().split(".")[-1] == last]
    if not found and len(channels) == 1:
        found = list(channels)
    if not found:
        raise ValueError(f"its channels are {', '.join(channels)}, none of them a depth such as Z")
    return channels[found[0]]


def _npy(path: Path) -> Raw:
    array = np.load(path, allow_pickle=False)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"its type is {array.dtype}, not a number")
    return np.asarray(array)


DEPTH_READERS: dict[str, Callable[[Path], Raw]] = {
    ".png": _png,
    **dict.fromkeys((".tif", ".tiff"), _tiff),
    ".exr": _exr,
    ".npy": _npy,
}
"""Parser of each suffix."""
