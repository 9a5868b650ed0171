"""Limits on what a file may unpack to, checked on what its header states before memory is taken for it.

A header of a few bytes can promise terabytes, and a megabyte of zip or gzip can hold a gigabyte. One limit is for all
readers: ``DEFAULT_GB``, or what the environment variable ``MEREO_MAX_FILE_GB`` says. It counts a file's content as it
lies in memory at first; working on it takes a few times as much.
"""

import bz2
import math
import os
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

LIMIT_VARIABLE = "MEREO_MAX_FILE_GB"

DEFAULT_GB = 4.0
"""Gigabytes (of 10^9 bytes) that a file may unpack to: 166 million points, or a label volume of 500 million voxels."""

ENGINES: dict[str, Callable[[], Any]] = {
    **dict.fromkeys(("gzip", "gz"), partial(zlib.decompressobj, zlib.MAX_WBITS | 32)),
    **dict.fromkeys(("bzip2", "bz2"), bz2.BZ2Decompressor),
}
"""Maker of what unpacks data, by NRRD's names of encodings."""

CHUNK = 1 << 12
"""Packed bytes at once where what they unpack to is only counted: 4 MB of gzip, 80 MB of bzip2 at most."""


class SizeError(ValueError):
    """Refusal of a file that unpacks to more than the limit; its text is a whole sentence."""


def max_bytes() -> int:
    """Limit in bytes. Raises ``SizeError`` where ``MEREO_MAX_FILE_GB`` is no positive number."""
    text = os.environ.get(LIMIT_VARIABLE, "") or str(DEFAULT_GB)
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        raise SizeError(f"{LIMIT_VARIABLE} is {text!r}; it must be a positive number of gigabytes: correct or unset it")
    return int(limit * 1e9)


def check_bytes(path: str | Path, size: int) -> None:
    """Raise ``SizeError`` where ``size`` bytes, what the content of ``path`` unpacks to, are over the limit."""
    limit = max_bytes()
    if size > limit:
        amount = f"{size / 1e9:.3g}" if size < 1e12 else f"{size / 1e9:,.0f}"
        raise SizeError(
            f"{path} unpacks to {amount} GB; at most {limit / 1e9:g} GB are read: check that it is what it should be, "
            f"export less, or raise the limit with {LIMIT_VARIABLE}={math.ceil(size / 1e8) / 10:g}"
        )


def check_count(count: int, found: int, what: str) -> None:
    """Raise ``ValueError`` (its reason only) for a negative count, or one of more than was ``found``."""
    if count < 0:
        raise ValueError(f"its header states {count} {what}")
    if found < count:
        raise ValueError(f"it is truncated: {found} of {count} {what}")


# --- numpy's files and other archives ---------------------------------------------------------------------------------


def check_archive(path: Path) -> None:
    """Refuse a zip file whose members unpack to too much; zipfile stops at the sizes in its directory."""
    with zipfile.ZipFile(path) as archive:
        check_bytes(path, sum(member.file_size for member in archive.infolist()))


def check_arrays(path: Path) -> None:
    """Refuse an NPY or NPZ file that is too large, or states arrays that its bytes cannot fill."""
    with path.open("rb") as file:
        if file.read(2) != b"PK":  # as numpy tells them apart
            file.seek(0)
            _check_array(file, path.stat().st_size)
            return
    check_archive(path)
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as entry:
                _check_array(entry, member.file_size)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an NPZ file, checked as ``check_arrays`` does; raises whatever damage makes of the parser."""
    check_arrays(path)
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:  # numpy leaves a damaged file open
        arrays = {key: file[key] for key in file.files}
    if strange := [key for key, value in arrays.items() if not isinstance(value, np.ndarray)]:
        raise ValueError(f"its entry {strange[0]!r} is no array")
    return arrays


def _check_array(file: Any, size: int) -> None:
    """Compare the shape in an NPY header with the ``size`` bytes of the file; numpy would take the memory first."""
    start = file.read(len(np.lib.format.MAGIC_PREFIX) + 2)
    if not start.startswith(np.lib.format.MAGIC_PREFIX) or start[-2] not in (1, 2, 3):
        return  # numpy says what it is instead
    if start[-2] > 1:
        length = file.read(4)
        check_count(int.from_bytes(length, "little"), size, "bytes of its header")
        file.seek(-len(length), os.SEEK_CUR)
    read: Any = np.lib.format.read_array_header_1_0 if start[-2] == 1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    # no side of an array without values may be longer either: sums along the others would be as long
    if any(not 0 <= side <= size for side in shape) or math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"its header states an array of shape {list(shape)}, which its {size} bytes cannot hold")


def check_stream(path: Path, start: int, encoding: str, wanted: int) -> None:
    """Refuse data packed by one of ``ENGINES``, from byte ``start`` on, that unpack to more than ``wanted`` bytes."""
    found, engine = 0, ENGINES[encoding]()
    with path.open("rb") as file:
        file.seek(start)
        while not engine.eof and (data := file.read(CHUNK)):
            found += len(engine.decompress(data))
            if found > wanted:
                raise ValueError(f"its data unpack to more than the {wanted} bytes that its header states")


# --- images -----------------------------------------------------------------------------------------------------------


def open_image(source: str | Path | BytesIO, name: str | Path, formats: tuple[str, ...] | None = None) -> Image.Image:
    """Open an image whose pixels are not too many and, in a PNG, whose checksums are right.

    Pillow does not compare the checksums of a PNG when it reads one, so damage came out as other values.

    Args:
        source: the file.
        name: what to call it in messages.
        formats: those that Pillow may take it for.

    Raises ``SizeError`` or what Pillow does. The image is to be closed by the caller.
    """
    with _opened(source, name, formats) as image:
        size = image.size
        check_bytes(name, math.prod(size) * np.dtype(np.float64).itemsize)
        if image.format == "PNG":
            image.verify()
    if not isinstance(source, str | Path):
        source.seek(0)
    return _opened(source, name, formats)


def _opened(source: str | Path | BytesIO, name: str | Path, formats: tuple[str, ...] | None) -> Image.Image:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # half of what it refuses, and within the limit
        try:
            return Image.open(source, formats=formats)
        except Image.DecompressionBombError:
            most = 2 * (Image.MAX_IMAGE_PIXELS or 0)
            raise SizeError(
                f"{name} has more than {most / 1e6:.0f} million pixels; no larger images are read: check that it is "
                "what it should be, or crop it"
            ) from None
