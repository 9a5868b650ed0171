"""Many poses at once, compared with a frame and drawn towards it by rigid steps, in single array operations.

    poses -aligned-> poses nearer to the frame, with their costs

Each pose takes some observed points into the frame of its state, whose table names the nearest sample of the surface;
some samples are looked up in a table of what the frame rules out. A Gauss-Newton step turns, shifts and scales.

Notation: n poses, p observed points, w samples that are looked up.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.transform import Rotation

from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.residuals import ROBUST, WITNESS_WEIGHT
from mereo.fitting.search.shape_tables import CELLS, ShapeTables
from mereo.fitting.search.sight_table import SightTable, clipped
from mereo.geometry.transforms import rotation_along
from mereo.io.cores import cores
from mereo.scenes.statistical_model import WITNESSES

POINTS = 128
"""Observed points that a pose is compared with."""

LOOKED_UP = 128
"""Samples of the surface that are looked up."""

BLOCK = 150
"""Poses in one array operation: their arrays fit a core's cache, where 3,600 at once take seven times as long each."""

OUTSIDE = WITNESS_WEIGHT * WITNESSES / 3000.0
"""Weight of what the frame rules out beside that of the cloud: as in the fit."""

DAMPING = 1e-3
"""Damping of a step, relative to the diagonal."""

FARTHEST = 0.5
"""Largest turn of one step, rad, and largest change of the scale's logarithm."""

ALONG = 0.2
"""Weight of the distance along the surface in a step: with planes alone, poses far away slide past each other."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Many poses of states, with their costs.

    Attributes:
        state: row of each one's state in the tables.
        rotation, translation, log_scale: of the similarity into the camera frame.
        cost: of each, as last computed.
    """

    state: Int[np.ndarray, " n"]
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
        return cls(*(np.concatenate(part) for part in zip(*(vars(one).values() for one in parts), strict=True)))


@dataclass(frozen=True, eq=False)
class Screen:
    """What poses are compared with.

    Attributes:
        tables: of the states.
        points: some of the observed ones, evenly spread.
        sight: what the frame rules out.
        half: half the object's length.
        scaled: whether the scale is unknown.
        in_part: whether something may hide a part of the object.
    """

    tables: ShapeTables
    points: Float32[np.ndarray, "p 3"]
    sight: SightTable
    half: float
    scaled: bool
    in_part: bool

    @classmethod
    def of(cls, tables: ShapeTables, evidence: Evidence, half: float, scaled: bool = False) -> "Screen":
        """Screen of a frame."""
        points, sight = evidence.partners[:POINTS].astype(np.float32), SightTable.of(evidence)
        return cls(tables, points, sight, half, scaled, evidence.may_be_cut)

    def starts(self, rotations: Float[np.ndarray, "r 3 3"]) -> Poses:
        """Every state at every rotation, its visible side on the cloud; where ``scaled``, as large as the cloud.

        Where something may hide a part of the object, also the four halves of its visible side.
        """
        rotations = rotations.astype(np.float32)
        center = self.points.mean(axis=0)
        ahead = center / np.linalg.norm(center)
        toward = (rotations.transpose(0, 2, 1) @ ahead).T
        visible = np.maximum(-(self.tables.normal @ toward), 0.0)  # q s r
        parts = [visible]
        if self.in_part:
            for axis in rotation_along(ahead)[:, :2].T.astype(np.float32):
                across = self.tables.place @ (rotations.transpose(0, 2, 1) @ axis).T
                middle = (across * visible).sum(axis=1, keepdims=True) / np.maximum(
                    visible.sum(axis=1, keepdims=True), 1e-9
                )
                parts += [np.where(across > middle, visible, 0.0), np.where(across <= middle, visible, 0.0)]
        return Poses.of_all([self._on_cloud(part, rotations, ahead) for part in parts])

    def _on_cloud(
        self,
        weight: Float32[np.ndarray, "q s r"],
        rotations: Float32[np.ndarray, "r 3 3"],
        ahead: Float32[np.ndarray, "3"],
    ) -> Poses:
        """Every state at every rotation, with the centre of its weighted samples on that of the cloud."""
        center = self.points.mean(axis=0)
        weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
        middle = np.matmul(weight.transpose(0, 2, 1), self.tables.place)  # q r 3
        state, turn = np.divmod(np.arange(len(middle) * len(rotations)), len(rotations))
        rotation, middle = rotations[turn], middle[state, turn]
        log_scale = np.zeros(len(state), dtype=np.float32)
        if self.scaled:
            place = np.matmul(self.tables.place[state] - middle[:, None], rotation.transpose(0, 2, 1))
            across = np.eye(3, dtype=np.float32) - ahead[:, None] * ahead
            spread = np.einsum("nsi,nsi,ns->n", place @ across, place, weight.transpose(0, 2, 1)[state, turn])
            seen = ((self.points - center) @ across * (self.points - center)).sum(axis=1).mean()
            log_scale = (0.5 * np.log(seen / np.maximum(spread, 1e-9))).astype(np.float32)
        shift = np.exp(log_scale)[:, None] * np.einsum("nij,nj->ni", rotation, middle)
        none = np.full(len(state), np.inf, dtype=np.float32)
        return Poses(state, rotation, (center - shift).astype(np.float32), log_scale, none)

    def aligned(self, poses: Poses, sigma: float) -> Poses:
        """Poses after a rigid step, with the costs that they had before; ``sigma`` is a share of ``half``."""
        return self._in_blocks(poses, sigma, True)

    def judged(self, poses: Poses, sigma: float) -> Poses:
        """Poses with their costs for a sigma in shares of ``half``."""
        return self._in_blocks(poses, sigma, False)

    def _in_blocks(self, poses: Poses, sigma: float, moves: bool) -> Poses:
        """``_step`` of blocks that fit a core's cache, on all cores."""
        blocks = [poses.rows(np.arange(first, min(first + BLOCK, len(poses)))) for first in range(0, len(poses), BLOCK)]
        with ThreadPoolExecutor(cores()) as pool:
            return Poses.of_all(list(pool.map(lambda block: self._step(block, sigma * self.half, moves), blocks)))

    def _step(self, poses: Poses, sigma: float, moves: bool) -> Poses:
        tables, state = self.tables, poses.state[:, None]
        size, inverse = np.exp(poses.log_scale)[:, None, None], poses.rotation.transpose(0, 2, 1)
        seen = np.matmul(self.points - poses.translation[:, None], poses.rotation) / size
        index = clipped((seen - tables.low[state]) / tables.cell[state][..., None], CELLS)
        sample = tables.nearest[state, (index[..., 0] * CELLS + index[..., 1]) * CELLS + index[..., 2]]
        place, normal = tables.place[state, sample], tables.normal[state, sample]
        offset, narrow = seen - place, sigma / size[..., 0]
        camera = -np.matmul(inverse, poses.translation[..., None]).transpose(0, 2, 1) / size
        facing = np.einsum("npi,npi->np", camera - place, normal) > 0
        squared = np.einsum("npi,npi->np", offset, offset) / narrow**2
        squared = np.where(facing, squared, squared + ROBUST**2)
        few = tables.place[poses.state, :: max(1, tables.place.shape[1] // LOOKED_UP)]
        direction, amount = self.sight.violations(poses.place(few), ROBUST * sigma)
        outside, robust = (amount / sigma) ** 2, (4 * ROBUST) ** 2
        cost = (squared / (1.0 + squared / ROBUST**2)).mean(axis=1)
        cost = cost + OUTSIDE * (outside / (1.0 + outside / robust)).mean(axis=1)
        poses = replace(poses, cost=cost.astype(np.float32))
        if not moves:
            return poses
        weight = np.where(facing, 1.0 / (1.0 + squared / ROBUST**2) ** 2, 0.0) / len(self.points)
        weight_outside = OUTSIDE / few.shape[1] / (1.0 + outside / robust) ** 2
        rows = np.concatenate([np.cross(seen, normal), normal, -np.einsum("npi,npi->np", seen, normal)[..., None]], 2)
        toward = np.matmul(direction, poses.rotation)  # in the model's frame, where a sample moves the other way
        pull = -np.concatenate([np.cross(few, toward), toward, -np.einsum("nwi,nwi->nw", few, toward)[..., None]], 2)
        rows, residual, weight = (
            np.concatenate(parts, axis=1)
            for parts in (
                (rows, pull),
                (np.einsum("npi,npi->np", offset, normal), -amount / size[..., 0]),
                (weight, np.where(amount > 0, weight_outside, 0.0)),
            )
        )
        matrix, gradient = _normal_equations(rows, residual, weight)
        near, pulled = _along(seen, offset, ALONG * weight[:, : len(self.points)])
        return _moved(poses, matrix + near, gradient + pulled, self.scaled)


def _normal_equations(
    rows: Float[np.ndarray, "n r 7"], residual: Float[np.ndarray, "n r"], weight: Float[np.ndarray, "n r"]
) -> tuple[Float[np.ndarray, "n 7 7"], Float[np.ndarray, "n 7"]]:
    weighted = (rows * weight[..., None]).transpose(0, 2, 1)
    return np.matmul(weighted, rows), np.matmul(weighted, residual[..., None])[..., 0]


def _along(
    seen: Float[np.ndarray, "n p 3"], offset: Float[np.ndarray, "n p 3"], weight: Float[np.ndarray, "n p"]
) -> tuple[Float[np.ndarray, "n 7 7"], Float[np.ndarray, "n 7"]]:
    """Normal equations of the points' distances in space, from the nearest samples."""
    rows = np.zeros((*seen.shape, 7), dtype=np.float32)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rows[:, :, i, j], rows[:, :, i, k] = seen[..., k], -seen[..., j]
        rows[:, :, i, 3 + i], rows[:, :, i, 6] = 1.0, -seen[..., i]
    count = len(seen)
    return _normal_equations(rows.reshape(count, -1, 7), offset.reshape(count, -1), np.repeat(weight, 3, axis=1))


def _moved(poses: Poses, matrix: Float[np.ndarray, "n 7 7"], gradient: Float[np.ndarray, "n 7"], scaled: bool) -> Poses:
    """Poses after the step that the normal equations ask for."""
    count = 7 if scaled else 6
    matrix, gradient = matrix[:, :count, :count].astype(np.float64), gradient[:, :count].astype(np.float64)
    diagonal = np.einsum("nkk->nk", matrix)
    matrix = matrix + (DAMPING * diagonal + 1e-9)[:, :, None] * np.eye(count)
    step = -np.linalg.solve(matrix, gradient[..., None])[..., 0]
    angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    step[:, :3] *= np.minimum(1.0, FARTHEST / np.maximum(angle, 1e-9))
    log_scale = poses.log_scale.astype(np.float64)
    if scaled:
        log_scale = log_scale + np.clip(step[:, 6], -FARTHEST, FARTHEST)
    rotation = poses.rotation @ Rotation.from_rotvec(-step[:, :3]).as_matrix()
    shift = np.exp(log_scale)[:, None] * np.einsum("nij,nj->ni", rotation, step[:, 3:6])
    return replace(
        poses,
        rotation=rotation.astype(np.float32),
        translation=(poses.translation - shift).astype(np.float32),
        log_scale=log_scale.astype(np.float32),
    )
