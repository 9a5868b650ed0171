"""Objects as CAD programs write them: flat faces of a few long triangles, and parts that touch face to face."""

from pathlib import Path

import trimesh
from manifold3d import CrossSection, Manifold

from mereo.geometry.mesh_check import mesh_of

LEVER = (
    *((-130, -22), (-128, -30), (-20, -12), (0, -13), (13, -8), (25, 0.5)),
    *((62, 0.5), (62, 5), (30, 13), (10, 14), (-8, 12), (-24, -1)),
)
"""Outline of the upper lever in millimetres, about the pin at the origin; the lower one is its mirror image."""


def pliers() -> dict[str, Manifold]:
    """Two levers, 6 mm thick, that lie on each other on the plane z = 0, and a pin of 10 mm through both."""
    upper = CrossSection([LEVER]) - CrossSection.circle(5, 40)
    return {
        "upper": upper.extrude(6),
        "lower": upper.mirror((0, 1)).extrude(6).translate((0, 0, -6)),
        "pin": Manifold.cylinder(14, 5, 5, 40).translate((0, 0, -7)),
    }


def write_parts(folder: Path, parts: dict[str, Manifold]) -> list[Path]:
    """STL files of an object's parts, in their order."""
    files = []
    for name, solid in parts.items():
        files.append(folder / f"{name}.stl")
        trimesh.Trimesh(*mesh_of(solid), process=False).export(files[-1])
    return files


def write_pliers(folder: Path) -> list[Path]:
    return write_parts(folder, pliers())


def tongs() -> dict[str, Manifold]:
    """A bar with two pegs 40 mm apart, and a lever on each that turns: each by itself freely, both into each other."""
    peg = Manifold.cylinder(10, 5, 5, 32).translate((0, 0, -5))
    lever = (CrossSection([[(-8, -8), (8, -8), (8, 36), (-8, 36)]]) - CrossSection.circle(5, 32)).extrude(5)
    return {
        "bar": Manifold.cube((60, 20, 5)).translate((-10, -10, -5)) + peg + peg.translate((40, 0, 0)),
        "left": lever,
        "right": lever.translate((40, 0, 0)),
    }
