"""Skinned bones: a small kinematic tree whose hinges move all of space.

Every hinge turns a point by its angle times the point's share in the bones below it. Blending angles instead of
matrices keeps each step a rotation, so joints do not collapse (cf. Kavan & Zara, "Spherical blend skinning", 2005).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mereo.deformation.maps import turn, unit

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Hinge:
    """One degree of freedom at the head of a bone: an axis in the rest pose, and its limits in radians."""

    axis: Vector
    lower_rad: float
    upper_rad: float


@dataclass(frozen=True)
class Bone:
    """A line segment from its joint (``head``) to its ``tip``.

    Attributes:
        parent: index of the bone it hangs from, -1 for a root.
        hinges: applied at the head, the last one first; none makes the bone rigid with its parent.
    """

    parent: int
    head: Vector
    tip: Vector
    hinges: tuple[Hinge, ...] = ()


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones at rest; parents come before their children.

    The share of a bone in a point is the softmax of ``-distance / width``. A hinge's share w sums its bone's and those
    of all bones below, so it falls smoothly from 1 to 0 across the joint, and ``|grad w| <= 1 / (2 width)``.

    Attributes:
        bones: the tree.
        width: softness of the joints, in length; about the thickness of the limbs suits.
    """

    bones: tuple[Bone, ...]
    width: float

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise ValueError(f"the skeleton's width is {self.width:g}; it must be above 0: use the limbs' thickness")
        for index, bone in enumerate(self.bones):
            if not -1 <= bone.parent < index:
                raise ValueError(
                    f"bone {index} hangs from bone {bone.parent}; a parent comes before its children, and -1 marks a "
                    "root: reorder the bones"
                )

    @property
    def hinges(self) -> tuple[tuple[int, Hinge], ...]:
        """(bone, hinge), in the order of the angles of a pose."""
        return tuple((index, hinge) for index, bone in enumerate(self.bones) for hinge in bone.hinges)

    @property
    def limits_rad(self) -> Float[np.ndarray, "h 2"]:
        """Lower and upper limit of each hinge."""
        return np.array([(hinge.lower_rad, hinge.upper_rad) for _, hinge in self.hinges]).reshape(-1, 2)

    def below(self) -> Bool[np.ndarray, "b b"]:
        """``[i, j]``: whether bone ``i`` is bone ``j`` or hangs below it."""
        table = np.eye(len(self.bones), dtype=bool)
        for index, bone in enumerate(self.bones):
            if bone.parent >= 0:
                table[index] |= table[bone.parent]
        return table

    def shares(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n b"]:
        """How much of each point belongs to each bone: in [0, 1], summing to 1."""
        heads = np.array([bone.head for bone in self.bones], dtype=float)
        along = np.array([bone.tip for bone in self.bones]) - heads
        local = points[:, None] - heads
        squared = np.maximum(np.einsum("bi,bi->b", along, along), 1e-30)
        t = np.clip(np.einsum("nbi,bi->nb", local, along) / squared, 0.0, 1.0)
        offset = local - t[..., None] * along
        # the width under the root rounds off the distance's cone at the bone itself
        distance = np.sqrt(np.einsum("nbi,nbi->nb", offset, offset) + self.width**2)
        weights = np.exp((distance.min(axis=1, keepdims=True) - distance) / self.width)
        return weights / weights.sum(axis=1, keepdims=True)

    def pose(self, angles_rad: Float[np.ndarray, " h"]) -> "SkinnedBones":
        """The deformation that turns each hinge by its angle. Raises ``ValueError`` for an angle outside its limits."""
        return SkinnedBones(self, angles_rad)

    def sample(self, rng: np.random.Generator) -> "SkinnedBones":
        """A random pose, each angle uniform within its limits."""
        return self.pose(rng.uniform(*self.limits_rad.T))


@dataclass(frozen=True, eq=False)
class SkinnedBones:
    """Forward kinematics with angles blended in space: each point turns by ``share * angle`` about every hinge.

    Hinges are applied from the leaves to the root, all in rest coordinates, with shares of the rest point. With one
    hinge (axis a through c) the Jacobian is exactly ``1 + angle * grad w . (a x (x - c))``; with several it is positive
    while ``sum |angle| |grad w| lever < 1``, the lever being the point's distance from the posed axis. That is a matter
    of limits, width and the object's extent: ``deformation.check_positive`` at the limits settles it for a scene.
    """

    skeleton: Skeleton
    angles_rad: Float[np.ndarray, " h"]

    def __post_init__(self) -> None:
        lower, upper = self.skeleton.limits_rad.T
        if len(self.angles_rad) != len(lower):
            raise ValueError(
                f"the pose has {len(self.angles_rad)} angles for {len(lower)} hinges; it needs one for each: "
                "list them in the order of skeleton.hinges"
            )
        outside = np.flatnonzero(~((self.angles_rad >= lower) & (self.angles_rad <= upper)))
        if len(outside):
            index = outside[0]
            raise ValueError(
                f"hinge {index} is set to {self.angles_rad[index]:.3g} rad; its limits are {lower[index]:.3g} to "
                f"{upper[index]:.3g}: clip the angle, or widen the limits and check the Jacobian again"
            )

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        weights = self.skeleton.shares(points) @ self.skeleton.below().astype(float)
        posed = list(zip(self.skeleton.hinges, self.angles_rad, strict=True))
        for (bone, hinge), angle in reversed(posed):
            head = np.array(self.skeleton.bones[bone].head, dtype=float)
            points = turn(points, head, unit(np.array(hinge.axis, dtype=float)), angle * weights[:, bone])
        return points
