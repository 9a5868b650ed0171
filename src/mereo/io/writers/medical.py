"""Label grids for medical viewers: NIfTI and 3D Slicer's ``.seg.nrrd``, both in millimetres, at the same place.

The rule: **LPS coordinates in millimetres are the input's coordinates**, axis by axis (x to the patient's left, y to
the back, z to the head). An axial slice, which viewers draw as seen from the feet with left on the right and back
below, is then what the camera saw: x right, y down, z forward. NIfTI counts in RAS, so there the first two axes change
sign. Why not another rule: docs/design/0012-files-out.md.
"""

import gzip
import json
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color
from mereo.io.atomic_files import atomic_file
from mereo.io.writers.segment_table import segment_table

MM_PER_M = 1000.0

COMMENT = 6
"""Code of NIfTI's header extensions that hold plain text."""

SLICER_HEADER = """NRRD0004
# written by mereo; format: http://teem.sourceforge.net/nrrd/format.html
type: unsigned char
dimension: 3
space: left-posterior-superior
sizes: {sizes}
space directions: {directions}
kinds: domain domain domain
encoding: gzip
space origin: {origin}
{segments}Segmentation_ContainedRepresentationNames:=Binary labelmap|Closed surface|
Segmentation_MasterRepresentation:=Binary labelmap
Segmentation_ReferenceImageExtentOffset:=0 0 0

"""


def write_labels_nifti(path: str | Path, grid: LabelGrid, colors: Sequence[Color], unit_m: float = 1.0) -> None:
    """Write NIfTI-1 (``.nii`` or ``.nii.gz``): ``RAS = diag(-1, -1, 1) * position * 1000 * unit_m``.

    NIfTI has no place for the names of labels. They stand as JSON in a comment of the header:
    ``{"segments": [{"label", "name", "color"}, ...]}``.

    Args:
        path: the file; ``.gz`` compresses it.
        grid: labels in the input's frame and unit.
        colors: of the segments.
        unit_m: metres per unit of the input.

    Raises ``ImportError`` without the extra `medical`.
    """
    nifti: Any = nibabel()
    image = nifti.Nifti1Image(grid.labels, T_ras_index(grid, unit_m))
    image.header.set_xyzt_units("mm")
    image.header.set_intent("label", name="mereo")
    image.set_qform(image.affine, code="scanner")
    image.set_sform(image.affine, code="scanner")
    table = json.dumps({"segments": segment_table(grid.names, colors)})
    image.header.extensions.append(nifti.nifti1.Nifti1Extension(COMMENT, table.encode("ascii")))
    content = image.to_bytes()
    with atomic_file(path) as partial:
        # mtime: the same result gives the same bytes
        partial.write_bytes(gzip.compress(content, mtime=0) if Path(path).suffix == ".gz" else content)


def nibabel() -> Any:
    """Library that writes NIfTI; ``ImportError`` says how to get it."""
    try:
        return import_module("nibabel")
    except ImportError:
        raise ImportError("nibabel is needed to write NIfTI files: pip install 'mereo[medical]'") from None


def T_ras_index(grid: LabelGrid, unit_m: float) -> Float[np.ndarray, "4 4"]:
    """Transform from voxel indices to RAS coordinates in millimetres; ``unit_m`` is metres per unit of the grid."""
    transform = np.eye(4)
    transform[:3, :3] = np.diag(grid.spacing)
    transform[:3, 3] = grid.origin
    ras_from_input = np.array([-1.0, -1.0, 1.0, 1.0])[:, None]
    transform[:3] *= MM_PER_M * unit_m
    return ras_from_input * transform + 0.0  # no -0


def write_labels_seg_nrrd(path: str | Path, grid: LabelGrid, colors: Sequence[Color], unit_m: float = 1.0) -> None:
    """Write a segmentation of 3D Slicer: ``LPS = position * 1000 * unit_m``, with names, colours and labels.

    One layer: a voxel has one label, and inside a nested segment it is the inner one's. Written here and not by pynrrd,
    which takes ASCII only (names may have any letters) and writes the time of day.

    Args:
        path: the file; Slicer knows it as a segmentation by its end, ``.seg.nrrd``.
        grid: labels in the input's frame and unit.
        colors: of the segments.
        unit_m: metres per unit of the input.
    """
    scale = MM_PER_M * unit_m
    directions = " ".join(vector(row) for row in np.diag(grid.spacing * scale))
    header = SLICER_HEADER.format(
        sizes=" ".join(str(n) for n in grid.labels.shape),
        directions=directions,
        origin=vector(grid.origin * scale),
        segments="".join(_segment_fields(grid, index, color) for index, color in enumerate(colors)),
    )
    with atomic_file(path) as partial:
        partial.write_bytes(header.encode("utf-8") + gzip.compress(grid.labels.tobytes(order="F"), mtime=0))


def _segment_fields(grid: LabelGrid, index: int, color: Color) -> str:
    """Header lines of a segment. Slicer cuts layers to the extent of their first segment, so all state the grid's."""
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
    return "".join(f"Segment{index}_{key}:={value}\n" for key, value in values.items())


def vector(values: Float[np.ndarray, "3"]) -> str:
    """A vector as NRRD writes it."""
    return f"({','.join(repr(float(value)) for value in values)})"
