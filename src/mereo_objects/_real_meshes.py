"""Real meshes as solids for the built-in scenes, after ``mesh_repair`` has made them so: largest part, fewer faces."""

import igl
import manifold3d
import numpy as np

from mereo.geometry.mesh_check import mesh_of, solid_of


def main_part(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """Largest of a solid's parts: Booleans of meshes that nearly touch leave flecks."""
    return max(solid.decompose(), key=lambda part: part.volume())


def simplified(solid: manifold3d.Manifold, faces: int, block_intersections: bool = False) -> manifold3d.Manifold:
    """Solid with at most ``faces`` faces: edges collapse, flattest first (Garland & Heckbert, SIGGRAPH 1997).

    Where the surface folds closely upon itself (lips, eyelids), ``block_intersections`` keeps it from passing through
    itself; that takes twice as long.
    """
    vertices, indices = mesh_of(solid)
    fewer = igl.qslim(
        np.asfortranarray(vertices), np.asfortranarray(indices.astype(np.int32)), faces, block_intersections
    )
    return solid_of(fewer[0], fewer[1].astype(np.int64))  # C's long long, which numpy tells apart
