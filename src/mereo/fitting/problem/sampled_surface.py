"""A model's surface as evenly spread points that carry their planes: the nearest of them is found in no time.

A search among all faces is exact and slow. Samples are as good while the model is farther from the cloud than they are
from each other; the last steps of a fit ask the faces themselves.

Notation: s samples, k modes. A frame is three vectors: the sample's place and two edges of its face.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from mereo.fitting.problem.gauss_newton import Posed, cross
from mereo.scenes.statistical_model import StatisticalModel

Planes = tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"], Float32[np.ndarray, "p 3 k"]]
"""Planes that observed points are compared with: a place on each, its normal, and the modes there."""


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """Samples of a model's surface, evenly spread; every second or fourth of them are as even.

    Attributes:
        mean, modes: of the frames.
        spacing: distance between samples, about.
    """

    mean: Float32[np.ndarray, "s 3 3"]
    modes: Float32[np.ndarray, "s 3 3 k"]
    spacing: float

    @classmethod
    def of(cls, model: StatisticalModel, count: int) -> "SampledSurface":
        """Samples of the rest surface, equal shares of its area each."""
        corners = model.rest_points[model.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        ends = np.cumsum(area)
        face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1])
        share = np.sort(np.random.default_rng(0).random((count, 2)), axis=1)  # uniform in a triangle
        weight = np.diff(share, axis=1, prepend=0.0, append=1.0)
        combine = np.zeros((count, 3, 3))
        combine[:, 0], combine[:, 1:, 0], combine[:, [1, 2], [1, 2]] = weight, -1.0, 1.0
        index = np.broadcast_to(model.faces[face][:, None], combine.shape)
        rows = np.repeat(np.arange(3 * count), 3)
        frames = csr_array((combine.ravel().astype(np.float32), (rows, index.ravel())), (3 * count, len(model.mean)))
        modes = (frames @ model.modes.reshape(len(model.modes), -1)).reshape(count, 3, 3, model.count)
        mean = (frames @ model.mean).reshape(count, 3, 3)
        spacing = float(np.sqrt(ends[-1] / 2 / count))
        return cls(mean.astype(np.float32), modes, spacing)

    def every(self, step: int) -> "SampledSurface":
        """Fewer samples."""
        return SampledSurface(self.mean[::step], self.modes[::step], self.spacing * np.sqrt(step))

    def posed(self, posed: Posed) -> "PosedSamples":
        """Samples of a state in the camera frame."""
        flat = self.modes.reshape(9 * len(self.mean), -1) @ posed.z.astype(np.float32)
        turn = (np.exp(posed.log_scale) * posed.rotation.T).astype(np.float32)
        frame = ((self.mean + flat.reshape(self.mean.shape)).reshape(-1, 3) @ turn).reshape(self.mean.shape)
        place = frame[:, 0] + posed.translation.astype(np.float32)
        normal = cross(frame[:, 1], frame[:, 2])
        normal /= np.maximum(np.sqrt(np.einsum("si,si->s", normal, normal)), 1e-30)[:, None]
        return PosedSamples(self, place, normal, np.einsum("si,si->s", normal, place) < 0)


@dataclass(frozen=True, eq=False)
class PosedSamples:
    """Samples in the camera frame.

    Attributes:
        surface: of which they are.
        place: of each.
        normal: outward.
        facing: whether the camera sees their outside.
    """

    surface: SampledSurface
    place: Float32[np.ndarray, "s 3"]
    normal: Float32[np.ndarray, "s 3"]
    facing: Bool[np.ndarray, " s"]

    def few(self, count: int) -> "PosedSamples":
        """About ``count`` samples, as evenly spread."""
        step = max(1, len(self.place) // count)
        return PosedSamples(self.surface.every(step), self.place[::step], self.normal[::step], self.facing[::step])

    def planes(self, points: Float[np.ndarray, "p 3"]) -> Planes:
        """Place, normal and modes of the facing sample nearest to each point."""
        rows = np.flatnonzero(self.facing)
        rows = rows if len(rows) else np.arange(len(self.place))
        tree = cKDTree(self.place[rows], balanced_tree=False, compact_nodes=False)
        near = rows[tree.query(points)[1]]
        return self.place[near].astype(np.float64), self.normal[near].astype(np.float64), self.surface.modes[near, 0]
