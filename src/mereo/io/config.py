"""Files for other programs: one module per format, and ``formats`` with the table of them all.

What is written where, in which frame and unit, and why: docs/design/0012-files-out.md. This module imports nothing
heavy, because the command line reads its options from here.
"""

from dataclasses import dataclass
from typing import Literal

Format = Literal["glb", "ply", "obj", "stl", "npz", "vti", "nifti", "seg.nrrd", "points", "json"]


@dataclass(frozen=True)
class FilesConfig:
    """Which files a reconstruction becomes.

    Attributes:
        formats: surfaces as glb, ply, obj, stl; labels as npz, vti (ParaView), nifti, seg.nrrd (3D Slicer); points,
            the observed ones with their segments; json, the figures; or all.
        millimetres: write ply, obj, stl, vti and points.ply, which have no unit, in millimetres and not in the input's.
    """

    formats: tuple[Format | Literal["all"], ...] = ("glb", "npz", "json")
    millimetres: bool = False


DEFAULT_FILES = FilesConfig()
