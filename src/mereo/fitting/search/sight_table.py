"""What a frame rules out as a table, in which many places are looked up at once.

Notation: n poses, w places of each, c cells.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from mereo.fitting.problem.evidence import Evidence
from mereo.geometry.transforms import rotation_along

SIDE = 96
"""Cells along each side of the table of what a frame rules out; about as many as a depth image has pixels there."""


def clipped(place: Float32[np.ndarray, "n w d"], count: int) -> Int32[np.ndarray, "n w d"]:
    """Index of a cell along each axis, of ``count``: that at the border for what lies beyond, or nowhere."""
    index: Int32[np.ndarray, "n w d"] = np.fmax(np.fmin(place, np.float32(count - 1)), np.float32(0)).astype(np.int32)
    return index


@dataclass(frozen=True, eq=False)
class SightTable:
    """What a frame rules out, as a table of lines of sight; the rules are those of ``Evidence.violations``.

    Attributes:
        T: rotation into the axes of the table, whose third is the direction of the cloud.
        low, cell: corner of the table and length of a cell, as slopes across the direction.
        toward: unit vector of the nearest line of sight to each cell that met the object, or of which nothing is known.
        front: distance before which it is free.
        free: distance up to which a cell beside these is free; negative where it is not beside.
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
        """Table around the cloud, three times as wide; beyond, the nearest cell of the border stands for a place."""
        direction = evidence.sight.data[: len(evidence.points)]
        T = rotation_along(direction.mean(axis=0) / np.linalg.norm(direction.mean(axis=0))).T
        turned = evidence.points @ T.T
        slope = turned[:, :2] / np.maximum(turned[:, 2:], 0.1 * np.linalg.norm(turned, axis=1, keepdims=True))
        low, high = slope.min(axis=0), slope.max(axis=0)
        side = 3.0 * float((high - low).max()) + 4 * evidence.pitch
        corner = (low + high - side) / 2
        cells = min(SIDE, max(16, int(side / evidence.pitch)))
        across = corner + (np.stack(np.meshgrid(*(np.arange(cells) + 0.5,) * 2, indexing="ij"), -1)) * side / cells
        sight = np.concatenate([across.reshape(-1, 2), np.ones((cells * cells, 1))], axis=1) @ T
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        toward, front, free = evidence.along(sight)
        return cls(
            T.astype(np.float32),
            corner.astype(np.float32),
            side / cells,
            toward.astype(np.float32),
            front.astype(np.float32),
            free.astype(np.float32),
            evidence.pitch,
        )

    def violations(
        self, place: Float32[np.ndarray, "n w 3"], slack: float
    ) -> tuple[Float32[np.ndarray, "n w 3"], Float32[np.ndarray, "n w"]]:
        """``Evidence.violations`` of many places, up to a cell."""
        cells = round(np.sqrt(len(self.front)))
        turned = place @ self.T.T
        slope = turned[..., :2] / np.maximum(turned[..., 2:], 1e-6)
        index = clipped((slope - self.low) / self.cell, cells)
        row = index[..., 0] * cells + index[..., 1]
        distance = np.sqrt(np.einsum("nwi,nwi->nw", place, place))
        toward, free = self.toward[row], self.free[row]
        beside = free > distance - slack
        sideways = toward * distance[..., None] - place
        length = np.sqrt(np.einsum("nwi,nwi->nw", sideways, sideways))
        direction = np.where(beside[..., None], sideways / np.maximum(length, 1e-9)[..., None], toward)
        ahead = np.where(free < 0, self.front[row] - slack - distance, 0.0)
        amount = np.where(beside, length - self.pitch * distance, ahead)
        return direction, np.maximum(amount, 0.0).astype(np.float32)
