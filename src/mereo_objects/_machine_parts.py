"""Machine elements as solids: plates, shafts, turned parts, bolts, toothed wheels; all aligned with the x, y or z axis.

Lengths are in scene units. A part along an axis is first made along z, then turned by the cyclic exchange of axes that
takes z there. So an outline (u, v) lies in (x, y) for parts along z, in (y, z) along x, and in (z, x) along y.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from mereo_objects._solids import Vector, hull, segment, union

__all__ = [
    "Vector",
    "along",
    "bolts",
    "box",
    "hull",
    "plate",
    "ring_of",
    "segment",
    "shaft",
    "toothed",
    "turned",
    "union",
    "without",
]

Axis = Literal["x", "y", "z"]
Outline = Sequence[tuple[float, float]]


def along(axis: Axis, part: Manifold) -> Manifold:
    """Part made along z, turned to ``axis``."""
    shift = {"x": 1, "y": 2, "z": 0}[axis]
    turn = np.roll(np.eye(3), shift, axis=0)
    return part.transform(np.column_stack([turn, np.zeros(3)]))


def box(low: Vector, high: Vector, chamfer: float = 0.0) -> Manifold:
    """Block between two corners, its twelve edges cut off by ``chamfer``."""
    lower, upper = np.array(low), np.array(high)
    if chamfer == 0.0:
        return Manifold.cube(tuple(upper - lower)).translate(low)
    corners = []
    for axis in range(3):  # three blocks, each of full length along one axis: their hull has all edges chamfered
        inset = np.where(np.arange(3) == axis, 0.0, chamfer)
        ends = np.stack([lower + inset, upper - inset])
        corners.append(np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3))
    return Manifold.hull_points(np.concatenate(corners))


def shaft(
    axis: Axis, start: Vector, length: float, radius: float, end_radius: float = -1.0, sides: int = 24
) -> Manifold:
    """Cylinder or cone from ``start`` along ``axis``; a negative ``length`` goes the other way."""
    part = Manifold.cylinder(abs(length), radius, end_radius, sides)
    if length < 0:
        part = part.rotate((180.0, 0.0, 0.0))
    return along(axis, part).translate(start)


def turned(axis: Axis, center: Vector, profile: Outline, sides: int = 24) -> Manifold:
    """Lathe part: ``profile`` lists (position along the axis, radius), both ends are closed towards the axis."""
    outline = [(0.0, profile[0][0]), *((radius, height) for height, radius in profile), (0.0, profile[-1][0])]
    return along(axis, Manifold.revolve(_section(outline), sides)).translate(center)


def plate(axis: Axis, outline: Outline, low: float, high: float) -> Manifold:
    """Flat part with an ``outline`` between two positions along ``axis``."""
    return along(axis, Manifold.extrude(_section(outline), high - low).translate((0.0, 0.0, low)))


def _section(outline: Outline) -> CrossSection:
    section = CrossSection([np.array(outline, dtype=float)])
    return section if section.area() > 0 else CrossSection([np.array(outline[::-1], dtype=float)])


def ring_of(axis: Axis, center: Vector, radius: float, count: int, first_rad: float = 0.0) -> list[Vector]:
    """Places, ``count`` of them, evenly on a circle about ``axis``; angles count in the outline's plane (u, v)."""
    angle = first_rad + 2 * np.pi * np.arange(count) / count
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    shift = {"x": 1, "y": 2, "z": 0}[axis]
    return [(float(x), float(y), float(z)) for x, y, z in np.roll(circle, shift, axis=1) + np.array(center)]


def bolts(axis: Axis, places: Iterable[Vector], height: float, radius: float, sides: int = 6) -> Manifold:
    """Bolt heads standing ``height`` above ``places`` (negative: the other way), rooted half as deep."""
    root = 0.5 * height
    heads = [shaft(axis, _moved(place, axis, -root), height + root, radius, sides=sides) for place in places]
    return union(*heads)


def _moved(place: Vector, axis: Axis, distance: float) -> Vector:
    x, y, z = np.array(place) + distance * np.eye(3)["xyz".index(axis)]
    return (float(x), float(y), float(z))


def toothed(axis: Axis, start: Vector, length: float, radius: float, teeth: int, depth: float) -> Manifold:
    """Straight toothed wheel: ``radius`` over the teeth, trapezoids of ``depth``."""
    pitch = 2 * np.pi / teeth
    outline = [
        (r * np.cos(tooth * pitch + share * pitch), r * np.sin(tooth * pitch + share * pitch))
        for tooth in range(teeth)
        for share, r in ((0.0, radius - depth), (0.35, radius - depth), (0.5, radius), (0.85, radius))
    ]
    part = Manifold.extrude(_section(outline), length)
    return along(axis, part).translate(start)


def without(part: Manifold, *cuts: Manifold) -> Manifold:
    """Solid ``part`` minus all ``cuts``."""
    return Manifold.batch_boolean([part, *cuts], OpType.Subtract)
