"""Symmetries of a segmented object: turns after which its visible surface lies on itself, so that no camera tells them.

The turns are about the centroid of the visible surface and, unless two of its second moments are alike, about its
principal axes: a symmetry keeps both. Lengths are those of the mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi

import igl
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.linalg import eigh, lstsq, norm
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from mereo.geometry.conventions import Names
from mereo.geometry.mesh import SegmentedMesh, area_vectors
from mereo.geometry.solids import Solids, search_tree
from mereo.geometry.transforms import Matrix, Points, Transform, Vector, longest_side, transform_points

TOLERANCE = 0.45
"""Scene units up to which a turned surface looks the same: a fit explains a point by a surface up to there."""

SAMPLES, FEW = 4000, 300
"""Samples of all surfaces, and how many of the visible ones, or of a segment's vertices, stand for all."""

ALIKE_MOMENTS = 0.1
"""Difference of two second moments, as a share of the greater, up to which turns about all axes between count."""

STEP = np.deg2rad(5.0)
"""Between turns that are compared."""

BEYOND = 0.005
"""Share of the visible surface that may lie farther than the tolerance from the turned one."""

NEARLY = 0.9
"""Share of the vertices of a segment that must come to lie on one segment, and of the turns about an axis that must be
symmetries for all to be."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A turn that maps the visible surface of an object onto itself.

    Attributes:
        turn: rigid transform of the rest mesh, which is that of the rest pose.
        angle: of it, in (0, pi]; None where every turn about ``axis`` is a symmetry, as of a bottle.
        axis: unit vector; None where turns about all axes are symmetries, as of a ball.
        lands_on: for each segment the index of the one on whose place it comes to lie; None where it lies on none, as
            a tumour in one half of a ball.
    """

    turn: Transform
    angle: float | None
    axis: Vector | None
    lands_on: tuple[int | None, ...]

    @property
    def swaps(self) -> bool:
        """Whether it is a permutation of segments that exchanges some."""
        return None not in self.lands_on and not self.keeps_segments

    @property
    def keeps_segments(self) -> bool:
        """Whether each segment comes to lie on itself, so that the pose alone is not determined."""
        return self.lands_on == tuple(range(len(self.lands_on)))

    def describe(self, names: Names) -> str:
        """Make a sentence of what no camera tells, for segments of these names."""
        how = "by any angle" if self.angle is None else f"by {np.rad2deg(self.angle):.0f} degrees"
        text = f"the object looks the same turned {'in any way' if self.axis is None else how + _about_axis(self.axis)}"
        lost = [name for name, index in zip(names, self.lands_on, strict=True) if index is None]
        moved = [name for i, (name, j) in enumerate(zip(names, self.lands_on, strict=True)) if j not in (None, i)]
        if moved:
            text += f": no frame tells {_list(moved)} apart"
        if lost:
            text += (
                f"{', nor' if moved else ': no frame tells'} where {_list(lost)} {'is' if len(lost) == 1 else 'are'}"
            )
        return text if moved or lost else f"{text}, each segment on itself"


def find_symmetries(mesh: SegmentedMesh, tolerance: float) -> tuple[Symmetry, ...]:
    """Find the symmetries of an object at rest, one for all of the same axis where any angle is one; most have none.

    Args:
        mesh: segments at rest.
        tolerance: how far a turned surface may lie from itself, as a camera's noise hides that; above 0.

    Raises ``ValueError`` for a tolerance that is not above 0.
    """
    if not 0 < tolerance < np.inf:
        raise ValueError(f"the tolerance is {tolerance:g}; it must be above 0: take the noise of the camera")
    surface = _Surface.of(mesh, tolerance)
    if len(surface.visible) < FEW:  # nearly all of it lies in other segments
        return ()
    center, moments, axes = surface.moments()
    alike = np.diff(moments) <= ALIKE_MOMENTS * moments[1:]
    if not alike.any():
        return _settled(surface, center, pi * axes)
    if alike.all():
        turns = Rotation.random(600, rng=default_rng(0)).as_rotvec()
        halves = [surface.settle(_about(center, pi * axis)) for axis in axes]
        middle = _fixed_point(halves)
        if np.mean([surface.is_kept(_about(middle, turn)) for turn in turns[:100]]) >= NEARLY:
            whole = _about(middle, turns[0])
            return (Symmetry(whole, None, None, surface.landing(whole)),)
        return _settled(surface, center, turns)
    main = axes[0 if alike[1] else 2]
    around = np.arange(1, round(2 * pi / STEP)) * STEP
    half = surface.settle(_about(center, pi * main))
    axis = _axis_of(half)
    middle = _fixed_point([half])
    if np.mean([surface.is_kept(_about(middle, angle * axis)) for angle in around]) >= NEARLY:
        whole = _about(middle, axis)  # by 1 rad, which nothing but a round part inside survives
        return (Symmetry(whole, None, axis, surface.landing(whole)), *_settled(surface, middle, pi * axes[1:2]))
    between = np.arange(round(pi / STEP))[:, None] * STEP
    across = np.cos(between) * axes[1] + np.sin(between) * np.cross(main, axes[1])
    return _settled(surface, center, np.concatenate([around[:, None] * main, pi * across]))


def describe_symmetries(symmetries: Sequence[Symmetry], names: Names, of_segments: bool = False) -> list[str]:
    """Make one sentence for each thing that no camera tells: of symmetries with the same effect the first.

    With ``of_segments`` those are left out that turn each segment onto itself.
    """
    symmetries = [each for each in symmetries if not (of_segments and each.keeps_segments)]
    first = {symmetry.lands_on: symmetry for symmetry in reversed(symmetries)}
    kept = [symmetry for symmetry in symmetries if first[symmetry.lands_on] is symmetry]
    return [symmetry.describe(names) for symmetry in kept]


@dataclass(frozen=True, eq=False)
class _Surface:
    """Samples of all surfaces and the surfaces themselves.

    Attributes:
        mesh, tolerance: of ``find_symmetries``.
        points, normals: of the samples; normals are outward.
        visible: rows of those samples that border on empty space.
    """

    mesh: SegmentedMesh
    tolerance: float
    points: Points
    normals: Points
    visible: Int[ndarray, " v"]

    @classmethod
    def of(cls, mesh: SegmentedMesh, tolerance: float) -> "_Surface":
        vertices, faces, _ = mesh.merged()
        normals = area_vectors(vertices, faces)
        area = norm(normals, axis=1)
        rng = default_rng(0)
        total = np.cumsum(area)
        face = np.searchsorted(total, (np.arange(SAMPLES) + rng.random(SAMPLES)) * total[-1] / SAMPLES)
        face = np.minimum(face, len(faces) - 1)
        share = rng.dirichlet((1.0, 1.0, 1.0), SAMPLES)
        points = np.einsum("nk,nki->ni", share, vertices[faces[face]])
        normals = normals[face] / area[face, None]
        size = longest_side(vertices)
        outside = Solids(mesh).label(points + 1e-3 * size * normals) == 0
        return cls(mesh, tolerance, points, normals, np.flatnonzero(outside))

    @cached_property
    def _tree(self) -> tuple[igl.AABB, ndarray, ndarray]:
        vertices, faces, _ = self.mesh.merged()
        return search_tree(vertices, faces), vertices, faces

    def nearest(self, points: Float[ndarray, "p 3"]) -> tuple[Float[ndarray, " p"], Float[ndarray, "p 3"]]:
        """Distance and place of the nearest point of all surfaces."""
        tree, vertices, faces = self._tree
        squared, _, place = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        return np.sqrt(squared), place

    def moments(self) -> tuple[Vector, Vector, Matrix]:
        """Centroid of the visible surface, its second moments, ascending, and their axes as rows."""
        seen = self.points[self.visible]
        center = seen.mean(axis=0)
        values, vectors = eigh((seen - center).T @ (seen - center))
        return center, values, vectors.T

    def off(self, turn: Transform) -> float:
        """Root mean square distance of a few turned samples from the surface."""
        return float(np.sqrt((self.nearest(transform_points(turn, self._few))[0] ** 2).mean()))

    @property
    def _few(self) -> Float[ndarray, "f 3"]:
        return self.points[self.visible[:: max(1, len(self.visible) // FEW)]]

    def is_kept(self, turn: Transform) -> bool:
        """Whether the turned visible surface lies on the surface."""
        distance = self.nearest(transform_points(turn, self.points[self.visible]))[0]
        return bool((distance > self.tolerance).mean() <= BEYOND)

    def settle(self, turn: Transform) -> Transform:
        """The turn near a given one that brings a few samples nearest to the planes they come to lie on."""
        few = self._few
        step = max(1, len(self.visible) // FEW)
        normals = self.normals[self.visible[::step]]
        for _ in range(12):
            moved = transform_points(turn, few)
            turned = normals @ turn[:3, :3].T
            offset = self.nearest(moved)[1] - moved
            center = moved.mean(axis=0)
            rows = np.hstack([np.cross(moved - center, turned), turned])
            rows = np.vstack([rows, 1e-3 * np.sqrt(len(rows)) * np.eye(6)])
            change = lstsq(rows, np.append((offset * turned).sum(axis=1), np.zeros(6)), rcond=None)[0]
            turn = _about(center, change[:3], change[3:]) @ turn
        return turn

    def landing(self, turn: Transform) -> tuple[int | None, ...]:
        """For each segment the one on whose surface most of its vertices come to lie."""
        segments = self.mesh.segments
        limit = (2 * self.tolerance) ** 2
        result = list[int | None]()
        for segment in segments:
            moved = transform_points(turn, segment.vertices[:: max(1, len(segment.vertices) // FEW)])
            near = [(igl.point_mesh_squared_distance(moved, s.vertices, s.faces)[0] <= limit).mean() for s in segments]
            result.append(int(np.argmax(near)) if max(near) >= NEARLY else None)
        return tuple(result) if len(set(result)) == len(result) or None in result else (None,) * len(result)


def _settled(surface: _Surface, center: Vector, turns: Float[ndarray, "t 3"]) -> tuple[Symmetry, ...]:
    """Symmetries near to turns about a centre, each once."""
    starts = [_about(center, turn) for turn in turns]
    order = np.argsort([surface.off(start) for start in starts], kind="stable")[:60]
    result = list[Symmetry]()
    for row in order:
        turn = surface.settle(starts[row])
        if any(_angle(turn[:3, :3].T @ other.turn[:3, :3]) < 2 * STEP for other in result):
            continue
        if _angle(turn[:3, :3]) > 2 * STEP and surface.is_kept(turn):
            result.append(Symmetry(turn, _angle(turn[:3, :3]), _axis_of(turn), surface.landing(turn)))
    return tuple(result)


def _about(center: Vector, turn: Vector, shift: Vector | float = 0.0) -> Transform:
    """Rigid transform that turns about a centre by a rotation vector, and then shifts."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    result[:3, 3] = center - result[:3, :3] @ center + shift
    return result


def _axis_of(turn: Transform) -> Vector:
    """Axis of a turn, a unit vector."""
    vector = Rotation.from_matrix(turn[:3, :3]).as_rotvec()
    return vector / max(float(norm(vector)), 1e-12)


def _fixed_point(turns: list[Transform]) -> Vector:
    """Find the point that turns move least; of those of one axis the nearest to the origin."""
    rows = np.concatenate([np.eye(3) - turn[:3, :3] for turn in turns])
    return lstsq(rows, np.concatenate([turn[:3, 3] for turn in turns]), rcond=1e-6)[0]


def _angle(rotation: Matrix) -> float:
    return float(Rotation.from_matrix(rotation).magnitude())


def _about_axis(axis: Vector) -> str:
    """Name of an axis of the object's frame, or its direction."""
    main = int(np.abs(axis).argmax())
    if abs(axis[main]) > 0.995:
        return f" about {'xyz'[main]}"
    direction = np.round(axis * np.sign(axis[main]), 2) + 0.0
    return f" about the direction {direction.tolist()}"


def _list(names: list[str]) -> str:
    """Names with commas and an "and"; of many the first few."""
    if len(names) > 6:
        return f"{', '.join(names[:5])} and {len(names) - 5} more segments"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
