"""What all scenes need of manifold3d: solids joined, and made into segments. Lengths are in scene units."""

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, OpType

from mereo.geometry.mesh import Color, Segment
from mereo.geometry.mesh_check import mesh_of

Vector = tuple[float, float, float]

SIMPLIFY = 1e-3
"""Detail below this is dropped from finished parts; it is far below the camera's noise and spares slivers."""


def segment_of(name: str, color: Color, solid: Manifold) -> Segment:
    """Segment of a solid as it is."""
    return Segment(name, color, *mesh_of(solid))


def segment(name: str, color: Color, part: Manifold, longest_edge: float = np.inf) -> Segment:
    """Segment of a finished part, with no more triangles than its shape needs.

    Edges longer than ``longest_edge`` are split, so that flat faces can bend. It also helps large parts: long slivers
    have large boxes, which slow down searches among them.
    """
    part = part.as_original().simplify(SIMPLIFY)
    return segment_of(name, color, part if longest_edge == np.inf else part.refine_to_length(longest_edge))


def union(*parts: Manifold) -> Manifold:
    """Solid of all parts together."""
    return Manifold.batch_boolean(list(parts), OpType.Add)


def hull(*parts: Manifold) -> Manifold:
    """Convex hull around all parts."""
    return Manifold.batch_hull(list(parts))


def ball(center: Vector, radius: float, sides: int = 12) -> Manifold:
    """Sphere with ``sides`` around its equator."""
    return Manifold.sphere(radius, sides).translate(center)


def rod(start: Vector, end: Vector, start_radius: float, end_radius: float, sides: int = 12) -> Manifold:
    """Tapering limb with round ends."""
    return hull(ball(start, start_radius, sides), ball(end, end_radius, sides))


def revolved(profile: Float[np.ndarray, "n 2"], sides: int) -> Manifold:
    """Lathe part about the z axis from rows (radius, height), counter-clockwise."""
    return Manifold.revolve(CrossSection([profile]), sides)
