"""Maps of space given by tetrahedra: where the nodes of a finite-element mesh go, all points in it go along.

A surface inside the mesh, or near it, is moved by the tetrahedra around it, as in SOFA's ``BarycentricMapping``; the
mesh of the simulation may be much coarser than the surface.

Notation: X are node positions at rest, x in the deformed state. In each tetrahedron the map is affine,
``f(p) = A p + b`` with the deformation gradient ``A = D D0^-1``, where the columns of D and D0 are the edges from the
first node, deformed and at rest.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.linalg import det, inv
from scipy.sparse import coo_array, csr_array
from scipy.spatial.distance import cdist

from mereo.deformation.maps import newton, smooth_step
from mereo.geometry.downsampling import farthest_point_order
from mereo.geometry.mesh import Elements, Faces, Vertices, barycentric
from mereo.geometry.read_only import read_only, read_only_view
from mereo.geometry.solids import search_tree
from mereo.geometry.transforms import Matrices, Points, longest_side

Places = Float[ndarray, "p 3"]
"""Positions or vectors in rows: as many as whatever else has the axis ``p``."""

Gradients = Float[ndarray, "m 3 3"]
"""A matrix for each tetrahedron."""


class Tetrahedra:
    """Tetrahedral mesh at rest, in either orientation, with its search trees, which all of its states share.

    Raises ``ValueError`` for NaN, indices that do not exist, and tetrahedra without volume.
    """

    def __init__(self, nodes: Points, elements: Elements) -> None:
        if len(elements) == 0:
            raise ValueError("there are no tetrahedra; at least one is needed: export the volume mesh")
        if not np.isfinite(nodes).all():
            bad = np.argmin(np.isfinite(nodes).all(axis=1))
            raise ValueError(f"rest node {bad} is not finite: export it again")
        if elements.min() < 0 or elements.max() >= len(nodes):
            raise ValueError(
                f"a tetrahedron refers to node {int(elements.max() if elements.min() >= 0 else elements.min())}, but "
                f"there are {len(nodes)}; indices run from 0: subtract 1 where they were counted from 1"
            )
        self.nodes = read_only_view(np.ascontiguousarray(nodes, float))
        self.elements = read_only_view(np.ascontiguousarray(elements, np.int64))
        edges = _edges(self.nodes, self.elements)
        self.volumes = det(edges) / 6
        size = longest_side(self.nodes)
        if (flat := np.abs(self.volumes) <= 1e-12 * size**3).any():
            raise ValueError(
                f"tetrahedron {np.argmax(flat)} has no volume at rest; it must have some: remove it from the mesh"
            )
        self._rest_inverse = inv(edges)

    def __getstate__(self) -> dict[str, Any]:
        """State without the search trees, which cannot be pickled; they are built again on first use."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_tree", "_surface_tree")}

    @cached_property
    def _tree(self) -> igl.AABB:
        return search_tree(self.nodes, self.elements)

    @cached_property
    def surface(self) -> Faces:
        """Faces that one tetrahedron has alone, counter-clockwise from outside."""
        outward = np.where((self.volumes < 0)[:, None], self.elements[:, [1, 0, 2, 3]], self.elements)
        return read_only(np.ascontiguousarray(igl.boundary_facets(outward)[0].astype(np.int64)))

    @cached_property
    def _surface_tree(self) -> igl.AABB:
        return search_tree(self.nodes, self.surface)

    @cached_property
    def _node_mean(self) -> csr_array:
        """From values of tetrahedra to their means at nodes, weighted by volume."""
        weight = np.repeat(np.abs(self.volumes), 4)
        rows = self.elements.ravel()
        columns = np.repeat(np.arange(len(self.elements)), 4)
        total = np.bincount(rows, weights=weight, minlength=len(self.nodes))
        return coo_array((weight / total[rows], (rows, columns)), (len(self.nodes), len(self.elements))).tocsr()

    @property
    def shape_gradients(self) -> Float[ndarray, "m 4 3"]:
        """Gradients of the linear functions that are 1 at a tetrahedron's corner and 0 at its others."""
        return np.concatenate([-self._rest_inverse.sum(axis=1, keepdims=True), self._rest_inverse], axis=1)

    def volume_ratios(self, nodes: Points) -> Float[ndarray, " m"]:
        """Volume of each tetrahedron at other node positions, of that at rest; 0 or less where it is inverted."""
        return det(_edges(nodes, self.elements)) / (6 * self.volumes)

    def gradients(self, nodes: Points) -> Gradients:
        """Deformation gradients A of all tetrahedra at other node positions."""
        return _edges(nodes, self.elements) @ self._rest_inverse

    def node_gradients(self, gradients: Gradients) -> Matrices:
        """Gradients averaged at nodes, which makes them continuous over the surface."""
        return np.reshape(self._node_mean @ gradients.reshape(-1, 9), (-1, 3, 3))

    def locate(self, points: Places) -> Int[ndarray, " p"]:
        """Tetrahedron around each point at rest, -1 outside."""
        return _locate(self._tree, self.nodes, self.elements, points)

    def embed(self, points: Places) -> csr_array:
        """Weights [p, n] by which points follow the nodes; outside they follow the closest point of the surface."""
        element = self.locate(points)
        rows, beyond = np.flatnonzero(element >= 0), np.flatnonzero(element < 0)
        tetrahedra = element[rows]
        offset = points[rows] - self.nodes[self.elements[tetrahedra, 0]]
        weights = np.einsum("pak,pk->pa", self.shape_gradients[tetrahedra], offset)
        weights[:, 0] += 1
        corners, outer, _ = self.closest(points[beyond])
        place = np.concatenate([np.repeat(rows, 4), np.repeat(beyond, 3)])
        nodes = np.concatenate([self.elements[tetrahedra].ravel(), corners.ravel()])
        entries = np.concatenate([weights.ravel(), outer.ravel()])
        return coo_array((entries, (place, nodes)), (len(points), len(self.nodes))).tocsr()

    def closest(self, points: Places) -> tuple[Int[ndarray, "p 3"], Places, Places]:
        """Corners, barycentric weights and place of the closest point of the surface at rest."""
        _, face, place = self._surface_tree.squared_distance(self.nodes, self.surface, np.ascontiguousarray(points))
        corners = self.surface[face]
        return corners, barycentric(self.nodes[corners], place), place


@dataclass(frozen=True, eq=False)
class TetrahedralMap:
    """Map of space that one state of a tetrahedral mesh gives, its deformed ``nodes``; it is ``Invertible``.

    Inside the mesh it is piecewise affine, so the Jacobian's determinant is a tetrahedron's ratio of volumes. Outside
    it goes on from the closest surface point c along the gradient averaged there, ``f(p) = f(c) + A(c) (p - c)``: a
    continuous map as far as c is continuous, that is nearer to the mesh than the mesh is to itself.
    """

    rest: Tetrahedra
    nodes: Points

    @cached_property
    def _gradients(self) -> Gradients:
        return self.rest.gradients(self.nodes)

    @cached_property
    def _node_gradients(self) -> Matrices:
        return self.rest.node_gradients(self._gradients)

    def __call__(self, points: Places) -> Places:
        """Images of points: affine in each tetrahedron, and continued outside of them."""
        element = self.rest.locate(points)
        moved = np.empty_like(points, float)
        inside = element >= 0
        first = self.rest.elements[element[inside], 0]
        offset = points[inside] - self.rest.nodes[first]
        moved[inside] = self.nodes[first] + _apply(self._gradients[element[inside]], offset)
        if not inside.all():
            moved[~inside] = self._beyond(points[~inside])
        return moved

    def _beyond(self, points: Places) -> Places:
        corners, weights, place = self.rest.closest(points)
        base = np.einsum("pk,pki->pi", weights, self.nodes[corners])
        gradient = np.einsum("pk,pkij->pij", weights, self._node_gradients[corners])
        return base + _apply(gradient, points - place)

    def rest_points(self, points: Places, guess: Places) -> tuple[Places, Bool[ndarray, " p"]]:
        """Rest points of deformed ones: exact in a tetrahedron, by Newton's method outside.

        Where the deformed mesh overlaps itself one of the answers is given.
        """
        elements = self.rest.elements
        element = _locate(search_tree(self.nodes, elements), self.nodes, elements, points)
        inside = element >= 0
        rest = np.empty_like(points, float)
        converged = inside.copy()
        first = elements[element[inside], 0]
        back = inv(self._gradients[element[inside]])
        rest[inside] = self.rest.nodes[first] + _apply(back, points[inside] - self.nodes[first])
        if not inside.all():
            rest[~inside], converged[~inside] = newton(self, points[~inside], guess[~inside])
        return rest, converged


def _edges(nodes: Points, elements: Elements) -> Gradients:
    """Edges from the first node as columns."""
    corners = nodes[elements]
    return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)


def _locate(
    tree: igl.AABB,
    nodes: Points,
    elements: Elements,
    points: Places,
) -> Int[ndarray, " p"]:
    if len(points) == 0:  # libigl's loop expects some
        return np.empty(0, np.int64)
    element = igl.in_element(nodes, elements, np.ascontiguousarray(points, float), tree)
    return element.astype(np.int64)  # C's long long, which numpy tells apart


def _apply(matrix: Float[ndarray, "p 3 3"], vector: Places) -> Places:
    return np.einsum("pij,pj->pi", matrix, vector)


# --- driven by a surface ----------------------------------------------------------------------------------------------

# A surface says nothing about its interior; many motions of the inside agree with it. This one is the biharmonic spline
# (the radial function ``r`` in three dimensions, Duchon 1977; as in Carr et al., SIGGRAPH 2001) through a spread of the
# surface's vertices, which bends as little as it can and is exact for affine motions. What it misses at the other
# vertices is carried inwards from the closest surface point and fades out (docs/design/0008-simulated-states.md).
#
# Notation: f(p) = s(p) + w(|p - c|) e(c), with the spline s, the closest surface point c, the spline's error e there
# (interpolated over the triangle), and a weight w from 1 at the surface to 0 at ``reach``.

CONTROLS = 100
"""Vertices that the spline goes through: more cost time in proportion, fewer leave more to the closest point."""

REACH = 3.0
"""Where the spline's error has faded out, in typical distances between neighbouring controls."""


class Surface:
    """Closed surface at rest with its search tree and the spline's system, which all of its states share."""

    def __init__(self, vertices: Vertices, faces: Faces) -> None:
        self.vertices = read_only_view(np.ascontiguousarray(vertices, float))
        self.faces = read_only_view(np.ascontiguousarray(faces, np.int64))
        self.center = vertices.mean(axis=0)
        self.controls = farthest_point_order(self.vertices, CONTROLS)
        knots = self.vertices[self.controls]
        self.reach = REACH * float(np.median(np.sort(cdist(knots, knots), axis=1)[:, 1]))

    def __getstate__(self) -> dict[str, Any]:
        """State without the search tree, which cannot be pickled; it is built again on first use."""
        return {key: value for key, value in self.__dict__.items() if key != "_tree"}

    @cached_property
    def _tree(self) -> igl.AABB:
        return search_tree(self.vertices, self.faces)

    @cached_property
    def solver(self) -> Float[ndarray, "k c"]:
        """Matrix from values at the controls to the spline's coefficients: of r at each control, and of 1, x, y, z."""
        count = len(self.controls)
        basis = self.basis(self.vertices[self.controls])
        system = np.zeros((count + 4, count + 4))
        system[:count] = basis
        system[count:, :count] = basis[:, count:].T
        return inv(system)[:, :count]

    @cached_property
    def vertex_basis(self) -> Float[ndarray, "v k"]:
        """Basis of the spline at all vertices at rest."""
        return read_only(self.basis(self.vertices))

    def basis(self, points: Places) -> Float[ndarray, "p k"]:
        """Values of the spline's functions at points at rest."""
        local = points - self.center
        radial = cdist(points, self.vertices[self.controls])
        return np.concatenate([radial, np.ones((len(points), 1)), local], axis=1)

    def carry(self, values: Vertices, points: Places) -> Places:
        """Values at vertices taken from the closest surface point, fading with its distance."""
        squared, face, place = self._tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points, float)
        )
        corners = self.faces[face]
        weights = barycentric(self.vertices[corners], place)
        fade = 1.0 - smooth_step(np.sqrt(squared) / self.reach)
        return fade[:, None] * np.einsum("pk,pki->pi", weights, values[corners])


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Map of space that one state of a surface gives, whose deformed ``vertices`` it meets exactly."""

    rest: Surface
    vertices: Vertices

    @cached_property
    def _coefficients(self) -> Float[ndarray, "k 3"]:
        return self.rest.solver @ self.vertices[self.rest.controls]

    @cached_property
    def _error(self) -> Vertices:
        return self.vertices - self.rest.vertex_basis @ self._coefficients

    def __call__(self, points: Places) -> Places:
        """Images of points: exact on the surface, estimated inside."""
        return self.rest.basis(points) @ self._coefficients + self.rest.carry(self._error, points)
