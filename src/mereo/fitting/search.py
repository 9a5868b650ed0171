"""Search for the pose and the state of an object in a frame.

    cloud, lines of sight, statistical model -search-> the state that explains the frame, and how many explain it alike

1. Rotations, evenly over all, of some states of the library, with their visible sides on the cloud; rigid steps draw
   each towards the frame (``Screen``).
2. The best that differ are bent towards the frame by few points, from wide to narrow.
3. The best of these are fitted as a frame always is, as long as they may be better or as good.
4. Unless that explains a clean frame, it is fitted with another side of the object there, as long as that is better.

Poses of a mechanism bend in the first step, and states near the best of them are tried too.

States that are known or guessed, as by a network, are fitted before.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.deformation.maps import crossing
from mereo.fitting.config import FitConfig
from mereo.fitting.modes import (
    BENDING,
    BENT_APART,
    ScoredFit,
    bend_by_few,
    differing,
    fit_cloud,
    fit_from_far,
    refined,
    robust_poses,
    settled_once,
    total_misfit,
    turned,
)
from mereo.fitting.problem.evidence import Evidence, Observed, SurfaceEvidence
from mereo.fitting.problem.gauss_newton import DAMPING, Posed, cross
from mereo.fitting.problem.problem import Problem, is_normal, noise_of
from mereo.fitting.problem.residuals import ROBUST, Prior, SampledMechanism, SampledSurface
from mereo.fitting.problem.segments import diverse_rows, rms_distance
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rotation_along, unit_rows
from mereo.io.cores import cores
from mereo.scenes.mechanism import Mechanism, placed
from mereo.scenes.statistical_model import SILHOUETTE_VERTICES, StatisticalModel

# --- tables of shapes -------------------------------------------------------------------------------------------------

# A table is made once for an object. With it, thousands of poses are compared with a cloud in single array operations.
#
# Notation: n poses, w positions of each, q states, s samples, c cells, r of them along each side of a table.


def clipped(position: Float32[np.ndarray, "n w d"], count: int) -> Int32[np.ndarray, "n w d"]:
    """Index of a cell along each axis, of ``count``: that at the border for what lies beyond, or nowhere."""
    index: np.ndarray = np.fmax(np.fmin(position, np.float32(count - 1)), np.float32(0))
    return index.astype(np.int32)


CELLS = 32
"""Cells along each side of a table."""

APART = 0.15
"""Distance between two poses' samples, as a share of the half length, up to which they are one."""


@dataclass(frozen=True, eq=False)
class ShapeTables:
    """Tables of some states, with their coefficients and samples, model frame.

    Attributes:
        low, cell: corner of each table's box, and the length of a cell.
        nearest: index of the sample nearest to the centre of each cell.
    """

    z: Float32[np.ndarray, "q k"]
    position: Float32[np.ndarray, "q s 3"]
    normal: Float32[np.ndarray, "q s 3"]
    low: Float32[np.ndarray, "q 3"]
    cell: Float32[np.ndarray, " q"]
    nearest: Int32[np.ndarray, "q c"]

    @classmethod
    def of(cls, model: StatisticalModel, z: Float32[np.ndarray, "q k"], surface: SampledSurface) -> "ShapeTables":
        """Tables of states with the coefficients ``z``."""
        frame = np.stack([surface.frames(each) for each in z])
        normal = cross(frame[:, :, 1].reshape(-1, 3), frame[:, :, 2].reshape(-1, 3))
        states = cls.tabulate(z, frame[:, :, 0], unit_rows(normal).reshape(frame[:, :, 0].shape), model.half)
        return MechanismTables.of_joints(states, surface) if isinstance(surface, SampledMechanism) else states

    @classmethod
    def tabulate(
        cls,
        z: Float32[np.ndarray, "q k"],
        position: Float32[np.ndarray, "q s 3"],
        normal: Float32[np.ndarray, "q s 3"],
        half: float,
    ) -> "ShapeTables":
        """Tables of samples, of an object of this half length."""
        position = np.ascontiguousarray(position)
        margin = np.float32(0.5 * half)  # beyond, all points are outliers
        low, high = position.min(axis=1) - margin, position.max(axis=1) + margin
        cell = (high - low).max(axis=1) / CELLS
        low = (low + high - CELLS * cell[:, None]) / 2
        steps = np.stack(np.meshgrid(*(np.arange(CELLS, dtype=np.float32) + 0.5,) * 3, indexing="ij"), axis=-1)
        trees = (cKDTree(samples, balanced_tree=False, compact_nodes=False) for samples in position)
        nearest = [tree.query(low[i] + cell[i] * steps.reshape(-1, 3))[1] for i, tree in enumerate(trees)]
        return cls(z, position, normal, low, cell, np.stack(nearest).astype(np.int32))

    @property
    def joints(self) -> int:
        """How many numbers of joints bend a pose: none."""
        return 0

    def looked_up(
        self, state: Int[np.ndarray, "n 1"], points: Float32[np.ndarray, "n p 3"]
    ) -> Int32[np.ndarray, "n p"]:
        """Index of the sample of a state near each point of its frame."""
        index = clipped((points - self.low[state]) / self.cell[state][..., None], CELLS)
        return self.nearest[state, (index[..., 0] * CELLS + index[..., 1]) * CELLS + index[..., 2]]

    def near(self, pose: "Poses", count: int, rng: np.random.Generator) -> "Poses":
        """Poses of states near one: none but itself, where states stay as they are."""
        return pose

    def met(self, poses: "Poses", seen: Float32[np.ndarray, "n p 3"]) -> "Samples":
        """Samples near points of each pose's model frame, and its ``places``."""
        state = poses.state[:, None]
        places = self.places(poses)
        sample = self.looked_up(state, seen)
        still = np.zeros((len(seen), 1, 6, 0), dtype=np.float32)
        owner, few_owner = (np.zeros(part.shape[:2], dtype=int) for part in (seen, places))
        return Samples(self.position[state, sample], self.normal[state, sample], owner, places, few_owner, still)

    def places(self, poses: "Poses") -> Float32[np.ndarray, "n w 3"]:
        """Positions of samples of each pose's state, evenly spread, as many as points that it is compared with."""
        return self.position[poses.state, :: max(1, self.position.shape[1] // POINTS)]


class Samples(NamedTuple):
    """Samples of states, model frame: near points, and evenly spread ones, with the segments that move them.

    ``twists`` are those of the segments, by the joints' numbers; a shape without joints is one segment.
    """

    position: Float32[np.ndarray, "n p 3"]
    normal: Float32[np.ndarray, "n p 3"]
    owner: Int[np.ndarray, "n p"]
    places: Float32[np.ndarray, "n w 3"]
    places_owner: Int[np.ndarray, "n w"]
    twists: Float32[np.ndarray, "n m 6 k"]


@dataclass(frozen=True, eq=False)
class MechanismTables(ShapeTables):
    """Tables of some states of a mechanism, whose poses bend: of each segment at rest too.

    Attributes:
        mechanism: it.
        segments: tables of the segments at rest, by their indices; not of those that are too small for a sample.
        owner, rest, rest_normal: segment, position and normal of each sample at rest, one segment after the other.
    """

    mechanism: Mechanism
    segments: Mapping[int, ShapeTables]
    owner: Int[np.ndarray, " s"]
    rest: Float32[np.ndarray, "s 3"]
    rest_normal: Float32[np.ndarray, "s 3"]

    @classmethod
    def of_joints(cls, states: ShapeTables, surface: SampledMechanism) -> "MechanismTables":
        """Tables of states, and of the segments of samples."""
        mechanism = surface.mechanism
        none = np.zeros((1, 0), dtype=np.float32)
        order = np.argsort(surface.owner, kind="stable")
        frame, owner = surface.mean[order], surface.owner[order]
        rest = frame[:, 0]
        normal = unit_rows(cross(frame[:, 1], frame[:, 2]))
        parts = {int(each): owner == each for each in np.unique(owner)}
        segments = {
            each: ShapeTables.tabulate(none, rest[None, rows], normal[None, rows], mechanism.half)
            for each, rows in parts.items()
        }
        return cls(**vars(states), mechanism=mechanism, segments=segments, owner=owner, rest=rest, rest_normal=normal)

    @property
    def joints(self) -> int:
        """How many numbers of joints bend a pose."""
        return len(self.mechanism.free)

    def met(self, poses: "Poses", seen: Float32[np.ndarray, "n p 3"]) -> Samples:
        """Samples near points of each pose's model frame, of the segments that come nearest, and its ``places``."""
        T, twists = (part.astype(np.float32) for part in self.mechanism.motions(poses.z))
        alone = np.zeros((len(seen), 1), dtype=int)
        nearest = np.full(seen.shape[:2], np.inf, dtype=np.float32)
        sample = np.zeros(seen.shape[:2], dtype=int)
        first = 0
        for number, table in self.segments.items():
            local = np.matmul(seen - T[:, number, None, :3, 3], T[:, number, :3, :3])
            row = first + table.looked_up(alone, local)
            offset = local - self.rest[row]
            squared = np.einsum("npi,npi->np", offset, offset)
            sample = np.where(squared < nearest, row, sample)
            nearest = np.minimum(nearest, squared)
            first = first + table.position.shape[1]
        few = self._few(len(seen))
        near = self._motions(T, sample)
        places = placed(self._motions(T, few), self.rest[few])
        normal = np.einsum("npij,npj->npi", near[..., :3, :3], self.rest_normal[sample])
        return Samples(placed(near, self.rest[sample]), normal, self.owner[sample], places, self.owner[few], twists)

    def near(self, pose: "Poses", count: int, rng: np.random.Generator) -> "Poses":
        """Poses of states near one: all joints turned a little, or one of them anywhere, with most of it in place."""
        joints = self.joints
        many = pose.rows(np.zeros(count, dtype=int))
        step, anywhere = rng.standard_normal((2, count, joints))
        is_single = np.arange(joints) == rng.integers(joints, size=(count, 1))
        single = np.where(is_single, anywhere, pose.z)
        little = pose.z + NEAR * step
        z = np.where(np.arange(count)[:, None] % 2, single, little).astype(np.float32)
        bent = replace(many, z=z)
        target = self.places(pose)[0]
        states = self.places(bent)
        _, rotation, translation = robust_poses(states, target, AGREES * self.mechanism.half)
        return replace(
            bent,
            rotation=(many.rotation @ rotation).astype(np.float32),
            translation=many.place(translation[:, None].astype(np.float32))[:, 0],
        )

    def places(self, poses: "Poses") -> Float32[np.ndarray, "n w 3"]:
        """Positions of samples of each pose's state, evenly spread, as many as points that it is compared with."""
        few = self._few(len(poses))
        T = self.mechanism.motions(poses.z)[0].astype(np.float32)
        return placed(self._motions(T, few), self.rest[few])

    def _few(self, count: int) -> Int[np.ndarray, "n w"]:
        """Samples, evenly spread, for each of so many poses."""
        rows = np.arange(len(self.rest))[:: max(1, len(self.rest) // POINTS)]
        return np.broadcast_to(rows, (count, len(rows)))

    def _motions(
        self, T: Float32[np.ndarray, "n m 4 4"], sample: Int[np.ndarray, "n p"]
    ) -> Float32[np.ndarray, "n p 4 4"]:
        """Motions of samples, of those of the segments in states."""
        return T[np.arange(len(sample))[:, None], self.owner[sample]]


def medoids(model: StatisticalModel, count: int) -> Int[np.ndarray, " q"]:
    """Rows of the library's states that stand for all of them: those nearest to the centres of so many clusters."""
    if count >= len(model.library) or model.count == 0:  # the states of a rigid object are all the same
        return np.arange(len(model.library) if model.count else 1)
    shape = (model.library * model.motion).astype(np.float64)
    center, owner = kmeans2(shape, count, minit="++", rng=0)
    sizes = np.bincount(owner, minlength=count)
    order = np.argsort(-sizes, kind="stable")[: np.count_nonzero(sizes)]
    distance = ((shape[None] - center[order, None]) ** 2).sum(axis=2)
    return np.unique(distance.argmin(axis=1))


@lru_cache(maxsize=4)
def tables_of(model: StatisticalModel, count: int) -> ShapeTables:
    """Tables of the mean state (``count`` 0), or of ``count`` medoids of the library; those of few models are kept."""
    surface = SampledSurface.of(model, 512)  # far nearer to each other than the first sigma
    z = np.zeros((1, model.count), dtype=np.float32) if count == 0 else model.library[medoids(model, count)]
    return ShapeTables.of(model, z, surface)


# --- screening --------------------------------------------------------------------------------------------------------

POINTS = 128
"""Observed points that a pose is compared with, and samples of the surface that are looked up."""

BLOCK = 150
"""Poses in one array operation: their arrays fit a core's cache, where 3,600 at once take seven times as long each."""

OUTSIDE = FitConfig.silhouette_weight * SILHOUETTE_VERTICES / FitConfig.cloud_weight
"""Weight of what the frame rules out relative to that of the cloud: as in the fit."""

NEAR = 0.4
"""Deviation of the states of a mechanism that are tried near another one, in the numbers of all joints."""

AGREES = 0.03
"""Distance, in half lengths, of samples of such a state from those of the other up to which they agree."""

FARTHEST = 0.5
"""Largest turn of one step, rad, and largest change of the scale's logarithm and of a joint's number."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Many poses of states, with their costs as last computed.

    Attributes:
        state: rows of the tables, in which a pose began.
        z: coefficients, of the state or, of a mechanism, as they are now.
    """

    state: Int[np.ndarray, " n"]
    z: Float32[np.ndarray, "n k"]
    rotation: Float32[np.ndarray, "n 3 3"]
    translation: Float32[np.ndarray, "n 3"]
    log_scale: Float32[np.ndarray, " n"]
    cost: Float32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.state)

    def rows(self, chosen: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Poses":
        """Some of them."""
        return Poses(*(part[chosen] for part in vars(self).values()))

    def place(self, unposed: Float32[np.ndarray, "n w 3"]) -> Float32[np.ndarray, "n w 3"]:
        """Points of each state's frame in the camera frame."""
        size = np.exp(self.log_scale)[:, None, None]
        return size * np.matmul(unposed, self.rotation.transpose(0, 2, 1)) + self.translation[:, None]

    @classmethod
    def of_all(cls, parts: "list[Poses]") -> "Poses":
        """All of several."""
        return cls(*(np.concatenate(part) for part in zip(*(vars(part).values() for part in parts), strict=True)))


# --- what samples may be observed -------------------------------------------------------------------------------------

# Notation: n poses, w positions of each, p points, q states, s samples, r rotations, c cells.


@dataclass(frozen=True, eq=False)
class SightTable:
    """What a frame rules out, as a table of lines of sight; the rules are those of ``Evidence.violations``.

    Attributes:
        T: rotation into the axes of the table, whose third is the direction of the cloud.
        low, cell: corner of the table and length of a cell, as slopes across the direction.
        toward, front, free: ``Evidence.along`` the cells.
        pitch: angle between neighbouring lines of sight.
    """

    T: Float32[np.ndarray, "3 3"]
    low: Float32[np.ndarray, "2"]
    cell: float
    toward: Float32[np.ndarray, "c 3"]
    front: Float32[np.ndarray, " c"]
    free: Float32[np.ndarray, " c"]
    pitch: float

    @classmethod
    def of(cls, evidence: Evidence) -> "SightTable":
        """Table around the cloud, three times as wide; beyond, the nearest cell of the border stands for a position."""
        direction = evidence.sight.data[: len(evidence.points)]
        T = rotation_along(direction.mean(axis=0) / np.linalg.norm(direction.mean(axis=0))).T
        turned = evidence.points @ T.T
        slope = turned[:, :2] / np.maximum(turned[:, 2:], 0.1 * np.linalg.norm(turned, axis=1, keepdims=True))
        low = slope.min(axis=0)
        high = slope.max(axis=0)
        side = 3.0 * float((high - low).max()) + 4 * evidence.pitch
        corner = (low + high - side) / 2
        cells = min(96, max(16, int(side / evidence.pitch)))
        across = corner + (np.stack(np.meshgrid(*(np.arange(cells) + 0.5,) * 2, indexing="ij"), -1)) * side / cells
        sight = np.concatenate([across.reshape(-1, 2), np.ones((cells * cells, 1))], axis=1) @ T
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        toward, front, free = (part.astype(np.float32) for part in evidence.along(sight))
        return cls(T.astype(np.float32), corner.astype(np.float32), side / cells, toward, front, free, evidence.pitch)

    def violations(
        self, position: Float32[np.ndarray, "n w 3"], slack: float
    ) -> tuple[Float32[np.ndarray, "n w 3"], Float32[np.ndarray, "n w"]]:
        """``Evidence.violations`` of many positions, up to a cell."""
        cells = round(np.sqrt(len(self.front)))
        turned = position @ self.T.T
        slope = turned[..., :2] / np.maximum(turned[..., 2:], 1e-6)
        index = clipped((slope - self.low) / self.cell, cells)
        row = index[..., 0] * cells + index[..., 1]
        distance = np.sqrt(np.einsum("nwi,nwi->nw", position, position))
        toward, free = self.toward[row], self.free[row]
        is_past = free > distance - slack
        sideways = toward * distance[..., None] - position
        length = np.sqrt(np.einsum("nwi,nwi->nw", sideways, sideways))
        direction = np.where(is_past[..., None], sideways / np.maximum(length, 1e-9)[..., None], toward)
        ahead = np.where(free < 0, self.front[row] - slack - distance, 0.0)
        amount = np.where(is_past, length - self.pitch * distance, ahead)
        return direction, np.maximum(amount, 0.0).astype(np.float32)

    def shown(
        self,
        normals: Float32[np.ndarray, "q s 3"],
        rotations: Float32[np.ndarray, "r 3 3"],
        center: Float32[np.ndarray, "3"],
    ) -> Float32[np.ndarray, "q s r"]:
        """How much of each sample the camera sees at each rotation; ``center`` is that of the cloud."""
        toward = (rotations.transpose(0, 2, 1) @ (center / np.linalg.norm(center))).T
        return np.maximum(-(normals @ toward), 0.0)

    def axes(self, center: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "a 3"]:
        """Directions in which a part may be hidden: across the line of sight."""
        return rotation_along(center / np.linalg.norm(center))[:, :2].T.astype(np.float32)

    def across(self, center: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "3 3"]:
        """Projection of positions onto what shows their size: across the line of sight."""
        ahead = center / np.linalg.norm(center)
        return np.eye(3, dtype=np.float32) - ahead[:, None] * ahead

    def facing(
        self, poses: Poses, position: Float32[np.ndarray, "n p 3"], normal: Float32[np.ndarray, "n p 3"]
    ) -> Bool[np.ndarray, "n p"]:
        """Whether samples can be what was observed: those that face the camera."""
        size = np.exp(poses.log_scale)[:, None, None]
        inverse = poses.rotation.transpose(0, 2, 1)
        camera = -np.matmul(inverse, poses.translation[..., None]).transpose(0, 2, 1) / size
        return np.einsum("npi,npi->np", camera - position, normal) > 0


@dataclass(frozen=True, eq=False)
class Normals:
    """In its place of a surface without a camera: nothing is ruled out, and samples are chosen by the points' normals.

    Attributes:
        normals: of the points that poses are compared with.
        lift: of ``SurfaceEvidence``.
    """

    normals: Float32[np.ndarray, "p 3"]
    lift: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def of(cls, evidence: SurfaceEvidence) -> "Normals":
        """Normals of a surface."""
        return cls(evidence.sample_normals[:POINTS].astype(np.float32), evidence.lift)

    def violations(
        self, position: Float32[np.ndarray, "n w 3"], slack: float
    ) -> tuple[Float32[np.ndarray, "n w 3"], Float32[np.ndarray, "n w"]]:
        """Nothing is ruled out."""
        return np.zeros_like(position), np.zeros_like(position[..., 0])

    def shown(
        self,
        normals: Float32[np.ndarray, "q s 3"],
        rotations: Float32[np.ndarray, "r 3 3"],
        center: Float32[np.ndarray, "3"],
    ) -> Float32[np.ndarray, "q s r"]:
        """How many of the points have normals like each sample's at each rotation."""
        points = np.matmul(self.normals, rotations)  # r p 3, in the model's frame
        samples, lifted = self.lift(normals), self.lift(points)
        shares = [np.maximum(each @ lifted.transpose(0, 2, 1), 0.0).mean(axis=2).T for each in samples]
        return np.stack(shares)

    def axes(self, center: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "a 3"]:
        """Directions in which a part may be hidden: all."""
        return np.eye(3, dtype=np.float32)

    def across(self, center: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "3 3"]:
        """Projection of positions onto what shows their size: as they are."""
        return np.eye(3, dtype=np.float32)

    def facing(
        self, poses: Poses, position: Float32[np.ndarray, "n p 3"], normal: Float32[np.ndarray, "n p 3"]
    ) -> Bool[np.ndarray, "n p"]:
        """Whether samples can be what was observed: those whose normals agree with the points'."""
        points = np.matmul(self.normals, poses.rotation)
        return np.einsum("npi,npi->np", self.lift(points), self.lift(normal)) > 0


SIGHTS: Mapping[type, Callable[[Any], SightTable | Normals]] = {Evidence: SightTable.of, SurfaceEvidence: Normals.of}
"""What samples may be observed, by each kind of evidence."""


@dataclass(frozen=True, eq=False)
class Screen:
    """What poses are compared with: some points that a camera saw, evenly spread, and what the frame rules out.

    Attributes:
        half: half the object's length.
        scaled: whether the scale is unknown.
        in_part: whether something may hide a part of the object, or nothing is known around it.
    """

    tables: ShapeTables
    points: Float32[np.ndarray, "p 3"]
    sight: SightTable | Normals
    half: float
    scaled: bool
    in_part: bool

    @classmethod
    def of(cls, tables: ShapeTables, evidence: Observed, half: float, scaled: bool = False) -> "Screen":
        """Screen of a frame."""
        points = evidence.observed_samples[:POINTS].astype(np.float32)
        sight = SIGHTS[type(evidence)](evidence)
        return cls(tables, points, sight, half, scaled, evidence.is_open)

    def starts(self, rotations: Float[np.ndarray, "r 3 3"]) -> Poses:
        """Every state at every rotation, its visible side on the cloud; where ``scaled``, as large as the cloud.

        Where something may hide a part of the object, also one of the halves of its visible side, at each rotation the
        next one.
        """
        rotations = rotations.astype(np.float32)
        center = self.points.mean(axis=0)
        visible = self.sight.shown(self.tables.normal, rotations, center)
        parts = [visible]
        if self.in_part:
            total = np.maximum(visible.sum(axis=1, keepdims=True), 1e-9)
            halves = []
            for axis in self.sight.axes(center):
                across = self.tables.position @ (rotations.transpose(0, 2, 1) @ axis).T
                middle = (across * visible).sum(axis=1, keepdims=True) / total
                halves += [np.where(across > middle, visible, 0.0), np.where(across <= middle, visible, 0.0)]
            turn = np.arange(len(rotations))
            parts += [np.stack(halves)[turn % len(halves), :, :, turn].transpose(1, 2, 0)]
        return Poses.of_all([self._on_cloud(part, rotations) for part in parts])

    def _on_cloud(
        self,
        weight: Float32[np.ndarray, "q s r"],
        rotations: Float32[np.ndarray, "r 3 3"],
    ) -> Poses:
        """Every state at every rotation, with the centre of its weighted samples on that of the cloud."""
        center = self.points.mean(axis=0)
        weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
        middle = np.matmul(weight.transpose(0, 2, 1), self.tables.position)  # q r 3
        state, turn = np.divmod(np.arange(len(middle) * len(rotations)), len(rotations))
        rotation = rotations[turn]
        middle = middle[state, turn]
        log_scale = np.zeros(len(state), dtype=np.float32)
        if self.scaled:
            position = np.matmul(self.tables.position[state] - middle[:, None], rotation.transpose(0, 2, 1))
            across = self.sight.across(center)
            spread = np.einsum("nsi,nsi,ns->n", position @ across, position, weight.transpose(0, 2, 1)[state, turn])
            seen = ((self.points - center) @ across * (self.points - center)).sum(axis=1).mean()
            log_scale = (0.5 * np.log(seen / np.maximum(spread, 1e-9))).astype(np.float32)
        shift = np.exp(log_scale)[:, None] * np.einsum("nij,nj->ni", rotation, middle)
        none = np.full(len(state), np.inf, dtype=np.float32)
        return Poses(state, self.tables.z[state], rotation, (center - shift).astype(np.float32), log_scale, none)

    def best(self, poses: Poses, count: int) -> Poses:
        """Poses that the frame has drawn to it, by rigid steps and those of joints: the best that differ."""
        for sigma in SIGMAS:
            poses = self.scored(poses, sigma, moves=True)
            kept = max(round(GO_ON * len(poses)), 2 * count)
            poses = poses.rows(np.argsort(poses.cost)[:kept])
        return self.differing(self.scored(poses, SIGMAS[-1]), count)

    def differing(self, poses: Poses, count: int) -> Poses:
        """The best poses that differ, so many of them."""
        poses = poses.rows(np.argsort(poses.cost))
        places = poses.place(self.tables.places(poses)[:, ::4])
        return poses.rows(np.array(diverse_rows(places, APART * self.half, rms_distance)[:count]))

    def scored(self, poses: Poses, sigma: float, moves: bool = False) -> Poses:
        """Poses with their costs for a sigma in shares of ``half``, after a rigid step from there if it ``moves`` them.

        In blocks that fit a core's cache, on all cores.
        """
        blocks = [poses.rows(np.arange(first, min(first + BLOCK, len(poses)))) for first in range(0, len(poses), BLOCK)]
        with ThreadPoolExecutor(cores()) as pool:
            return Poses.of_all(list(pool.map(lambda block: self._step(block, sigma * self.half, moves), blocks)))

    def _step(self, poses: Poses, sigma: float, moves: bool) -> Poses:
        size = np.exp(poses.log_scale)[:, None, None]
        seen = np.matmul(self.points - poses.translation[:, None], poses.rotation) / size
        position, normal, owner, few, few_owner, twists = self.tables.met(poses, seen)
        offset = seen - position
        narrow = sigma / size[..., 0]
        facing = self.sight.facing(poses, position, normal)
        squared = np.einsum("npi,npi->np", offset, offset) / narrow**2
        squared = np.where(facing, squared, squared + ROBUST**2)
        direction, amount = self.sight.violations(poses.place(few), ROBUST * sigma)
        outside = (amount / sigma) ** 2
        robust = (4 * ROBUST) ** 2
        cost = (squared / (1.0 + squared / ROBUST**2)).mean(axis=1)
        cost = cost + OUTSIDE * (outside / (1.0 + outside / robust)).mean(axis=1)
        bent = poses.z[:, : twists.shape[3]]
        bends = np.arange(7, 7 + twists.shape[3])
        cost = cost + (bent**2).sum(axis=1) / FitConfig.cloud_weight
        poses = replace(poses, cost=cost.astype(np.float32))
        if not moves:
            return poses
        weight = np.where(facing, 1.0 / (1.0 + squared / ROBUST**2) ** 2, 0.0) / len(self.points)
        weight_outside = OUTSIDE / few.shape[1] / (1.0 + outside / robust) ** 2
        toward = np.matmul(direction, poses.rotation)  # in the model's frame, where a sample moves the other way
        across = np.einsum("npi,npi->np", offset, normal)
        beyond = amount / size[..., 0]
        weight_outside = np.where(amount > 0, weight_outside, 0.0)
        columns = np.concatenate([_across(seen, normal, across), -_across(few, toward, beyond)], axis=2)
        weights, owners = (np.concatenate(pair, axis=1) for pair in ((weight, weight_outside), (owner, few_owner)))
        matrix, gradient = _normal_equations(columns, weights, owners, twists)
        matrix[:, bends, bends] += narrow**2 / FitConfig.cloud_weight
        gradient[:, bends] += narrow**2 / FitConfig.cloud_weight * bent
        # with planes alone, poses far away would slide past each other
        apart = _along(seen, offset), np.tile(0.2 * weight, 3), np.tile(owner, 3)
        near, pulled = _normal_equations(*apart, twists)
        return _moved(poses, matrix + near, gradient + pulled, self.scaled)


# Residuals as columns: seven derivatives by pose and scale, and what is left, of each of r comparisons in a row.


def _across(
    points: Float[np.ndarray, "n r 3"], across: Float[np.ndarray, "n r 3"], residual: Float[np.ndarray, "n r"]
) -> Float32[np.ndarray, "n 8 r"]:
    """Columns of points' distances along directions."""
    (x, y, z), (a, b, c) = np.moveaxis(points, 2, 0), np.moveaxis(across, 2, 0)
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c, -(x * a + y * b + z * c), residual], axis=1)


def _along(seen: Float[np.ndarray, "n p 3"], offset: Float[np.ndarray, "n p 3"]) -> Float32[np.ndarray, "n 8 r"]:
    """Columns of points' distances in space from the nearest samples, along one axis after the other."""
    columns = np.zeros((len(seen), 8, 3, seen.shape[1]), dtype=np.float32)
    columns[:, :3] = crossing(seen).transpose(0, 3, 2, 1)
    columns[:, range(3, 6), range(3)] = 1.0
    columns[:, 6] = -seen.transpose(0, 2, 1)
    columns[:, 7] = offset.transpose(0, 2, 1)
    return columns.reshape(len(seen), 8, -1)


def _normal_equations(
    columns: Float32[np.ndarray, "n 8 r"],
    weight: Float[np.ndarray, "n r"],
    owner: Int[np.ndarray, "n r"],
    twists: Float32[np.ndarray, "n m 6 k"],
) -> tuple[Float[np.ndarray, "n q q"], Float[np.ndarray, "n q"]]:
    """Normal equations of pose, scale and joints' numbers: a segment that moves is the pose moved back for its points.

    ``owner`` has the segment of each comparison.
    """
    moved = (np.matmul(-twist, columns[:, :6]) for twist in np.moveaxis(twists, 3, 0))  # by each number, each segment
    of_numbers = (np.take_along_axis(each, owner[:, None], axis=1) for each in moved)
    columns = np.concatenate([columns[:, :7], *of_numbers, columns[:, 7:]], axis=1)
    products = np.matmul(columns * weight[:, None], columns.transpose(0, 2, 1))
    return products[:, :-1, :-1], products[:, :-1, -1]


def _moved(poses: Poses, matrix: Float[np.ndarray, "n q q"], gradient: Float[np.ndarray, "n q"], scaled: bool) -> Poses:
    """Poses after the step of the normal equations."""
    matrix = matrix.astype(np.float64)
    gradient = gradient.astype(np.float64)
    free = np.delete(np.arange(gradient.shape[1]), [] if scaled else 6)  # without the scale
    matrix = matrix[:, free][:, :, free]
    step = np.zeros_like(gradient)
    diagonal = np.einsum("nkk->nk", matrix)
    matrix = matrix + (DAMPING * diagonal + 1e-9)[:, :, None] * np.eye(len(free))
    step[:, free] = -np.linalg.solve(matrix, gradient[:, free, None])[..., 0]
    angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    step[:, :3] *= np.minimum(1.0, FARTHEST / np.maximum(angle, 1e-9))
    log_scale = poses.log_scale.astype(np.float64) + np.clip(step[:, 6], -FARTHEST, FARTHEST)
    rotation = poses.rotation @ Rotation.from_rotvec(-step[:, :3]).as_matrix()
    bent = poses.z.copy()
    bent[:, : step.shape[1] - 7] += np.clip(step[:, 7:], -FARTHEST, FARTHEST)
    shift = np.exp(log_scale)[:, None] * np.einsum("nij,nj->ni", rotation, step[:, 3:6])
    return replace(
        poses,
        rotation=rotation.astype(np.float32),
        z=bent,
        translation=(poses.translation - shift).astype(np.float32),
        log_scale=log_scale.astype(np.float32),
    )


# --- the search -------------------------------------------------------------------------------------------------------


class Screening(NamedTuple):
    """How many poses are screened: medoids of the library and rotations of each; and how many are bent.

    Where there are fewer medoids, as of a rigid object, each has more rotations. ``near`` is how often states of a
    mechanism near the best are tried.
    """

    states: int
    rotations: int
    bent: int
    near: int = 0


SCREENING = Screening(12, 100, 12, 6)
"""That of a search (docs/experiments.md, entries 96 and 104)."""

FITTED = 4
"""Candidates that are fitted at most."""

SIGMAS = np.geomspace(0.15, 0.05, 9)
"""The cloud's standard deviation in each rigid step, in half lengths."""

GO_ON = 0.65
"""Share of the poses that go on after each of these."""

RIVAL = 1.5
"""Misfit by few points, in misfits of the best, up to which a candidate may still be as good."""

ALIKE = 1.1
"""Misfit, in misfits of the best state, up to which another one may be the true one: how large errors are, and how many
of them are independent, is known from what the best leaves over alone (docs/experiments/098.md)."""

SAME, MOST_PLACES = 0.04, 0.95
"""Distance in half lengths up to which two states look the same, and the share of the places that is so near."""

TURNED = 3
"""Turned states that are fitted at most."""

HEAVIER_STEPS = (0.04, 12)
HELPS = 0.65
"""First sigma and steps of the fit of an elastic solid whose cloud weighs as others', and the share of the misfit that
may be left: bends of a bunny's ears leave .45 to .54, states of livers .77 up."""

WHOLE = 150.0
"""Misfit by which an object that is seen whole may be explained worse than one that something hides in part: it is on
36 of 40 whole training views, and on none of 40 of which 30 % are hidden."""


def rotations(count: int) -> Float[np.ndarray, "n 3 3"]:
    """Return rotations, evenly over all (super-Fibonacci spirals; Alexa, CVPR 2022)."""
    step = np.arange(count) + 0.5
    inner, outer = np.sqrt(step / count), np.sqrt(1 - step / count)
    first, second = 2 * np.pi * step / np.sqrt(2), 2 * np.pi * step / 1.533751168755204288118041
    spiral = (inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second))
    return Rotation.from_quat(np.stack(spiral, axis=1)).as_matrix()


@dataclass(eq=False)
class Trail:
    """Search under one hypothesis on the lines of sight around the cloud, by the constants of one noise.

    Attributes:
        handicap: misfit by which another hypothesis is likelier before the frame was seen.
    """

    problem: Problem
    handicap: float = 0.0
    fitted: list[ScoredFit] = field(default_factory=list)

    @property
    def best(self) -> ScoredFit:
        """The state of the least misfit."""
        return min(self.fitted, key=total_misfit)

    @property
    def is_explained(self) -> bool:
        """Whether that explains the frame, noise that neighbours share aside."""
        problem, best = self.problem, self.best
        return problem.explained(best.surface) or (
            problem.shares_noise and (settled := settled_once(problem, best.posed)).problem.explained(settled.surface)
        )

    @property
    def is_evident(self) -> bool:
        """Whether that explains a clean frame, and no other hypothesis may win as much as the frame rules out of it."""
        problem, surface = self.problem, self.best.surface
        return problem.explained(surface) and problem.silhouette_misfit(surface) + self.handicap < WHOLE

    @property
    def is_noisy(self) -> bool:
        """Whether that leaves a camera's noise over, where neighbours differ as by one."""
        problem = self.problem
        return problem.is_noisy and problem.with_noise(problem.left_noise(self.best.surface)).is_noisy

    def fit(self, poses: list[Posed]) -> None:
        """Fit the candidates that may be the best."""
        ranked = bend_by_few(self.problem, poses, FITTED)
        fitted = list[ScoredFit]()
        for cost, posed in ranked[:FITTED]:
            if cost > RIVAL * ranked[0][0] and self.problem.explained(min(fitted, key=total_misfit).surface):
                break
            fitted.append(fit_from_far(self.problem, posed))
        self.fitted += fitted

    def turn(self) -> None:
        """Fit again with another side of the object where the best state lies, as long as that is better.

        Not where few points show that it is worse: they would have to be bent to it more than they have been.
        """
        problem = self.problem
        before = None
        while self.best is not before:
            before = self.best
            most = problem.coarse.screen(before.posed, BENDING[-1][2] * problem.model.half).total
            ranked = bend_by_few(problem, turned(problem, before.posed), TURNED)[:TURNED]
            self.fitted += [fit_from_far(problem, each) for cost, each in ranked if cost < most]

    def with_heavier_cloud(self) -> "Trail | None":
        """The same with a cloud that is worth more, where the prior of an elastic solid keeps it from being explained.

        Where that hardly helps, the object moves in ways that the modes do not have, and the prior is right.
        """
        problem, best = self.problem, self.best
        if not problem.model.is_normal or self.is_explained:
            return None
        problem = problem.changed(config=replace(problem.config, cloud_weight=FitConfig.cloud_weight))
        heavier = ScoredFit.of(problem, fit_cloud(problem, best.posed, Prior.whole(problem.model), *HEAVIER_STEPS, 0.0))
        return Trail(problem, 0.0, [heavier]) if heavier.misfit.cloud < HELPS * best.misfit.cloud else None

    def in_problem(self, problem: Problem) -> "Trail":
        """The same from its best states that differ, in another problem of the frame, as many as are fitted at most."""
        states = [scored.posed for scored in sorted(self.fitted, key=total_misfit)]
        rows = differing(problem, states, BENT_APART)[:FITTED]
        fits = [fit_from_far(problem, states[row]) for row in rows]
        return Trail(problem, self.handicap, fits)

    def with_shared_noise(self) -> "Trail":
        """The same with all noise that the best fit leaves over, where nothing else explains the frame."""
        problem = self.problem.with_noise(noise_of(self.problem.offsets(self.best.surface)))
        if not problem.is_noisy or problem.noise <= self.problem.noise or self.is_explained:
            return self
        trail = self.in_problem(problem.by_every_point)
        if not trail.leaves_noise:
            return self
        trail.turn()
        return trail if trail.leaves_noise else self

    @property
    def leaves_noise(self) -> bool:
        """Whether what the best fit leaves over is spread as noise is."""
        return is_normal(self.problem.offsets(self.best.surface))

    @property
    def others(self) -> tuple[Float[np.ndarray, "m 3"], ...]:
        """Positions of the material points in other states that explain the frame alike, and do not look the same.

        That a whole, or a segment, looks the same turned is said by its symmetry.
        """
        model, best = self.problem.model, self.best
        rivals = sorted(
            (fit for fit in self.fitted if total_misfit(fit) <= ALIKE * total_misfit(best)), key=total_misfit
        )
        rows = differing(self.problem, [fit.posed for fit in rivals], APART)[1:]
        others = [rivals[row].surface.material for row in rows]
        vertices = model.silhouette_vertices
        solids = Solids(model.mesh(best.surface.material))
        apart = (np.quantile(solids.nearest(each[vertices]).distance, MOST_PLACES) for each in others)
        return tuple(each for each, far in zip(others, apart, strict=True) if far > SAME * model.half)


def search(
    whole: Problem, partial: Problem | None = None, starts: Sequence[Posed] = (), everywhere: bool = True
) -> Trail:
    """Search for the state that explains a frame, first from ``starts``, then, unless these suffice, ``everywhere``.

    What explains a clean frame is searched for no further; under noise several states do, of which a start is one.

    ``partial`` is the same where it is open whether the object is seen whole: with nothing known around the cloud. It
    is taken where it explains the frame better by more than ``WHOLE``, and not searched where it cannot.
    """
    trails = [Trail(whole)] if partial is None else [Trail(whole), Trail(partial, WHOLE)]
    if starts:
        for trail in trails:
            trail.fitted += [fit_from_far(trail.problem, start) for start in starts]
        chosen = likelier(with_left_noise(trails))
        if not everywhere or (chosen.is_explained and not chosen.problem.shares_noise):
            return chosen.with_heavier_cloud() or chosen.with_shared_noise()
    for trail in trails:
        trail.fit(screen_poses(trail.problem, SCREENING))
        if not trail.is_noisy and (evident := with_left_noise([trail])[0]).is_evident:
            return evident
    for trail, other in permutations(trails, 2):  # either may have found what the other has missed
        trail.fitted.append(refined(trail.problem, other.best.posed))
    chosen = likelier(with_left_noise(trails))
    chosen.turn()
    return chosen.with_heavier_cloud() or chosen.with_shared_noise()


def likelier(trails: list[Trail]) -> Trail:
    """The trail under the likelier hypothesis."""
    return min(trails, key=lambda trail: trail.best.misfit.total + trail.handicap)


def with_left_noise(trails: list[Trail]) -> list[Trail]:
    """Trails by every point of a noisy frame, with no more noise than the likelier one leaves over."""
    chosen = likelier(trails)
    if not chosen.problem.is_noisy:
        return trails
    noise = chosen.problem.left_noise(chosen.best.surface)
    return [trail.in_problem(trail.problem.quieted(noise)) for trail in trails]


def screen_poses(problem: Problem, screening: Screening) -> list[Posed]:
    """Choose diverse poses from which bending goes on."""
    states, turns, bent, near = screening
    tables = tables_of(problem.model, states)
    screen = Screen.of(tables, problem.evidence, problem.model.half, problem.is_scale_open)
    poses = screen.best(screen.starts(rotations(turns * states // len(tables.z))), bent)
    rng = np.random.default_rng(0)
    for _ in range(near * min(tables.joints, 1)):
        others = Poses.of_all([tables.near(poses.rows(np.array([row])), bent, rng) for row in range(len(poses))])
        poses = screen.differing(Poses.of_all([poses, screen.best(others, bent)]), bent)
    rotation = Rotation.from_matrix(poses.rotation).as_matrix()
    translation = poses.translation.astype(np.float64)
    return list(map(Posed, rotation, translation, poses.z.astype(np.float64), poses.log_scale.tolist()))
