"""An angle of two unequal arms, in millimetres: an object that a search finds, as it has no symmetry."""

from pathlib import Path

import trimesh
from shapes import box


def write_part(folder: Path, name: str, low: tuple[float, ...], high: tuple[float, ...]) -> Path:
    part = box(low, high, name)
    fine = trimesh.Trimesh(part.vertices, part.faces).subdivide().subdivide().subdivide()
    fine.export(folder / f"{name}.stl")
    return folder / f"{name}.stl"


def write_angle(folder: Path) -> list[Path]:
    """Files of the two arms."""
    long = write_part(folder, "long", (0, 0, 0), (120, 30, 25))
    return [long, write_part(folder, "short", (0, 30, 0), (40, 95, 25))]
