"""Volumes (NIfTI, NRRD): voxel values with their place in space, and label volumes as segments.

Both formats come out in one frame: RAS, x to the right, y to the front, z to the head, in the file's unit (millimetres
by NIfTI's convention). NRRD files say which frame they are in; those of 3D Slicer are LPS and are turned; without a
space they stay as they are.
"""

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float32, Int, Integer, Shaped
from numpy import ndarray
from numpy.linalg import det, inv, norm
from scipy.ndimage import gaussian_filter

from mereo.geometry.brief import listed
from mereo.geometry.conventions import Texts, WholeNumbers
from mereo.geometry.labels import VoxelMask, part_of_grid
from mereo.geometry.marching_cubes import zero_surface
from mereo.geometry.mesh import PALETTE, Color, Segment, SegmentedMesh, palette_color
from mereo.geometry.transforms import Corners, Flags, Points, Transform, Vector, box_of, transform_points
from mereo.io.config import Space
from mereo.io.errors import check_size, limited_memory, quiet, readable
from mereo.io.extras import library
from mereo.io.readers import in_memory, lies_below

VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd")

FEW = 32
"""Distinct values of whole numbers up to which they are labels whatever they look like."""

SAMPLED = 2_000_000
"""Voxels that are looked at to tell labels from intensities, roughly."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Values on a regular grid, with their place in space.

    Attributes:
        values: as they are stored; what they mean is ``slope * values + intercept``.
        T_world_index: from voxel indices (whole numbers at voxel centres) to positions. Of a file that was read these
            are RAS in the file's unit; what is made of it says its own frame.
        header: of the file, nibabel's or pynrrd's, for what else it says; None for a volume without a file.
    """

    values: Shaped[ndarray, "..."]
    T_world_index: Transform
    slope: float = 1.0
    intercept: float = 0.0
    header: Any = field(default=None, repr=False)

    @property
    def spacing(self) -> Vector:
        """Distance between voxel centres along each axis."""
        return norm(self.T_world_index[:3, :3], axis=0)

    @property
    def bounds(self) -> Corners:
        """Axis-aligned box of the voxels, their own extent included."""
        ends = product(*([-0.5, n - 0.5] for n in self.values.shape))
        corners = transform_points(self.T_world_index, np.array(list(ends)))
        return box_of(corners)

    def index_of(self, points: Points) -> Points:
        """Voxel indices, with fractions, of positions."""
        return transform_points(inv(self.T_world_index), points)

    def holds(self, index: Points) -> Flags:
        """Whether indices with fractions lie in a voxel."""
        return np.all((index >= -0.5) & (index <= np.array(self.values.shape) - 0.5), axis=1)

    def tissue_share(self, points: Points) -> float:
        """Share of points that lie in voxels above the mean: in tissue, and not in air or empty space."""
        index = np.rint(self.index_of(points)).astype(np.int64)
        held = np.all((index >= 0) & (index < self.values.shape), axis=1)
        values = self.values[tuple(index[held].T)].astype(float)
        return float((np.sign(self.slope) * (values - self.values.mean()) > 0).sum() / len(points))


def is_volume(path: Path) -> bool:
    """Whether a file's name is that of a volume."""
    return path.name.lower().endswith(VOLUME_SUFFIXES)


def read_volume(path: Path, kind: str = "volume") -> Volume:
    """Volume of a NIfTI or NRRD file, with as many dimensions as it has; ``kind`` is what messages call it.

    Raises ``FileNotFoundError``, ``ValueError`` for a file that is damaged or holds other than real numbers, and
    ``ImportError`` without the extra `medical`.
    """
    nifti = ".nii" in path.name.lower()
    module = library("nibabel" if nifti else "nrrd", "medical", path)
    with readable(path, kind):
        volume = _nifti(module, path) if nifti else _nrrd(module, path)
    if volume.values.dtype.kind not in "iuf":
        raise ValueError(
            f"{path} has voxels of the type {volume.values.dtype}; each must be one real number: export one channel"
        )
    matrix = volume.T_world_index
    if not (np.isfinite(matrix).all() and abs(det(matrix)) > 1e-12 * np.prod(volume.spacing) > 0):
        raise ValueError(
            f"{path} has voxels whose axes are {matrix[:3, :3].T.tolist()}; they must span space: export it again"
        )
    return volume


def _nifti(nibabel: Any, path: Path) -> Volume:
    image = nibabel.load(path)
    _check_sides(path, image.shape, image.get_data_dtype().itemsize)
    values = image.dataobj.get_unscaled()
    values = values[..., 0] if values.ndim == 4 and values.shape[3] == 1 else values
    slope, intercept = float(image.dataobj.slope), float(image.dataobj.inter)
    return Volume(in_memory(values), np.asarray(image.affine, float), slope, intercept, image.header.copy())


def _nrrd(nrrd: Any, path: Path) -> Volume:
    with path.open("rb") as file:  # names of segments have any letters, which pynrrd drops
        header = nrrd.read_header(line.decode("utf-8", "replace") for line in file)
    _check_sides(path, header["sizes"], 1)
    data = header.get("data file", header.get("datafile"))
    if data is not None and not lies_below(path.parent, path.parent / data):
        raise ValueError(f"its data file {data!r} is not a regular file in its folder or below")
    values, _ = nrrd.read(str(path))
    transform = np.eye(4)
    directions = header.get("space directions")
    if directions is not None:
        transform[:3, :3] = np.asarray(directions, float)[-3:].T  # a row for each axis of the array
    elif "spacings" in header:
        transform[:3, :3] = np.diag(header["spacings"][-3:])
    transform[:3, 3] = header.get("space origin", np.zeros(3))
    return Volume(in_memory(values), _to_ras(str(header.get("space", ""))) @ transform, header=header)


def _check_sides(path: Path, sizes: Iterable[Any], item_bytes: int) -> None:
    sides = [int(side) for side in sizes]
    if min(sides, default=0) < 1:
        raise ValueError(f"its header states the size {' x '.join(map(str, sides))}")
    check_size(path, 2 * item_bytes * math.prod(sides))  # as it is stored, and in the machine's order of bytes


ANATOMICAL = re.compile("(r|l)(?:ight|eft)?-?(a|p)(?:nterior|osterior)?-?(s|i)(?:uperior|nferior)?(?:-?t(?:ime)?)?")
"""Name of an anatomical frame in NRRD files, in small letters; its groups are the letters of the axes."""


def file_space(path: Path) -> Space | None:
    """Anatomical frame that positions of a mesh or a volume are in as they are read; None where its file names none.

    3D Slicer states it in the header of an STL file and in comments of PLY and OBJ files: ``SPACE=LPS``. NIfTI is RAS,
    and an NRRD file that names its space comes out in RAS. Raises ``ValueError`` for a mesh in another space.
    """
    if not path.is_file() or not (path.suffix.lower() in (".stl", ".ply", ".obj") or is_volume(path)):
        return None
    with path.open("rb") as file:
        head = file.read(4096).decode("latin-1")
    if path.suffix.lower() == ".nrrd":
        space = re.search(r"^space: *(\S+)", head, re.MULTILINE)
        return "RAS" if space is not None and ANATOMICAL.fullmatch(space[1].lower()) else None
    if is_volume(path):
        return "RAS"
    space = re.search(r"\bSPACE=([LRAPIS]{3})\b", head)
    if space is not None and space[1] not in get_args(Space):
        raise ValueError(f"{path} is in the space {space[1]}; a mesh is in LPS or RAS: export it in one of them")
    return None if space is None else "LPS" if space[1] == "LPS" else "RAS"


def _to_ras(space: str) -> Transform:
    """Transform to RAS from an anatomical frame, such as left-posterior-superior or LPS; others stay as they are."""
    axes = ANATOMICAL.fullmatch(space.lower())
    return np.diag([*(-1.0 if axis in "lpi" else 1.0 for axis in ("ras" if axes is None else axes.groups())), 1.0])


def read_scalar_volume(path: Path) -> Volume:
    """Volume of three dimensions, of one finite number for each voxel, which has a place; raises as ``read_volume``."""
    volume = read_volume(path)
    if volume.values.ndim != 3:
        raise ValueError(
            f"{path} has {volume.values.ndim} dimensions; a volume that is carried has 3, with one number for each "
            "voxel: export one time step or one component"
        )
    with limited_memory(path):
        is_finite = np.isfinite(volume.values).all()
    if not is_finite:
        raise ValueError(f"{path} has NaN or infinite values; all must be finite: replace them, for example by 0")
    return volume


def segment_fields(header: Any) -> Texts:
    """Fields about the segments of a segmentation of 3D Slicer (``.seg.nrrd``), of a header of any format."""
    fields = header if isinstance(header, Mapping) else {}
    return {key: str(value) for key, value in fields.items() if key.startswith("Segment")}


def is_labels(volume: Volume) -> bool:
    """Whether the values are labels: whole numbers, few different ones or mostly equal to their neighbours.

    Neighbours that both have the least value are left out, as air is even everywhere.
    """
    if volume.values.dtype.kind not in "iu":
        return False
    depth = volume.values.shape[2]
    step = -(-volume.values.size // SAMPLED)
    slices = volume.values[:, :, min(step // 2, depth - 1) :: step]
    if len(np.unique(slices)) <= FEW:
        return True
    least = volume.values.min()
    equal = 0
    counted = 0
    for first, second in ((slices[1:], slices[:-1]), (slices[:, 1:], slices[:, :-1])):
        seen = (first != least) | (second != least)
        equal, counted = equal + int((seen & (first == second)).sum()), counted + int(seen.sum())
    return 2 * equal > counted


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Voxel labels with their place (see ``Volume``), and what their file says of them.

    Attributes:
        labels: 0 in empty space; in several layers where segments overlap, which then have other labels.
        T_world_index: from voxel indices to positions.
        names, colors: of labels, where the file has them.
    """

    labels: Integer[ndarray, "l x y z"]
    T_world_index: Transform
    names: Mapping[int, str]
    colors: Mapping[int, Color] = field(default_factory=dict)

    @cached_property
    def values(self) -> WholeNumbers:
        """Labels above 0 that occur."""
        slices = (part for layer in self.labels for part in np.moveaxis(layer, 2, 0) if part.any())
        return tuple(sorted({int(value) for part in slices for value in np.unique(part)} - {0}))


class LabelWarning(UserWarning):
    """Warning that surfaces are not all that a label volume holds."""


def read_label_volume(*paths: Path) -> LabelVolume:
    """Label volume of whole numbers from 0 up; raises as ``read_volume``.

    A segmentation of 3D Slicer (``.seg.nrrd``) may have several layers, whose segments overlap. Several files are those
    of one segment each on one grid, as automatic segmentation of CT writes them: labels count from 1 in their order,
    names are those of the files, and empty ones are left out with a ``LabelWarning``.
    """
    if len(paths) > 1:
        return _joined_labels(paths)
    (path,) = paths
    if path.exists() and not is_volume(path):
        raise ValueError(f"{path} is no label volume; its name must end in {', '.join(VOLUME_SUFFIXES)}: convert it")
    volume = read_volume(path, "label volume")
    with limited_memory(path):
        return _labels(path, volume)


def _labels(path: Path, volume: Volume) -> LabelVolume:
    with readable(path, "label volume"):
        values = volume.values
        segments = _slicer_segments(volume)
    if values.ndim != 3 and not (values.ndim == 4 and segments):
        raise ValueError(
            f"{path} has {values.ndim} dimensions; a label volume has 3, or the layers of a segmentation of 3D Slicer: "
            "export one label map"
        )
    if values.dtype.kind == "f" or (volume.slope, volume.intercept) != (1.0, 0.0):
        with quiet():  # what becomes of NaN and of numbers beyond all is not what it was
            stored = volume.slope * values + volume.intercept
            values = np.rint(stored).astype(np.int32)
            is_whole = np.array_equal(values, stored)
    else:
        is_whole = True
    if not is_whole or values.min(initial=0) < 0:
        raise ValueError(f"{path} holds values that are no labels; they must be whole numbers from 0: threshold it")
    if values.ndim == 4:
        values = _renumbered(path, values, segments)
        segments = [segment._replace(value=number) for number, segment in enumerate(segments, start=1)]
    names = {segment.value: segment.name for segment in segments}
    colors = {segment.value: segment.color for segment in segments if segment.color is not None}
    return LabelVolume(values if values.ndim == 4 else values[None], volume.T_world_index, names, colors)


class _SlicerSegment(NamedTuple):
    """Segment of a segmentation of 3D Slicer: the voxels of a value in a layer."""

    name: str
    layer: int
    value: int
    color: Color | None


def _slicer_segments(volume: Volume) -> list[_SlicerSegment]:
    """Segments that the header of a segmentation lists; older ones have a layer each."""
    parts = dict[int, Texts]()
    for key, text in segment_fields(volume.header).items():
        if match := re.fullmatch(r"Segment(\d+)_(\w+)", key):
            parts.setdefault(int(match[1]), {})[match[2]] = text
    segments = []
    for number, part in sorted(parts.items()):
        value, layer = int(part.get("LabelValue", 1)), int(part.get("Layer", number))
        shades = [round(255 * float(shade)) for shade in part.get("Color", "").split()]
        is_color = len(shades) == 3 and all(0 <= shade <= 255 for shade in shades)
        color = (shades[0], shades[1], shades[2]) if is_color else None
        segments.append(_SlicerSegment(part.get("Name", f"label_{value}"), layer, value, color))
    return segments


def _renumbered(
    path: Path, layers: Integer[ndarray, "l x y z"], segments: Sequence[_SlicerSegment]
) -> Integer[ndarray, "l x y z"]:
    """Layers in which each segment has its number, from 1 up, as its label: files use a label once for each layer."""
    result = np.zeros(layers.shape, np.int16)
    for number, segment in enumerate(segments, start=1):
        if not 0 <= segment.layer < len(layers):
            raise ValueError(
                f"{path} has {len(layers)} layers, and {segment.name!r} in layer {segment.layer}: save it again"
            )
        result[segment.layer][layers[segment.layer] == segment.value] = number
    if lost := int(((layers > 0) & (result == 0)).sum()):
        raise ValueError(f"{path} has {lost} voxels of no segment that its header lists: save it again with 3D Slicer")
    return result


def _joined_labels(paths: Sequence[Path]) -> LabelVolume:
    """Label volume of files with a segment each."""
    layers = list[ndarray]()
    names = dict[int, str]()
    empty = list[str]()
    for number, path in enumerate(paths, start=1):
        volume = read_label_volume(path)
        if len(volume.values) > 1:
            raise ValueError(
                f"{path} holds the values {listed(map(str, volume.values))}; of several label volumes each has one "
                "segment: name it alone, or write a file for each segment"
            )
        if number == 1:
            first = volume
        _check_same_grid(paths[0], first, path, volume)
        if not volume.values:
            empty.append(path.name)
            continue
        names[number] = re.sub(r"(\.seg)?(\.nii|\.nii\.gz|\.nrrd)$", "", path.name, flags=re.IGNORECASE)
        mask = volume.labels[0] > 0
        free = (layer for layer in layers if not layer[mask].any())
        if (layer := next(free, None)) is None:
            layers.append(layer := np.zeros(mask.shape, np.int16))
        layer[mask] = number
    if empty:
        text = f"{len(empty)} of {len(paths)} label volumes hold only empty space and are left out: {', '.join(empty)}"
        warnings.warn(text, LabelWarning, stacklevel=4)
    return LabelVolume(np.stack(layers or [first.labels[0].astype(np.int16)]), first.T_world_index, names)


def _check_same_grid(path: Path, volume: LabelVolume, other_path: Path, other: LabelVolume) -> None:
    shift = np.abs(volume.T_world_index - other.T_world_index).max()
    if volume.labels.shape[1:] == other.labels.shape[1:] and shift < 0.01 * np.abs(volume.T_world_index[:3, :3]).max():
        return
    raise ValueError(
        f"{other_path} has {other.labels.shape[1:]} voxels from {other.T_world_index[:3, 3]} on, and {path} "
        f"{volume.labels.shape[1:]} from {volume.T_world_index[:3, 3]}, or they have other axes; the segments of one "
        "object share one grid: resample them to it"
    )


# --- surfaces of labels: closed, smoothed, neighbours in contact ------------------------------------------------------

Share = Float32[ndarray, "a b c"]
"""Share of a segment in each cell of a grid, or what is positive inside it."""

SMOOTHING = 0.8
"""Standard deviation of the smoothing, in the longest side of a cell: enough against stairs, and little volume lost."""

MARGIN = 4
"""Empty cells around the object: a segment at the border of the volume is closed there."""

LEAST_VOLUME, WHOLE = 0.6, 0.95
"""Share of its volume that a segment keeps at least; what keeps less is too thin for the grid. And the share from which
nothing is reported as lost."""

LEAST_LEVEL, HALVINGS = 0.1, 6
"""Share of a cell at which the surface of a thin segment lies at least (that of others lies at a half), and how often
the interval between the two is halved."""

LEAST_MARGIN = 1e-3
"""Least distance of a margin from zero: a tie between two segments at a node would make faces without area there."""

NESTED = 0.95
"""Share of a segment's voxels in another one from which it is nested in it."""


class ThinSegmentError(ValueError):
    """Refusal of segments that are too thin for a grid: ``thin`` has a sentence for each."""

    def __init__(self, thin: Texts) -> None:
        super().__init__(next(iter(thin.values())))
        self.thin = thin


def segment_surfaces(volume: LabelVolume, names: Mapping[int, str], cells: int) -> SegmentedMesh:
    """Closed surface of each named label, smoothed, in the volume's world coordinates.

    Labels become shares of the cells of a coarser grid, each smoothed by a Gaussian. The object is where they add up to
    more than a half, and in it a segment is where its share is the largest: so neighbours share one interface. A
    segment that would lose more than ``1 - WHOLE`` of its volume is smoothed less, by each side of a cell instead of
    the longest, and its surface lies where its volume is kept, as far as ``LEAST_LEVEL`` allows.

    Labels without a name count as empty space, and several may share one. Where segments overlap, one that lies in
    another by ``NESTED`` is nested in it, and comes first; else the smaller one has the voxels. ``cells`` are those of
    the grid along the longest side, roughly: a cell is a whole number of voxels. A lost share is reported by a
    ``LabelWarning``. Raises ``ValueError`` for a value that does not occur, and ``ThinSegmentError``.
    """
    if missing := [value for value in names if value not in volume.values]:
        raise ValueError(
            f"the volume has no voxel of {names[missing[0]]!r}, value {missing[0]}; it holds the values "
            f"{', '.join(map(str, volume.values))}: correct `names`"
        )
    layers = volume.labels
    segments = list(dict.fromkeys(names.values()))
    check_size("the label volume", (len(segments) + 3) * layers[0].size)  # a byte for each voxel of a mask
    labels = [[value for value in names if names[value] == name] for name in segments]
    masks = [np.logical_or.reduce([(layers == value).any(axis=0) for value in group]) for group in labels]
    parents = _part_masks(masks)
    grid = _Grid.around(np.logical_or.reduce(masks), volume.T_world_index, cells)
    margins = _margins(_in_partition([grid.share(mask) for mask in masks], parents), parents)
    thin = Texts()
    parts = list[Segment]()
    cell = abs(float(det(volume.T_world_index[:3, :3])))
    for index, (name, margin) in enumerate(zip(segments, margins, strict=True)):
        part = grid.surface(margin, name, volume.colors.get(labels[index][0], palette_color(index)))
        kept = 0.0 if part is None else part.volume / (float(masks[index].sum()) * cell)
        if part is None or kept < LEAST_VOLUME:
            thin[name] = (
                f"segment {name!r} would keep {kept:.0%} of its volume on a grid of {cells} cells; it must keep "
                f"{LEAST_VOLUME:.0%}: raise `cells`, or leave this segment out"
            )
            continue
        if kept < WHOLE:
            text = f"segment {name!r} keeps {kept:.0%} of its volume on a grid of {cells} cells: raise `cells` for more"
            warnings.warn(text, LabelWarning, stacklevel=2)
        parts.append(part)
    if thin:
        raise ThinSegmentError(thin)
    nested = tuple((segments[i], segments[j]) for i, j in parents.items())
    order = dict.fromkeys((*parents, *range(len(parts))))
    return SegmentedMesh(tuple(parts[index] for index in order), nested)


def _part_masks(masks: list[VoxelMask]) -> dict[int, int]:
    """Make masks nested or apart, in place; returns those that are nested, from the smallest on, and what is around."""
    sizes = [int(mask.sum()) for mask in masks]
    order = sorted(range(len(masks)), key=lambda index: sizes[index])
    parents = dict[int, int]()
    for place, small in enumerate(order):
        for large in order[place + 1 :]:
            shared = int((masks[small] & masks[large]).sum())
            if shared >= NESTED * sizes[small]:
                parents.setdefault(small, large)
                masks[large] |= masks[small]
            elif shared:
                masks[large] &= ~masks[small]
    return parents


def _in_partition(shares: Sequence[tuple[Share, float]], parents: Mapping[int, int]) -> list[Share]:
    """Shares that are a half at each segment's surface; what a thin one gains is taken from its siblings."""
    bent = [_bent(share, level) for share, level in shares]
    result = list(bent)
    for index in (index for index, (_, level) in enumerate(shares) if level < 0.5):
        siblings = [i for i in range(len(shares)) if i != index and parents.get(i) == parents.get(index)]
        total = np.sum([bent[other] for other in siblings], axis=0)
        left = np.minimum((1 - bent[index]) / np.maximum(total, np.float32(1e-6)), np.float32(1))
        for other in siblings:
            result[other] = result[other] * left
    return result


def _bent(share: Share, level: float) -> Share:
    """Share from 0 to 1 that is a half where it was ``level``."""
    return share if level == 0.5 else np.interp(share, [0, level, 1], [0, 0.5, 1]).astype(np.float32)


def _margins(shares: Sequence[Share], parents: Mapping[int, int]) -> list[Share]:
    """For each segment what is positive inside it, and 0 on its surface; siblings share interfaces."""
    margins: dict[int | None, Share] = {None: np.full(shares[0].shape, np.float32(np.inf))}
    todo: list[int | None] = [None]
    for parent in todo:
        members = [index for index in range(len(shares)) if parents.get(index) == parent]
        todo += [index for index in members if index in parents.values()]
        group = np.stack([shares[index] for index in members])
        filled = 2 * group.sum(axis=0) - 1
        owner = np.where((filled > 0) & (margins[parent] > 0), group.argmax(axis=0), -1)
        for place, index in enumerate(members):
            others = np.delete(group, place, axis=0).max(axis=0, initial=0)
            sign = np.where(owner == place, np.float32(1), np.float32(-1))
            margin = np.minimum(np.minimum(filled, group[place] - others), margins[parent])
            margins[index] = sign * np.maximum(sign * margin, LEAST_MARGIN)
    return [margins[index] for index in range(len(shares))]


@dataclass(frozen=True, eq=False)
class _Grid:
    """A coarser grid over part of a volume, from the voxel ``first`` on: ``counts`` cells of ``block`` voxels each."""

    first: Int[ndarray, "3"]
    counts: Int[ndarray, "3"]
    block: Int[ndarray, "3"]
    T_world_index: Transform

    @classmethod
    def around(
        cls,
        mask: VoxelMask,
        transform: Transform,
        cells: int,
    ) -> "_Grid":
        """Grid over all that is set, with about ``cells`` along the longest side; cells are whole numbers of voxels."""
        sides = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
        first, end = np.array([side[0] for side in sides]), np.array([side[-1] + 1 for side in sides])
        voxel = norm(transform[:3, :3], axis=0)
        wanted = ((end - first) * voxel).max() / cells
        block = np.maximum(np.rint(wanted / voxel).astype(np.int64), 1)
        return cls(first, -(-(end - first) // block), block, transform)

    def share(self, mask: VoxelMask) -> tuple[Share, float]:
        """Share of each cell that is set, smoothed, with ``MARGIN`` empty cells around; and the one at the surface."""
        end = np.minimum(self.first + self.counts * self.block, mask.shape)
        part = mask[part_of_grid(self.first, end)]
        part = np.pad(part, [(0, int(n)) for n in self.counts * self.block - part.shape])
        (a, b, c), (i, j, k) = self.counts, self.block
        means = np.pad(part.reshape(a, i, b, j, c, k).mean(axis=(1, 3, 5), dtype=np.float32), MARGIN)
        cell = self.block * norm(self.T_world_index[:3, :3], axis=0)
        smooth: Share = gaussian_filter(means, SMOOTHING * cell.max() / cell, mode="constant")
        whole = float(means.sum()) * float(np.prod(cell))
        if self.enclosed(smooth) >= WHOLE * whole:
            return smooth, 0.5
        smooth = gaussian_filter(means, SMOOTHING, mode="constant")
        low = LEAST_LEVEL
        high = 0.5
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if self.enclosed(_bent(smooth, middle)) < whole else (middle, high)
        return smooth, high

    def enclosed(self, share: Share) -> float:
        """Volume of where a share is above a half."""
        inside = np.argwhere(share > 0.5)
        if len(inside) == 0:
            return 0.0
        near = part_of_grid(inside.min(axis=0) - 1, inside.max(axis=0) + 2)
        part = self.surface(share[near] - np.float32(0.5), "", PALETTE[0])
        return 0.0 if part is None else part.volume

    def surface(self, margin: Share, name: str, color: Color) -> Segment | None:
        """Surface where ``margin`` is 0, outward oriented, in world coordinates; None where it is nowhere positive."""
        if margin.max() <= 0:
            return None
        vertices, faces = zero_surface(margin)
        index = (vertices - MARGIN + 0.5) * self.block - 0.5 + self.first
        world = transform_points(self.T_world_index, index)
        # voxel axes may be left-handed
        turned = -1 if det(self.T_world_index[:3, :3]) < 0 else 1
        return Segment(name, color, world, faces[:, ::turned])
