"""Label volumes (NIfTI, NRRD) as segments: closed surfaces of voxel labels, smoothed, neighbours in contact.

Where their voxels are is read by ``volume_files``: RAS in the file's unit.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes

from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.errors import quiet
from mereo.io.volume_files import VOLUME_SUFFIXES, is_volume, read_volume, segment_fields

SMOOTHING = 0.8
"""Standard deviation of the smoothing, in the longest side of a cell: enough against stairs, and little volume lost."""

MARGIN = 4
"""Empty cells around the object: a segment at the border of the volume is closed there."""

LEAST_VOLUME = 0.6
"""Share of its volume that a segment keeps at least; what keeps less is too thin for the grid."""

LEAST_MARGIN = 1e-3
"""Least distance of a margin from zero: a tie between two segments at a node would make faces without area there."""


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Voxel labels with their place in space.

    Attributes:
        labels: 0 is empty space.
        T_world_index: from voxel indices (whole numbers at voxel centres) to RAS coordinates in the file's unit.
        names: of the values, where the file has them (``.seg.nrrd`` of 3D Slicer).
    """

    labels: Int[np.ndarray, "x y z"]
    T_world_index: Float[np.ndarray, "4 4"]
    names: Mapping[int, str]


def read_label_volume(path: Path) -> LabelVolume:
    """Label volume from a NIfTI or NRRD file of whole numbers.

    Raises ``FileNotFoundError``, ``ValueError`` for anything but three dimensions of whole numbers from 0 up, and
    ``ImportError`` without the extra `medical`.
    """
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
    return LabelVolume(labels, volume.T_world_index, _slicer_names(segment_fields(volume.header)))


def _slicer_names(header: Mapping[str, str]) -> dict[int, str]:
    found = {}
    for key, value in header.items():
        if match := re.fullmatch(r"Segment(\d+)_LabelValue", key):
            found[int(value)] = header.get(f"Segment{match[1]}_Name", f"label_{value}")
    return found


# --- surfaces ---------------------------------------------------------------------------------------------------------


def segment_surfaces(volume: LabelVolume, names: Mapping[int, str], cells: int) -> SegmentedMesh:
    """Closed surface of each named label, smoothed, in the volume's world coordinates.

    Labels become shares of the cells of a coarser grid, each smoothed by a Gaussian. The object is where they add up to
    more than a half, and in it a segment is where its share is the largest: marching cubes gives neighbours the same
    interface, so that they touch without overlap (as in ``extraction``), and no groove runs along it.

    Args:
        volume: the labels; those without a name count as empty space.
        names: of the values; several may share one.
        cells: of the grid along the longest side, roughly: a cell is a whole number of voxels.

    Raises ``ValueError`` for a value that does not occur, and for a segment too thin for the grid.
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
    """A coarser grid over part of a volume; a cell is a block of voxels.

    Attributes:
        first: voxel index of its lowest corner, before the margin.
        counts: cells along each axis, without the margin.
        block: voxels of a cell along each axis.
        T_world_index: of the volume.
    """

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
