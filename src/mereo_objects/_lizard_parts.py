"""The lizard's solids at rest: trunk and tail as one scaly body cut at its knuckles, head, legs with toes and claws.

The nose points along +x, the back along +z, the belly lies on z = 0, left is +y. Stations are distances from the nose.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float
from manifold3d import Manifold, Mesh

from mereo_objects._hinges import Knuckle
from mereo_objects._solids import Vector, ball, hull, rod, union

NOSE = 36.0
"""x of station 0; the body reaches from there to -NOSE."""

SIDES = 14
HINGES = (12.5, 19.5, 24.0, 28.5, 33.0, 40.0, 44.0, 48.0, 52.0, 56.0, 60.0, 64.0)
"""Stations of the knuckles of the spine: link k lies between hinges k - 1 and k, link 0 is the head."""

STIFF_HINGES = (1, 2, 3, 4)
"""Those inside the trunk, whose broad flanks leave less room to turn."""

SHOULDER_LINK, HIP_LINK = 1, 5

_STATIONS = (7.0, 9.5, 12.5, 15.0, 18.0, 22.0, 27.0, 31.0, 35.0, 38.0, 41.0, 46.0, 52.0, 58.0, 64.0, 69.0, 71.4, 72.0)
_WIDTHS = (2.2, 2.9, 3.3, 4.0, 4.3, 5.0, 5.4, 5.1, 4.4, 3.7, 3.2, 2.8, 2.3, 1.9, 1.45, 0.95, 0.6, 0.2)
_HEIGHTS = (3.6, 4.2, 4.5, 5.0, 5.4, 5.8, 6.0, 5.8, 5.3, 4.7, 4.2, 3.6, 3.0, 2.5, 1.95, 1.35, 0.95, 0.5)


def half_width(station: float) -> float:
    """Half of the width of trunk and tail at stations, without scales."""
    return float(np.interp(station, _STATIONS, _WIDTHS))


def height(station: float) -> float:
    """Height of trunk and tail at stations, without scales."""
    return float(np.interp(station, _STATIONS, _HEIGHTS))


def _spine_knuckle(number: int) -> Knuckle:
    station = HINGES[number]
    radius = min(1.4, 0.42 * half_width(station))
    sector, opening = (1.0, 0.3) if number in STIFF_HINGES else (0.9, 0.44)
    return Knuckle((NOSE - station, 0.0, 0.45 * height(station)), np.pi, radius, sector, opening)


SPINE = tuple(_spine_knuckle(number) for number in range(len(HINGES)))


@dataclass(frozen=True)
class LegPlan:
    """Plan of a left leg seen from above; right legs are its mirror images.

    Attributes:
        root: station and y of the knuckle on the trunk.
        knee, ankle: offsets (x, y) from the root.
        foot_rad: heading of the middle toe.
        radii: of the limb at root, knee and ankle.
        toes: lengths from the innermost (towards the head) to the outermost.
    """

    root: tuple[float, float]
    knee: tuple[float, float]
    ankle: tuple[float, float]
    foot_rad: float
    radii: tuple[float, float, float]
    toes: tuple[float, ...]


FRONT_LEG = LegPlan((18.0, 4.5), (-1.6, 4.4), (1.6, 7.3), 0.85, (1.9, 1.6, 1.2), (2.0, 2.8, 3.2, 2.9, 2.0))
REAR_LEG = LegPlan((38.3, 4.2), (2.0, 4.6), (-1.6, 7.9), 1.75, (2.0, 1.7, 1.3), (1.9, 2.7, 3.5, 3.9, 2.3))


@dataclass(frozen=True)
class Leg:
    """Knuckles and solids of a leg: ``upper`` from the trunk to the ankle, ``foot`` beyond it."""

    root: Knuckle
    ankle: Knuckle
    upper: Manifold
    foot: Manifold


@cache
def leg(plan: LegPlan, side: int) -> Leg:
    """Leg of a plan, ``side`` +1 for left and -1 for right."""
    x = NOSE - plan.root[0]
    y = plan.root[1]
    root, knee, ankle = (x, y), (x + plan.knee[0], y + plan.knee[1]), (x + plan.ankle[0], y + plan.ankle[1])
    shank_rad = float(np.arctan2(ankle[1] - knee[1], ankle[0] - knee[0]))
    outward_rad = 0.5 * (np.pi / 2 + float(np.arctan2(plan.knee[1], plan.knee[0])))
    at_root = Knuckle((*root, 1.5), side * outward_rad, 1.3, 0.95, 0.5)
    at_ankle = Knuckle((*ankle, 1.0), side * (shank_rad + plan.foot_rad) / 2, 0.7, 0.95, 0.42, 0.16)
    limb = _limb(plan, root, knee, ankle)
    foot = _foot(plan, ankle)
    if side < 0:
        limb = limb.mirror((0.0, 1.0, 0.0))
        foot = foot.mirror((0.0, 1.0, 0.0))
        at_root, at_ankle = (
            Knuckle(
                (k.pivot[0], -k.pivot[1], k.pivot[2]), k.heading_rad, k.radius, k.sector_rad, k.opening_rad, k.clearance
            )
            for k in (at_root, at_ankle)
        )
    limb = (limb ^ at_root.knob_side()) - at_ankle.knob_room()
    return Leg(at_root, at_ankle, _largest(limb), _largest(foot ^ at_ankle.knob_side()))


def _limb(plan: LegPlan, root: tuple[float, float], knee: tuple[float, float], ankle: tuple[float, float]) -> Manifold:
    """Thigh and shank, thickest at the trunk, with a ridge of scales along the outside."""
    a, b, c = plan.radii
    at_root, at_knee, at_ankle = (*root, 1.5), (*knee, 1.7), (*ankle, 1.0)
    parts = [rod(at_root, at_knee, a, b), rod(at_knee, at_ankle, b, c)]
    for start, end, radius in ((at_root, at_knee, a), (at_knee, at_ankle, b)):
        for share in (0.35, 0.6, 0.85):
            x, y, z = (1 - share) * np.array(start) + share * np.array(end)
            along = np.subtract(end, start)[:2] / np.linalg.norm(np.subtract(end, start)[:2])
            parts.append(_spike((x, y, z + 0.7 * radius), 0.55, (0.35 * along[0], 0.35 * along[1], 0.75)))
    return _on_the_ground(union(*parts))


def _foot(plan: LegPlan, ankle: tuple[float, float]) -> Manifold:
    """A palm and five toes in a fan, each with one joint and a claw."""
    heading = np.array([np.cos(plan.foot_rad), np.sin(plan.foot_rad)])
    palm_x, palm_y = np.array(ankle) + 1.7 * heading
    palm = hull(ball((*ankle, 1.0), 1.25), ball((palm_x, palm_y, 0.9), 1.35))
    parts = [palm]
    for number, length in enumerate(plan.toes):
        angle_rad = plan.foot_rad + np.deg2rad(-56.0 + 28.0 * number)
        x, y = float(np.cos(angle_rad)), float(np.sin(angle_rad))
        joint = (palm_x + (0.7 + 0.5 * length) * x, palm_y + (0.7 + 0.5 * length) * y, 0.95)
        claw = (palm_x + (1.6 + length) * x, palm_y + (1.6 + length) * y, 0.15)
        parts += [
            rod((palm_x, palm_y, 0.75), joint, 0.7, 0.62, 8),
            hull(ball(joint, 0.62, 8), ball(claw, 0.18, 4)),
        ]
    return _on_the_ground(union(*parts))


def _on_the_ground(part: Manifold) -> Manifold:
    return part.trim_by_plane((0.0, 0.0, 1.0), 0.0)


def _largest(part: Manifold) -> Manifold:
    """Largest part of a solid, without the crumbs that a cut leaves of a scale."""
    return max(part.decompose(), key=lambda piece: float(piece.volume()))


def _spike(base: Vector, radius: float, tip: Vector, stretch: float = 1.6) -> Manifold:
    """A keeled scale: a low pyramid on a rhombus around ``base``, reaching below it, with its tip at ``base + tip``."""
    rhombus = radius * np.array([[stretch, 0.0, 0.0], [0.0, 1.0, 0.0], [-stretch, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rhombus[:, 2] = -0.3
    return Manifold.hull_points(np.concatenate([rhombus, [tip]]) + np.array(base))


def _section(station: float) -> Float[np.ndarray, "s 3"]:
    """The body's outline at a station: broad, rounded above, flat below."""
    width = half_width(station)
    top = height(station)
    middle = 0.4 * top
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    y = width * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.85
    z = middle + np.where(np.sin(angle) > 0, top - middle, 1.2 * middle) * np.sin(angle)
    return np.stack([np.full(SIDES, NOSE - station), y, np.maximum(z, 0.0)], axis=1)


def _trunk_and_tail() -> Manifold:
    """A loft through the sections, closed by fans at both ends."""
    stations = np.concatenate([np.arange(7.0, 40.0, 2.75), np.arange(40.0, 72.0, 4.0), [72.0]])
    rings = [_section(float(station)) for station in stations]
    vertices = np.concatenate([*rings, [rings[0].mean(axis=0)], [rings[-1].mean(axis=0)]])
    i = np.arange(SIDES)
    j = (np.arange(SIDES) + 1) % SIDES
    faces = []
    last = SIDES * (len(rings) - 1)
    for a in range(0, last, SIDES):
        b = a + SIDES
        faces += [np.stack([a + i, a + j, b + j], axis=1), np.stack([a + i, b + j, b + i], axis=1)]
    first_hub, last_hub = np.full(SIDES, len(vertices) - 2), np.full(SIDES, len(vertices) - 1)
    faces += [np.stack([first_hub, j, i], axis=1), np.stack([last_hub, last + i, last + j], axis=1)]
    solid = Manifold(Mesh(vertices.astype(np.float32), np.concatenate(faces)[:, ::-1].astype(np.uint32)))
    return solid if solid.volume() > 0 else Manifold()


def _scales() -> list[Manifold]:
    """A crest along the back, two rows of keeled scales on each side of it, and a fringe of spikes on the flanks."""
    parts = []
    for station in [*np.arange(11.0, 40.0, 2.25), *np.arange(41.1, 70.0, 2.0)]:
        x = NOSE - station
        width = half_width(station)
        top = height(station)
        size = width / 5.0
        rows = (0.36, 0.7) if station < 40.0 else (0.5,)
        parts.append(_spike((x, 0.0, top - 0.15), 0.35 + 0.4 * size, (-0.6, 0.0, 0.6 + 1.0 * size)))
        for side in (-1.0, 1.0):
            for share in rows:
                z = 0.4 * top + 0.6 * top * (1 - share ** (2 / 0.85)) ** 0.5
                tip = (-0.45, 0.25 * side * size, 0.25 + 0.5 * size)
                parts.append(_spike((x + 0.7 * share, side * share * width, z - 0.1), 0.25 + 0.5 * size, tip))
            flank = (x - 0.3, side * (width - 0.25), 0.42 * top)
            parts.append(_spike(flank, 0.35 + 0.4 * size, (-0.4, side * (0.5 + 0.6 * size), 0.1)))
    return parts


def _head() -> Manifold:
    """A broad wedge with brows, eyes, nostrils, a mouth, ears and a crown of spikes."""

    def at(station: float, y: float, z: float) -> Vector:
        return (NOSE - station, y, z)

    jaw = hull(
        *(ball(at(1.6, y, 1.2), 1.2, 8) for y in (-0.9, 0.9)), *(ball(at(8.2, y, 1.6), 1.6, 8) for y in (-2.9, 2.9))
    )
    skull = hull(
        *(ball(at(1.5, y, 2.3), 1.0, 8) for y in (-0.8, 0.8)),
        *(ball(at(5.6, y, 4.0), 1.3, 8) for y in (-1.7, 1.7)),
        *(ball(at(8.6, y, 3.4), 1.8, 8) for y in (-2.6, 2.6)),
        ball(at(11.0, 0.0, 3.0), 1.9, 8),
    )
    parts, holes = [jaw, skull], []
    for side in (-1.0, 1.0):
        parts.append(ball(at(5.3, 2.55 * side, 3.9), 1.0))
        parts.append(rod(at(4.3, 1.9 * side, 4.9), at(6.9, 2.9 * side, 4.8), 0.45, 0.55, 8))
        holes.append(ball(at(0.75, 0.75 * side, 3.0), 0.3, 8))
        holes.append(ball(at(9.0, 4.6 * side, 3.1), 0.75, 8))
        for station, y in ((9.9, 1.4), (9.6, 2.8), (8.9, 4.0)):
            parts.append(_spike(at(station, y * side, 5.4 - 0.45 * y), 0.6, (-1.3, 0.45 * side * y, 0.7)))
    lips = hull(
        *(ball(at(-0.5, y, 1.95), 0.22, 4) for y in (-4.0, 4.0)),
        *(ball(at(6.6, y, 2.15), 0.22, 4) for y in (-6.0, 6.0)),
    )
    inner = hull(
        *(ball(at(1.5, y, 1.95), 0.9, 8) for y in (-0.4, 0.4)), *(ball(at(7.0, y, 2.1), 0.9, 8) for y in (-2.6, 2.6))
    )
    return union(*parts) - (lips - inner) - union(*holes)


@cache
def spine_links() -> tuple[Manifold, ...]:
    """Links of head, trunk (five) and tail (seven): one solid for each, with air between."""
    body = _on_the_ground(union(_trunk_and_tail(), _head(), *_scales()))
    carried = {SHOULDER_LINK: FRONT_LEG, HIP_LINK: REAR_LEG}
    links = []
    for number in range(len(SPINE) + 1):
        roots = [leg(carried[number], side).root for side in (1, -1)] if number in carried else []
        link = union(body, *(_boss(root) for root in roots))
        if number > 0:
            link ^= SPINE[number - 1].knob_side()
        if number < len(SPINE):
            link -= SPINE[number].knob_room()
        for root in roots:
            link -= root.knob_room()
        links.append(_largest(link))
    return tuple(links)


def _boss(root: Knuckle) -> Manifold:
    """What surrounds a leg's socket."""
    return Manifold.cylinder(3.5, root.radius + 1.0, root.radius + 0.8, 16).translate((*root.pivot[:2], 0.0))
