"""Some states of an object as tables: evenly spread samples of the surface, and the nearest of them to every place.

A table is made once for an object. With it, thousands of poses are compared with a cloud in single array operations.

Notation: q states, s samples, r cells along each side of a table.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Int, Int32
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from mereo.fitting.problem.gauss_newton import cross
from mereo.fitting.problem.sampled_surface import SampledSurface
from mereo.scenes.statistical_model import StatisticalModel

SAMPLES = 512
"""Samples of the surface: they are 2 to 4 % of half its longest side apart, far less than the first sigma."""

CELLS = 32
"""Cells along each side of a table."""

MARGIN = 0.5
"""By so much of its half length is a table larger than its state on each side; beyond, all points are outliers."""

MODELS = 4
"""Objects whose tables are kept."""


@dataclass(frozen=True, eq=False)
class ShapeTables:
    """Tables of some states, model frame.

    Attributes:
        z: coefficients of each state.
        place, normal: of its samples.
        low, cell: corner of each table's box, and the length of a cell.
        nearest: index of the sample nearest to the centre of each cell.
    """

    z: Float32[np.ndarray, "q k"]
    place: Float32[np.ndarray, "q s 3"]
    normal: Float32[np.ndarray, "q s 3"]
    low: Float32[np.ndarray, "q 3"]
    cell: Float32[np.ndarray, " q"]
    nearest: Int32[np.ndarray, "q c"]

    @classmethod
    def of(cls, model: StatisticalModel, z: Float32[np.ndarray, "q k"], surface: SampledSurface) -> "ShapeTables":
        """Tables of states with the coefficients ``z``."""
        flat = z @ surface.modes.reshape(-1, model.count).T
        frame = surface.mean + flat.reshape(len(z), *surface.mean.shape)
        place = np.ascontiguousarray(frame[:, :, 0])
        normal = cross(frame[:, :, 1].reshape(-1, 3), frame[:, :, 2].reshape(-1, 3))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        margin = np.float32(MARGIN * model.half)
        low, high = place.min(axis=1) - margin, place.max(axis=1) + margin
        cell = (high - low).max(axis=1) / CELLS
        low = (low + high - CELLS * cell[:, None]) / 2
        steps = np.stack(np.meshgrid(*(np.arange(CELLS, dtype=np.float32) + 0.5,) * 3, indexing="ij"), axis=-1)
        nearest = [
            cKDTree(place[i], balanced_tree=False, compact_nodes=False).query(low[i] + cell[i] * steps.reshape(-1, 3))[
                1
            ]
            for i in range(len(z))
        ]
        return cls(z, place, normal.reshape(place.shape), low, cell, np.stack(nearest).astype(np.int32))


def medoids(model: StatisticalModel, count: int) -> Int[np.ndarray, " q"]:
    """Rows of the library's states that stand for all of them: those nearest to the centres of so many clusters."""
    if count >= len(model.library):
        return np.arange(len(model.library))
    shape = (model.library * model.motion).astype(np.float64)
    center, owner = kmeans2(shape, count, minit="++", rng=0)
    sizes = np.bincount(owner, minlength=count)
    order = np.argsort(-sizes, kind="stable")[: np.count_nonzero(sizes)]
    distance = ((shape[None] - center[order, None]) ** 2).sum(axis=2)
    rows: Int[np.ndarray, " q"] = np.unique(distance.argmin(axis=1))
    return rows


@lru_cache(maxsize=MODELS)
def tables_of(model: StatisticalModel, count: int) -> ShapeTables:
    """Tables of the mean state (``count`` 0), or of ``count`` medoids of the library; those of few models are kept."""
    surface = SampledSurface.of(model, SAMPLES)
    z = np.zeros((1, model.count), dtype=np.float32) if count == 0 else model.library[medoids(model, count)]
    return ShapeTables.of(model, z, surface)
