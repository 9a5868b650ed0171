"""Deformations: maps of space with a positive Jacobian, so that closed surfaces stay closed and solids keep an inside.

A deformation moves any point, not only a mesh's vertices. The rest position of a point inside a deformed segment is
therefore known: it is the map's inverse there. This module has the protocol, rigid motion, composition, windows and the
inverse; ``warps`` has the shapes of deformation.

Notation: ``f`` maps rest points ``x`` to deformed points; ``u = f(x) - x`` is the displacement; J is the 3x3 matrix of
derivatives of f. Lengths share one unit, angles are in radians.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Integer
from numpy import ndarray
from numpy.linalg import det, norm
from scipy.spatial.transform import Rotation

from mereo.geometry.transforms import Flags, Matrices, Matrix, PointArray, Points, Values, Vector

STEP, TOLERANCE = 1e-6, 1e-7
"""Step of finite differences, which err by 1e-6 in truncation, 1e-10 in rounding, and tolerance at which Newton's
iteration is done, both of the coordinates' magnitude."""

ITERATIONS, LEAST_DETERMINANT = 30, 0.02


@runtime_checkable
class Deformation(Protocol):
    """Map of space, for any number of points at once, each moved independently of the others."""

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""


Deformations = tuple[Deformation, ...]
"""One for each segment of a scene, or one after the other."""


@runtime_checkable
class Invertible(Protocol):
    """Deformation that can undo itself better than Newton's method: exactly, or where finite differences mislead."""

    def rest_points(self, points: Points, guess: Points) -> tuple[Points, Flags]:
        """Rest points whose image is ``points``, and which of them were found; arguments as for ``invert``."""


@dataclass(frozen=True, eq=False)
class Identity:
    """Deformation that leaves every point where it is."""

    def __call__(self, points: Points) -> Points:
        """The points themselves."""
        return points


@dataclass(frozen=True, eq=False)
class Rigid:
    """Rigid motion: a turn about ``center`` by ``rotation_vector`` (axis times radians), then ``translation``."""

    rotation_vector: Vector
    translation: Vector
    center: Vector

    def __call__(self, points: Points) -> Points:
        """Points after the turn and the shift."""
        return (points - self.center) @ self._matrix.T + (self.center + self.translation)

    @cached_property
    def _matrix(self) -> Matrix:
        """Turn as a matrix, made once: a chain of joints asks each for all links behind it."""
        return Rotation.from_rotvec(self.rotation_vector).as_matrix()


@dataclass(frozen=True, eq=False)
class Compose:
    """Chain of deformations, the first of ``parts`` applied first; the Jacobians multiply."""

    parts: Deformations

    def __call__(self, points: Points) -> Points:
        """Points after all parts."""
        for part in self.parts:
            points = part(points)
        return points


@dataclass(frozen=True, eq=False)
class Localized:
    """Deformation that is ``inner`` within ``inner_radius`` of ``center``, fades, and is none beyond ``outer_radius``.

    ``x + w(|x - center|) u(x)`` with the quintic step w. Its Jacobian is that of ``inner`` blended towards 1 plus
    ``u * grad w``: positive while |u| stays well below the width of the blend. That is checked when the object is made,
    on a grid of ``samples``^3 points over the window; the map of a smooth ``inner`` does not change much between them.

    Raises ``ValueError`` where the determinant falls below ``LEAST_DETERMINANT``, or for radii that do not grow.
    """

    inner: Deformation
    center: Vector
    inner_radius: float
    outer_radius: float
    samples: int = 13

    def __post_init__(self) -> None:
        if not 0 <= self.inner_radius < self.outer_radius:
            raise ValueError(
                f"the window's radii are {self.inner_radius:g} and {self.outer_radius:g}; they must be at least 0 and "
                "grow outwards: enlarge outer_radius"
            )
        ticks = np.linspace(-self.outer_radius, self.outer_radius, self.samples)
        points = self.center + np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        determinant = jacobian_determinant(self, points)
        worst = int(np.argmin(determinant))
        if not determinant[worst] >= LEAST_DETERMINANT:
            raise ValueError(
                f"the deformation Localized scales volume by {determinant[worst]:.3g} at "
                f"{np.round(points[worst], 3).tolist()}; it must be at least {LEAST_DETERMINANT:g} or space folds "
                "over: make its displacement smaller or its transition wider"
            )

    def __call__(self, points: Points) -> Points:
        """Points after the part of ``inner`` that reaches them."""
        distance = norm(points - self.center, axis=1, keepdims=True)
        weight = 1.0 - smooth_step((distance - self.inner_radius) / (self.outer_radius - self.inner_radius))
        return points + weight * (self.inner(points) - points)


def smooth_step(t: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """Quintic step from 0 (t <= 0) to 1 (t >= 1) with two continuous derivatives; its slope is at most 15/8."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


def moved_by(points: Points, owner: Integer[ndarray, " n"], deformations: Deformations) -> Points:
    """Images of points, each by the deformation of its ``owner``'s number."""
    result = np.empty_like(points)
    for index in np.unique(owner):
        rows = owner == index
        result[rows] = deformations[index](points[rows])
    return result


def unit(vector: Vector) -> Vector:
    """Unit vector along ``vector``. Raises ``ValueError`` when it has no direction."""
    length = float(norm(vector))
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"the direction {vector.tolist()} has no finite length above 0: give a vector that points")
    return vector / length


def turn(
    points: Points,
    center: Vector,
    axis: Vector,
    angle_rad: ndarray,
) -> Points:
    """Points turned about the line through ``center`` along the unit ``axis``, each by its own angle ("n").

    Rodrigues' formula; one axis for all makes it several times faster than a rotation object for each point.
    """
    local = points - center
    across = local - np.outer(local @ axis, axis)
    quarter = across @ crossing(axis)
    return points + (np.cos(angle_rad) - 1.0)[:, None] * across + np.sin(angle_rad)[:, None] * quarter


def crossing(vectors: PointArray) -> Float[ndarray, "*n 3 3"]:
    """Matrices whose rows are v x e_k, so that ``points @ matrix`` is v x p; many times faster than numpy's cross."""
    x, y, z = (vectors[..., axis] for axis in range(3))
    result = np.zeros((*vectors.shape, 3))
    result[..., 0, 1], result[..., 0, 2] = z, -y
    result[..., 1, 0], result[..., 1, 2] = -z, x
    result[..., 2, 0], result[..., 2, 1] = y, -x
    return result


def jacobian(deformation: Deformation, points: Points) -> tuple[Points, Matrices]:
    """Images ``f(x)`` and Jacobians ``J[:, i, j] = df_i / dx_j`` of a map, by forward differences.

    One call of the map with four times the points.
    """
    step = STEP * _magnitude(points)
    shifts = np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    value = deformation((shifts[:, None] + points).reshape(-1, 3)).reshape(4, -1, 3)
    return value[0], np.moveaxis((value[1:] - value[0]) / step, 0, -1)


def jacobian_determinant(deformation: Deformation, points: Points) -> Values:
    """Growth of volume at each point: 1 is rigid or volume preserving, 0 or less folds space over."""
    return det(jacobian(deformation, points)[1])


def invert(deformation: Deformation, points: Points, guess: Points) -> tuple[Points, Flags]:
    """Rest points whose image is ``points``: by the deformation itself where it is ``Invertible``, else by ``newton``.

    It starts at ``guess``, for example the rest positions of the nearest deformed vertices. Returns also for each
    whether its image lies within ``TOLERANCE`` of the coordinates' magnitude; else it is the best position reached.
    """
    if isinstance(deformation, Invertible):
        return deformation.rest_points(points, guess)
    return newton(deformation, points, guess)


def newton(deformation: Deformation, points: Points, guess: Points) -> tuple[Points, Flags]:
    """Rest points found by damped Newton's method with finite differences, all points at once; see ``invert``.

    A step is kept where the distance to the target falls by at least half of what the linear model promises; else
    half of the step is tried, and so on, so that guesses from which the plain method overshoots still converge.
    (Any decrease would not do: a point can run away along one axis while it gains along another.)
    """
    tolerance = TOLERANCE * max(_magnitude(points), _magnitude(guess))
    rest = guess.astype(float)
    full = np.zeros(points.shape)
    scale = np.ones(len(points))
    error = np.full(len(points), np.inf)
    active = np.arange(len(points))
    for _ in range(ITERATIONS):
        trial = rest[active] + scale[active, None] * full[active]
        value, matrix = jacobian(deformation, trial)
        residual = points[active] - value
        distance = norm(residual, axis=1)
        closer = distance <= (1.0 - 0.5 * scale[active]) * error[active]
        kept = active[closer]
        rest[kept], error[kept], scale[kept] = trial[closer], distance[closer], 1.0
        full[kept] = _solve(matrix[closer], residual[closer])
        scale[active[~closer]] *= 0.5
        active = active[error[active] > tolerance]
        if len(active) == 0:
            break
    return rest, error <= tolerance


def _solve(matrix: Matrices, right: Points) -> Points:
    """Cramer's rule, with a zero step where the matrix is singular (LAPACK would refuse the whole batch)."""
    a, b, c = (np.ascontiguousarray(matrix[:, :, k]) for k in range(3))
    bc = np.cross(b, c)
    determinant = np.einsum("ni,ni->n", a, bc)
    numerators = [bc, np.cross(c, a), np.cross(a, b)]
    solution = np.stack([np.einsum("ni,ni->n", right, numerator) for numerator in numerators], axis=1)
    regular = np.abs(determinant) > 1e-9
    return np.where(regular[:, None], solution / np.where(regular, determinant, 1.0)[:, None], 0.0)


def _magnitude(points: Points) -> float:
    """The largest coordinate, the scale of rounding errors; 1 where there is none."""
    largest = float(np.abs(points).max(initial=0.0))
    return largest if largest > 0 else 1.0
