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

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mereo.deformation.draw_names import part, unchecked
from mereo.deformation.maps import Compose, Deformation, Rigid
from mereo.deformation.samplers import JointSampler, RandomMotion
from mereo.geometry.conventions import Names
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.read_only import read_only
from mereo.scenes.scene import GUESSED_UNIT_M, Scene, Workspace
from mereo_objects import _robot_parts as parts
from mereo_objects._solids import Vector, segment

MOVED = "column", "upper_arm", "elbow", "forearm", "wrist", "hand", "finger_left", "finger_right"
"""Segments that move, in the order of the chain."""


def _turn(name: str, center: Vector, axis: Vector, lower_deg: float, upper_deg: float) -> JointSampler:
    """Revolute joint of the rest pose, called after the segment that it moves."""
    limits = float(np.deg2rad(lower_deg)), float(np.deg2rad(upper_deg))
    return JointSampler(np.array(center), np.array(axis), limits, (0.0, 0.0), np.zeros(3), name)


JOINTS = (
    _turn("column turn", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), -170.0, 170.0),
    _turn("upper arm lean", parts.SHOULDER, (0.0, 1.0, 0.0), -50.0, 75.0),
    _turn("elbow fold", parts.ELBOW, (0.0, 1.0, 0.0), -45.0, 75.0),
    _turn("forearm roll", parts.WRIST, (1.0, 0.0, 0.0), -180.0, 180.0),
    _turn("wrist pitch", parts.WRIST, (0.0, 1.0, 0.0), -100.0, 100.0),
    _turn("hand spin", parts.WRIST, (1.0, 0.0, 0.0), -180.0, 180.0),
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


def _finger(name: str, side: float, follows: str = "") -> JointSampler:
    """Slide of a finger, on a side."""
    limits = side * (OPENING[0] - parts.JAW_OPENING), side * (OPENING[1] - parts.JAW_OPENING)
    return JointSampler(np.zeros(3), np.array([0.0, 1.0, 0.0]), (0.0, 0.0), limits, np.zeros(3), name, follows)


@dataclass(frozen=True, eq=False)
class ArmMotion(RandomMotion):
    """Random angles of all joints at which the parts keep apart, and a random opening; the base stays."""

    @property
    def leaders(self) -> Names:
        """Joints in the order in which they are drawn."""
        return (*(joint.name for joint in JOINTS), "fingers apart")

    def __call__(self, rng: np.random.Generator) -> tuple[Deformation, ...]:
        """Motions of all segments."""
        shares = dict[str, float]()
        while True:
            for name in self.leaders[:-1]:
                with part(rng, name):
                    shares[name] = self.joints[name][0].sample_share(rng)
            if unchecked(rng) or is_clear(tuple(self.joints[name][0].at(share) for name, share in shares.items())):
                break
        with part(rng, self.leaders[-1]):
            shares[self.leaders[-1]] = self.joints[self.leaders[-1]][0].sample_share(rng)
        return self.at(shares)


def motion() -> ArmMotion:
    """Motion of the arm: of the fingers first, as the tip of a chain moves first."""
    rest = rest_mesh()
    number = {name: rest.names.index(name) for name in MOVED}
    moved = [tuple(number[name] for name in MOVED[first:]) for first in range(len(JOINTS))]
    left, right = (number["finger_left"],), (number["finger_right"],)
    fingers = ((_finger("fingers apart", 1.0), left), (_finger("other finger", -1.0, "fingers apart"), right))
    return ArmMotion(rest, (*fingers, *reversed(tuple(zip(JOINTS, moved, strict=True)))))


def scene() -> Scene:
    """Scene of the arm; the paper's camera workspace above it."""
    workspace = Workspace(fov_rad=float(np.deg2rad(44.0)))
    return Scene("robot", rest_mesh(), motion(), workspace, unit_m=GUESSED_UNIT_M)
