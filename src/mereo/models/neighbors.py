"""Ball query and nearest neighbours on batched point sets, in plain PyTorch: no compiled extension.

Points arrive in farthest-point order (``mereo.geometry.downsampling``). The greedy order makes the first m
points exactly the farthest-point sample of size m, so the centres of every set-abstraction level are a prefix and cost
nothing, and "the first K neighbours in order" are a well-spread subset of a crowded ball.
"""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from mereo.geometry.transforms import Points

CloudBatch = Float[Tensor, "b n 3"]
"""Points, or vectors at them, of each example of a batch."""

QueryBatch = Float[Tensor, "b q 3"]
"""Places at which a network is evaluated, or vectors there, of each example of a batch."""

VectorBatch = Float[Tensor, "b 3"]
"""A vector for each example of a batch."""

NeighborIndices = Int[Tensor, "b m k"]
"""Indices of the points near each center."""

# PyTorch 2.6 cannot tell exporting from compiling, and compiles what is exported
is_exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)

THREADED_QUERIES = 1024
"""Number of queries below which a k-d tree's threads cost more than they save."""


@torch.no_grad()
def ball_query(centers: Float[Tensor, "b m 3"], points: CloudBatch, radius: float, limit: int) -> NeighborIndices:
    """Indices of the first ``limit`` points, in order, within ``radius`` of each centre.

    Balls with fewer points repeat their first one, which a max pool does not notice. Every centre must itself be one
    of the points, so no ball is empty (PointNet++, section 3.3).
    """
    limit = min(limit, points.shape[1])
    if centers.device.type == "cpu" and not is_exporting():
        return _by_pairs(centers.detach(), points.detach(), radius, limit)
    return _by_rank(centers, points, radius, limit)


def _by_rank(centers: Float[Tensor, "b m 3"], points: CloudBatch, radius: float, limit: int) -> NeighborIndices:
    """Ball query without sizes that depend on the values: for GPUs and for graphs."""
    count = points.shape[1]
    near = squared_distances(centers, points) <= radius * radius
    rank = near.cumsum(dim=-1, dtype=torch.int32)
    # slot `limit` collects what is not wanted: points outside, and those beyond the limit
    slot = torch.where(near & (rank <= limit), rank - 1, limit).long()
    index = torch.arange(count, device=points.device).expand_as(slot)
    rows = torch.full((*near.shape[:2], limit + 1), -1, dtype=torch.long, device=points.device)
    rows = rows.scatter_(-1, slot, index)[..., :limit]
    return torch.where(rows < 0, rows[..., :1], rows)


@torch.library.custom_op("mereo::ball_query", mutates_args=())
def _by_pairs(centers: Tensor, points: Tensor, radius: float, limit: int) -> Tensor:
    """Ball query by the list of near pairs: most are not. An operator, so that a compiled network can call it."""
    clouds = zip(centers.numpy().astype(float), points.numpy().astype(float), strict=True)
    return torch.from_numpy(np.stack([_first_in_ball(c, p, radius, limit) for c, p in clouds]))


def _first_in_ball(centers: Float[ndarray, "m 3"], points: Points, radius: float, limit: int) -> Int[ndarray, "m k"]:
    # |c - p|^2 - r^2 as one product of five columns with five rows; in double precision nothing is lost
    lengths = (centers * centers).sum(axis=1) - radius * radius
    left = np.column_stack([-2 * centers, np.ones(len(centers)), lengths])
    right = np.vstack([points.T, (points * points).sum(axis=1), np.ones(len(points))])
    row, column = np.divmod(np.flatnonzero(left @ right <= 0), len(points))
    count = np.bincount(row, minlength=len(centers))
    first = np.cumsum(count) - count
    rank = np.arange(len(row)) - first[row]
    kept = rank < limit
    result = np.repeat(column[first][:, None], limit, axis=1)
    result[row[kept], rank[kept]] = column[kept]
    return result


@_by_pairs.register_fake
def _(centers: Tensor, points: Tensor, radius: float, limit: int) -> Tensor:
    return centers.new_empty((*centers.shape[:2], limit), dtype=torch.long)


@torch.no_grad()
def nearest(queries: Float[Tensor, "b q d"], points: Float[Tensor, "b n d"], count: int) -> Int[Tensor, "b q k"]:
    """Indices of the ``count`` nearest points to each query, nearest first; ties in any order.

    On a CPU by a k-d tree per cloud, which is exact and six times faster than all distances and a selection; on a
    GPU and in exported graphs, by those.
    """
    count = min(count, points.shape[1])
    if queries.device.type == "cpu" and not is_exporting():
        return _by_trees(queries.detach(), points.detach(), count)
    return squared_distances(queries, points).topk(count, dim=-1, largest=False).indices


@torch.library.custom_op("mereo::nearest", mutates_args=())
def _by_trees(queries: Tensor, points: Tensor, count: int) -> Tensor:
    """Nearest neighbours by k-d trees. An operator, so that a compiled network can call it."""
    return torch.from_numpy(
        np.stack([_by_tree(q, p, count) for q, p in zip(queries.numpy(), points.numpy(), strict=True)])
    )


@_by_trees.register_fake
def _(queries: Tensor, points: Tensor, count: int) -> Tensor:
    return queries.new_empty((*queries.shape[:2], count), dtype=torch.long)


def _by_tree(queries: Float[ndarray, "q d"], points: Float[ndarray, "n d"], count: int) -> Int[ndarray, "q k"]:
    workers = torch.get_num_threads() if len(queries) >= THREADED_QUERIES else 1
    ranks = np.arange(1, count + 1)  # a list keeps the last axis where one number would drop it
    tree = _tree(points.tobytes(), points.dtype.str, points.shape[1])
    return tree.query(queries, ranks, workers=workers)[1].astype(np.int64, copy=False)


@lru_cache(maxsize=16)
def _tree(data: bytes, dtype: str, axes: int) -> KDTree:
    """Tree of points; the latest are kept, as a cloud's is used again for every chunk of its queries."""
    return KDTree(np.frombuffer(data, dtype).reshape(-1, axes))


def squared_distances(a: Float[Tensor, "b m d"], b: Float[Tensor, "b n d"]) -> Float[Tensor, "b m n"]:
    """Squared distances of all pairs, by summed squares: the expanded product loses digits where they matter."""
    total = (a[:, :, None, 0] - b[:, None, :, 0]).square()
    for axis in range(1, a.shape[-1]):
        total = total + (a[:, :, None, axis] - b[:, None, :, axis]).square()
    return total


def gather(values: Float[Tensor, "b n c"], index: NeighborIndices) -> Float[Tensor, "b m k c"]:
    """Rows of each cloud's values by index, ``values[b, index[b, m, k]]``."""
    batch, count, channels = values.shape
    offset = torch.arange(batch, device=values.device).view(-1, 1, 1) * count
    flat = (index + offset).reshape(-1)
    return values.reshape(batch * count, channels).index_select(0, flat).reshape(*index.shape, channels)


@torch.no_grad()
def distinct_distances(points: CloudBatch) -> Float[Tensor, "b n n"]:
    """Squared distances among points; infinite in the columns of points that repeat an earlier one.

    A cloud with too few points repeats them. Repetitions must not take the places of real neighbours.
    """
    distances = squared_distances(points, points)
    repeated = (distances == 0).tril(diagonal=-1).any(dim=2)
    return distances.masked_fill(repeated[:, None], torch.inf)
