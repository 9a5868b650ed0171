"""The random deformations of a scene file: each draws one map of space within its bounds.

They are applied in the file's order, and all places in them are those of the rest pose; a joint at the tip of a chain
therefore comes before the one that carries it. A map that depends on where the object is by then (a bend on its
thickness, a push on its surface) is drawn for the points as the maps before it have left them.

Every map that can be drawn has a positive Jacobian throughout the object: each is bounded by its own rule, and maps one
after the other multiply. Lengths are in scene units, angles in radians.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, Deformations, Localized, Rigid, unit
from mereo.deformation.warps import Bend, FreeFormLattice, SmoothField, Squash, Taper, Twist
from mereo.geometry.conventions import GridShape, Names, Range, WholeNumbers
from mereo.geometry.mesh import SegmentedMesh, vertex_normals
from mereo.geometry.transforms import AnyPoints, Corners, Points, Vector

Surface = Callable[[], tuple[AnyPoints, AnyPoints]]
"""Vertices of what is to be moved, as the maps before have left them, and outward unit normals."""

FOLD_SHARE = 0.9
"""A bend stays below this share of the angle at which space would fold over."""


@runtime_checkable
class DeformationSampler(Protocol):
    """Bounds of one deformation, from which a random one is drawn."""

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random deformation; ``surface`` is what it is to move, as the maps before have left it."""
        ...


@dataclass(frozen=True, eq=False)
class LatticeSampler:
    """Free-form lattices over a box; the control points move by at most ``strength`` of what is injective."""

    bounds: Corners
    cells: GridShape
    strength: float

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random lattice."""
        return FreeFormLattice.sample(rng, self.bounds, self.cells, self.strength)


@dataclass(frozen=True)
class WavesSampler:
    """Smooth fields whose gradient is at most ``strength``, which is uniform up to the bound."""

    wavelength: Range
    strength: float
    modes: int

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random field of waves."""
        strength = named(rng, "strength").uniform(0.0, self.strength)
        return SmoothField.sample(rng, strength, self.wavelength, self.modes)


@dataclass(frozen=True, eq=False)
class BendSampler:
    """Bends about an axis, to a random side where ``toward`` is None."""

    origin: Vector
    axis: Vector
    length: float
    angle_rad: Range
    toward: Vector | None

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random bend that does not fold what the maps before have made of the object."""
        toward = named(rng, "toward").normal(size=3) if self.toward is None else self.toward
        radius = distance_from_line(surface()[0], self.origin, self.axis)
        most = FOLD_SHARE * self.length / max(radius, 1e-12)
        angle = named(rng, "angle", "rad").uniform(*np.clip(self.angle_rad, -most, most))
        return Bend(self.origin, self.axis, toward, self.length, angle, radius)


@dataclass(frozen=True, eq=False)
class TwistSampler:
    """Twists about an axis, any angle of which preserves volume."""

    origin: Vector
    axis: Vector
    length: float
    angle_rad: Range

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random twist."""
        return Twist(self.origin, self.axis, self.length, named(rng, "angle", "rad").uniform(*self.angle_rad))


@dataclass(frozen=True, eq=False)
class TaperSampler:
    """Tapers by factors uniform in their logarithm, so that a half is as likely as a double."""

    origin: Vector
    axis: Vector
    length: float
    factor: Range

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random taper."""
        return Taper(self.origin, self.axis, self.length, _factor(rng, self.factor))


@dataclass(frozen=True, eq=False)
class SquashSampler:
    """Squashes along a random axis where ``axis`` is None; factors are uniform in their logarithm."""

    center: Vector
    axis: Vector | None
    factor: Range

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random squash."""
        axis = named(rng, "axis").normal(size=3) if self.axis is None else self.axis
        return Squash(self.center, axis, _factor(rng, self.factor))


@dataclass(frozen=True, eq=False)
class JointSampler:
    """Rigid motions: a turn about an axis, a slide along it, and a shift of at most ``shift`` along x, y, z.

    A joint with a ``name`` either turns or slides, by one number, and those that follow it move by the same share of
    their ranges, which may go either way. It has only some ``shares`` of its range where more of it is known.
    """

    pivot: Vector
    axis: Vector
    angle_rad: Range
    slide: Range
    shift: Vector
    name: str = ""
    follows: str = ""
    shares: Range = (0.0, 1.0)

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random rigid motion."""
        axis = unit(self.axis)
        rotation = axis * named(rng, "angle", "rad").uniform(*self.angle_rad)
        slide = axis * named(rng, "slide").uniform(*self.slide)
        return Rigid(rotation, slide + named(rng, "shift").uniform(-self.shift, self.shift), self.pivot)

    @property
    def turns(self) -> bool:
        """Whether a joint with a name turns, else it slides."""
        return self.angle_rad[0] != self.angle_rad[1]

    @property
    def limits(self) -> Range:
        """Values of a joint with a name at the shares 0 and 1: radians, or scene units."""
        return self.angle_rad if self.turns else self.slide

    def share(self, value: float) -> float:
        """Share of the range of a joint with a name at a value: 0 at its least, 1 at its greatest."""
        return float((value - self.limits[0]) / (self.limits[1] - self.limits[0]))

    def sample_share(self, rng: Generator) -> float:
        """Random share that a joint with a name may have."""
        drawn = named(rng, "angle", "rad") if self.turns else named(rng, "slide")
        least, most = ((1 - share) * self.limits[0] + share * self.limits[1] for share in self.shares)
        return self.share(drawn.uniform(least, most))

    def at(self, share: float) -> Rigid:
        """Motion of a joint with a name at a share of its range."""
        motion = unit(self.axis) * (self.limits[0] + share * (self.limits[1] - self.limits[0]))
        return Rigid(motion, np.zeros(3), self.pivot) if self.turns else Rigid(np.zeros(3), motion, self.pivot)


@dataclass(frozen=True)
class PushSampler:
    """Pushes by an instrument at a random vertex, within 30 degrees or so of its normal.

    The map's Jacobian is at least 1 - 15/8 |distance| / (reach - tip), which the schema keeps above 0.05.
    """

    distance: Range
    tip: float
    reach: float

    def __call__(self, rng: Generator, surface: Surface) -> Deformation:
        """A random push of the surface as the maps before have left it."""
        vertices, normals = surface()
        index = named(rng, "vertex").integers(len(vertices))
        direction = unit(normals[index] + 0.35 * named(rng, "slant").normal(size=3))
        pull = Rigid(np.zeros(3), direction * named(rng, "distance").uniform(*self.distance), vertices[index])
        return Localized(pull, vertices[index], self.tip, self.reach)


@dataclass(frozen=True, eq=False)
class RandomMotion:
    """Random deformations of a scene file: samplers one after the other, each for the segments of some indices.

    Segments with the same steps share one map and so stay in contact.
    """

    rest: SegmentedMesh
    steps: tuple[tuple[DeformationSampler, WholeNumbers], ...]

    def __call__(self, rng: Generator) -> Deformations:
        """One deformation for each segment, as ``Scene.sample_deformations`` draws them."""
        chains: list[Deformations] = [()] * len(self.rest.segments)
        shares = dict[str, float]()
        for number, (sampler, members) in enumerate(self.steps, start=1):

            def surface(members: WholeNumbers = members) -> tuple[ndarray, ndarray]:
                return _surface(self.rest, chains, members)

            if isinstance(sampler, JointSampler) and sampler.name:
                leader = sampler.follows or sampler.name
                if leader not in shares:
                    with part(rng, leader):
                        shares[leader] = self.joints[leader][0].sample_share(rng)
                drawn: Deformation = sampler.at(shares[leader])
            else:
                with part(rng, self.title(number, sampler, members)):
                    drawn = sampler(rng, surface)
            for index in members:
                chains[index] = (*chains[index], drawn)
        return _shared(chains)

    @cached_property
    def joints(self) -> dict[str, tuple[JointSampler, WholeNumbers]]:
        """Joints with a name, by it, and indices of the segments that each moves; in the order of the steps."""
        joints = ((sampler, members) for sampler, members in self.steps if isinstance(sampler, JointSampler))
        return {sampler.name: (sampler, members) for sampler, members in joints if sampler.name}

    @property
    def leaders(self) -> Names:
        """Joints with a name that follow no other one, in the order in which they are drawn."""
        return tuple(dict.fromkeys(joint.follows or joint.name for joint, _ in self.joints.values()))

    def narrowed(self, shares: Mapping[str, Range]) -> "RandomMotion":
        """The same where joints that follow no other one have but these shares of their ranges, by their names."""
        joints = {name: replace(self.joints[name][0], shares=each) for name, each in shares.items()}
        return replace(self, steps=tuple((joints.get(getattr(s, "name", ""), s), members) for s, members in self.steps))

    def at(self, shares: Mapping[str, float]) -> Deformations:
        """One deformation for each segment by the joints with a name alone, at these shares of their ranges.

        ``shares`` has those of the joints that follow no other one.
        """
        chains: list[Deformations] = [()] * len(self.rest.segments)
        for joint, members in self.joints.values():
            motion = joint.at(shares[joint.follows or joint.name])
            for index in members:
                chains[index] = (*chains[index], motion)
        return _shared(chains)

    def title(self, number: int, sampler: DeformationSampler, members: WholeNumbers) -> str:
        """Step ``number``, counted from 1, as people know it from their file, for example "2 joint of hand, arm"."""
        if isinstance(sampler, JointSampler) and sampler.name:
            return sampler.name
        kind = type(sampler).__name__.removesuffix("Sampler").lower()
        whole = len(members) == len(self.rest.names)
        return f"{number} {kind}" + ("" if whole else f" of {', '.join(self.rest.names[i] for i in members)}")


def _shared(chains: Sequence[Deformations]) -> tuple[Compose, ...]:
    """Chains as maps, one for all segments of the same chain."""
    maps = dict[WholeNumbers, Compose]()
    return tuple(maps.setdefault(tuple(id(part) for part in chain), Compose(chain)) for chain in chains)


def _factor(rng: Generator, bounds: Range) -> float:
    """A factor, uniform in its logarithm."""
    return float(np.exp(named(rng, "factor", "log").uniform(*np.log(bounds))))


def _surface(
    rest: SegmentedMesh, chains: Sequence[Deformations], members: Sequence[int]
) -> tuple[AnyPoints, AnyPoints]:
    """Vertices of segments after their maps so far, and their normals."""
    parts = [(rest.segments[index], Compose(chains[index])) for index in members]
    moved = [replace(segment, vertices=chain(segment.vertices)) for segment, chain in parts]
    return np.concatenate([s.vertices for s in moved]), np.concatenate([vertex_normals(s) for s in moved])


def distance_from_line(points: Points, origin: Vector, axis: Vector) -> float:
    """Largest distance of the points; that of all of a mesh is at a vertex, because the distance is convex."""
    local = points - origin
    across = local - np.outer(local @ unit(axis), unit(axis))
    return float(norm(across, axis=1).max())


def default_cells(bounds: Corners) -> GridShape:
    """Cells of a lattice over a box: roughly cubes, two along the shortest side and at most six along the longest."""
    sides = bounds[1] - bounds[0]
    x, y, z = np.clip(np.rint(2 * sides / sides.min()), 2, 6).astype(int)
    return int(x), int(y), int(z)


def cubic_cells(bounds: Corners, spacing: float) -> tuple[Corners, GridShape]:
    """Box around a box, with its middle, that whole cubes fill, and how many of them go along each side."""
    x, y, z = np.maximum(np.ceil((bounds[1] - bounds[0]) / spacing - 1e-6), 1).astype(int)
    half = np.array([x, y, z]) * spacing / 2
    return bounds.mean(axis=0) + np.stack([-half, half]), (int(x), int(y), int(z))
