"""The body's joints: places and hierarchy from MakeHuman's skeleton, degrees of freedom and limits from anatomy."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mereo.geometry.read_only import read_only
from mereo_objects._human_parts import joints

Turns = tuple[tuple[str, float, float], ...]
"""Axis, lower and upper limit in degrees from the rest pose. An axis is x, y, z, `bone` (along the bone, a twist), or
`hinge` (across upper arm and forearm; a positive angle bends them further)."""


@dataclass(frozen=True)
class BodyJoint:
    """Joint of the body: what turns about one point.

    Attributes:
        name: of the part it moves.
        parent: the part it hangs from.
        bone, tip: MakeHuman's bone whose head is the joint, and the joint to which the part reaches.
        skin: how the names of the bones begin whose skin moves with the part, and how they end.
        softness: by how much its share is diffused, standard deviation in scene units.
        turns: its degrees of freedom, applied the last one first.
    """

    name: str
    parent: str
    bone: str
    tip: str
    skin: tuple[tuple[str, ...], str]
    softness: float
    turns: Turns

    @property
    def head(self) -> Float[np.ndarray, "3"]:
        """Place of the joint, in scene coordinates."""
        return joints()[f"{self.bone}____head"]

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Direction of the part, a unit vector."""
        along = joints()[self.tip] - self.head
        unit: Float[np.ndarray, "3"] = along / np.linalg.norm(along)
        return unit


FACE = ("head", "jaw", "eye", "tongue", "levator", "oculi", "orbicularis", "oris", "risorius", "special")


def _trunk() -> Iterator[BodyJoint]:
    bend: Turns = (("y", -15, 15), ("z", -12, 12), ("x", -10, 22))
    yield BodyJoint("waist", "", "spine04", "spine02____head", (("spine04", "spine03"), ""), 2.5, bend)
    chest = ("spine02", "spine01", "clavicle", "breast", "shoulder01")
    yield BodyJoint("chest", "waist", "spine02", "neck01____head", (chest, ""), 2.5, bend)
    turns: Turns = (("y", -25, 25), ("z", -10, 10), ("x", -12, 15))
    yield BodyJoint("neck", "chest", "neck01", "head____head", (("neck",), ""), 1.6, turns)
    yield BodyJoint("head", "neck", "head", "head____tail", (FACE, ""), 2.0, turns)


def _limbs(side: str) -> Iterator[BodyJoint]:
    """Joints of one side, `L` or `R`; the limits are those of the left side and mirrored for the right one."""

    def limb(
        name: str, parent: str, bone: str, tip: str, skin: tuple[str, ...], softness: float, turns: Turns
    ) -> BodyJoint:
        above = parent if parent in ("chest", "") else f"{parent}.{side}"
        return BodyJoint(
            f"{name}.{side}", above, f"{bone}.{side}", f"{tip}.{side}____head", (skin, f".{side}"), softness, turns
        )

    shoulder: Turns = (("z", -22, 60), ("x", -65, 25), ("bone", -25, 25))
    yield limb("upper_arm", "chest", "upperarm01", "lowerarm01", ("upperarm",), 2.6, shoulder)
    yield limb("forearm", "upper_arm", "lowerarm01", "wrist", ("lowerarm",), 2.5, (("hinge", -40, 58),))
    hand = ("wrist", "metacarpal", "finger")
    yield limb("hand", "forearm", "wrist", "finger3-1", hand, 1.0, (("hinge", -35, 35), ("bone", -30, 30)))
    hip: Turns = (("z", -6, 25), ("x", -62, 15), ("bone", -12, 12))
    yield limb("thigh", "", "upperleg01", "lowerleg01", ("upperleg",), 3.2, hip)
    yield limb("shin", "thigh", "lowerleg01", "foot", ("lowerleg",), 2.7, (("x", 0, 95),))
    yield limb("foot", "shin", "foot", "toe3-1", ("foot", "toe"), 1.1, (("z", -10, 10), ("x", -15, 30)))


JOINTS = (*_trunk(), *_limbs("L"), *_limbs("R"))
"""Parents before their children; `waist` and thighs hang from the pelvis, which stays."""

NAMES = tuple(joint.name for joint in JOINTS)
PARENTS = tuple(NAMES.index(joint.parent) if joint.parent else -1 for joint in JOINTS)


@cache
def turn_axes() -> Float[np.ndarray, "j 3 3"]:
    """Axes of each joint in the rest pose, in the order of its turns; zero where it has fewer than three."""
    axes = np.zeros((len(JOINTS), 3, 3))
    for index, joint in enumerate(JOINTS):
        for place, (name, _, _) in enumerate(joint.turns):
            axes[index, place] = _axis(joint, name)
    return read_only(axes)


@cache
def turn_limits() -> Float[np.ndarray, "2 j 3"]:
    """Lower and upper limit of each turn in radians; zero where there is none."""
    limits = np.zeros((2, len(JOINTS), 3))
    for index, joint in enumerate(JOINTS):
        limits[:, index, : len(joint.turns)] = np.deg2rad([turn[1:] for turn in joint.turns]).T
    return read_only(limits)


@cache
def turn_names() -> tuple[str, ...]:
    """Name of each turn, joint by joint in the order of ``turn_limits``; "" where there is none."""
    about = {"bone": "twist", "hinge": "bend", "x": "about x", "y": "about y", "z": "about z"}
    names = []
    for joint in JOINTS:
        part, _, side = joint.name.replace("_", " ").partition(".")
        owner = f"{'left ' if side == 'L' else 'right ' if side else ''}{part}"
        turns = [f"{owner} {about[axis]}" for axis, _, _ in joint.turns]
        names += [*turns, *("" for _ in range(3 - len(turns)))]
    return tuple(names)


def _axis(joint: BodyJoint, name: str) -> Float[np.ndarray, "3"]:
    right = joint.name.endswith("R")
    if name == "bone":  # a turn about a mirrored bone is mirrored by turning the other way
        return joint.direction * (-1.0 if right else 1.0)
    if name == "hinge":
        side = joint.name[-1]
        upper, fore = (JOINTS[NAMES.index(f"{part}.{side}")].direction for part in ("upper_arm", "forearm"))
        across = np.cross(upper, fore)
        unit: Float[np.ndarray, "3"] = across / np.linalg.norm(across)
        return unit
    axis = np.eye(3)["xyz".index(name)]
    return axis * np.array([1.0, -1.0, -1.0]) if right else axis


@cache
def part_axes() -> tuple[Float[np.ndarray, "j 3 3"], Float[np.ndarray, "j 3"]]:
    """Projection across the axis of each part, and the joint at which it begins."""
    directions = np.stack([joint.direction for joint in JOINTS])
    projections = np.eye(3) - directions[:, :, None] * directions[:, None]
    return read_only(projections), read_only(np.stack([joint.head for joint in JOINTS]))


def rotations(angles_rad: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
    """Rotations of joints whose turns have these angles, as axis times angle."""
    first, second, third = (
        Rotation.from_rotvec(angles_rad[:, place, None] * turn_axes()[:, place]) for place in range(3)
    )
    vectors: Float[np.ndarray, "j 3"] = (first * second * third).as_rotvec()
    return vectors
