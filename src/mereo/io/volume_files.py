"""Volumes (NIfTI, NRRD): voxel values with their place in space, read and written.

Both formats come out in one frame: RAS, x to the right, y to the front, z to the head, in the file's unit (millimetres
by NIfTI's convention). NRRD files say which frame they are in; those of 3D Slicer are LPS and are turned; without a
space they stay as they are.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mereo.geometry.transforms import transform_points
from mereo.io.errors import readable

VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr")


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
        slope, intercept: scaling of the values that the file states.
        header: of the file, for what else it says: that of NIfTI as nibabel has it, the fields of NRRD as pynrrd has
            them; None for a volume without a file.
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


def is_volume(path: Path) -> bool:
    """Whether a file's name is that of a volume."""
    return path.name.lower().endswith(VOLUME_SUFFIXES)


def read_volume(path: Path, kind: str = "volume") -> Volume:
    """Volume of a NIfTI or NRRD file, with as many dimensions as it has.

    Args:
        path: the file, whose name ``is_volume``.
        kind: what it should be, for messages: "label volume".

    Raises ``FileNotFoundError``, ``ValueError`` for a file that is damaged or holds other than real numbers, and
    ``ImportError`` without the extra `medical`.
    """
    nifti = ".nii" in path.name.lower()
    library: Any = _library("nibabel" if nifti else "nrrd", kind)
    with readable(path, kind):
        volume = _nifti(library, path) if nifti else _nrrd(library, path)
    if volume.values.dtype.kind not in "iuf":
        raise ValueError(
            f"{path} has voxels of the type {volume.values.dtype}; each must be one real number: export one channel"
        )
    return volume


def _library(name: str, kind: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise ImportError(f"{name} is needed to read {kind}s: pip install 'mereo[medical]'") from None


def _nifti(nibabel: Any, path: Path) -> Volume:
    image = nibabel.load(path)
    _check_sides(image.shape)
    values = _in_memory(image.dataobj.get_unscaled())
    values = values[..., 0] if values.ndim == 4 and values.shape[3] == 1 else values
    slope, intercept = float(image.dataobj.slope), float(image.dataobj.inter)
    return Volume(values, np.asarray(image.affine, float), slope, intercept, image.header.copy())


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
    return Volume(_in_memory(values), _to_ras(str(header.get("space", ""))) @ transform, header=header)


def _in_memory(values: np.ndarray) -> np.ndarray:
    """Values that no longer lie in the file, with the machine's own order of bytes."""
    return np.array(values, dtype=values.dtype.newbyteorder("="))


def _check_sides(sizes: Iterable[Any]) -> None:
    """Raise ``ValueError`` (its reason only) for sizes in a header that are none."""
    sides = [int(side) for side in sizes]
    if min(sides, default=0) < 1:
        raise ValueError(f"its header states the size {' x '.join(map(str, sides))}")


def _to_ras(space: str) -> Float[np.ndarray, "4 4"]:
    """Transform to RAS from an anatomical frame, such as left-posterior-superior or LPS; others stay as they are."""
    words = space.lower().split("-") if "-" in space else list(space.lower())
    words = [{"l": "left", "r": "right", "p": "posterior", "a": "anterior", "i": "inferior"}.get(w, w) for w in words]
    negative = [word in ("left", "posterior", "inferior") for word in words[:3]]
    return np.diag([*(-1.0 if flip else 1.0 for flip in negative), *[1.0] * (4 - len(negative))])


def read_scalar_volume(path: Path) -> Volume:
    """Volume of one finite number for each voxel.

    Raises as ``read_volume``, and ``ValueError`` for more than three dimensions, for values that are not finite and for
    voxels without a place.
    """
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
    found = header if isinstance(header, Mapping) else {}
    return {key: str(value) for key, value in found.items() if key.startswith("Segment")}


def is_labels(volume: Volume) -> bool:
    """Whether the values are labels: whole numbers, few different ones or mostly equal to their neighbours.

    Judged by evenly spread slices. Neighbours that both have the least value are left out, as air is even everywhere.
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
