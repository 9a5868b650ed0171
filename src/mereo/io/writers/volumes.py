"""Label grids and observed points for numpy (NPZ), label grids for ParaView and VTK (VTI), in their frame and unit.

The VTI is written by hand: it is a page of XML around one compressed array, and VTK itself is 100 MB.
Its format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

import base64
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import Color
from mereo.io.atomic_files import atomic_file

VTI = """<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64" \
compressor="vtkZLibDataCompressor">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}" Direction="1 0 0 0 1 0 0 0 1">
    <FieldData>
      <Array type="String" Name="segment_names" NumberOfTuples="{count}" format="ascii">{names}</Array>
      <DataArray type="UInt8" Name="segment_colors" NumberOfComponents="3" NumberOfTuples="{count}" format="ascii">\
{colors}</DataArray>
    </FieldData>
    <Piece Extent="{extent}">
      <PointData Scalars="label">
        <DataArray type="UInt8" Name="label" format="binary">{labels}</DataArray>
{radii}      </PointData>
    </Piece>
  </ImageData>
</VTKFile>
"""


def write_labels_npz(path: str | Path, grid: LabelGrid, radii: Float32[np.ndarray, "x y z"] | None = None) -> None:
    """Write a label grid for numpy: the arrays ``labels``, ``origin``, ``spacing`` and ``names``.

    Voxel [i, j, k] is centred at ``origin + [i, j, k] * spacing``, in the input's frame and units. ``names[k]`` is the
    segment of label k + 1; label 0 is empty space. Where ``radii`` are known, ``radius95`` is the radius around each
    voxel that holds the true place of what is there with probability 0.95, in the input's unit, NaN in empty space.
    Raises ``ValueError`` for a label without a name.
    """
    if grid.labels.size and int(grid.labels.max()) > len(grid.names):
        raise ValueError(f"label {int(grid.labels.max())} has no name among {len(grid.names)}; name every segment")
    arrays: dict[str, Any] = {
        "labels": grid.labels,
        "origin": np.asarray(grid.origin, dtype=np.float64),
        "spacing": np.asarray(grid.spacing, dtype=np.float64),
        "names": np.asarray(grid.names),
    }
    if radii is not None:
        arrays["radius95"] = radii
    with atomic_file(path) as partial:
        np.savez_compressed(partial, **arrays)


def write_points_npz(path: str | Path, cloud: SegmentedCloud) -> None:
    """Write an NPZ file with the arrays of a ``SegmentedCloud``.

    They are ``points``, ``labels``, ``confidence``, ``occupancy``, ``names`` and ``colors``; ``names[k]`` and
    ``colors[k]`` are of label k + 1. ``confidence`` and ``occupancy`` are a network's, and left out without one.
    Positions are in the cloud's frame and unit.
    """
    chances: dict[str, Any] = dict(cloud.chances)
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            points=cloud.points,
            labels=cloud.labels,
            **chances,
            names=np.asarray(cloud.names),
            colors=np.asarray(cloud.colors, dtype=np.uint8),
        )


def write_labels_vti(
    path: str | Path,
    grid: LabelGrid,
    colors: Sequence[Color],
    radii: Float32[np.ndarray, "x y z"] | None = None,
) -> None:
    """Write VTK image data: the array ``label`` at voxel centres; field data ``segment_names``, ``segment_colors``.

    ``segment_names[k]`` is the segment of label k + 1; label 0 is empty space. Coordinates are in the grid's frame and
    unit, and so are ``radii``, which become the array ``radius95``.
    """
    array = '        <DataArray type="Float32" Name="radius95" format="binary">{}</DataArray>\n'
    codes = (str(code) for name in grid.names for code in (*name.encode("utf-8"), 0))
    text = VTI.format(
        extent=" ".join(f"0 {n - 1}" for n in grid.labels.shape),
        origin=_numbers(grid.origin),
        spacing=_numbers(grid.spacing),
        count=len(grid.names),
        names=" ".join(codes),
        colors=" ".join(str(value) for color in colors for value in color),
        labels=_compressed(grid.labels),
        radii="" if radii is None else array.format(_compressed(radii.astype("<f4"))),
    )
    with atomic_file(path) as partial:
        partial.write_text(text, "utf-8")


def _numbers(values: Float[np.ndarray, "3"]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _compressed(values: np.ndarray) -> str:
    """Values of voxels as one zlib block, x running fastest.

    The head has the number of blocks, the bytes of each and of a partial one, and those that are packed.
    """
    packed = zlib.compress(values.tobytes(order="F"))
    head = struct.pack("<4Q", 1, values.nbytes, 0, len(packed))
    return base64.b64encode(head).decode() + base64.b64encode(packed).decode()
