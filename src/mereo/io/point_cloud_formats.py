"""Parsers of point-cloud formats: PLY, PCD, text, numpy arrays and ZDF.

Each parser returns [n, 3] positions, NaN rows included, or raises any exception whose text completes "cannot be read
as a point cloud (...)"; ``mereo.io.readers`` turns it into the sentence a user sees.
"""

import re
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from mereo.io.errors import check_count

PLY_ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")


def _ply_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Vertices of a PLY file; trimesh returns those it finds, so a file cut short is only noticed by counting them."""
    check_ply(path)
    count = ply_counts(path).get("vertex", 0)
    if count == 0:
        raise ValueError("it has 0 vertices")
    loaded: Any = trimesh.load(path, file_type="ply", process=False)
    check_count(count, len(loaded.vertices), "points")
    return np.asarray(loaded.vertices, dtype=np.float64)


def ply_counts(path: Path) -> dict[str, int]:
    """Number of each kind of element (vertex, face) that a PLY file's header states."""
    with path.open("rb") as file:
        return {name: count for name, count, _ in _ply_header(file.read(65536))[1]}


def check_ply(path: Path) -> None:
    """Raise ``ValueError`` for a PLY file that trimesh would read in part: with a wrong header, or text cut short."""
    with path.open("rb") as file:
        order, elements, start = _ply_header(file.read(65536))
        file.seek(start)
        rows = sum(1 for row in file if row.strip()) if order == "ascii" else 0
    if order == "ascii":
        check_count(sum(count for _, count, _ in elements), rows, "rows")


def _ply_header(content: bytes) -> tuple[str, list[tuple[str, int, list[list[str]]]], int]:
    """Header of a PLY file: format, name, count and properties (type and name) of each element, start of the data."""
    match = re.search(rb"^end_header[ \t]*\r?\n?", content[:65536], re.MULTILINE)
    if not content.startswith(b"ply") or match is None:
        raise ValueError("it has no PLY header")
    order, elements = "", []
    for key, *values in filter(None, map(str.split, content[: match.end()].decode("latin-1").splitlines())):
        if key == "format":
            order = values[0]
        elif key == "element":
            count = int(values[1])
            check_count(count, max(count, 0), f"of element {values[0]!r}")
            elements.append((values[0], count, list[list[str]]()))
        elif key == "property":
            elements[-1][2].append(values)
    if order not in PLY_ORDERS:
        raise ValueError(f"its format is {order!r}, not one of {', '.join(PLY_ORDERS)}")
    return order, elements, match.end()


def _text_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Rows of a text file; comment lines (# or //) and others before the first row of numbers are skipped."""
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines[:100]) if _is_row(line)), None)
    if first is None:
        raise ValueError("it has no row of three numbers")
    # an empty cell must not shift its neighbours, so a separator is kept where the file has one
    delimiter = next((mark for mark in (",", ";") if mark in lines[first]), None)
    title = lines[first - 1].lstrip("#/ ") if first else ""
    header = [cell.strip().strip('"').lower() for cell in title.split(delimiter)]
    columns = [header.index(axis) if set("xyz") <= set(header) else i for i, axis in enumerate("xyz")]
    rows = [line for line in lines[first:] if not line.lstrip().startswith(("#", "//"))]
    if path.suffix.lower() == ".pts" and title.strip().isdecimal():
        check_count(int(title), len(rows), "points")
    return np.loadtxt(rows, delimiter=delimiter, usecols=columns, ndmin=2)


def _is_row(line: str) -> bool:
    """Whether a line holds at least three numbers; other cells may be words, and comments are never rows."""
    if line.lstrip().startswith(("#", "//")):
        return False
    return sum(map(_is_number, re.split(r"[,;\s]+", line.strip()))) >= 3


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _array_points(path: Path) -> Float[np.ndarray, "n 3"]:
    with path.open("rb") as file:  # by its name, numpy would leave a damaged archive open
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return _check_array(loaded)
        if "points" in loaded:
            return _check_array(loaded["points"])
        arrays = [loaded[key] for key in loaded.files]
        fitting = [array for array in arrays if array.ndim in (2, 3) and array.shape[-1] == 3]
    if len(fitting) != 1:
        raise ValueError(f"it holds {len(fitting)} arrays of shape [n, 3] and none called 'points'")
    return _check_array(fitting[0])


def _check_array(array: np.ndarray) -> Float[np.ndarray, "n 3"]:
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise ValueError(f"its shape is {array.shape}, not [n, 3] or [h, w, 3]")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"its type is {array.dtype}, not a number")
    return array.reshape(-1, 3).astype(np.float64)


# --- PCD (Point Cloud Library, https://pointclouds.org/documentation/tutorials/pcd_file_format.html) -----------------


def _pcd_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Points of a PCD file: ascii, binary, binary_compressed; organized clouds come row by row, with their NaN rows."""
    header, body = _pcd_header(path.read_bytes())
    count, row = int(header["POINTS"][0]), _pcd_row(header)
    width, height = (int(header.get(key, [str(count)])[0]) for key in ("WIDTH", "HEIGHT"))
    if count < 0 or ({"WIDTH", "HEIGHT"} <= header.keys() and width * height != count):
        raise ValueError(f"its header states {count} points and {width} x {height}")
    if not {"x", "y", "z"} <= set(row.names or ()):
        raise ValueError(f"its fields are {', '.join(header['FIELDS'])}, without x, y and z")
    layout = header["DATA"][0]
    if layout == "ascii":
        return _pcd_ascii(body, row, count)
    if layout == "binary_compressed":
        return _pcd_compressed(body, row, count)
    if layout != "binary":
        raise ValueError(f"its DATA is {layout!r}, not ascii, binary or binary_compressed")
    check_count(count, len(body) // row.itemsize, "points")
    records = np.frombuffer(body, row, count)
    return np.stack([records[axis].astype(np.float64).reshape(count) for axis in "xyz"], axis=1)


def _pcd_header(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    match = re.search(rb"^DATA[ \t]+\S+[ \t]*\r?\n?", content[:65536], re.MULTILINE)
    if match is None:
        raise ValueError("it has no PCD header")
    lines = [line.split() for line in content[: match.end()].decode("ascii").splitlines() if not line.startswith("#")]
    header = {line[0]: line[1:] for line in lines if len(line) > 1}
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if key not in header]
    if missing:
        raise ValueError(f"its header has no {missing[0]}")
    return header, content[match.end() :]


def _pcd_row(header: dict[str, list[str]]) -> np.dtype:
    """One point as a packed record; padding fields are all called ``_`` and get distinct names."""
    kinds = {"F": "f", "I": "i", "U": "u"}
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    fields: list[Any] = []
    for index, (name, kind, size, count) in enumerate(columns):
        fields.append((name if name in "xyz" else f"{name}{index}", f"<{kinds[kind]}{size}", (int(count),)))
    return np.dtype(fields)


def _pcd_ascii(body: bytes, row: np.dtype, count: int) -> Float[np.ndarray, "n 3"]:
    sizes = [int(np.prod(row[name].shape)) for name in row.names or ()]
    starts = dict(zip(row.names or (), np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
    lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
    check_count(count, len(lines), "points")
    if count == 0:
        return np.empty((0, 3))
    return np.loadtxt(lines[:count], usecols=[starts[axis] for axis in "xyz"], ndmin=2)


def _pcd_compressed(body: bytes, row: np.dtype, count: int) -> Float[np.ndarray, "n 3"]:
    """Points of a compressed body: two sizes, then LZF data with all values of one field together."""
    if len(body) < 8:
        raise ValueError("it is truncated after its header")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    check_count(count, unpacked // row.itemsize, "points")
    data = _lzf_decompress(body[8 : 8 + packed], unpacked)
    axes, start = {}, 0
    for name in row.names or ():
        length = row[name].itemsize * count
        if name in "xyz":
            axes[name] = np.frombuffer(data[start : start + length], row[name].base).astype(np.float64)
        start += length
    return np.stack([axes[axis] for axis in "xyz"], axis=1)


def _lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress Marc Lehmann's LZF: runs of literals, or copies of ``length`` bytes from ``offset`` back."""
    output, at = bytearray(), 0
    while at < len(data):
        control, at = data[at], at + 1
        if control < 32:
            output += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, at = length + data[at], at + 1
        offset, at = ((control & 31) << 8) + data[at] + 1, at + 1
        start, length = len(output) - offset, length + 2
        if start < 0:
            raise ValueError("its compressed data are damaged")
        # a copy may overlap what it writes: it then repeats the last `offset` bytes
        chunk = output[start : start + length]
        output += (chunk * (length // len(chunk) + 1))[:length]
    if len(output) != size:
        raise ValueError(f"it is truncated: {len(output)} of {size} bytes")
    return bytes(output)


# --- ZDF (Zivid; NetCDF 4) -------------------------------------------------------------------------------------------


def _zdf_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Points of a ZDF file: organized, millimetres, NaN where nothing was measured."""
    if find_spec("netCDF4") is None:
        raise ImportError(f"{path} needs netCDF4, which is not installed: pip install 'mereo[sensors]'")
    import netCDF4

    with netCDF4.Dataset(path) as file:
        cloud = file["data"]["pointcloud"][:]
    return _check_array(np.ma.filled(np.ma.asarray(cloud, dtype=np.float64), np.nan))


CLOUD_READERS: dict[str, Callable[[Path], Float[np.ndarray, "n 3"]]] = {
    ".ply": _ply_points,
    ".pcd": _pcd_points,
    **dict.fromkeys((".xyz", ".txt", ".pts", ".asc", ".csv"), _text_points),
    **dict.fromkeys((".npy", ".npz"), _array_points),
    ".zdf": _zdf_points,
}
"""Parser of each suffix."""
