"""Robot: an industrial arm with six revolute joints and a two-finger gripper; modelled here, needs no download.

Source: modelled in mereo's own code (`_robot_parts`), MIT licence; no particular product. Proportions are those of an
arm of 0.7 m reach, with a large gripper: one unit is about 16 mm. At rest, with the upper arm upright and the forearm
level, it is 48 x 20 x 46 units.

Segments: one for each link, `base`, `column`, `upper_arm`, `elbow`, `forearm`, `wrist`, `hand`, and the jaws
`finger_left` and `finger_right`. Motors, covers, ribs and bolts belong to the link that carries them.

Beside the right finger the hand carries a camera, whose cable makes a bow over to a socket. Without it a hand turned by
half looks the same with its fingers exchanged: in the median of 200 views of 96 x 96 pixels, four pixels told them
apart, and which finger is the left one was a question that no view answers. With it 40 do, and in 95 % of the views 19.

Degrees of freedom, each uniform within its limits, rigid motions composed down the chain:

    turn      column about z              -170 to 170 degrees
    lean      upper arm about y            -50 to 75 (forward)
    fold      elbow about y                -45 to 75 (down)
    roll      forearm about its length    -180 to 180
    pitch     wrist about the fork's pin  -100 to 100
    spin      hand about its length       -180 to 180
    opening   of each finger from the middle, 0.15 to 2.0 units

Neighbours cannot meet within these limits, by construction; poses in which other parts would (the hand and the base,
the column, the upper arm or the floor) are drawn again, about one in four. The base stays.

What makes it hard: the chain reaches 58 units from a fixed base, so a small error in one angle moves everything after
it; the forearm looks almost the same after half a turn; only the hand's camera tells how far the hand is turned and
which finger is which; the fingers are two pixels thick and often hidden; the depth camera may stand behind the arm,
where the column hides the hand.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import named, unchecked
from mereo.deformation.maps import Compose, Deformation, Identity, Rigid
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects import _robot_parts as parts
from mereo_objects._solids import Vector, segment


class ArmJoint(NamedTuple):
    """Revolute joint of the rest pose: a point of its axis, the axis, and limits in degrees.

    It is called after the segment that it moves.
    """

    name: str
    center: Vector
    axis: Vector
    lower_deg: float
    upper_deg: float


JOINTS = (
    ArmJoint("column turn", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), -170.0, 170.0),
    ArmJoint("upper arm lean", parts.SHOULDER, (0.0, 1.0, 0.0), -50.0, 75.0),
    ArmJoint("elbow fold", parts.ELBOW, (0.0, 1.0, 0.0), -45.0, 75.0),
    ArmJoint("forearm roll", parts.WRIST, (1.0, 0.0, 0.0), -180.0, 180.0),
    ArmJoint("wrist pitch", parts.WRIST, (0.0, 1.0, 0.0), -100.0, 100.0),
    ArmJoint("hand spin", parts.WRIST, (1.0, 0.0, 0.0), -180.0, 180.0),
)
OPENING = (0.15, 2.0)
"""Least and largest distance of a finger from the middle."""


class Bulk(NamedTuple):
    """Row of ``spheres`` of one radius with centres from ``start`` to ``end``, which enclose a part at rest."""

    link: int
    start: Vector
    end: Vector
    radius: float
    spheres: int

    def centers(self) -> Float[np.ndarray, "n 3"]:
        """Centres of the spheres at rest."""
        return np.linspace(self.start, self.end, self.spheres)


_Z = parts.FOREARM_HEIGHT
REACHING = (
    Bulk(3, (-5.0, 0.0, _Z), (6.5, 0.0, _Z), 4.4, 5),
    Bulk(4, (11.0, 0.0, _Z), (19.5, 0.0, _Z), 3.9, 4),
    Bulk(5, (21.5, 0.0, _Z), (24.0, 0.0, _Z), 3.9, 2),
    Bulk(6, (27.5, 0.0, _Z), (35.8, 0.0, _Z), 4.9, 5),
    Bulk(6, (30.3, -7.9, _Z - 1.4), (30.3, -7.9, _Z + 1.4), 2.9, 2),  # the hand's camera
    Bulk(6, (29.1, -5.6, _Z), (29.1, -5.6, _Z), 1.8, 1),  # its bracket
    Bulk(6, (29.3, -6.4, _Z + 4.3), (29.3, -4.0, _Z + 4.3), 2.8, 2),  # the bow of its cable
)
"""What may come near the parts it does not hang from; the fingers are in the hand's spheres."""

COLUMN = (
    Bulk(1, (0.5, -0.8, 11.0), (3.5, -0.8, 19.0), 5.8, 4),
    Bulk(1, (3.5, -7.0, 19.0), (3.5, -2.0, 19.0), 4.2, 3),
    Bulk(1, (-4.3, -2.6, 11.0), (-4.3, -2.6, 14.5), 3.4, 3),
)
UPPER_ARM = (Bulk(2, (3.5, 5.4, 19.0), (3.5, 5.4, 37.0), 4.4, 9),)

FOOT = read_only(np.array([[-10.6, -10.0, -50.0], [10.0, 10.0, 10.4]]))
"""A box around the base and the turntable."""


@cache
def rest_mesh() -> SegmentedMesh:
    """Arm at rest: nine closed segments, 0.15 to 0.2 apart where they move upon each other."""
    solids = {
        "base": parts.base(),
        "column": parts.column(),
        "upper_arm": parts.upper_arm(),
        "elbow": parts.elbow(),
        "forearm": parts.forearm(),
        "wrist": parts.wrist(),
        "hand": parts.hand(),
        "finger_left": parts.finger(1),
        "finger_right": parts.finger(-1),
    }
    return SegmentedMesh(tuple(segment(name, PALETTE[i], part) for i, (name, part) in enumerate(solids.items())))


def sample_angles(rng: np.random.Generator) -> Float[np.ndarray, "6"]:
    """Random joint angles in radians, uniform within the limits."""
    limits = np.array([(joint.lower_deg, joint.upper_deg) for joint in JOINTS])
    names = tuple(joint.name for joint in JOINTS)
    return np.deg2rad(named(rng, names, "°").uniform(limits[:, 0], limits[:, 1]))


def chain(angles_rad: Float[np.ndarray, "6"]) -> tuple[Rigid, ...]:
    """Turns of the joints, in the rest frame; link k moves by the first k of them, the last one first."""
    return tuple(
        Rigid(angle * np.array(joint.axis), np.zeros(3), np.array(joint.center))
        for joint, angle in zip(JOINTS, angles_rad, strict=True)
    )


def is_clear(turns: tuple[Rigid, ...]) -> bool:
    """Whether the moving parts keep off the floor, the base, the column and the upper arm.

    Neighbours are left out, as their layers keep them apart. The spheres enclose the parts with a little to spare, so
    that some clear poses are refused, but none that collides is let through.
    """
    reaching = [(bulk.link, _moved(bulk, turns), bulk.radius) for bulk in REACHING]
    for link, centers, radius in reaching:
        outside = np.maximum(np.maximum(FOOT[0] - centers, centers - FOOT[1]), 0.0)
        if centers[:, 2].min() < radius or np.linalg.norm(outside, axis=1).min() < radius:
            return False
        others = COLUMN if link < 5 else COLUMN + UPPER_ARM
        for other in others:
            gaps = np.linalg.norm(centers[:, None] - _moved(other, turns), axis=-1)
            if gaps.min() < radius + other.radius:
                return False
    return True


def _moved(bulk: Bulk, turns: tuple[Rigid, ...]) -> Float[np.ndarray, "n 3"]:
    return Compose(turns[: bulk.link][::-1])(bulk.centers())


def sample_deformations(rng: np.random.Generator) -> tuple[Deformation, ...]:
    """Motions of all segments at random angles of all joints and a random opening; the base stays."""
    while True:  # one line draws, so that a recorder knows refused angles for what they are
        turns = chain(sample_angles(rng))
        if unchecked(rng) or is_clear(turns):
            break
    links = [Compose(turns[:count][::-1]) for count in range(1, len(turns) + 1)]
    opening = named(rng, "fingers apart").uniform(*OPENING)
    slide = np.array([0.0, opening - parts.JAW_OPENING, 0.0])
    fingers = [Compose((Rigid(np.zeros(3), side * slide, np.zeros(3)), *turns[::-1])) for side in (1, -1)]
    return (Identity(), *links, *fingers)


def scene() -> Scene:
    """Scene of the arm; the paper's camera workspace above it."""
    workspace = Workspace(fov_rad=float(np.deg2rad(44.0)))
    return Scene("robot", rest_mesh(), sample_deformations, workspace, unit_m=GUESSED_UNIT_M)
