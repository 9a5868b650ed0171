"""Tools and hands in front of an object, and a plane behind it: what else a camera sees.

Everything is in the camera frame, in scene units; lengths in metres are multiplied by ``unit``, scene units per metre.
Occluders are solid bodies with a depth of their own (sources in docs/design/0006-sensors.md).
"""

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.linalg import norm
from numpy.random import Generator

from mereo.geometry.solids import Hits, Solids, toward
from mereo.geometry.transforms import Labels, Matrix, Points, Subset, Values, Vector
from mereo.synthesis.config import Occluder, SensorConfig

NOTHING, OBJECT, OCCLUDER, BACKGROUND = range(4)
"""What a pixel's ray meets first."""


@dataclass(frozen=True, eq=False)
class Capsule:
    """Solid of all points within ``radius`` of the segment from ``start`` to ``end``."""

    start: Vector
    end: Vector
    radius: float

    def first_hit(self, directions: Points) -> tuple[Subset, Hits]:
        """Rows of the rays from the origin that hit the capsule, and where each of them does first."""
        low, high = np.minimum(self.start, self.end) - self.radius, np.maximum(self.start, self.end) + self.radius
        rows = toward(directions, low, high)
        rays = directions[rows]
        ends = np.minimum(self._end_hit(self.start, rays), self._end_hit(self.end, rays))
        distance = np.minimum(ends, self._side_hit(rays))
        hit = np.isfinite(distance)
        place, axis = rays[hit] * distance[hit, None], self.end - self.start
        share = np.clip((place - self.start) @ axis / max(float(axis @ axis), 1e-300), 0.0, 1.0)
        return rows[hit], Hits(distance[hit], place - (self.start + share[:, None] * axis))  # from the axis outwards

    def _end_hit(self, center: Vector, rays: Points) -> Values:
        """Entry into the ball around one end: the smaller root of |t ray - center| = radius."""
        a = np.einsum("ij,ij->i", rays, rays)
        b = rays @ center
        c = center @ center - self.radius**2
        return _entry(a, b, np.full(len(rays), c))

    def _side_hit(self, rays: Points) -> Values:
        """Entry through the cylinder's side: the same equation for the parts perpendicular to the axis."""
        axis = self.end - self.start
        length = float(norm(axis))
        if length == 0:
            return np.full(len(rays), inf)
        axis = axis / length
        along = rays @ axis
        offset = float(self.start @ axis)
        across, start = rays - along[:, None] * axis, self.start - offset * axis
        distance = _entry(
            np.einsum("ij,ij->i", across, across), across @ start, np.full(len(rays), start @ start - self.radius**2)
        )
        place = np.where(np.isfinite(distance), distance, 0.0) * along - offset
        return np.where((place >= 0) & (place <= length), distance, inf)


def _entry(a: Values, b: Values, c: Values) -> Values:
    """The smaller root of a t^2 - 2 b t + c = 0 where it is positive, else infinity."""
    discriminant = b * b - a * c
    root = (b - np.sqrt(np.maximum(discriminant, 0.0))) / np.maximum(a, 1e-300)
    return np.where((discriminant > 0) & (a > 0) & (root > 0), root, inf)


@dataclass(frozen=True, eq=False)
class Backdrop:
    """Plane of all points with ``normal @ point = offset``; ``offset`` is positive, so that the normal points away."""

    normal: Vector
    offset: float

    def first_hit(self, directions: Points) -> tuple[Subset, Hits]:
        """Rows of the rays from the origin that hit the plane, and where."""
        slope = directions @ self.normal
        rows = np.flatnonzero(slope > 1e-6)
        return rows, Hits(self.offset / slope[rows], np.tile(self.normal, (len(rows), 1)))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Everything in a view that is not the object: tools, hands, a plane behind."""

    occluders: tuple[Capsule, ...] = ()
    background: Backdrop | None = None

    def join(self, hits: Hits, directions: Points) -> tuple[Hits, Labels]:
        """First hits of rays among object and surroundings, and what is hit; ``hits`` are those of the object alone."""
        first = Hits(hits.distance.copy(), hits.normal.copy())
        source = np.where(np.isfinite(hits.distance), OBJECT, NOTHING).astype(np.uint8)
        if self.background is not None:
            source[first.nearer(*self.background.first_hit(directions))] = BACKGROUND
        for occluder in self.occluders:
            source[first.nearer(*occluder.first_hit(directions))] = OCCLUDER
        return first, source


def sample_surroundings(
    sensor: SensorConfig,
    solids: Solids,
    seen: Points,
    reach: float,
    streams: dict[str, Generator],
) -> Surroundings:
    """Random tool, hand and plane around an object, as probable as ``sensor`` says, each of a stream of its name.

    ``seen`` and ``reach`` are as for ``sample_occluder``.
    """
    unit = 1 / sensor.metres_per_unit
    probable: tuple[tuple[Occluder, float], ...] = (("tool", sensor.tool), ("hand", sensor.hand))
    kinds = [kind for kind, probability in probable if streams[kind].random() < probability]
    occluders = [part for kind in kinds for part in sample_occluder(kind, seen, reach, unit, streams[kind])]
    plane = None
    if streams["background"].random() < sensor.background:
        plane = sample_plane(solids, unit, streams["background"])
    return Surroundings(tuple(occluders), plane)


def sample_occluder(kind: Occluder, seen: Points, reach: float, unit: float, rng: Generator) -> tuple[Capsule, ...]:
    """Random occluder of a kind in front of an object; "none" is nothing.

    It points at one of the visible points ``seen``, in the camera frame, and begins outside the image: ``reach`` is the
    slope x/z from the image's centre to its corners. ``unit`` is scene units in a metre.
    """
    if kind == "none":
        return ()
    return tuple((_sample_tool if kind == "tool" else _sample_hand)(seen, reach, unit, rng))


def sample_plane(solids: Solids, unit: float, rng: Generator) -> Backdrop:
    """Random table or wall behind the object: up to 45 degrees off the image plane, touching to 5 cm behind."""
    normal = _polar(np.tan(rng.uniform(0, pi / 4)), rng.uniform(0, 2 * pi))
    normal = normal / norm(normal)
    return Backdrop(normal, farthest(solids, normal) + rng.uniform(0, 0.05) * unit)


def farthest(solids: Solids, normal: Vector) -> float:
    """How far an object reaches along a direction."""
    return max(float((segment.vertices @ normal).max()) for segment in solids.mesh.segments)


def _polar(radius: float, angle_rad: float) -> Vector:
    """Direction with z = 1 whose slope has this length and angle."""
    return np.array([radius * np.cos(angle_rad), radius * np.sin(angle_rad), 1.0])


def _approach(seen: Points, reach: float, unit: float, rng: Generator) -> tuple[Vector, Vector]:
    """A tip up to 3 cm before a visible point, and the way out: a point nearer to the camera, outside the image."""
    target = seen[rng.integers(len(seen))]
    tip = target * max(1 - rng.uniform(0.002, 0.03) * unit / target[2], 0.5)
    out = tip[2] * rng.uniform(0.65, 0.95) * _polar(1.1 * reach, rng.uniform(0, 2 * pi))
    return tip, out


def _sample_tool(seen: Points, reach: float, unit: float, rng: Generator) -> list[Capsule]:
    """Random straight shaft that ends in two jaws, as laparoscopic instruments have: 5 to 12 mm thick."""
    tip, out = _approach(seen, reach, unit, rng)
    radius = rng.uniform(0.0025, 0.006) * unit
    jaw = 0.018 * unit
    opening = rng.uniform(0.05, 0.4)
    axis = (out - tip) / norm(out - tip)
    across = np.cross(axis, rng.normal(size=3))
    across /= norm(across)
    joint = tip + jaw * axis
    ends = [joint - jaw * (np.cos(opening) * axis + side * np.sin(opening) * across) for side in (-1, 1)]
    return [Capsule(joint, out, radius), *(Capsule(joint, end, 0.45 * radius) for end in ends)]


_FINGERS = ((-0.030, 0.90), (-0.010, 1.0), (0.010, 0.93), (0.030, 0.75))
"""Index to little finger: place of the knuckle across the palm in metres, length relative to the middle finger."""


def _sample_hand(seen: Points, reach: float, unit: float, rng: Generator) -> list[Capsule]:
    """Random left or right hand with forearm, as capsules, that reaches up to 7 cm past the point it is sent to.

    An adult's: about 18 cm long, 8 cm wide, with 10 % of variation. Fingers bend away from the camera by random angles.
    """
    tip, out = _approach(seen, reach, unit, rng)
    size = unit * rng.uniform(0.9, 1.1)
    mirror = rng.choice([-1.0, 1.0])
    frame = _hand_frame(tip, out, rng)
    reach_m = 0.18 - rng.uniform(0, 0.07)

    def part(start: Vector, end: Vector, radius: float) -> Capsule:
        """From (across, along, away) in metres, seen from the wrist."""
        places = [tip + size * ((place - [0, reach_m, 0]) * [mirror, 1, 1]) @ frame for place in (start, end)]
        return Capsule(places[0], places[1], size * radius)

    def bone(start: Vector, length: float, bend_rad: float) -> Vector:
        return start + length * np.array([0, np.cos(bend_rad), np.sin(bend_rad)])

    parts = [part(np.array([0, -0.35, 0]), np.zeros(3), 0.03)]
    for across, share in _FINGERS:
        bend = np.cumsum(rng.uniform(0, [0.7, 1.0]))
        knuckle = np.array([across, 0.09, 0])
        middle = bone(knuckle, 0.047 * share, bend[0])
        end = bone(middle, 0.043 * share, bend[1])
        parts += [part(np.array([0.4 * across, 0, 0]), knuckle, 0.012)]
        parts += [part(knuckle, middle, 0.0095), part(middle, end, 0.008)]
    base, thumb = np.array([-0.045, 0.045, 0.01]), np.array([-0.06, 0.09, 0.02])
    return [*parts, part(np.array([-0.015, 0.0, 0]), base, 0.014), part(base, thumb, 0.01)]


def _hand_frame(tip: Vector, out: Vector, rng: Generator) -> Matrix:
    """Rows: across the palm, along the fingers, away from the camera; rolled by up to 45 degrees."""
    along = (tip - out) / norm(tip - out)
    away = tip - (tip @ along) * along
    away /= norm(away)
    across = np.cross(along, away)
    roll = rng.uniform(-pi / 4, pi / 4)
    cosine = np.cos(roll)
    sine = np.sin(roll)
    return np.stack([cosine * across + sine * away, along, cosine * away - sine * across])
