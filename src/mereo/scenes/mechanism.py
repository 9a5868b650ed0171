"""States of a mechanism: rigid segments on joints with known axes, exact where a linear model of states is not.

A turning joint moves points on circles, which no mode follows. Here a state is a number for each joint, N(0, 1), and
the joint is at the share ``Phi(z)`` of its range: the draws of the object's scene. Modes are derivatives at a state.

Notation: s segments, k joints that are free, m material points, n states.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from math import prod

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from numpy.random import default_rng
from scipy.optimize import least_squares
from scipy.special import ndtr, ndtri

from mereo.deformation.maps import unit
from mereo.deformation.samplers import RandomMotion
from mereo.geometry.conventions import Names, WholeNumbers
from mereo.geometry.transforms import Transform, best_rotations, fit_rigid, transform_points
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import OF_REST, MaterialPoints, PairDistances, PerMode, Rows, StatisticalModel

STATES = 600
"""Random states of a mechanism's library."""

LARGEST, LARGEST_START = 4.0, 2.0
"""Standard deviations beyond which a joint stays where it is, and of one at rest at most: near its limit a joint hardly
moves with its number."""

NEARLY = 1e-3
"""Difference, rad, of a turning joint's range from a whole turn up to which it has no limits: its number goes on."""

CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)
"""``t @ CROSS`` is the matrix by which the cross product with t multiplies."""

Numbers = Float[ndarray, "*n k"]
"""Numbers of the free joints in states."""

Each = Float[ndarray, " *n"]
"""A value for each state."""

Motions = tuple[Float[ndarray, "*n s 4 4"], Float[ndarray, "*n s 6 k"]]
"""Rigid motion of each segment from rest in states, and its twists by the joints' numbers: turn, then shift."""


@dataclass(frozen=True, eq=False, repr=False)
class Mechanism(StatisticalModel):
    """Model of a mechanism's states; ``mean`` and ``modes`` are those of its middle.

    Attributes:
        linear: statistical model of the same object, whose material points it has.
        chain: all joints.
        free: names of those that have a number, in the order of the scene's draws.
    """

    linear: StatisticalModel = field(kw_only=True)
    chain: RandomMotion = field(kw_only=True)
    free: Names = field(kw_only=True)

    @classmethod
    def of(cls, scene: Scene | None, model: StatisticalModel) -> StatisticalModel:
        """Mechanism of a scene and of its statistical model; that itself where more moves than joints with names."""
        linear = model.registered
        motion = joints_alone(scene)
        if isinstance(model, Mechanism) and model.chain is motion:
            return model
        if motion is None:
            return linear
        free = tuple(name for name in motion.leaders if np.ptp(motion.joints[name][0].shares) > 0)
        mechanism = cls(
            **{name: getattr(linear, name) for name in ("rest", "nodes", "node_labels", "source_frame", "is_held")},
            mean=np.empty_like(linear.mean),
            modes=np.empty((*linear.mean.shape, len(free)), dtype=np.float32),
            library=default_rng(0).standard_normal((STATES, len(free)), dtype=np.float32),
            residue=0.0,
            pairs=PairDistances.none(),
            is_normal=True,
            rests=False,  # at rest it is found as in any other state
            linear=linear,
            chain=motion,
            free=free,
        )
        vars(mechanism).update({name: getattr(linear, name) for name in OF_REST})
        middle = np.zeros(len(free))
        mechanism.mean[:], mechanism.modes[:] = mechanism.material(middle), mechanism.tangent(middle)
        return mechanism

    @property
    def sizes(self) -> WholeNumbers:
        """How many numbers each draw of the scene has."""
        return (1,) * len(self.chain.leaders)

    def draws(self, z: PerMode) -> Float[ndarray, " d"]:
        """Draws of the scene in a state, standard normal: of joints whose values are known too."""
        # the share of a joint without limits goes on beyond its range
        return ndtri([self._share(name, z)[0] % 1.0 for name in self.chain.leaders])

    @cached_property
    def _twists(self) -> tuple[Float[ndarray, "j 6"], Float[ndarray, "j 4 4"]]:
        """Twist of each joint: the derivative of its motion by its value, radians or scene units, where that is 0.

        As a turn and a shift, and as a matrix.
        """
        joints = [(joint.turns, unit(joint.axis), joint.pivot) for joint, _ in self.chain.joints.values()]
        twists = [(*axis, *np.cross(at, axis)) if turns else (0.0, 0.0, 0.0, *axis) for turns, axis, at in joints]
        vectors = np.reshape(twists, (-1, 6))
        matrices = np.zeros((len(joints), 4, 4))
        matrices[:, :3, :3], matrices[:, :3, 3] = np.cross(np.eye(3), vectors[:, None, :3]), vectors[:, 3:]
        return vectors, matrices

    def _share(self, name: str, z: Numbers) -> tuple[Each, Each]:
        """Share, of what a joint has of its range, at which it is, and the derivative by its number."""
        if name not in self.free:
            return np.full(z.shape[:-1], 0.5), np.zeros(z.shape[:-1])
        joint = self.chain.joints[name][0]
        number = np.asarray(z[..., self.free.index(name)], dtype=float)
        turn = abs(joint.limits[1] - joint.limits[0]) * (joint.shares[1] - joint.shares[0])
        if joint.turns and abs(turn - 2 * np.pi) < NEARLY:  # as variable as what is uniform
            return np.asarray(0.5 + number / np.sqrt(12.0)), np.full(number.shape, 1 / np.sqrt(12.0))
        number = np.clip(number, -LARGEST, LARGEST)
        return np.asarray(ndtr(number)), np.asarray(np.exp(-(number**2) / 2) / np.sqrt(2 * np.pi))

    def motions(self, z: Numbers) -> Motions:
        """Motions of all segments in states; a step of a fit asks for those of its state several times."""
        before = z.shape[:-1]  # one state is the same alone and in a row
        T, twists = self._motions(np.asarray(z, dtype=float).tobytes(), prod(before))
        return T.reshape(*before, *T.shape[1:]), twists.reshape(*before, *twists.shape[1:])

    @lru_cache(maxsize=8)  # noqa: B019 (a few states of a few mechanisms)
    def _motions(self, numbers: bytes, states: int) -> Motions:
        z = np.frombuffer(numbers).reshape(states, len(self.free))
        count = len(self.vertex_counts)
        T = np.tile(np.eye(4), (states, count, 1, 1))
        twists = np.zeros((states, count, 6, len(self.free)))
        for vector, twist, (joint, members) in zip(*self._twists, self.chain.joints.values(), strict=True):
            name, rows, (first, last) = joint.follows or joint.name, list(members), joint.limits
            (low, high), (share, slope) = self.chain.joints[name][0].shares, self._share(name, z)
            value = (first + (low + share * (high - low)) * (last - first))[..., None, None]
            # of a turn the twist's cube is minus the twist, of a slide its square is nothing
            sine, rest = (np.sin(value), 1.0 - np.cos(value)) if joint.turns else (value, 0.0 * value)
            step = np.eye(4) + sine * twist + rest * (twist @ twist)
            T[..., rows, :, :] = step[..., None, :, :] @ T[..., rows, :, :]
            turned = _of_twists(step)[..., None, :, :] @ twists[..., rows, :, :]
            if name in self.free:
                turned[..., self.free.index(name)] += (slope * (high - low) * (last - first))[..., None, None] * vector
            twists[..., rows, :, :] = turned
        return T, twists

    def material(self, z: PerMode) -> MaterialPoints:
        """Positions of all material points, unposed."""
        return self.positions(z[None])[0]

    def positions(self, z: Float[ndarray, "n k"], rows: Rows = slice(None)) -> Float[ndarray, "n r 3"]:
        """Positions of some material points in states, unposed."""
        rest = self.rest_points[rows]
        owners = self.labels[rows] - 1
        T = self.motions(z)[0]
        result = np.empty((len(z), *rest.shape))
        for owner in np.unique(owners):
            part = owners == owner
            each = T[:, owner]
            result[:, part] = rest[part] @ each[:, :3, :3].transpose(0, 2, 1) + each[:, None, :3, 3]
        return result

    def tangent(self, z: PerMode, rows: Rows = slice(None)) -> Float32[ndarray, "r 3 k"]:
        """Motion of some material points for one standard deviation of each number, at a state."""
        return moved_by(self.motions(z)[1][self.labels[rows] - 1], self.positions(z[None], rows)[0])

    @cached_property
    def rest_z(self) -> PerMode:
        """Numbers of the joints at rest, none of them quite at its limit."""
        joints = (self.chain.joints[name][0] for name in self.free)
        shares = [(joint.share(0.0) - joint.shares[0]) / np.ptp(joint.shares) for joint in joints]
        return np.clip(ndtri(np.clip(shares, 0.0, 1.0)), -LARGEST_START, LARGEST_START)

    @property
    def registered(self) -> StatisticalModel:
        """The linear model, in which a state is kept."""
        return self.linear

    def around(self, mean: MaterialPoints, modes: Float32[ndarray, "m 3 d"]) -> StatisticalModel:
        """Linear model of the same object."""
        return self.linear.around(mean, modes)

    def project(self, material: MaterialPoints) -> tuple[Transform, PerMode]:
        """Pose and numbers of a state: ``T_state_model`` and z of least squared distance."""
        goal = material[self.sparse]
        library = self.sparse_library - self.sparse_library.mean(axis=1, keepdims=True)
        turned = np.matmul(goal - goal.mean(axis=0), best_rotations(np.matmul(library.transpose(0, 2, 1), goal)))
        nearest = ((library - turned) ** 2).sum(axis=(1, 2)).argmin()

        def aligned(z: PerMode) -> tuple[Transform, MaterialPoints]:
            points = self.positions(z[None], self.sparse)[0]
            T = fit_rigid(points, goal)
            return T, transform_points(T, points)

        z = self.library[nearest].astype(float)
        if self.free:
            z = least_squares(lambda z: (aligned(z)[1] - goal).ravel(), z).x
        return aligned(z)[0], z


def _of_twists(T: Float[ndarray, "*n 4 4"]) -> Float[ndarray, "*n 6 6"]:
    """Matrix that moves twists as a rigid motion moves points."""
    R = T[..., :3, :3]
    moves = np.zeros((*T.shape[:-2], 6, 6))
    moves[..., :3, :3] = moves[..., 3:, 3:] = R
    moves[..., 3:, :3] = (T[..., :3, 3] @ CROSS.reshape(3, 9)).reshape(R.shape) @ R
    return moves


def placed(T: Float[ndarray, "*p 4 4"], rest: Float[ndarray, "*p 3"]) -> Float[ndarray, "*p 3"]:
    """Positions of points at rest, each after a motion of its own."""
    return np.asarray(np.einsum("...ij,...j->...i", T[..., :3, :3], rest) + T[..., :3, 3])


def moved_by(twists: Float[ndarray, "r 6 k"], points: Float[ndarray, "r 3"]) -> Float32[ndarray, "r 3 k"]:
    """Motion of points with each number, by the twists of their segments."""
    return np.asarray(np.cross(twists[:, :3], points[..., None], axis=1) + twists[:, 3:], dtype=np.float32)


def joints_alone(scene: Scene | None) -> RandomMotion | None:
    """Motion of a scene in which joints with names are all that moves; None of another one."""
    motion = None if scene is None else scene.sample_deformations
    if not isinstance(motion, RandomMotion) or not motion.joints or len(motion.joints) < len(motion.steps):
        return None
    return motion
