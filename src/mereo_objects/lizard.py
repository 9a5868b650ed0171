"""Lizard: a print-in-place toy of hinged links, after the printed lizard of the paper; modelled here, no download.

The paper's model (by Javi Rodríguez, Creative Commons) is not used; this one is our own. Its 21 rigid links are head,
five of the trunk, seven of the tail, and an upper part and a foot for each leg; knobs sit in sockets, with V-shaped
openings to turn in. It is 72 units long from the snout to the tip of the tail, 38 wide across the feet and 7.5 high.

Segments: `head`; `body_front` (shoulders and the next two links); `body_rear` (one link and the hips); `tail_base`
(four links) and `tail_tip` (three); `leg_front_left`, `leg_front_right`, `leg_rear_left`, `leg_rear_right` (with their
feet). A segment of several links is a solid of several pieces, each of which moves rigidly.

Degrees of freedom: twelve knuckles of the spine turn about the vertical by at most 0.23 rad in the trunk and 0.36 rad
at the neck and in the tail, a smooth random function of the place along the spine (three harmonics); each leg swings by
0.36 rad and each foot by 0.28 rad. The clearance adds play about the other axes: 0.025 rad in the spine, 0.05 rad in
the legs. The middle of the trunk stays. Poses in which legs, tail and trunk would touch are drawn again.

What makes it hard: it is nearly symmetrical left and right, links differ only in size along the tail, and scales, toes
and openings are about as small as the distance between the pixels' rays.
"""

from functools import cache
from itertools import combinations

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import named, part, unchecked
from mereo.deformation.maps import Compose, Deformation
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects._hinges import Hinged, follow, rigid_map
from mereo_objects._lizard_parts import (
    FRONT_LEG,
    HINGES,
    HIP_LINK,
    NOSE,
    REAR_LEG,
    SHOULDER_LINK,
    SPINE,
    STIFF_HINGES,
    half_width,
    leg,
    spine_links,
)
from mereo_objects._solids import segment, union

SPINE_SEGMENTS = {"head": (0, 1), "body_front": (1, 4), "body_rear": (4, 6), "tail_base": (6, 10), "tail_tip": (10, 13)}
"""First link, and the one after the last."""

LEGS = {
    "leg_front_left": (FRONT_LEG, 1, SHOULDER_LINK),
    "leg_front_right": (FRONT_LEG, -1, SHOULDER_LINK),
    "leg_rear_left": (REAR_LEG, 1, HIP_LINK),
    "leg_rear_right": (REAR_LEG, -1, HIP_LINK),
}
"""Plan, side, and the link that carries it."""

MIDDLE_LINK = 3
SPINE_LIMIT_RAD = read_only(np.array([0.23 if number in STIFF_HINGES else 0.36 for number in range(len(SPINE))]))
SWING_RAD, FOOT_RAD = 0.36, 0.28
SPINE_PLAY_RAD, LEG_PLAY_RAD = 0.025, 0.05
PLAYS = ("about x", "about y")
HARMONICS = 3
GAP = 0.2
"""Least distance between links that are not neighbours, in the plane."""


@cache
def rest_mesh() -> SegmentedMesh:
    """Straight lizard, symmetrical, its belly on z = 0."""
    links = spine_links()
    parts = {name: union(*links[first:last]) for name, (first, last) in SPINE_SEGMENTS.items()}
    for name, (plan, side, _) in LEGS.items():
        parts[name] = union(leg(plan, side).upper, leg(plan, side).foot)
    return SegmentedMesh(tuple(segment(name, PALETTE[i], part) for i, (name, part) in enumerate(parts.items())))


def sample_spine(rng: np.random.Generator) -> Float[np.ndarray, "h 3"]:
    """Rotation vectors of the knuckles: a smooth curve about the vertical, scaled to a random share of the limits."""
    k = np.arange(HARMONICS + 1)[:, None]
    along = np.arange(len(SPINE)) / (len(SPINE) - 1)
    amplitudes = named(rng, "harmonics").normal(size=k.shape) / (1 + k)
    phases = named(rng, "phase", "rad").uniform(0, 2 * np.pi, size=k.shape)
    curve = (amplitudes * np.cos(np.pi * k * along + phases)).sum(axis=0)
    yaw = SPINE_LIMIT_RAD * curve * named(rng, "bend").uniform(0.35, 1.0) / np.abs(curve).max()
    names = tuple(f"play of knuckle {number} {about}" for number in range(1, len(SPINE) + 1) for about in PLAYS)
    play = named(rng, names, "rad").uniform(-SPINE_PLAY_RAD, SPINE_PLAY_RAD, size=(len(SPINE), 2))
    return np.column_stack([play, yaw])


def spine_motions(vectors: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, "k 4 4"]:
    """Motions of all links from rest, the middle one staying."""
    motions = [np.eye(4)]
    for knuckle, vector in zip(SPINE, vectors, strict=True):
        motions.append(follow(motions[-1], knuckle, vector))
    back = inverse_rigid(motions[MIDDLE_LINK])
    return np.stack([back @ motion for motion in motions])


@cache
def _spine_discs() -> tuple[tuple[int, Float[np.ndarray, "d 4"]], ...]:
    """For every link discs (x, y, z, radius) that cover it seen from above; the head's jaws are broader."""
    ends = [0.0, *HINGES, 2 * NOSE]
    discs = [(0, np.array([[NOSE - s, 0.0, 2.0, r] for s, r in ((2.2, 2.0), (5.0, 3.2), (8.4, 4.6), (11.0, 3.4))]))]
    for link in range(1, len(ends) - 1):
        stations = np.arange(ends[link] + 0.7, ends[link + 1] + 1.0, 1.5)
        discs.append((link, np.array([[NOSE - s, 0.0, 2.0, half_width(s) + 0.4] for s in stations])))
    return tuple((link, read_only(covering)) for link, covering in discs)


@cache
def _leg_discs(name: str) -> tuple[Float[np.ndarray, "u 4"], Float[np.ndarray, "f 4"]]:
    """Discs (x, y, z, radius) that cover the upper leg from the knee on, and the foot."""
    plan, side, _ = LEGS[name]
    root = leg(plan, side).root.pivot
    knee = (root[0] + plan.knee[0], root[1] + side * plan.knee[1], 1.5, plan.radii[1] + 0.2)
    vertices = np.array(leg(plan, side).foot.to_mesh().vert_properties[:, :3], dtype=float)
    x, y, _ = leg(plan, side).ankle.pivot
    far = vertices[np.hypot(vertices[:, 0] - x, vertices[:, 1] - y) > 1.0][::7]
    return read_only(np.array([knee])), read_only(np.column_stack([far, np.zeros(len(far))]))


def _moved(discs: Float[np.ndarray, "d 4"], motion: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "d 3"]:
    """x, y, radius after a motion."""
    return np.column_stack([transform_points(motion, discs[:, :3])[:, :2], discs[:, 3]])


def _apart(first: Float[np.ndarray, "a 3"], second: Float[np.ndarray, "b 3"]) -> bool:
    gaps = np.linalg.norm(first[:, None, :2] - second[None, :, :2], axis=-1)
    return bool((gaps > first[:, None, 2] + second[None, :, 2] + GAP).all())


def is_clear(spine: Float[np.ndarray, "k 4 4"], legs: dict[str, Float[np.ndarray, "2 4 4"]]) -> bool:
    """Whether legs, seen from above, touch neither each other nor links that do not carry them."""
    links = {link: _moved(discs, spine[link]) for link, discs in _spine_discs()}
    limbs = {}
    for name, (upper, foot) in legs.items():
        knee_discs, foot_discs = _leg_discs(name)
        knee, toes = _moved(knee_discs, upper), _moved(foot_discs, foot)
        if not all(
            _apart(toes, discs) and (link == LEGS[name][2] or _apart(knee, discs)) for link, discs in links.items()
        ):
            return False
        limbs[name] = np.concatenate([knee, toes])
    return all(_apart(limbs[a], limbs[b]) for a, b in combinations(limbs, 2))


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random maps, one for each segment: its inner knuckles turn, then it follows the link that carries it."""
    while True:
        with part(rng, "spine"):
            vectors = sample_spine(rng)
        spine = spine_motions(vectors)
        swings = {name: _leg_vectors(rng, name) for name in LEGS}
        legs = {name: _leg_motions(name, spine, swing) for name, swing in swings.items()}
        if unchecked(rng) or is_clear(spine, legs):
            break
    maps: list[Deformation] = [
        Compose((Hinged(SPINE[first : last - 1], vectors[first : last - 1]), rigid_map(spine[first])))
        for first, last in SPINE_SEGMENTS.values()
    ]
    for name, (plan, side, _) in LEGS.items():
        ankle = Hinged((leg(plan, side).ankle,), swings[name][1:])
        maps.append(Compose((ankle, rigid_map(legs[name][0]))))
    return tuple(maps)


def _leg_vectors(rng: np.random.Generator, name: str) -> Float[np.ndarray, "2 3"]:
    """Rotation vectors at the root and at the ankle."""
    names = tuple(f"play of the {place} {about}" for place in ("leg", "foot") for about in PLAYS)
    with part(rng, name.replace("_", " ")):
        play = named(rng, names, "rad").uniform(-LEG_PLAY_RAD, LEG_PLAY_RAD, size=(2, 2))
        turns = named(rng, ("swing", "swing of the foot")).uniform(-1.0, 1.0, size=2) * (SWING_RAD, FOOT_RAD)
    return np.column_stack([play, turns])


def _leg_motions(
    name: str, spine: Float[np.ndarray, "k 4 4"], vectors: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "2 4 4"]:
    """Motions of the upper leg and of the foot, from rest."""
    plan, side, carrier = LEGS[name]
    upper = follow(spine[carrier], leg(plan, side).root, vectors[0])
    return np.stack([upper, follow(upper, leg(plan, side).ankle, vectors[1])])


def scene() -> Scene:
    """Scene of the lizard on its belly; the paper's camera workspace above it."""
    workspace = Workspace(fov_rad=float(np.deg2rad(46.0)))
    return Scene("lizard", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
