"""Rope: it hangs from a base, in random curves and coils; modelled here, needs no download.

Source: modelled in mereo's own code, MIT licence. The x axis points down: the base is fixed above, the rope hangs from
it, and the camera looks across, from a cone about z.

Segments: `base` (a rounded block) and `segment_1` (at the base) to `segment_8` (the free end), each a piece of one
round rope, 8 units long and 3.6 thick.

Degrees of freedom: the base stays. Two ropes in three swing: heading and elevation of the centreline are smooth random
functions of arc length (four harmonics each), up to full loops. One in three coils: from somewhere in its upper part on
it winds about an axis across it, 0.13 to 0.2 radians per unit, which is up to 1.8 turns, each 5 to 9 units beside the
last. Nothing bends more than 0.22 per unit (radius of curvature 4.5). Curves in which the rope would touch itself or
the base are drawn again.

What makes it hard: the segments are identical, so a segment's name follows only from its place along the rope, which
may be hidden where the rope crosses itself in the image. The paper's own Rope reaches mIoU 0.375 (or 0.422).
"""

from functools import cache
from itertools import pairwise

import manifold3d
import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Deformation, Identity
from mereo.deformation.warps import CurveSweep
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import Scene, Workspace

SEGMENTS = 8
SEGMENT_LENGTH = 8.0
RADIUS = 1.8
SIDES = 20
RINGS = 8
LENGTH = SEGMENTS * SEGMENT_LENGTH
BASE_SIZE = (10.0, 16.0, 8.0)
BASE_ROUNDING = 1.5
HARMONICS = 4
MAX_BEND = 0.22
"""Largest curvature; times RADIUS it is 0.4 < 1, which keeps the Jacobian positive."""

CLEARANCE = 2.4 * RADIUS
"""Least distance between stretches of the centreline that are not neighbours."""


def _disc(x: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """A triangulated disc at ``x``: centre, half-radius ring and rim; faces look along +x."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.zeros(SIDES), np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.zeros((1, 3)), 0.5 * RADIUS * circle, RADIUS * circle]) + np.array([x, 0.0, 0.0])
    i, j = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    inner, outer = 1, 1 + SIDES
    faces = np.concatenate(
        [
            np.stack([np.zeros(SIDES, dtype=int), inner + i, inner + j], axis=1),
            np.stack([inner + i, outer + i, outer + j], axis=1),
            np.stack([inner + i, outer + j, inner + j], axis=1),
        ]
    )
    return vertices, faces


def _piece(number: int) -> Segment:
    """Segment ``number`` (from 0) of the straight rope along x; neighbours share their discs exactly."""
    start = number * SEGMENT_LENGTH
    first, faces = _disc(start)
    last, _ = _disc(start + SEGMENT_LENGTH)
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    rings = [
        np.stack(
            [np.full(SIDES, start + SEGMENT_LENGTH * k / RINGS), RADIUS * np.cos(angle), RADIUS * np.sin(angle)], 1
        )
        for k in range(1, RINGS)
    ]
    vertices = np.concatenate([first, last, *rings])
    disc, rim = len(first), 1 + SIDES
    loops = np.array([rim, *(2 * disc + SIDES * k for k in range(RINGS - 1)), disc + rim])
    i, j = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    side = [
        np.concatenate([np.stack([a + i, b + i, b + j], axis=1), np.stack([a + i, b + j, a + j], axis=1)])
        for a, b in pairwise(loops)
    ]
    all_faces = np.concatenate([faces[:, ::-1], faces + disc, *(s[:, ::-1] for s in side)])
    return Segment(f"segment_{number + 1}", PALETTE[number + 1], vertices, all_faces)


def _base() -> Segment:
    """A rounded block whose +x face carries the rope."""
    size, rounding = np.array(BASE_SIZE), BASE_ROUNDING
    core = manifold3d.Manifold.cube(tuple(size - 2 * rounding), True)
    ball = manifold3d.Manifold.sphere(rounding, 16)
    solid = core.minkowski_sum(ball).translate((-float(size[0]) / 2, 0.0, 0.0)).refine_to_length(2.5)
    mesh = solid.to_mesh()
    return Segment(
        "base", PALETTE[0], np.array(mesh.vert_properties[:, :3], dtype=float), np.array(mesh.tri_verts, dtype=np.int64)
    )


@cache
def rest_mesh() -> SegmentedMesh:
    """Straight rope along +x from the base."""
    return SegmentedMesh((_base(), *(_piece(number) for number in range(SEGMENTS))))


NODES = read_only(np.linspace(0.0, LENGTH, 97))

COILS = 1 / 3
"""The share of ropes that coil."""

COIL_PITCH = (5.0, 9.0)
"""Between neighbouring turns; the rope is 3.6 thick."""

COIL_BEGINS = 10.0
"""Over this length straight becomes coiled: the turn out of the plane, at most 0.03 per unit, bends little more."""


SWINGS = tuple(f"phase {k + 1} of the {angle}" for angle in ("heading", "elevation") for k in range(HARMONICS))
"""Names of the harmonics of a rope that swings."""


def sample_centerline(rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    """Places at ``NODES`` along a random rope that starts along x."""
    coils = named(rng, "coils below 1/3").random() < COILS
    with part(rng, "coil" if coils else "swing"):
        heading, elevation = coil(rng) if coils else swing(rng)
    tangents = np.stack(
        [np.cos(elevation) * np.cos(heading), np.cos(elevation) * np.sin(heading), np.sin(elevation)], axis=1
    )
    middle = (tangents[1:] + tangents[:-1]) / 2
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(middle * NODES[1], axis=0)])


Angles = tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]
"""Heading and elevation of the tangent at ``NODES``."""


def swing(rng: np.random.Generator) -> Angles:
    """Tangent angles of a rope that swings: random harmonics, scaled to a random share of the largest bend."""
    k = np.arange(1, HARMONICS + 1)
    phases = named(rng, SWINGS, "rad").uniform(0, 2 * np.pi, size=(2, HARMONICS, 1))
    amplitudes = named(rng, "amplitudes").normal(size=(2, HARMONICS, 1)) / np.sqrt(k)[:, None]
    rates = (amplitudes * np.cos(np.pi * k[:, None] * NODES / LENGTH + phases)).sum(axis=1)
    rates[1] *= 0.5  # the camera sees sweeps sideways better
    rates *= named(rng, "bend").uniform(0.15, 1.0) * MAX_BEND / np.linalg.norm(rates, axis=0).max()
    rates *= np.clip(NODES / 6.0, 0.0, 1.0)  # leaves the base straight
    heading, elevation = (np.cumsum(rates, axis=1) - rates / 2) * NODES[1]
    return heading, 1.2 * np.tanh(elevation / 1.2)


def coil(rng: np.random.Generator) -> Angles:
    """Tangent angles of a helix from a random place on; its axis is z and its pitch keeps the turns apart."""
    start = named(rng, "start").uniform(0.05, 0.4) * LENGTH
    rate, pitch = named(rng, "turn per unit", "rad").uniform(0.13, 0.2), named(rng, "pitch").uniform(*COIL_PITCH)
    begun = np.clip((NODES - start) / COIL_BEGINS, 0.0, 1.0)
    heading = named(rng, "sense of turning").choice([-1.0, 1.0]) * np.cumsum(rate * begun) * NODES[1]
    # one turn takes an arc of 2 pi / rate, of which the sine of the elevation is pitch
    elevation = named(rng, "side").choice([-1.0, 1.0]) * np.arcsin(pitch * rate / (2 * np.pi)) * begun
    return heading, elevation


def is_clear(center: Float[np.ndarray, "m 3"]) -> bool:
    """Whether a rope around this centreline touches neither itself nor the base."""
    apart = np.abs(NODES[:, None] - NODES[None]) > 2.0 * CLEARANCE
    gaps = np.linalg.norm(center[:, None] - center[None], axis=-1)
    if (gaps[apart] < CLEARANCE).any():
        return False
    size = np.array(BASE_SIZE)
    outside = np.maximum(np.abs(center + np.array([size[0] / 2, 0.0, 0.0])) - size / 2, 0.0)
    far = NODES > 2.0 * RADIUS
    return bool((np.linalg.norm(outside, axis=1)[far] > 1.1 * RADIUS).all())


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random sweep that moves the whole rope; the base stays."""
    center = sample_centerline(rng)
    while not is_clear(center):
        center = sample_centerline(rng)
    sweep = CurveSweep.through(NODES, center, np.array([0.0, 1.0, 0.0]), RADIUS)
    return (Identity(), *([sweep] * SEGMENTS))


def scene() -> Scene:
    """Scene of the rope; the paper's camera workspace above it."""
    return Scene(
        name="rope",
        rest=rest_mesh(),
        sample_deformations=sample_deformations,
        workspace=Workspace(fov_rad=float(np.deg2rad(45.0))),
    )
