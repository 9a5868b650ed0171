"""Rope: it hangs from a base, in random curves and coils; modelled here, needs no download.

Source: modelled in mereo's own code, MIT licence. The x axis points down: the base is fixed above, the rope hangs from
it, and the camera looks across, from a cone about z.

Segments: `base` (a rounded block) and `segment_1` (at the base) to `segment_8` (the free end), each a piece of one
round rope, 8 units long and 3.6 thick.

Degrees of freedom: the base stays. The centreline is drawn by how much it bends, at each place, sideways (at rest along
y) and forwards (along z, towards the cameras): both by the same law, so that a rope leaves its plane as far as it moves
in it. Two ropes in three swing: both bends are random functions of arc length (four harmonics each), up to full loops.
One in three coils: from somewhere in its upper part on it winds as a helix of either hand, about an axis across it in
any direction, 0.13 to 0.2 radians per unit, which is up to 1.8 turns, each 5 to 9 units beside the last. Nothing bends
more than 0.22 per unit (radius of curvature 4.5). Curves in which the rope would touch itself or the base are drawn
again.

What makes it hard: the segments are identical, so a segment's name follows only from its place along the rope, which
may be hidden where the rope crosses itself in the image. The paper's own Rope reaches mIoU 0.375 (or 0.422).
"""

from functools import cache
from itertools import pairwise

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mereo.deformation.draw_names import named, part, unchecked
from mereo.deformation.maps import Deformation, Identity
from mereo.deformation.warps import CurveSweep
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace

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
    i = np.arange(SIDES)
    j = (np.arange(SIDES) + 1) % SIDES
    inner = 1
    outer = 1 + SIDES
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
    disc = len(first)
    rim = 1 + SIDES
    loops = np.array([rim, *(2 * disc + SIDES * k for k in range(RINGS - 1)), disc + rim])
    i = np.arange(SIDES)
    j = (np.arange(SIDES) + 1) % SIDES
    side = [
        np.concatenate([np.stack([a + i, b + i, b + j], axis=1), np.stack([a + i, b + j, a + j], axis=1)])
        for a, b in pairwise(loops)
    ]
    all_faces = np.concatenate([faces[:, ::-1], faces + disc, *(s[:, ::-1] for s in side)])
    return Segment(f"segment_{number + 1}", PALETTE[number + 1], vertices, all_faces)


def _base() -> Segment:
    """A rounded block whose +x face carries the rope."""
    size = np.array(BASE_SIZE)
    rounding = BASE_ROUNDING
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
"""Over this length straight becomes coiled."""

SWINGS = tuple(f"phase {k + 1} {way}" for way in ("sideways", "forwards") for k in range(HARMONICS))
"""Names of the harmonics of a rope that swings."""

Bends = Float[np.ndarray, "2 m"]
"""Curvature sideways and forwards at ``NODES``, along two normals that never turn about the rope (Bishop, "There is
more than one way to frame a curve", 1975)."""


def sample_centerline(rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    """Places at ``NODES`` along a random rope that starts along x."""
    coils = named(rng, "coils below 1/3").random() < COILS
    with part(rng, "coil" if coils else "swing"):
        return centerline(coil(rng) if coils else swing(rng))


def centerline(bends: Bends) -> Float[np.ndarray, "m 3"]:
    """Places at ``NODES`` along the curve of these bends, which starts along x; sideways is y there, forwards z.

    With tangent t and normals u, v it obeys t' = a u + b v, u' = -a t, v' = -b t. The frame's columns t, u, v turn by a
    small rotation from node to node, about (0, -b, a) in the frame's own axes.
    """
    step = NODES[1]
    sideways, forwards = (bends[:, 1:] + bends[:, :-1]) / 2
    turns = Rotation.from_rotvec(step * np.stack([np.zeros_like(sideways), -forwards, sideways], axis=1)).as_matrix()
    frames = np.concatenate([np.eye(3)[None], turns])
    reach = 1
    while reach < len(frames):  # products of ever more turns: seven rounds instead of one for each node
        frames[reach:] = frames[:-reach] @ frames[reach:]
        reach *= 2
    tangents = frames[:, :, 0]
    middle = (tangents[1:] + tangents[:-1]) / 2
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(middle * step, axis=0)])


def swing(rng: np.random.Generator) -> Bends:
    """Bends of a rope that swings: random harmonics, scaled to a random share of the largest bend."""
    k = np.arange(1, HARMONICS + 1)
    phases = named(rng, SWINGS, "rad").uniform(0, 2 * np.pi, size=(2, HARMONICS, 1))
    amplitudes = named(rng, "amplitudes").normal(size=(2, HARMONICS, 1)) / np.sqrt(k)[:, None]
    bends = (amplitudes * np.cos(np.pi * k[:, None] * NODES / LENGTH + phases)).sum(axis=1)
    largest = max(float(np.linalg.norm(bends, axis=0).max()), np.finfo(float).tiny)  # 0 where all amplitudes are
    bends *= named(rng, "bend").uniform(0.15, 1.0) * MAX_BEND / largest
    return bends * np.clip(NODES / 6.0, 0.0, 1.0)  # leaves the base straight


def coil(rng: np.random.Generator) -> Bends:
    """Bends of a helix from a random place on, in a random direction; its pitch keeps the turns apart."""
    start = named(rng, "start").uniform(0.05, 0.4) * LENGTH
    rate = named(rng, "turn per unit", "rad").uniform(0.13, 0.2)
    pitch = named(rng, "pitch").uniform(*COIL_PITCH)
    direction = named(rng, "direction", "rad").uniform(0, 2 * np.pi)
    hand = named(rng, "hand").choice([-1.0, 1.0])
    # one turn takes an arc of 2 pi / rate, of which the sine of the slope is pitch; so a helix has its curvature
    # and torsion, and torsion turns the direction in which it bends
    slope = np.arcsin(pitch * rate / (2 * np.pi))
    along = np.maximum(NODES - start, 0.0)
    toward = direction + hand * rate * np.sin(slope) * along
    bend = rate * np.cos(slope) * np.minimum(along / COIL_BEGINS, 1.0)
    return bend * np.stack([np.cos(toward), np.sin(toward)])


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
    while True:  # one line draws, so that a recorder knows refused curves for what they are
        center = sample_centerline(rng)
        if unchecked(rng) or is_clear(center):
            break
    sweep = CurveSweep.through(NODES, center, np.array([0.0, 1.0, 0.0]), RADIUS)
    return (Identity(), *([sweep] * SEGMENTS))


def scene() -> Scene:
    """Scene of the rope; the paper's camera workspace above it."""
    workspace = Workspace(fov_rad=float(np.deg2rad(45.0)))
    return Scene("rope", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
