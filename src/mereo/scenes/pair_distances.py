"""Distances between material points that an object's states keep, though its linear model does not.

A linear model of states is too wide where states are not linear: it stretches a rope that only bends, and shears a
robot's links. Each pair here has a distance that varies far less among the states than under the model's own Gaussian.
Together they say, without any code of the scene, what bends, what is rigid and what turns about what.

Notation: q pairs, v points that are tried, k modes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

TRIED_STATES, TRIED_GAUSSIAN = 600, 300
"""States, and draws of the Gaussian, whose distances are compared."""

MOST_PAIRS = 1000
LEAST_RATIO = 2.0
"""Pairs whose distance varies at least so many times more under the Gaussian than among the states."""

FLOOR = 0.002
"""Least deviation, of half the rest box's longest side: no distance is taken to be known better."""


@dataclass(frozen=True, eq=False)
class PairDistances:
    """Pairs of material points, and mean and standard deviation of their distance; there may be none."""

    first: Int[np.ndarray, " q"]
    second: Int[np.ndarray, " q"]
    mean: Float[np.ndarray, " q"]
    std: Float[np.ndarray, " q"]

    def __len__(self) -> int:
        return len(self.first)


def kept_distances(
    tried: Int[np.ndarray, " v"],
    mean: Float[np.ndarray, "m 3"],
    modes: Float32[np.ndarray, "m 3 k"],
    library: Float32[np.ndarray, "n k"],
    half: float,
) -> PairDistances:
    """Distances among the ``tried`` material points that the states keep; see ``LEAST_RATIO``.

    Args:
        tried: material points.
        mean: of the linear model.
        modes: of the linear model.
        library: coefficients of the states.
        half: half of the rest box's longest side.
    """
    rng = np.random.default_rng(0)
    first, second = np.triu_indices(len(tried), 1)
    middle, motion = mean[tried].astype(np.float32), modes[tried]
    states = library[rng.permutation(len(library))[:TRIED_STATES]]
    real = _distances(middle, motion, states)[:, first, second]
    drawn = rng.normal(size=(TRIED_GAUSSIAN, library.shape[1])).astype(np.float32)
    linear = _distances(middle, motion, drawn)[:, first, second]
    center = real.mean(axis=0)
    std = np.maximum(real.std(axis=0), FLOOR * half)
    kept = np.flatnonzero(np.sqrt(((linear - center) ** 2).mean(axis=0)) > LEAST_RATIO * std)
    if len(kept) > MOST_PAIRS:
        kept = np.sort(rng.choice(kept, MOST_PAIRS, replace=False))
    return PairDistances(
        tried[first[kept]], tried[second[kept]], center[kept].astype(np.float64), std[kept].astype(np.float64)
    )


def _distances(
    mean: Float32[np.ndarray, "v 3"], modes: Float32[np.ndarray, "v 3 k"], z: Float32[np.ndarray, "n k"]
) -> Float32[np.ndarray, "n v v"]:
    """Between all pairs of points in each state."""
    points = mean + (z @ modes.reshape(3 * len(mean), z.shape[1]).T).reshape(len(z), -1, 3)
    squared = (points**2).sum(axis=2)
    product = np.matmul(points, points.transpose(0, 2, 1))
    result: np.ndarray = np.sqrt(np.maximum(squared[:, :, None] + squared[:, None] - 2 * product, 0.0))
    return result
