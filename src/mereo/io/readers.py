"""Readers of point clouds, depth images and masks; ``mereo.io.sensor_frame`` reads whichever a file holds.

Every reader raises ``FileNotFoundError`` or a ``ValueError`` of one sentence (value, rule, cure); a parser of a format
raises any exception whose text completes "cannot be read as a point cloud (...)". Nothing is repaired silently.
"""

import json
import re
import warnings
from collections.abc import Callable
from contextlib import nullcontext, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Real
from numpy import ndarray
from numpy.linalg import norm
from PIL import Image
from scipy.spatial.transform import Rotation

from mereo.geometry.brief import listed
from mereo.geometry.camera import Camera, DepthImage, PixelMask, PixelValues, PointCloud, Size
from mereo.geometry.conventions import LARGEST, Names, WholeNumbers
from mereo.geometry.mesh import with_normals
from mereo.geometry.transforms import Points, Rows, Transform, checked_pose, rigid
from mereo.io.errors import AnyPath, check_count, check_suffix, limited_memory, quiet, readable, without_output
from mereo.io.extras import library

PLAUSIBLE_DEPTH_M = (0.05, 20.0)
"""Range of an image's median depth; beyond it the unit is wrong, which is otherwise invisible."""

MILLIMETRES = 1000.0
"""Depth scale of images of integers where nothing else is said, in units per metre; that of floats is 1."""

NOTHING_M = 1e9
"""Depth from which on nothing was measured: renderers store 1e10 where a ray met nothing."""

NARROWEST = 16
"""Least number of columns of an image; with fewer an array is a list of points, or of points with something else."""


def lies_below(folder: Path, file: Path) -> bool:
    """Whether it is a regular file in a folder or below: a file should not choose which others or devices are read."""
    return file.resolve().is_relative_to(folder.resolve()) and file.is_file()


class InputWarning(UserWarning):
    """Warning that a file may be meant in two ways, and in which it was taken."""


Raw = Real[ndarray, "h w"]
"""Values of a depth image as they are stored."""


# --- point clouds -----------------------------------------------------------------------------------------------------


def read_point_cloud(path: AnyPath, drop_invalid: bool = False) -> PointCloud:
    """Points of a PLY, PCD, XYZ/TXT/PTS/ASC/CSV, NPY, NPZ or ZDF file, in the file's units and frame.

    Args:
        path: the file; its suffix names the format. Arrays are [n, 3] or organized [h, w, 3]; text has x, y, z in its
            first three columns or in the columns its header calls x, y, z; NPZ holds ``points`` or one such array; ZDF
            is Zivid's, in millimetres.
        drop_invalid: leave out points that are NaN, infinite or beyond 1e12, and points at exactly (0, 0, 0): sensors
            mark missing measurements so.

    Raises ``FileNotFoundError``, ``ValueError`` where it is of another format, empty, truncated or not numeric, or has
    invalid points that are not to be dropped, and ``ImportError`` for a ZDF file without the extra `sensors`.
    """
    return PointCloud.of(valid_points(read_points(path), path, drop_invalid))


MESHES = (".stl", ".obj", ".glb", ".gltf", ".off", ".3mf")
"""Suffixes of files that hold surfaces and no points."""


def read_points(path: AnyPath) -> Rows:
    """Rows of ``PointCloud.of``: points as ``read_point_cloud`` has them, those without a measurement included."""
    path = Path(path)
    if path.suffix.lower() in MESHES and path.exists():
        raise ValueError(
            f"{path} is a mesh, not what a camera has measured, which is a depth image or a point cloud ("
            f"{', '.join(CLOUD_READERS)}): give the frame, and the mesh as the object (--object)"
        )
    check_suffix(path, CLOUD_READERS, "point cloud")
    with readable(path, "point cloud"):
        return np.asarray(CLOUD_READERS[path.suffix.lower()](path), float)


def valid_points(
    rows: Rows,
    path: AnyPath,
    drop_invalid: bool,
    cure: str = "leave them out with --drop-invalid",
) -> Float[ndarray, "m c"]:
    """Rows whose points, the first three columns, are measurements, as a copy. Raises as ``read_point_cloud`` does.

    ``path`` is where they come from, and ``cure`` what to do where others are not to be left out, for the sentences.
    """
    points = rows[:, :3]
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
    return rows[usable]


# --- depth images and masks -------------------------------------------------------------------------------------------


def read_depth_image(
    path: AnyPath, camera: Camera, depth_scale: float | None = None, mask_path: AnyPath | None = None
) -> DepthImage:
    """Depth in metres of a PNG, TIFF, EXR or NPY image; 0 where nothing was measured or the mask is 0.

    Args:
        path: the image, 16-bit or floating; 0 means no measurement, and in floating ones NaN and infinity do too.
        camera: intrinsics of the same size, see ``read_camera``.
        depth_scale: pixel value of one metre, so that metres = value / depth_scale; by default 1000 for integers and 1
            for floats (``mereo.io.intrinsics`` on BOP and RealSense).
        mask_path: image of the same size, not 0 on the object, see ``read_mask``.

    Raises ``FileNotFoundError``, ``ValueError`` where it is damaged, of another kind or size, without any measured
    pixel, or of an implausible median depth, and ``ImportError`` for an EXR file without the extra `sensors`.
    """
    path = Path(path)
    check_suffix(path, DEPTH_READERS, "depth image")
    return usable_depth(depth_of(path, read_raw_depth(path), depth_scale, camera), path, mask_path)


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
    # a damaged header raises what Python's own parser does, too; the reader of clouds says what is wrong
    with suppress(Exception), quiet():
        array = np.lib.format.open_memmap(path, mode="r")
        return array.ndim == 2 and array.shape[1] >= NARROWEST
    return False


def metres(raw: Raw, depth_scale: float | None) -> PixelValues:
    """Depth in metres from stored values, 0 where nothing was measured.

    In floats NaN and infinity say so (ROS REP 118), and values from ``NOTHING_M`` up. ``depth_scale`` is the pixel
    value of one metre, by default 1000 for integers and 1 for floats.
    """
    if depth_scale is None:
        depth_scale = 1.0 if raw.dtype.kind == "f" else MILLIMETRES
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(
            f"the depth scale is {depth_scale}; it must be positive, in units per metre: 1000 for millimetres"
        )
    with np.errstate(invalid="ignore"):  # a NaN may be of the kind that signals
        values = raw.astype(float)
    return np.where(np.isfinite(values) & (values < NOTHING_M), values, 0.0) / depth_scale


def depth_of(path: Path, raw: Raw, depth_scale: float | None, camera: Camera) -> DepthImage:
    """Depth image of stored values; ``ValueError`` names the file where they are negative or of another size."""
    try:
        return DepthImage(metres(raw, depth_scale), camera)
    except ValueError as error:
        raise ValueError(f"{path} cannot be used: {error}") from None


def masked_depth(image: DepthImage, path: AnyPath, mask: PixelMask) -> DepthImage:
    """Depth image without what a mask leaves out; raises ``ValueError`` where nothing is left."""
    depth = np.where(mask, image.depth, 0.0)
    if not (depth > 0).any():
        where = "inside the mask" if image.valid.any() else "in the image"
        raise ValueError(f"{path} measures 0 pixels {where}; the object must be visible: check the image and the mask")
    return DepthImage(depth, image.camera)


def usable_depth(
    image: DepthImage, path: AnyPath, mask_path: AnyPath | None = None, mask_values: WholeNumbers = ()
) -> DepthImage:
    """Depth image in metres without what its mask leaves out; raises ``ValueError`` as ``read_depth_image`` does.

    ``mask_values`` are as in ``read_mask``.
    """
    mask = np.ones(image.depth.shape, bool)
    if mask_path is None and np.size(mask_values):
        raise ValueError("--mask-value says which pixels of a mask are the object, and none is given: give --mask FILE")
    if mask_path is not None:
        mask = read_mask(mask_path, (image.camera.width, image.camera.height), mask_values)
    image = masked_depth(image, path, mask)
    median_m = float(np.median(image.depth[image.valid]))
    least_m, most_m = PLAUSIBLE_DEPTH_M
    if not least_m <= median_m <= most_m:
        raise ValueError(
            f"the median depth of {path} is {median_m:.4g} m; it must be between {least_m:g} and {most_m:g} m: give "
            "the pixel value of one metre with --depth-scale (1000 for millimetres)"
        )
    return image


FULL = (1, 255, 65535)
"""Values of white in images of floats, 8 and 16 bits: where it is the commonest next to 0, others are soft edges."""

LOSSY = ("JPEG", "MPO", "JPEG2000", "WEBP")
"""Formats (as Pillow calls them) that may store other values than they were given."""


def read_mask(path: AnyPath, size: Size | None = None, values: WholeNumbers = ()) -> PixelMask:
    """Pixels of an image that show the object.

    These are the opaque ones of an image with transparent parts; else those that are not 0, in any channel, or that
    have some ``values``, the ids of an image of several things. Where grey is an edge's, as in lossy formats and where
    an image was resized, they are those from half of white.

    ``size`` is the expected (width, height). Warns with ``InputWarning`` where half of white was taken. Raises
    ``FileNotFoundError``, or ``ValueError``, also for several ids without ``values``, and for ``values`` it has not.
    """
    path = Path(path)
    with readable(path, "mask image"), open_image(path) as image:
        layers = _mask_layers(image)
    return _chosen_pixels(layers, f"the mask {path}", size, values)


def mask_of_image(image: Image.Image, size: Size | None = None, values: WholeNumbers = ()) -> PixelMask:
    """Pixels of an image in memory that show the object; takes the arguments of ``read_mask`` and raises as it does."""
    return _chosen_pixels(_mask_layers(image), "the mask", size, values)


MaskLayers = tuple[bool, ndarray, ndarray, ndarray]
"""Whether an image's format may have changed its values; its opacity, what it shows, and its stored values."""


def _mask_layers(image: Image.Image) -> MaskLayers:
    opacity = np.asarray(image.convert("RGBA").getchannel("A")) if image.has_transparency_data else np.zeros(1)
    # a 1-bit or palette image is taken by what it shows, anything else by its stored values
    shown = np.asarray(image.convert("RGB") if image.mode in ("1", "P", "PA", "RGBA", "LA", "CMYK") else image)
    return image.format in LOSSY, opacity, shown, np.asarray(image) if image.mode == "P" else shown


def _chosen_pixels(layers: MaskLayers, name: str, size: Size | None, values: WholeNumbers) -> PixelMask:
    is_lossy, opacity, shown, stored = layers
    channels = stored.reshape(*stored.shape[:2], -1)
    ids = channels.max(axis=-1)
    has_ids = bool((channels == channels[..., :1]).all())
    mask = np.asarray(shown.reshape(*shown.shape[:2], -1).any(axis=-1))
    if size is not None and mask.shape != (size[1], size[0]):
        raise ValueError(
            f"{name} is {mask.shape[1]} x {mask.shape[0]} pixels but the depth image is "
            f"{size[0]} x {size[1]}; they must agree: export the mask at the depth image's size"
        )
    present, counts = np.unique(ids[mask], return_counts=True)
    seen = listed(f"{value:g}" for value in np.unique(ids))
    is_soft = is_lossy or (has_ids and len(present) > 1 and present[-1] == present[counts.argmax()] in FULL)
    if opacity.min() < 128 <= opacity.max():
        mask = opacity >= 128
    elif np.size(values):
        if is_lossy or not has_ids or not np.isin(values, present).all():
            kind = "is in a lossy format" if is_lossy else f"has the values {seen}" if has_ids else "has colours"
            raise ValueError(
                f"{name} {kind}, and the object's are to be {np.atleast_1d(values).tolist()}; ids are needed: "
                "save them as a grey PNG, or correct --mask-value"
            )
        mask = np.isin(ids, values)
    elif is_soft:
        mask = ids >= 0.5 * present.max(initial=1)
        warnings.warn(
            f"{name} has grey edges{' (a lossy format makes them)' if is_lossy else ''}; its pixels from half "
            "of white are taken for the object's: save masks as PNG, in black and white",
            InputWarning,
            stacklevel=4,
        )
    elif has_ids and len(present) > 1:
        raise ValueError(
            f"{name} has the values {seen}, which may be ids of several things; the object's are needed: give "
            f"--mask-value {present[-1]:g} or others"
        )
    return mask


# --- parsers of depth images: values as stored, integers or floats ----------------------------------------------------


def open_image(source: Path | BytesIO, formats: Names | None = None) -> Image.Image:
    """Open an image of one of some formats, to be closed by the caller, and compare the checksums of a PNG."""
    with Image.open(source, formats=formats) as image:
        if image.format == "PNG":
            image.verify()
    if isinstance(source, BytesIO):
        source.seek(0)
    return Image.open(source, formats=formats)


def in_memory(values: ndarray) -> ndarray:
    """Values that no longer lie in the file, with the machine's own order of bytes."""
    return np.array(values, values.dtype.newbyteorder("="))


def _grey(path: Path) -> Raw:
    kind = "PNG" if path.suffix.lower() == ".png" else "TIFF"
    with path.open("rb") as file:
        is_big_endian = file.read(2) == b"MM"
    # libtiff prints what Pillow says again
    with without_output() if kind == "TIFF" else nullcontext(), open_image(path) as image:
        if image.format != kind or image.mode not in ("I;16", "I;16B", "I", "F"):
            needed = "16-bit grey PNG" if kind == "PNG" else "grey TIFF of 16-bit or float values"
            raise ValueError(f"it is {image.format} of mode {image.mode}, not a {needed}")
        if (pages := getattr(image, "n_frames", 1)) != 1:
            raise ValueError(f"it has {pages} pages instead of one")
        if image.mode == "F" and is_big_endian and image.info.get("compression") != "raw":
            # Pillow 13 swaps no bytes here and returns noise
            raise ValueError("it is compressed, floating and big-endian, which is not supported: save it uncompressed")
        return in_memory(np.asarray(image))


def _exr(path: Path) -> Raw:
    OpenEXR: Any = library("OpenEXR", "sensors", path)
    with without_output(), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {str(name): np.array(channel.pixels) for name, channel in file.channels().items()}
    known = ("z", "v", "y", "r", "depth", "distance")  # v is Blender's, r that of an image saved as grey colour
    depths = [name for last in known for name in channels if name.lower().split(".")[-1] == last]
    depths = depths or (list(channels) if len(channels) == 1 else [])
    if not depths:
        raise ValueError(f"its channels are {', '.join(channels)}, none of them a depth such as Z")
    return channels[depths[0]]


def _npy(path: Path) -> Raw:
    array = np.load(path, allow_pickle=False)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"its type is {array.dtype}, not a number")
    return array


DEPTH_READERS: dict[str, Callable[[Path], Raw]] = {
    **dict.fromkeys((".png", ".tif", ".tiff"), _grey),
    ".exr": _exr,
    ".npy": _npy,
}
"""Parser of each suffix of depth images."""


# --- parsers of point clouds: positions, NaN rows included ------------------------------------------------------------


def _ply_points(path: Path) -> Rows:
    """Vertices of a PLY file, with the normals that it states, or that its faces have.

    trimesh returns those it finds, so a file cut short is only noticed by counting them.
    """
    count = check_ply(path).get("vertex", 0)
    if count == 0:
        raise ValueError("it has 0 vertices")
    loaded: Any = trimesh.load(path, file_type="ply", resolver={}, process=False)  # no textures
    check_count(count, len(loaded.vertices), "points")
    vertices = np.asarray(loaded.vertices, float)
    with suppress(LookupError, ValueError):  # which numpy raises for a name that it has not
        stated = loaded.metadata["_ply_raw"]["vertex"]["data"]
        normals = np.stack([np.asarray(stated[name], float).reshape(-1) for name in ("nx", "ny", "nz")], 1)
        return np.hstack([vertices, np.nan_to_num(normals, posinf=0.0, neginf=0.0)])
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)
    return with_normals(vertices, faces) if len(faces) else vertices


def check_ply(path: Path) -> dict[str, int]:
    """Number of each kind of element (vertex, face) that a PLY file's header states.

    Raises ``ValueError`` for a file that trimesh would read in part: with a wrong header, or text cut short.
    """
    with path.open("rb") as file:
        head = file.read(65536)
        end = re.search(rb"^end_header[ \t]*\r?\n?", head, re.MULTILINE)
        if not head.startswith(b"ply") or end is None:
            raise ValueError("it has no PLY header")
        lines = [line.split() for line in head[: end.end()].decode("latin-1").splitlines()]
        order = next((line[1] for line in lines if line[:1] == ["format"]), "")
        if order not in ("ascii", "binary_little_endian", "binary_big_endian"):
            raise ValueError(f"its format is {order!r}, not ascii, binary_little_endian or binary_big_endian")
        counts = {line[1]: int(line[2]) for line in lines if line[:1] == ["element"]}
        for name, count in counts.items():
            check_count(count, max(count, 0), f"of element {name!r}")
        if order == "ascii":
            file.seek(end.end())
            check_count(sum(counts.values()), sum(1 for row in file if row.strip()), "rows")
    return counts


def _text_points(path: Path) -> Points:
    """Rows of a text file; comment lines (# or //) and others before the first row of numbers are skipped."""
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines[:100]) if _is_row(line)), None)
    if first is None:
        raise ValueError("it has no row of three numbers")
    # an empty cell must not shift its neighbours, so a separator is kept where the file has one
    words = lines[first].split()
    is_spaced = len(words) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?(e[-+]?\d+)?", word, re.I) for word in words[:3])
    delimiter = None if is_spaced else next((mark for mark in ";," if lines[first].count(mark) >= 2), None)
    title = lines[first - 1].lstrip("#/ ") if first else ""
    header = [cell.strip().strip('"').lower() for cell in title.split(delimiter)]
    columns = [header.index(axis) if set("xyz") <= set(header) else i for i, axis in enumerate("xyz")]
    rows = [line for line in lines[first:] if not line.lstrip().startswith(("#", "//"))]
    if delimiter == "," and _has_decimal_commas(rows[:100], header):
        raise ValueError(
            f"its first row is {lines[first].strip()[:60]!r}, where commas are between numbers and seem to be in them: "
            "export it with points in the numbers, or with semicolons between them"
        )
    if delimiter != ",":  # commas are in numbers
        rows = [line.replace(",", ".") for line in rows]
    if path.suffix.lower() == ".pts" and title.strip().isdecimal():
        check_count(int(title), len(rows), "points")
    return np.loadtxt(rows, delimiter=delimiter, usecols=columns, ndmin=2)


def _has_decimal_commas(rows: list[str], header: list[str]) -> bool:
    """Whether cells are halves of numbers: some begin with 0 as no number does, or they are twice as many as titles."""
    cells = [row.replace(" ", "").split(",") for row in rows]
    if any("." in row or len(row.split(",")) not in (6, 8, 12) for row in rows):
        return False
    is_titled = set("xyz") <= set(header) and len(cells[0]) == 2 * len(header)
    return is_titled or any(re.match(r"0\d", half) for row in cells for half in row[1::2])


def _is_row(line: str) -> bool:
    """Whether a line holds at least three numbers; other cells may be words, and comments are never rows."""
    numbers = 0
    for cell in re.split(r"[,;\s]+", line.strip()):
        with suppress(ValueError):
            float(cell)
            numbers += 1
    return numbers >= 3 and not line.lstrip().startswith(("#", "//"))


def _array_points(path: Path) -> Points:
    with path.open("rb") as file:  # by its name, numpy would leave a damaged archive open
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, ndarray):
            return _check_array(loaded)
        names = ["points"] if "points" in loaded else loaded.files
        arrays = [loaded[name] for name in names]
    fitting = [array for array in arrays if names == ["points"] or (array.ndim in (2, 3) and array.shape[-1] == 3)]
    if len(fitting) != 1:
        raise ValueError(f"it holds {len(fitting)} arrays of shape [n, 3] and none called 'points'")
    return _check_array(fitting[0])


def _check_array(array: ndarray) -> Points:
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise ValueError(f"its shape is {array.shape}, not [n, 3] or [h, w, 3]")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"its type is {array.dtype}, not a number")
    return array.reshape(-1, 3).astype(float)


# --- PCD (Point Cloud Library, https://pointclouds.org/documentation/tutorials/pcd_file_format.html) -----------------


def _pcd_points(path: Path) -> Points:
    """Points of a PCD file: ascii, binary, binary_compressed; organized clouds come row by row, with their NaN rows."""
    header, body = _pcd_parts(path.read_bytes())
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if key not in header]:
        raise ValueError(f"its header has no {missing[0]}")
    count = int(header["POINTS"][0])
    row = _pcd_row(header)
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
    return np.stack([records[axis].astype(float).reshape(count) for axis in "xyz"], axis=1)


def _pcd_parts(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Header of a PCD file, each line's words by the first, and what follows it."""
    match = re.search(rb"^DATA[ \t]+\S+[ \t]*\r?\n?", content[:65536], re.MULTILINE)
    if match is None:
        raise ValueError("it has no PCD header")
    lines = [line.split() for line in content[: match.end()].decode("ascii").splitlines() if not line.startswith("#")]
    return {line[0]: line[1:] for line in lines if len(line) > 1}, content[match.end() :]


def read_viewpoint(path: Path) -> Transform | None:
    """Pose of the camera by a PCD file's header; None where that is the identity, or missing, and for other files.

    Raises ``ValueError`` for one that is no position and unit quaternion (x y z, qw qx qy qz).
    """
    if path.suffix.lower() != ".pcd":
        return None
    with readable(path, "point cloud"), path.open("rb") as file:
        words = _pcd_parts(file.read(65536))[0].get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])
        numbers = np.array(words, float)
        if numbers.shape != (7,) or not np.isfinite(numbers).all() or abs(norm(numbers[3:]) - 1.0) > 1e-2:
            raise ValueError(f"its VIEWPOINT is {' '.join(words)}, not x y z and a unit quaternion qw qx qy qz")
        pose = rigid(Rotation.from_quat(numbers[3:], scalar_first=True).as_matrix(), numbers[:3])
        return None if np.allclose(pose, np.eye(4)) else pose


def _pcd_row(header: dict[str, list[str]]) -> np.dtype:
    """One point as a packed record; padding fields are all called ``_`` and get distinct names."""
    kinds = {"F": "f", "I": "i", "U": "u"}
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    fields: list[Any] = [
        (name if name in "xyz" else f"{name}{index}", f"<{kinds[kind]}{size}", (int(count),))
        for index, (name, kind, size, count) in enumerate(columns)
    ]
    return np.dtype(fields)


def _pcd_ascii(body: bytes, row: np.dtype, count: int) -> Points:
    names = [name for name in row.names or () for _ in range(int(np.prod(row[name].shape)))]  # of the columns
    lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
    check_count(count, len(lines), "points")
    if count == 0:
        return np.empty((0, 3))
    return np.loadtxt(lines[:count], usecols=[names.index(axis) for axis in "xyz"], ndmin=2)


def _pcd_compressed(body: bytes, row: np.dtype, count: int) -> Points:
    """Points of a compressed body: two sizes, then LZF data with all values of one field together."""
    if len(body) < 8:
        raise ValueError("it is truncated after its header")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    check_count(count, unpacked // row.itemsize, "points")
    data = _lzf_decompress(body[8 : 8 + packed], unpacked)
    starts = {name: count * offset for name, (_, offset, *_) in (row.fields or {}).items()}
    axes = [np.frombuffer(data, row[axis].base, count, starts[axis]) for axis in "xyz"]
    return np.stack([values.astype(float) for values in axes], axis=1)


def _lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress Marc Lehmann's LZF: runs of literals, or copies of ``length`` bytes from ``offset`` back."""
    output = bytearray()
    at = 0
    while at < len(data):
        control = data[at]
        at = at + 1
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


def _zdf_points(path: Path) -> Points:
    with library("netCDF4", "sensors", path).Dataset(path) as file:
        cloud = file["data"]["pointcloud"][:]
    return _check_array(np.ma.filled(np.ma.asarray(cloud, dtype=float), np.nan))


CLOUD_READERS: dict[str, Callable[[Path], Rows]] = {
    ".ply": _ply_points,
    ".pcd": _pcd_points,
    **dict.fromkeys((".xyz", ".txt", ".pts", ".asc", ".csv"), _text_points),
    **dict.fromkeys((".npy", ".npz"), _array_points),
    ".zdf": _zdf_points,
}
"""Parser of each suffix of point clouds."""


def read_pose(path: Path) -> Transform:
    """Rigid pose of a file: 4 x 4 numbers as text or NPY, or ``pose`` of a result's summary.json."""
    with readable(path, "pose"):
        if path.suffix.lower() == ".npy":
            return checked_pose(np.load(path, allow_pickle=False))
        if path.suffix.lower() != ".json":
            return checked_pose(np.loadtxt(path, ndmin=2))
        content = json.loads(path.read_text("utf-8"))
        return checked_pose(content["pose"] if isinstance(content, dict) else content)


Arrays = dict[str, ndarray]
"""Arrays by their names."""


def read_arrays(path: Path) -> Arrays:
    """All arrays of an NPZ file; raises ``SizeError``, and whatever damage makes of the parser."""
    with limited_memory(path), path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    if strange := [key for key, value in arrays.items() if not isinstance(value, ndarray)]:
        raise ValueError(f"its entry {strange[0]!r} is no array")
    return arrays
