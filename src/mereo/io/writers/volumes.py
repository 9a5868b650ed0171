"""Label grids and volumes for numpy (NPZ), ParaView (VTI) and medical viewers (NIfTI, NRRD, 3D Slicer's ``.seg.nrrd``).

NPZ and VTI are in the grid's frame and unit. The VTI is written by hand: it is a page of XML around compressed arrays,
and VTK itself is 100 MB (https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html).

Files for medical viewers are in millimetres. The rule: **LPS coordinates in millimetres are the input's coordinates**,
axis by axis, so that an axial slice is what the camera saw (docs/design/0012-files-out.md). NIfTI counts in RAS, so
there the first two axes change sign. NRRD is written here and not by pynrrd, which takes ASCII only (names may have any
letters) and writes the time of day.
"""

import base64
import gzip
import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from mereo.geometry.conventions import Texts
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import Color
from mereo.geometry.transforms import Transform, Vector
from mereo.io.atomic_files import atomic_file, write_file
from mereo.io.errors import AnyPath
from mereo.io.extras import library
from mereo.io.volume_files import Volume, segment_fields
from mereo.io.writers.meshes import segment_table

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


def write_labels_npz(path: AnyPath, grid: LabelGrid, radii: Float32[ndarray, "x y z"] | None = None) -> None:
    """Write a label grid for numpy: the arrays ``labels``, ``origin``, ``spacing`` and ``names``.

    Voxel [i, j, k] is centred at ``origin + [i, j, k] * spacing``, in the input's frame and units. ``names[k]`` is the
    segment of label k + 1; label 0 is empty space. ``radii`` become ``radius95``, in the input's unit, NaN in empty
    space. Raises ``ValueError`` for a label without a name.
    """
    if (most := int(grid.labels.max(initial=0))) > len(grid.names):
        raise ValueError(f"label {most} has no name among {len(grid.names)}; name every segment")
    sure: dict[str, Any] = {} if radii is None else {"radius95": radii}
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            labels=grid.labels,
            origin=np.asarray(grid.origin, float),
            spacing=np.asarray(grid.spacing, float),
            names=np.asarray(grid.names),
            **sure,
        )


def write_points_npz(path: AnyPath, cloud: SegmentedCloud) -> None:
    """Write the arrays of a cloud: ``points``, ``labels``, ``confidence``, ``occupancy``, ``names`` and ``colors``.

    ``names[k]`` and ``colors[k]`` are of label k + 1. ``confidence`` and ``occupancy`` are a network's, and left out
    without one.
    """
    chances: dict[str, Any] = dict(cloud.chances)
    with atomic_file(path) as partial:
        np.savez_compressed(
            partial,
            points=cloud.points,
            labels=cloud.labels,
            **chances,
            names=np.asarray(cloud.names),
            colors=np.asarray(cloud.colors, np.uint8),
        )


def write_labels_vti(
    path: AnyPath,
    grid: LabelGrid,
    colors: Sequence[Color],
    radii: Float32[ndarray, "x y z"] | None = None,
) -> None:
    """Write VTK image data: the array ``label`` at voxel centres; field data ``segment_names``, ``segment_colors``.

    Coordinates are in the grid's frame and unit, and so are ``radii``, which become the array ``radius95``.
    """
    array = '        <DataArray type="Float32" Name="radius95" format="binary">{}</DataArray>\n'
    codes = (str(code) for name in grid.names for code in (*name.encode("utf-8"), 0))
    text = VTI.format(
        extent=" ".join(f"0 {n - 1}" for n in grid.labels.shape),
        origin=" ".join(map(repr, grid.origin.tolist())),
        spacing=" ".join(map(repr, grid.spacing.tolist())),
        count=len(grid.names),
        names=" ".join(codes),
        colors=" ".join(str(value) for color in colors for value in color),
        labels=_compressed(grid.labels),
        radii="" if radii is None else array.format(_compressed(radii.astype("<f4"))),
    )
    write_file(path, text)


def _compressed(values: ndarray) -> str:
    """Values as one zlib block; its head has the number of blocks, the bytes of each, of a partial one, and packed."""
    packed = zlib.compress(values.tobytes(order="F"))
    head = struct.pack("<4Q", 1, values.nbytes, 0, len(packed))
    return base64.b64encode(head).decode() + base64.b64encode(packed).decode()


# --- medical viewers: NIfTI, NRRD, 3D Slicer's seg.nrrd ---------------------------------------------------------------

MM_PER_M = 1000.0

RAS_FROM_LPS = np.array([-1.0, -1.0, 1.0, 1.0])[:, None]

LEVEL = 6
"""Level of compression of volumes: of intensities, 9 takes three times as long and saves a hundredth."""

NRRD_HEADER = """{magic}
# written by mereo; format: http://teem.sourceforge.net/nrrd/format.html
type: {type}
dimension: 3
space: left-posterior-superior
sizes: {sizes}
space directions: {directions}
kinds: domain domain domain
endian: little
encoding: gzip
space origin: {origin}
{fields}
"""


def write_labels_nifti(path: AnyPath, grid: LabelGrid, colors: Sequence[Color], unit_m: float = 1.0) -> None:
    """Write NIfTI-1 (``.nii`` or ``.nii.gz``): ``RAS = diag(-1, -1, 1) * position * 1000 * unit_m``.

    NIfTI has no place for the names of labels. They stand as JSON in a comment of the header:
    ``{"segments": [{"label", "name", "color"}, ...]}``. ``grid`` is in the input's frame and unit, of which ``unit_m``
    is the metres. Raises ``ImportError`` without the extra `medical`.
    """
    nifti = nibabel()
    image = nifti.Nifti1Image(grid.labels, RAS_FROM_LPS * _T_lps_index(grid, unit_m) + 0.0)  # no -0
    image.header.set_intent("label", name="mereo")
    table = json.dumps({"segments": segment_table(grid.names, colors)})
    # code 6: a comment of plain text
    image.header.extensions.append(nifti.nifti1.Nifti1Extension(6, table.encode("ascii")))
    _write_nifti(Path(path), image, 9)


def _write_nifti(path: Path, image: Any, level: int) -> None:
    image.header.set_xyzt_units("mm")
    image.set_qform(image.affine, code="scanner")
    image.set_sform(image.affine, code="scanner")
    content = image.to_bytes()
    # mtime: the same result gives the same bytes
    is_packed = path.suffix.lower() == ".gz"
    write_file(path, gzip.compress(content, level, mtime=0) if is_packed else content)


def nibabel() -> Any:
    """Library that writes NIfTI; ``ImportError`` says how to get it."""
    return library("nibabel", "medical", "NIfTI")


def _T_lps_index(grid: LabelGrid, unit_m: float) -> Transform:
    """Transform from voxel indices to LPS coordinates in millimetres; ``unit_m`` is metres per unit of the grid."""
    transform = np.eye(4)
    transform[:3, :3] = np.diag(grid.spacing)
    transform[:3, 3] = grid.origin
    transform[:3] *= MM_PER_M * unit_m
    return transform


def write_labels_seg_nrrd(path: AnyPath, grid: LabelGrid, colors: Sequence[Color], unit_m: float = 1.0) -> None:
    """Write a segmentation of 3D Slicer: ``LPS = position * 1000 * unit_m``, with names, colours and labels.

    One layer: a voxel has one label, and inside a nested segment it is the inner one's. Slicer knows the file by its
    end, ``.seg.nrrd``. ``grid`` is in the input's frame and unit, of which ``unit_m`` is the metres.
    """
    fields = Texts()
    for index, color in enumerate(colors):
        fields |= _segment_fields(grid, index, color)
    fields |= {
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|Closed surface|",
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    write_file(path, _nrrd("NRRD0004", grid.labels, _T_lps_index(grid, unit_m), fields, 9))


def _nrrd(magic: str, values: ndarray, T_lps_index: Transform, fields: Texts, level: int) -> bytes:
    header = NRRD_HEADER.format(
        magic=magic,
        type={"float32": "float", "float64": "double"}.get(values.dtype.name, values.dtype.name),
        sizes=" ".join(str(n) for n in values.shape),
        directions=" ".join(_vector(axis) for axis in T_lps_index[:3, :3].T),
        origin=_vector(T_lps_index[:3, 3]),
        fields="".join(f"{key}:={value}\n" for key, value in fields.items()),
    )
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    return header.encode("utf-8") + gzip.compress(little.tobytes(order="F"), level, mtime=0)


def _segment_fields(grid: LabelGrid, index: int, color: Color) -> Texts:
    """Fields of a segment. Slicer cuts layers to the extent of their first segment, so all state the grid's."""
    name = " ".join(grid.names[index].split()).replace("\\", "\\\\")  # a backslash begins an escape in NRRD values
    values = {
        "Color": " ".join(f"{value / 255:.6g}" for value in color),
        "ColorAutoGenerated": "0",
        "Extent": " ".join(f"0 {n - 1}" for n in grid.labels.shape),
        "ID": f"Segment_{index + 1}",
        "LabelValue": str(index + 1),
        "Layer": "0",
        "Name": name,
        "NameAutoGenerated": "0",
    }
    return {f"Segment{index}_{key}": value for key, value in values.items()}


def _vector(values: Vector) -> str:
    return f"({','.join(map(repr, values.tolist()))})"


def write_volume(path: Path, volume: Volume, unit_m: float = 1.0) -> None:
    """Write NIfTI-1 (``.nii``, ``.nii.gz``) or NRRD, by the name, in millimetres.

    LPS coordinates in millimetres are the input's coordinates; NIfTI counts in RAS.

    Args:
        path: the file.
        volume: its ``T_world_index`` leads to the input's frame and unit. What else the header of its file says is kept
            where it does not depend on the grid.
        unit_m: metres per unit of the input.

    Raises ``ImportError`` for NIfTI without the extra `medical`.
    """
    T_lps_index = volume.T_world_index.copy()
    T_lps_index[:3] *= MM_PER_M * unit_m
    if ".nii" in path.name.lower():
        _write_volume_nifti(path, volume, RAS_FROM_LPS * T_lps_index + 0.0)  # no -0
        return
    fields = segment_fields(volume.header)
    whole = " ".join(f"0 {n - 1}" for n in volume.values.shape)  # of 3D Slicer's segments
    fields |= {key: whole for key in fields if key.endswith("_Extent")}
    fields |= {key: "0 0 0" for key in fields if key.endswith("Segmentation_ReferenceImageExtentOffset")}
    write_file(path, _nrrd("NRRD0005", volume.values, T_lps_index, fields, LEVEL))


def _write_volume_nifti(path: Path, volume: Volume, T_ras_index: Transform) -> None:
    nifti = nibabel()
    header = volume.header if isinstance(volume.header, nifti.Nifti1Header) else None
    image = nifti.Nifti1Image(volume.values, T_ras_index, header, dtype=volume.values.dtype)
    image.header.set_data_dtype(volume.values.dtype)
    image.header.set_slope_inter(volume.slope, volume.intercept)  # of values that are stored as they are
    _write_nifti(path, image, LEVEL)
