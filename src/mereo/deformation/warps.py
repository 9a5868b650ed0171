"""Shapes of deformation: bend, twist, taper, squash, waves, lattices and sweeps along curves.

Each states the bound under which its Jacobian is positive and refuses parameters beyond it (``ValueError``), so that
what can be made can be used. Global deformations after Barr, "Global and local deformations of solid primitives",
SIGGRAPH 1984. Lengths share one unit, angles are in radians; notation as in ``maps``.
"""

from dataclasses import dataclass
from math import pi

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from mereo.deformation.draw_names import named
from mereo.deformation.maps import crossing, smooth_step, turn, unit
from mereo.geometry.conventions import GridShape, Range
from mereo.geometry.transforms import Corners, Points, Vector, unit_rows

LATTICE_LIMIT = 1 / 2.48
"""Choi & Lee, "Injectivity conditions of 2D and 3D uniform cubic B-spline functions", Graphical Models 62, 2000."""


@dataclass(frozen=True, eq=False)
class Bend:
    """Bend of a straight axis into a circular arc; before and beyond it space moves rigidly (Barr 1984).

    Attributes:
        origin, axis: where the arc starts, and its direction there.
        toward: the side to which it bends; its part along ``axis`` is dropped.
        length: arc length; the axis keeps its length.
        angle_rad: angle between the two ends.
        radius: largest distance from the axis of anything to be moved; ``|angle| * radius < length`` is required,
            which keeps the Jacobian, 1 minus curvature times the offset toward the centre, positive.
    """

    origin: Vector
    axis: Vector
    toward: Vector
    length: float
    angle_rad: float
    radius: float

    def __post_init__(self) -> None:
        _check_curvature(abs(self.angle_rad) / self.length, self.radius)

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        axis = unit(self.axis)
        side = unit(self.toward - (self.toward @ axis) * axis)
        local = points - self.origin
        along, offset = local @ axis, local @ side
        s = np.clip(along, 0.0, self.length)
        angle = s * (self.angle_rad / self.length)
        # of the arc: (sin a / k, (1 - cos a) / k), written so that it holds for curvature zero
        half = np.sinc(angle / (2 * pi))
        x, y = s * half * np.cos(angle / 2), s * half * np.sin(angle / 2)
        cosine = np.cos(angle)
        sine = np.sin(angle)
        beyond = along - s
        new_along = x + beyond * cosine - offset * sine
        new_offset = y + beyond * sine + offset * cosine
        return points + np.outer(new_along - along, axis) + np.outer(new_offset - offset, side)


@dataclass(frozen=True, eq=False)
class Twist:
    """Turn of cross-sections about an axis by an angle that grows smoothly from 0 to ``angle_rad`` over ``length``.

    Preserves volume exactly, whatever the angle: the Jacobian is 1 (Barr 1984).
    """

    origin: Vector
    axis: Vector
    length: float
    angle_rad: float

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        axis = unit(self.axis)
        weight = smooth_step((points - self.origin) @ axis / self.length)
        return turn(points, self.origin, axis, self.angle_rad * weight)


@dataclass(frozen=True, eq=False)
class Taper:
    """Scaling of cross-sections by a factor that goes smoothly from 1 to ``factor`` > 0 over ``length`` (Barr 1984).

    The Jacobian is the square of the local factor.
    """

    origin: Vector
    axis: Vector
    length: float
    factor: float

    def __post_init__(self) -> None:
        _check_factor(self.factor)

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        axis = unit(self.axis)
        local = points - self.origin
        along = local @ axis
        growth = (self.factor - 1.0) * smooth_step(along / self.length)
        return points + growth[:, None] * (local - np.outer(along, axis))


@dataclass(frozen=True, eq=False)
class Squash:
    """Scaling by ``factor`` > 0 along ``axis`` and by its inverse square root across: volume is preserved."""

    center: Vector
    axis: Vector
    factor: float

    def __post_init__(self) -> None:
        _check_factor(self.factor)

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        axis = unit(self.axis)
        across = self.factor**-0.5
        matrix = across * np.eye(3) + (self.factor - across) * np.outer(axis, axis)
        return self.center + (points - self.center) @ matrix


@dataclass(frozen=True, eq=False)
class SmoothField:
    """Field of random smooth waves: ``x + sum_k a_k sin(b_k . x + c_k)``.

    The displacement's gradient has norm at most ``g = sum_k |a_k| |b_k|``. For g < 1, which is required, the map is a
    diffeomorphism of all space: distances change by a factor in [1 - g, 1 + g].

    Amplitudes a are lengths, frequencies b radians per length, phases c radians.
    """

    amplitudes: Float[ndarray, "k 3"]
    frequencies: Float[ndarray, "k 3"]
    phases: Float[ndarray, " k"]

    def __post_init__(self) -> None:
        if not self.gradient_bound < 1:
            raise ValueError(
                f"the waves' gradient may reach {self.gradient_bound:.3g}; it must stay below 1 or space folds over: "
                "make the amplitudes smaller or the wavelengths longer"
            )

    @property
    def gradient_bound(self) -> float:
        """Bound g of the displacement's gradient, from 0 to below 1."""
        lengths = [norm(vectors, axis=1) for vectors in (self.amplitudes, self.frequencies)]
        return float(lengths[0] @ lengths[1])

    @classmethod
    def sample(cls, rng: Generator, strength: float, wavelength: Range, modes: int = 4) -> "SmoothField":
        """Field of ``modes`` random waves, wavelengths uniform in a range, with gradient bound ``strength``."""
        directions, amplitudes = named(rng, "pattern").normal(size=(2, modes, 3))
        frequencies = unit_rows(directions) * 2 * pi / named(rng, "wavelength").uniform(*wavelength, size=(modes, 1))
        shares = norm(amplitudes, axis=1) @ norm(frequencies, axis=1)
        phases = named(rng, "phase", "rad").uniform(0, 2 * pi, size=modes)
        return cls(amplitudes * (strength / shares), frequencies, phases)

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        return points + np.sin(points @ self.frequencies.T + self.phases) @ self.amplitudes


@dataclass(frozen=True, eq=False)
class FreeFormLattice:
    """Uniform cubic B-spline lattice that displaces space; two spacings beyond the control points nothing moves.

    Each component of a control point's displacement must stay below ``spacing / 2.48``, under which the map is
    injective with a positive Jacobian (Choi & Lee 2000).

    ``origin`` is the position of control point (0, 0, 0), ``spacing`` that between them along x, y, z.
    """

    origin: Vector
    spacing: Vector
    displacements: Float[ndarray, "a b c 3"]

    def __post_init__(self) -> None:
        share = float(np.abs(self.displacements / self.spacing).max())
        if not share < LATTICE_LIMIT:
            raise ValueError(
                f"a lattice control point moves by {share:.3g} of the spacing; it must stay below "
                f"{LATTICE_LIMIT:.3g} or space may fold over: make the displacements smaller or the lattice coarser"
            )

    @classmethod
    def sample(cls, rng: Generator, bounds: Corners, cells: GridShape, strength: float) -> "FreeFormLattice":
        """Random control points over a box of ``cells`` and one spacing around; ``strength`` in [0, 1) of the limit."""
        spacing = (bounds[1] - bounds[0]) / np.array(cells)
        shape = (cells[0] + 3, cells[1] + 3, cells[2] + 3, 3)
        limit = strength * LATTICE_LIMIT * spacing
        return cls(bounds[0] - spacing, spacing, named(rng, "control points").uniform(-limit, limit, size=shape))

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        at = ((points - self.origin) / self.spacing).T
        moves = [
            map_coordinates(
                np.ascontiguousarray(self.displacements[..., k]), at, order=3, mode="grid-constant", prefilter=False
            )
            for k in range(3)
        ]
        return points + np.stack(moves, axis=1)


@dataclass(frozen=True, eq=False)
class CurveSweep:
    """Sweep of the x axis onto a curve: ``(x, y, z) -> c(x) + y n(x) + z b(x)``; straight beyond its ends.

    The Jacobian is the curve's speed times one minus curvature times the offset towards the centre of curvature:
    positive within ``radius`` of the axis while curvature times radius is below one. Make it with ``through``; its
    curve goes from arc length, between that of both ends, to c, n and b as nine numbers.
    """

    curve: CubicSpline
    ends: Range

    @classmethod
    def through(
        cls,
        nodes: Float[ndarray, " m"],
        centers: Float[ndarray, "m 3"],
        normal: Vector,
        radius: float,
    ) -> "CurveSweep":
        """Sweep onto the cubic spline through ``centers`` at ascending arc lengths, its frame free of twist.

        The y axis starts along ``normal``, whose part along the curve is dropped. Raises ``ValueError`` where the
        curvature times ``radius``, the largest distance from the axis of anything to be moved, reaches one.
        """
        spline = CubicSpline(nodes, centers)
        velocity, acceleration = spline(nodes, 1), spline(nodes, 2)
        speed = norm(velocity, axis=1)
        curvature = norm(np.cross(velocity, acceleration), axis=1) / speed**3
        _check_curvature(float(curvature.max()), radius)
        frames = transport_frames(velocity / speed[:, None], normal)
        curve = CubicSpline(nodes, np.concatenate([centers, frames[:, 1], frames[:, 2]], axis=1))
        return cls(curve, (float(nodes[0]), float(nodes[-1])))

    def __call__(self, points: Points) -> Points:
        """Images of points, in the points' unit."""
        s = np.clip(points[:, 0], *self.ends)
        values = self.curve(s)
        center, normal, binormal = values[:, :3], values[:, 3:6], values[:, 6:]
        moved = center + points[:, 1:2] * normal + points[:, 2:3] * binormal
        beyond = np.flatnonzero(points[:, 0] != s)
        tangent = np.cross(normal[beyond], binormal[beyond])
        moved[beyond] += (points[beyond, 0] - s[beyond])[:, None] * tangent
        return moved


def transport_frames(tangents: Float[ndarray, "m 3"], normal: Vector) -> Float[ndarray, "m 3 3"]:
    """Frames along a curve, rows tangent, normal, binormal, by parallel transport.

    From one tangent to the next the frame turns by the smallest rotation, so it never twists about the curve (Bergou
    et al., "Discrete elastic rods", 2008).
    """
    a, b = tangents[:-1], tangents[1:]
    cross = np.cross(a, b)
    cosine = np.einsum("ni,ni->n", a, b)
    skew = crossing(cross)
    turns = np.eye(3) + skew + skew @ skew / (1.0 + cosine)[:, None, None]
    normal = unit(normal - (normal @ tangents[0]) * tangents[0])
    frames = np.empty((len(tangents), 3, 3))
    frames[0] = np.stack([tangents[0], normal, np.cross(tangents[0], normal)])
    for index, rotation in enumerate(turns):
        frames[index + 1] = frames[index] @ rotation
    return frames


def _check_curvature(curvature: float, radius: float) -> None:
    if not curvature * radius < 1:
        raise ValueError(
            f"curvature {curvature:.3g} times radius {radius:.3g} is {curvature * radius:.3g}; it must be below 1 or "
            "space folds over at the centre of curvature: bend less sharply or make the object thinner"
        )


def _check_factor(factor: float) -> None:
    if not (np.isfinite(factor) and factor > 0):
        raise ValueError(f"the scale factor is {factor:g}; it must be above 0 or space folds over: choose it positive")
