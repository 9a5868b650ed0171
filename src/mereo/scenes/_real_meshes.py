"""Real meshes as solids for the built-in scenes, after ``mesh_repair``: largest part, fewer faces, as a segment."""

import igl
import manifold3d
import numpy as np

from mereo.mesh import Color, Segment
from mereo.mesh_repair import mesh_of, solid_of


def segment_of(name: str, color: Color, solid: manifold3d.Manifold) -> Segment:
    return Segment(name, color, *mesh_of(solid))


def main_part(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """The largest of a solid's parts: Booleans of meshes that nearly touch leave flecks."""
    return max(solid.decompose(), key=lambda part: part.volume())


def simplified(solid: manifold3d.Manifold, faces: int) -> manifold3d.Manifold:
    """The solid with at most ``faces`` faces: edges collapse, flattest first (Garland & Heckbert, SIGGRAPH 1997)."""
    vertices, indices = mesh_of(solid)
    fewer = igl.qslim(np.asfortranarray(vertices), np.asfortranarray(indices.astype(np.int32)), faces, False)
    return solid_of(fewer[0], fewer[1].astype(np.int64))  # C's long long, which numpy tells apart
