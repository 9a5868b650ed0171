"""Maps of space given by a moving surface alone: exact on it, estimated inside.

A surface says nothing about its interior; many motions of the inside agree with it. This one is the biharmonic spline
(the radial function ``r`` in three dimensions, Duchon 1977; as in Carr et al., SIGGRAPH 2001) through a spread of the
surface's vertices, which bends as little as it can and is exact for affine motions. What it misses at the other
vertices is carried inwards from the closest surface point and fades out. How far that is from an elastic solid is
measured in docs/design/0008-simulated-states.md.

Notation: f(p) = s(p) + w(|p - c|) e(c), with the spline s, the closest surface point c, the spline's error e there
(interpolated over the triangle), and a weight w from 1 at the surface to 0 at ``reach``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

from mereo.deformation.maps import smooth_step
from mereo.geometry.farthest_point_sampling import farthest_point_order
from mereo.geometry.mesh import barycentric
from mereo.geometry.read_only import read_only, read_only_view

CONTROLS = 100
"""Vertices that the spline goes through: more cost time in proportion, fewer leave more to the closest point."""

REACH = 3.0
"""Where the spline's error has faded out, in typical distances between neighbouring controls."""


class Surface:
    """Closed surface at rest with its search tree and the spline's system, which all of its states share."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self.vertices = read_only_view(np.ascontiguousarray(vertices, dtype=np.float64))
        self.faces = read_only_view(np.ascontiguousarray(faces, dtype=np.int64))
        self.center = vertices.mean(axis=0)
        self.controls = farthest_point_order(self.vertices, CONTROLS)
        knots = self.vertices[self.controls]
        self.reach = REACH * float(np.median(np.sort(cdist(knots, knots), axis=1)[:, 1]))

    def __getstate__(self) -> dict[str, Any]:
        """State without the search tree, which cannot be pickled; it is built again on first use."""
        return {key: value for key, value in self.__dict__.items() if key != "_tree"}

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    @cached_property
    def _solver(self) -> Float[np.ndarray, "k c"]:
        """From values at the controls to the spline's coefficients: of r at each control, and of 1, x, y, z."""
        count = len(self.controls)
        basis = self._basis(self.vertices[self.controls])
        system = np.zeros((count + 4, count + 4))
        system[:count] = basis
        system[count:, :count] = basis[:, count:].T
        return np.linalg.inv(system)[:, :count]

    @cached_property
    def vertex_basis(self) -> Float[np.ndarray, "v k"]:
        """Basis of the spline at all vertices at rest."""
        return read_only(self._basis(self.vertices))

    def _basis(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p k"]:
        local = points - self.center
        radial = cdist(points, self.vertices[self.controls])
        return np.concatenate([radial, np.ones((len(points), 1)), local], axis=1)

    def coefficients(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "k 3"]:
        """Coefficients of the spline that takes the controls to where they are in ``vertices``."""
        return self._solver @ vertices[self.controls]

    def spline(self, coefficients: Float[np.ndarray, "k 3"], points: Float[np.ndarray, "p 3"]) -> np.ndarray:
        """Values [p, 3] of a spline at points."""
        return self._basis(points) @ coefficients

    def carry(self, values: Float[np.ndarray, "v 3"], points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Values at vertices taken from the closest surface point, fading with its distance."""
        squared, face, place = self._tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points, dtype=np.float64)
        )
        corners = self.faces[face]
        weights = barycentric(self.vertices[corners], place)
        fade = 1.0 - smooth_step(np.sqrt(squared) / self.reach)
        return fade[:, None] * np.einsum("pk,pki->pi", weights, values[corners])


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Map of space that one state of a surface gives; satisfies ``Deformation``.

    Attributes:
        rest: the surface at rest.
        vertices: its deformed vertices, which the map meets exactly.
    """

    rest: Surface
    vertices: Float[np.ndarray, "v 3"]

    @cached_property
    def _coefficients(self) -> Float[np.ndarray, "k 3"]:
        return self.rest.coefficients(self.vertices)

    @cached_property
    def _error(self) -> Float[np.ndarray, "v 3"]:
        return self.vertices - self.rest.vertex_basis @ self._coefficients

    def __call__(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Images of points: exact on the surface, estimated inside."""
        return self.rest.spline(self._coefficients, points) + self.rest.carry(self._error, points)
