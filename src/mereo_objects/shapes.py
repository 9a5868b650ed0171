"""Shapes: eight simple solids on and around one another, each moved and each deformed; modelled here, no download.

Segments: in the middle a fluted `post`, a `ring` (torus) threaded on it and a `cone` on its top; around it a `box` with
a `ball` on top, a `star` (prism), a `wedge` (a ramp with steps) and an `arch`. It is 26 by 25 units wide, 21.6 high.

Degrees of freedom, rigid: the ring slides up or down the post by 3.75 units, turns by 0.7 rad, tilts by 0.08 rad and
shifts by 0.1; the cone slides on the post's top by 0.6 and turns by 0.7 rad; each of the four around turns by 0.7 rad
and shifts by 1.0 in its cell; the ball also rolls by 0.5 rad and slides by 0.6 on the box.
Continuous: the post twists by 1.2 rad and bends by 0.7 rad to any side, with what is on it; the ring curls by 0.6 rad
and becomes an oval (6 %); the cone's tip leans by 0.9 rad; the box twists by 0.7 rad and tapers by a factor of 0.8 to
1.22; the ball is squashed to between 0.84 and 1.18 of its height; the star twists by 1.2 rad and tapers by 0.8 to 1.2;
the wedge curves by 0.9 rad; the arch twists by 0.7 rad and leans by 0.6 rad; at last smooth waves (gradient up to
0.15) move all of space.

Nothing collides, because of how it is made: solids move in cells that do not meet, and what carries several of them
(the bend of the post, the stack, the waves) is one map of space.

What makes it hard: the solids hide each other from nearly every side, all but the wedge are nearly symmetrical
(notches, a blunt point or a bump tell how far they are turned), and turning and twisting look alike from most sides.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float
from manifold3d import Manifold

from mereo.deformation.draw_names import named, part
from mereo.deformation.maps import Compose, Deformation, Rigid
from mereo.deformation.warps import Bend, SmoothField, Squash, Taper, Twist
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects import _shapes_parts as solid
from mereo_objects._solids import segment

LONGEST_EDGE = 1.15
GAP = 0.1
"""Air between a solid and the one that it stands on."""

UP = read_only(np.array([0.0, 0.0, 1.0]))
CELLS = {"box": (45.0, 20.0), "star": (135.0, 0.0), "wedge": (225.0, 80.0), "arch": (315.0, -35.0)}
"""Where each of the four around the post stands and how far it is turned at rest, in degrees."""

CELL_DISTANCE = 12.6
RING_HEIGHT = 6.75
RING_SLIDE = 3.75
BALL_FLOOR = solid.BOX_SIZE[2] + GAP
CONE_FLOOR = solid.POST_HEIGHT + GAP
BEND_START = 5.0


def cell_center(name: str) -> Float[np.ndarray, "3"]:
    """Middle of a cell, on the ground."""
    angle = np.deg2rad(CELLS[name][0])
    return CELL_DISTANCE * np.array([np.cos(angle), np.sin(angle), 0.0])


def cell_axes(name: str) -> Float[np.ndarray, "2 3"]:
    """Axes x and y of the solid in a cell at rest."""
    angle = np.deg2rad(CELLS[name][1])
    return np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0]])


@cache
def rest_mesh() -> SegmentedMesh:
    """Solids at rest: the ring in the middle of its way along the post, everything upright."""
    parts: dict[str, Manifold] = {
        "post": solid.post(),
        "ring": solid.ring().translate((0.0, 0.0, RING_HEIGHT)),
        "cone": solid.cone().translate((0.0, 0.0, CONE_FLOOR)),
        "box": _placed("box", solid.box()),
        "ball": _placed("box", solid.facetted_ball().translate((0.0, 0.0, BALL_FLOOR))),
        "star": _placed("star", solid.star()),
        "wedge": _placed("wedge", solid.wedge()),
        "arch": _placed("arch", solid.arch()),
    }
    return SegmentedMesh(
        tuple(segment(name, PALETTE[i], part, LONGEST_EDGE) for i, (name, part) in enumerate(parts.items()))
    )


def _placed(cell: str, part: Manifold) -> Manifold:
    x, y, z = cell_center(cell)
    return part.rotate((0.0, 0.0, CELLS[cell][1])).translate((float(x), float(y), float(z)))


def _flat(rng: np.random.Generator, name: str) -> Float[np.ndarray, "3"]:
    """A random horizontal direction."""
    angle = named(rng, name, "rad").uniform(0.0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _within(rng: np.random.Generator, radius: float) -> Float[np.ndarray, "3"]:
    """A horizontal shift, uniform in its length."""
    return named(rng, "shift").uniform(0.0, radius) * _flat(rng, "direction of the shift")


def _angle(rng: np.random.Generator, name: str, limit_rad: float) -> float:
    """An angle, uniform up to its limit to either side."""
    return float(named(rng, name, "rad").uniform(-limit_rad, limit_rad))


def _factor(rng: np.random.Generator, name: str, low: float, high: float) -> float:
    """A factor, uniform in its logarithm."""
    return float(np.exp(named(rng, name, "log").uniform(np.log(low), np.log(high))))


def _curl(
    center: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    toward: Float[np.ndarray, "3"],
    half: float,
    angle_rad: float,
    radius: float,
) -> list[Deformation]:
    """Both halves bend to the same side, so that the middle stays; ``angle_rad`` is that between the ends."""
    return [Bend(center, sign * axis, toward, half, angle_rad / 2, radius) for sign in (1.0, -1.0)]


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Random maps, one for each segment: its own shape, its motion in its cell, what carries it, and the waves."""
    with part(rng, "waves"):
        waves = SmoothField.sample(rng, named(rng, "strength").uniform(0.0, 0.15), (30.0, 60.0))
    with part(rng, "post"):
        lean = _lean(rng, BEND_START * UP, solid.POST_HEIGHT - BEND_START, 0.7, 8.0)
    with part(rng, "box and ball"):
        stack = _move_in_cell(rng, "box")
    carried: dict[str, list[Deformation]] = {"post": [lean], "ring": [lean], "cone": [lean]}
    carried |= {"box": [stack], "ball": [stack]}
    chains = []
    for name, shape in SHAPES.items():
        with part(rng, name):
            local = shape(rng)
            carrier = carried[name] if name in carried else [_move_in_cell(rng, name)]
        chains.append(Compose((*local, *carrier, waves)))
    return tuple(chains)


def _move_in_cell(rng: np.random.Generator, cell: str) -> Rigid:
    return Rigid(_angle(rng, "turn", 0.7) * UP, _within(rng, 1.0), cell_center(cell))


def _lean(
    rng: np.random.Generator, foot: Float[np.ndarray, "3"], length: float, most_rad: float, radius: float
) -> Bend:
    """A bend of what stands upright, to any side."""
    toward = _flat(rng, "direction of leaning")
    return Bend(foot, UP, toward, length, named(rng, "lean", "rad").uniform(0.0, most_rad), radius)


def _post(rng: np.random.Generator) -> list[Deformation]:
    return [Twist(np.zeros(3), UP, solid.POST_HEIGHT, _angle(rng, "twist", 1.2))]


def _ring(rng: np.random.Generator) -> list[Deformation]:
    center, reach = RING_HEIGHT * UP, solid.RING_RADIUS + solid.RING_TUBE
    across = _flat(rng, "direction of oval and curl")
    oval = Squash(center, across, _factor(rng, "oval", 1 / 1.06, 1.06))
    curl = _curl(center, across, UP, reach, _angle(rng, "curl", 0.6), solid.RING_TUBE + 0.5)
    turn = _angle(rng, "turn", 0.7) * UP
    tilt = named(rng, "tilt", "rad").uniform(0.0, 0.08) * _flat(rng, "direction of the tilt")
    slide = _within(rng, 0.1) + float(named(rng, "height").uniform(-RING_SLIDE, RING_SLIDE)) * UP
    return [Rigid(turn, np.zeros(3), center), oval, *curl, Rigid(tilt, slide, center)]


def _cone(rng: np.random.Generator) -> list[Deformation]:
    foot = CONE_FLOOR * UP
    lean = _lean(rng, foot + UP, solid.CONE_HEIGHT - 1.0, 0.9, solid.CONE_RADIUS)
    return [lean, Rigid(_angle(rng, "turn", 0.7) * UP, _within(rng, 0.6), foot)]


def _box(rng: np.random.Generator) -> list[Deformation]:
    foot = cell_center("box")
    height = solid.BOX_SIZE[2]
    return [
        Taper(foot, UP, height, _factor(rng, "taper", 0.8, 1.22)),
        Twist(foot, UP, height, _angle(rng, "twist", 0.7)),
    ]


def _ball(rng: np.random.Generator) -> list[Deformation]:
    contact = cell_center("box") + BALL_FLOOR * UP
    roll = named(rng, "roll about").normal(size=3)
    roll *= named(rng, "roll", "rad").uniform(0.0, 0.5) / np.linalg.norm(roll)
    return [
        Rigid(roll, np.zeros(3), contact + solid.BALL_RADIUS * UP),
        Squash(contact, UP, _factor(rng, "squash", 0.84, 1.18)),  # about the contact: it stays on the box
        Rigid(np.zeros(3), _within(rng, 0.6), contact),
    ]


def _star(rng: np.random.Generator) -> list[Deformation]:
    foot = cell_center("star")
    height = solid.STAR_HEIGHT
    return [
        Taper(foot, UP, height, _factor(rng, "taper", 0.8, 1.2)),
        Twist(foot, UP, height, _angle(rng, "twist", 1.2)),
    ]


def _wedge(rng: np.random.Generator) -> list[Deformation]:
    along, across = cell_axes("wedge")
    half, width = solid.WEDGE_SIZE[0] / 2, solid.WEDGE_SIZE[1] / 2
    return _curl(cell_center("wedge"), along, across, half, _angle(rng, "curve", 0.9), width)


def _arch(rng: np.random.Generator) -> list[Deformation]:
    foot = cell_center("arch")
    across = cell_axes("arch")[1]
    height, reach = solid.ARCH_LEG + solid.ARCH_RADIUS, solid.ARCH_DEPTH / 2 + 1.0
    lean = Bend(foot, UP, across, height, _angle(rng, "lean", 0.6), reach)
    return [lean, Twist(foot, UP, height, _angle(rng, "twist", 0.7))]


SHAPES: dict[str, Callable[[np.random.Generator], list[Deformation]]] = {
    "post": _post,
    "ring": _ring,
    "cone": _cone,
    "box": _box,
    "ball": _ball,
    "star": _star,
    "wedge": _wedge,
    "arch": _arch,
}
"""What deforms each solid by itself, in the order of the segments."""


def scene() -> Scene:
    """Scene of the shapes on the ground; the paper's camera workspace above them."""
    workspace = Workspace(fov_rad=float(np.deg2rad(24.0)))
    return Scene("shapes", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
