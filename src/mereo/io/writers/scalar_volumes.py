"""Volumes of numbers for medical viewers, NIfTI and NRRD, at the same place as the label grids of ``medical``."""

import gzip
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.io.atomic_files import atomic_file
from mereo.io.volume_files import Volume, segment_fields
from mereo.io.writers.medical import MM_PER_M, nibabel, vector

RAS_FROM_INPUT = np.array([-1.0, -1.0, 1.0, 1.0])[:, None]

LEVEL = 6
"""Level of compression: of intensities, 9 takes three times as long and saves a hundredth."""

NRRD_TYPES = {
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "float32": "float",
    "float64": "double",
}
"""Names of numpy's types in NRRD."""

NRRD_HEADER = """NRRD0005
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
{more}
"""


def write_volume(path: Path, volume: Volume, unit_m: float = 1.0) -> None:
    """Write NIfTI-1 (``.nii``, ``.nii.gz``) or NRRD (``.nrrd``, ``.nhdr``), by the name, in millimetres.

    LPS coordinates in millimetres are the input's coordinates, as in ``medical``; NIfTI counts in RAS. A ``.nhdr`` has
    its values beside it, in ``.raw.gz``.

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
        _write_nifti(path, volume, RAS_FROM_INPUT * T_lps_index + 0.0)  # no -0
    else:
        _write_nrrd(path, volume, T_lps_index)


def _write_nifti(path: Path, volume: Volume, T_ras_index: Float[np.ndarray, "4 4"]) -> None:
    nifti: Any = nibabel()
    header = volume.header if isinstance(volume.header, nifti.Nifti1Header) else None
    image = nifti.Nifti1Image(volume.values, T_ras_index, header, dtype=volume.values.dtype)
    image.header.set_data_dtype(volume.values.dtype)
    image.header.set_slope_inter(volume.slope, volume.intercept)  # of values that are stored as they are
    image.header.set_xyzt_units("mm")
    image.set_qform(T_ras_index, code="scanner")
    image.set_sform(T_ras_index, code="scanner")
    content = image.to_bytes()
    with atomic_file(path) as partial:
        # mtime: the same result gives the same bytes
        packed = path.suffix.lower() == ".gz"
        partial.write_bytes(gzip.compress(content, LEVEL, mtime=0) if packed else content)


def _write_nrrd(path: Path, volume: Volume, T_lps_index: Float[np.ndarray, "4 4"]) -> None:
    """By hand and not by pynrrd, for the reasons of ``medical.write_labels_seg_nrrd``; scaled values as they are."""
    values = volume.values.astype(volume.values.dtype.newbyteorder("<"), copy=False)
    detached = path.with_suffix(".raw.gz") if path.suffix.lower() == ".nhdr" else None
    more = "".join(f"{key}:={value}\n" for key, value in _segments(volume).items())
    header = NRRD_HEADER.format(
        type=NRRD_TYPES[volume.values.dtype.name],
        sizes=" ".join(str(n) for n in values.shape),
        directions=" ".join(vector(axis) for axis in T_lps_index[:3, :3].T),
        origin=vector(T_lps_index[:3, 3]),
        more=more if detached is None else f"data file: {detached.name}\n{more}",
    )
    content = gzip.compress(values.tobytes(order="F"), LEVEL, mtime=0)
    if detached is not None:
        with atomic_file(detached) as partial:
            partial.write_bytes(content)
    with atomic_file(path) as partial:
        partial.write_bytes(header.encode("utf-8") + (content if detached is None else b""))


def _segments(volume: Volume) -> dict[str, str]:
    """Fields about the segments of 3D Slicer's segmentations; their extents are those of the whole grid."""
    whole = " ".join(f"0 {n - 1}" for n in volume.values.shape)
    extents = {"_Extent": whole, "Segmentation_ReferenceImageExtentOffset": "0 0 0"}
    fields = segment_fields(volume.header)
    return {
        key: next((own for end, own in extents.items() if key.endswith(end)), value) for key, value in fields.items()
    }
