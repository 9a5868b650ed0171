"""Volumes (NIfTI, NRRD): voxel values with their place in space, and label volumes as segments.

Both formats come out in one frame: RAS, x to the right, y to the front, z to the head, in the file's unit (millimetres
by NIfTI's convention). NRRD files say which frame they are in; those of 3D Slicer are LPS and are turned; without a
space they stay as they are.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes

from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.transforms import transform_points
from mereo.io.config import Space
from mereo.io.errors import quiet, readable
from mereo.io.extras import library
from mereo.io.readers import in_memory

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

    values: Shaped[np.ndarray, "..."]
    T_world_index: Float[np.ndarray, "4 4"]
    slope: float = 1.0
    intercept: float = 0.0
    header: Any = field(default=None, repr=False)

    @property
    def spacing(self) -> Float[np.ndarray, "3"]:
        """Distance between voxel centres along each axis."""
        return np.linalg.norm(self.T_world_index[:3, :3], axis=0)

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Axis-aligned box of the voxels, their own extent included."""
        ends = np.stack(np.meshgrid(*([-0.5, n - 0.5] for n in self.values.shape), indexing="ij"), axis=-1)
        corners = transform_points(self.T_world_index, ends.reshape(-1, 3))
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def index_of(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Voxel indices, with fractions, of positions."""
        return transform_points(np.linalg.inv(self.T_world_index), points)

    def holds(self, index: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether indices with fractions lie in a voxel."""
        return np.all((index >= -0.5) & (index <= np.array(self.values.shape) - 0.5), axis=1)

    def tissue_share(self, points: Float[np.ndarray, "n 3"]) -> float:
        """Share of points that lie in voxels above the mean: in tissue, and not in air or empty space."""
        index = np.rint(self.index_of(points)).astype(np.int64)
        held = np.all((index >= 0) & (index < self.values.shape), axis=1)
        values = self.values[tuple(index[held].T)].astype(np.float64)
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
    return volume


def _nifti(nibabel: Any, path: Path) -> Volume:
    image = nibabel.load(path)
    _check_sides(image.shape)
    values = image.dataobj.get_unscaled()
    values = values[..., 0] if values.ndim == 4 and values.shape[3] == 1 else values
    slope, intercept = float(image.dataobj.slope), float(image.dataobj.inter)
    return Volume(in_memory(values), np.asarray(image.affine, float), slope, intercept, image.header.copy())


def _nrrd(nrrd: Any, path: Path) -> Volume:
    with path.open("rb") as file:
        _check_sides(nrrd.read_header(file)["sizes"])
    values, header = nrrd.read(str(path))
    transform = np.eye(4)
    directions = header.get("space directions")
    if directions is not None:
        transform[:3, :3] = np.asarray(directions, dtype=float)[-3:].T  # a row for each axis of the array
    elif "spacings" in header:
        transform[:3, :3] = np.diag(header["spacings"][-3:])
    transform[:3, 3] = header.get("space origin", np.zeros(3))
    return Volume(in_memory(values), _to_ras(str(header.get("space", ""))) @ transform, header=header)


def _check_sides(sizes: Iterable[Any]) -> None:
    sides = [int(side) for side in sizes]
    if min(sides, default=0) < 1:
        raise ValueError(f"its header states the size {' x '.join(map(str, sides))}")


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


def _to_ras(space: str) -> Float[np.ndarray, "4 4"]:
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
    if not np.isfinite(volume.values).all():
        raise ValueError(f"{path} has NaN or infinite values; all must be finite: replace them, for example by 0")
    matrix = volume.T_world_index
    if not (np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 1e-12 * np.prod(volume.spacing) > 0):
        raise ValueError(
            f"{path} has voxels whose axes are {matrix[:3, :3].T.tolist()}; they must span space: export it again"
        )
    return volume


def segment_fields(header: Any) -> dict[str, str]:
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
    least, equal, counted = volume.values.min(), 0, 0
    for first, second in ((slices[1:], slices[:-1]), (slices[:, 1:], slices[:, :-1])):
        seen = (first != least) | (second != least)
        equal, counted = equal + int((seen & (first == second)).sum()), counted + int(seen.sum())
    return 2 * equal > counted


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Voxel labels, 0 in empty space, with their place (see ``Volume``), and the names of values that the file has."""

    labels: Int[np.ndarray, "x y z"]
    T_world_index: Float[np.ndarray, "4 4"]
    names: Mapping[int, str]


def read_label_volume(path: Path) -> LabelVolume:
    """Label volume of three dimensions of whole numbers from 0 up; raises as ``read_volume``."""
    if path.exists() and not is_volume(path):
        raise ValueError(f"{path} is no label volume; its name must end in {', '.join(VOLUME_SUFFIXES)}: convert it")
    volume = read_volume(path, "label volume")
    values = volume.values
    if values.ndim != 3:
        raise ValueError(f"{path} has {values.ndim} dimensions; a label volume has 3: export one label map, not layers")
    with quiet():  # what becomes of NaN and of numbers beyond all is not what it was
        if (volume.slope, volume.intercept) != (1.0, 0.0):
            values = volume.slope * values + volume.intercept
        labels = np.rint(values).astype(np.int64)
    if not (np.array_equal(labels, values) and labels.min(initial=0) >= 0):
        raise ValueError(f"{path} holds values that are no labels; they must be whole numbers from 0: threshold it")
    fields, names = segment_fields(volume.header), dict[int, str]()
    for key, value in fields.items():
        if match := re.fullmatch(r"Segment(\d+)_LabelValue", key):
            names[int(value)] = fields.get(f"Segment{match[1]}_Name", f"label_{value}")
    return LabelVolume(labels, volume.T_world_index, names)


# --- surfaces of labels: closed, smoothed, neighbours in contact ------------------------------------------------------

SMOOTHING = 0.8
"""Standard deviation of the smoothing, in the longest side of a cell: enough against stairs, and little volume lost."""

MARGIN = 4
"""Empty cells around the object: a segment at the border of the volume is closed there."""

LEAST_VOLUME = 0.6
"""Share of its volume that a segment keeps at least; what keeps less is too thin for the grid."""

LEAST_MARGIN = 1e-3
"""Least distance of a margin from zero: a tie between two segments at a node would make faces without area there."""


def segment_surfaces(volume: LabelVolume, names: Mapping[int, str], cells: int) -> SegmentedMesh:
    """Closed surface of each named label, smoothed, in the volume's world coordinates.

    Labels become shares of the cells of a coarser grid, each smoothed by a Gaussian. The object is where they add up to
    more than a half, and in it a segment is where its share is the largest: so neighbours share one interface.

    Labels without a name count as empty space, and several may share one. ``cells`` are those of the grid along the
    longest side, roughly: a cell is a whole number of voxels. Raises ``ValueError`` for a value that does not occur,
    and for a segment too thin for the grid.
    """
    present = np.unique(volume.labels)
    if missing := [value for value in names if value not in present]:
        raise ValueError(
            f"the volume has no voxel of {names[missing[0]]!r}, value {missing[0]}; it holds the values "
            f"{', '.join(map(str, present[present > 0]))}: correct `names`"
        )
    segments = list(dict.fromkeys(names.values()))
    masks = [np.isin(volume.labels, [value for value in names if names[value] == name]) for name in segments]
    grid = _Grid.around(np.logical_or.reduce(masks), volume.T_world_index, cells)
    shares = np.stack([grid.share(mask) for mask in masks])
    filled = 2 * shares.sum(axis=0) - 1
    owner = np.where(filled > 0, shares.argmax(axis=0), -1)
    parts = []
    for index, name in enumerate(segments):
        others = np.delete(shares, index, axis=0).max(axis=0, initial=0)
        sign = np.where(owner == index, np.float32(1), np.float32(-1))
        margin = sign * np.minimum(filled, shares[index] - others)
        part = grid.surface(sign * np.maximum(margin, LEAST_MARGIN), name, index)
        true = float(masks[index].sum()) * abs(float(np.linalg.det(volume.T_world_index[:3, :3])))
        if part is None or part.volume < LEAST_VOLUME * true:
            raise ValueError(
                f"segment {name!r} would keep {0 if part is None else part.volume / true:.0%} of its volume on a grid "
                f"of {cells} cells; it must keep {LEAST_VOLUME:.0%}: raise `cells`, or leave this segment out"
            )
        parts.append(part)
    return SegmentedMesh(tuple(parts))


@dataclass(frozen=True, eq=False)
class _Grid:
    """A coarser grid over part of a volume, from the voxel ``first`` on: ``counts`` cells of ``block`` voxels each."""

    first: Int[np.ndarray, "3"]
    counts: Int[np.ndarray, "3"]
    block: Int[np.ndarray, "3"]
    T_world_index: Float[np.ndarray, "4 4"]

    @classmethod
    def around(cls, mask: Bool[np.ndarray, "x y z"], transform: Float[np.ndarray, "4 4"], cells: int) -> "_Grid":
        """Grid over all that is set, with about ``cells`` along the longest side; cells are whole numbers of voxels."""
        sides = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
        first, end = np.array([side[0] for side in sides]), np.array([side[-1] + 1 for side in sides])
        voxel = np.linalg.norm(transform[:3, :3], axis=0)
        wanted = ((end - first) * voxel).max() / cells
        block = np.maximum(np.rint(wanted / voxel).astype(np.int64), 1)
        return cls(first, -(-(end - first) // block), block, transform)

    def share(self, mask: Bool[np.ndarray, "x y z"]) -> Float32[np.ndarray, "a b c"]:
        """Share of each cell that is set, smoothed, with ``MARGIN`` empty cells around."""
        end = np.minimum(self.first + self.counts * self.block, mask.shape)
        part = mask[tuple(slice(a, b) for a, b in zip(self.first, end, strict=True))]
        part = np.pad(part, [(0, int(n)) for n in self.counts * self.block - part.shape])
        (a, b, c), (i, j, k) = self.counts, self.block
        means = part.reshape(a, i, b, j, c, k).mean(axis=(1, 3, 5), dtype=np.float32)
        cell = self.block * np.linalg.norm(self.T_world_index[:3, :3], axis=0)
        smooth: Float32[np.ndarray, "a b c"] = gaussian_filter(
            np.pad(means, MARGIN), SMOOTHING * cell.max() / cell, mode="constant"
        )
        return smooth

    def surface(self, margin: Float32[np.ndarray, "a b c"], name: str, number: int) -> Segment | None:
        """Surface where ``margin`` is 0, outward oriented, in world coordinates; None where it is nowhere positive."""
        if margin.max() <= 0:
            return None
        vertices, faces, _, _ = marching_cubes(margin, 0.0, gradient_direction="ascent")
        index = (vertices - MARGIN + 0.5) * self.block - 0.5 + self.first
        world = index @ self.T_world_index[:3, :3].T + self.T_world_index[:3, 3]
        # voxel axes may be left-handed
        turned = -1 if np.linalg.det(self.T_world_index[:3, :3]) < 0 else 1
        return Segment(name, PALETTE[number % len(PALETTE)], world, faces[:, ::turned].astype(np.int64))
