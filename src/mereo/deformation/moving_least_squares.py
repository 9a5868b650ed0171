"""Motion of any point of an object, from the motion of its material points (surface vertices and interior nodes).

A point ``p`` follows ``sum_i w_i x_i`` over material points ``x_i`` of its own segment, with weights from rest
positions alone: ``sum_i w_i = 1`` and ``sum_i w_i x_i = p``, so that every affine motion, hence every rigid part, is
followed exactly (moving least squares; Levin, Math. Comp. 1998). The motion is linear in the material points, so a
linear model of these is one of every point.

Notation: n points, k material points that each of them follows, m material points.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.linalg import solve
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from mereo.geometry.downsampling import farthest_point_order
from mereo.geometry.transforms import Points, Subset, longest_side

ANCHORS = 200
"""Surface vertices of each segment that points may follow, spread evenly: the nearest of all lie on one small patch,
from which the other side is extrapolated (errors up to 6 units in the bunny, 0.8 with these)."""

FOLLOWED, SOFTENING = 32, 0.05
"""Material points that one point follows; nearer than the softening length, of the segment's size, they count alike."""

RIDGE = 1e-6
"""Keeps the normal equations regular where all material points lie in a plane."""


@dataclass(frozen=True, eq=False)
class PointWeights:
    """Material points that each point follows, and their weights; rows of ``weight`` sum to one."""

    index: Int[ndarray, "n k"]
    weight: Float[ndarray, "n k"]

    def __call__(self, material: Float[ndarray, "m *c"]) -> Float[ndarray, "n *c"]:
        """Values at the points, from values at the material points."""
        flat = material.reshape(len(material), -1)
        rows = np.repeat(np.arange(len(self.index)), self.index.shape[1])
        entries = (self.weight.ravel().astype(flat.dtype), (rows, self.index.ravel()))
        result = csr_array(entries, shape=(len(self.index), len(flat))) @ flat
        return result.reshape(len(self.index), *material.shape[1:])

    def rows(self, chosen: ndarray) -> "PointWeights":
        """Weights of some of the points."""
        return PointWeights(self.index[chosen], self.weight[chosen])


@dataclass(frozen=True, eq=False)
class Anchors:
    """Material points of one segment that others follow, by their index among the object's, and where they are."""

    index: Int[ndarray, " a"]
    position: Float[ndarray, "a 3"]

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree over the positions."""
        return cKDTree(self.position)

    def weights(self, points: Points) -> PointWeights:
        """Weights by which points move with the anchors; an anchor's falls with the fourth power of its distance."""
        count = min(FOLLOWED, len(self.index))
        distance, near = self.tree.query(points, k=range(1, count + 1))
        size = longest_side(self.position)
        influence = 1.0 / (distance**2 + (SOFTENING * size) ** 2) ** 2
        influence /= influence.sum(axis=1, keepdims=True)
        offset = (self.position[near] - points[:, None]) / size
        basis = np.concatenate([np.ones((*near.shape, 1)), offset], axis=2)
        weighted = influence[..., None] * basis
        moment = np.matmul(weighted.transpose(0, 2, 1), basis)
        moment[:, range(1, 4), range(1, 4)] += RIDGE * np.trace(moment, axis1=1, axis2=2)[:, None] / 4
        right = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (len(points), 1))[..., None]
        weight = np.matmul(weighted, solve(moment, right))[..., 0]
        return PointWeights(self.index[near], weight / weight.sum(axis=1, keepdims=True))


def spread(points: Points, count: int) -> Subset:
    """Indices of at most ``count`` points, evenly spread (farthest-point order)."""
    return farthest_point_order(points.astype(np.float32), min(count, len(points)))
