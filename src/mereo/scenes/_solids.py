"""Small helpers between manifold3d's solids and the package's segments. Lengths are in scene units."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, OpType

from mereo.mesh import Color, Segment

Vector = tuple[float, float, float]

SIMPLIFY = 1e-3
"""Detail below this is dropped from finished parts; it is far below the camera's noise and spares slivers."""


def union(parts: Iterable[Manifold]) -> Manifold:
    """All parts as one solid."""
    return Manifold.batch_boolean(list(parts), OpType.Add)


def hull(parts: Iterable[Manifold]) -> Manifold:
    """The convex hull around all parts."""
    return Manifold.batch_hull(list(parts))


def ball(center: Vector, radius: float, sides: int = 12) -> Manifold:
    """A sphere; ``sides`` around its equator."""
    return Manifold.sphere(radius, sides).translate(center)


def rod(start: Vector, end: Vector, start_radius: float, end_radius: float, sides: int = 12) -> Manifold:
    """A tapering limb with round ends."""
    return hull((ball(start, start_radius, sides), ball(end, end_radius, sides)))


def turned(profile: Float[np.ndarray, "n 2"], sides: int) -> Manifold:
    """A lathe part about the z axis from rows (radius, height), counter-clockwise."""
    return Manifold.revolve(CrossSection([profile]), sides)


def to_segment(name: str, color: Color, solid: Manifold, longest_edge: float | None = None) -> Segment:
    """A finished part; edges longer than ``longest_edge`` are split, so that its flat faces can bend."""
    solid = solid.simplify(SIMPLIFY)
    if longest_edge is not None:
        solid = solid.refine_to_length(longest_edge)
    mesh = solid.to_mesh()
    vertices = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    return Segment(name, color, vertices, np.array(mesh.tri_verts, dtype=np.int64))
