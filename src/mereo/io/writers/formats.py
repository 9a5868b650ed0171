"""Table of formats: what ``--formats`` writes, and with which function."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float32

from mereo.geometry.conventions import Facts
from mereo.geometry.labels import LabelGrid, SegmentedCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import Matrix
from mereo.io.atomic_files import write_json
from mereo.io.config import Format
from mereo.io.writers.glb import write_segments_glb
from mereo.io.writers.meshes import write_points_ply, write_segments_obj, write_segments_ply, write_segments_stl
from mereo.io.writers.volumes import (
    MM_PER_M,
    nibabel,
    write_labels_nifti,
    write_labels_npz,
    write_labels_seg_nrrd,
    write_labels_vti,
    write_points_npz,
)

SURE = "radius95.glb"
"""Name of the file next to the segments' GLB whose colours say how sure each place of the surfaces is."""


@dataclass(frozen=True, eq=False)
class Results:
    """Reconstruction to be written, in the input's frame and unit.

    Attributes:
        surfaces, labels, summary, radii: of a reconstruction; the last say how sure it is.
        observed: the input's points with their segments; needed for the format "points" only.
        frame_rotation: from the input's frame to glTF's (y up).
        unit_m: metres per unit of the input.
        millimetres: write files that have no unit of their own in millimetres, and not in the input's unit.
    """

    surfaces: SegmentedMesh
    labels: LabelGrid
    observed: SegmentedCloud | None
    frame_rotation: Matrix
    unit_m: float = 1.0
    millimetres: bool = False
    summary: Facts = field(default_factory=dict)
    radii: Radii | None = None

    @property
    def factor(self) -> float:
        """Factor of positions in files that have no unit of their own."""
        return MM_PER_M * self.unit_m if self.millimetres else 1.0

    @property
    def scaled_surfaces(self) -> SegmentedMesh:
        """Surfaces for files that have no unit of their own."""
        return self.surfaces.transformed(np.diag([self.factor] * 3 + [1.0]))

    @cached_property
    def radii_on_grid(self) -> Float32[np.ndarray, "x y z"] | None:
        """Radii at the voxels of ``labels``, in the input's unit."""
        return None if self.radii is None else self.radii.on_grid(self.labels)


def _glb(path: Path, results: Results) -> None:
    content = results.surfaces, results.frame_rotation, results.unit_m, results.radii
    write_segments_glb(path, *content)
    if results.radii is not None:
        write_segments_glb(path.with_name(SURE), *content, colored=True)


def _ply(path: Path, results: Results) -> None:
    radii = None if results.radii is None else results.radii.scaled(results.factor)
    write_segments_ply(path, results.scaled_surfaces, radii)


def _vti(path: Path, results: Results) -> None:
    radii, factor, grid = results.radii_on_grid, results.factor, results.labels
    scaled = None if radii is None else radii * np.float32(factor)
    grid = replace(grid, origin=grid.origin * factor, spacing=grid.spacing * factor)
    write_labels_vti(path, grid, results.surfaces.colors, scaled)


def _points(path: Path, results: Results) -> None:
    cloud = results.observed
    if cloud is None:
        raise ValueError("the observed points have no labels; the format 'points' needs them: pass label_points=True")
    write_points_npz(path.with_suffix(".npz"), cloud)
    write_points_ply(path, replace(cloud, points=cloud.points * results.factor))


class Writer(NamedTuple):
    """Name of a format's file or folder, the main one where there are two, and what makes it at a path."""

    file: str
    write: Callable[[Path, Results], None]


WRITERS: dict[Format, Writer] = {
    "glb": Writer("segments.glb", _glb),
    "ply": Writer("segments.ply", _ply),
    "obj": Writer("segments.obj", lambda path, r: write_segments_obj(path, r.scaled_surfaces)),
    "stl": Writer("stl", lambda path, r: write_segments_stl(path, r.scaled_surfaces)),
    "npz": Writer("labels.npz", lambda path, r: write_labels_npz(path, r.labels, r.radii_on_grid)),
    "vti": Writer("labels.vti", _vti),
    "nifti": Writer("labels.nii.gz", lambda path, r: write_labels_nifti(path, r.labels, r.surfaces.colors, r.unit_m)),
    "seg.nrrd": Writer(
        "labels.seg.nrrd", lambda path, r: write_labels_seg_nrrd(path, r.labels, r.surfaces.colors, r.unit_m)
    ),
    "points": Writer("points.ply", _points),
    "json": Writer("summary.json", lambda path, r: write_json(path, dict(r.summary))),
}
"""Writer of each format, in the order in which they are written."""


def chosen_formats(names: Iterable[str]) -> tuple[Format, ...]:
    """Formats that these names mean, in the table's order; "all" means every one.

    Raises ``ValueError`` for an unknown name and ``ImportError`` for a format whose extra is not installed.
    """
    wanted = set(names)
    if unknown := sorted(wanted - {"all", *get_args(Format)}):
        raise ValueError(f"there is no format {unknown[0]!r}; the formats are {', '.join(WRITERS)} and all: choose one")
    chosen = tuple(name for name in WRITERS if name in wanted or "all" in wanted)
    if "nifti" in chosen:
        nibabel()
    return chosen


def write_single(path: Path, suffix: str, results: Results) -> None:
    """Write the one format whose file has this suffix, as ".glb"; raises as ``chosen_formats``."""
    (name,) = (name for name, writer in WRITERS.items() if writer.file.endswith(suffix) and name != "points")
    chosen_formats([name])
    WRITERS[name].write(path, results)


def write_formats(directory: Path, formats: Iterable[Format], results: Results) -> None:
    """Write each of the formats into an existing directory."""
    for name in formats:
        WRITERS[name].write(directory / WRITERS[name].file, results)
