"""Farthest-point order and nearest neighbours as Triton kernels: the two steps that plain PyTorch does badly on a GPU.

In PyTorch the order is a thousand rounds of five launches, and nearest neighbours write all distances and select from
them. Here the order is one program that keeps all points in registers, and neighbours are found where the distances
are made. Triton comes with PyTorch's CUDA builds for Linux.

Notation: b clouds, n points, q queries, d 2 or 3 coordinates, k neighbours.
"""

# mypy: disable-error-code="untyped-decorator, no-untyped-def"
# what Triton compiles has its own types

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mereo.models.config import MOST_ORDERED

MOST_COMPARED = 2048
"""Number of points that a query may be compared with."""

QUERIES = 16
"""Number of queries of one program."""

DISTANCES_PER_WARP = 2048
"""Distances of one warp: 64 in each thread, which has room for twice as many numbers."""


@triton.jit
def _order(points, valid, order, n, count, BLOCK: tl.constexpr):
    cloud = tl.program_id(0)
    points += cloud * n * 3
    row = tl.arange(0, BLOCK)
    inside = row < n
    x = tl.load(points + row * 3, mask=inside, other=0.0)
    y = tl.load(points + row * 3 + 1, mask=inside, other=0.0)
    z = tl.load(points + row * 3 + 2, mask=inside, other=0.0)
    wanted = inside & (tl.load(valid + cloud * n + row, mask=inside, other=0) != 0)
    # the first point is the farthest from the origin; distances of points that cannot be chosen (again) are below 0
    current = tl.argmax(tl.where(wanted, x * x + y * y + z * z, -1.0), axis=0)
    distance = tl.where(wanted, float("inf"), -1.0)
    for i in range(count):
        tl.store(order + cloud * count + i, current)
        dx = x - tl.load(points + current * 3)
        dy = y - tl.load(points + current * 3 + 1)
        dz = z - tl.load(points + current * 3 + 2)
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
        distance = tl.where(row == current, -1.0, distance)
        current = tl.argmax(distance, axis=0)


@triton.jit
def _nearest(
    queries, points, found, q, n, D: tl.constexpr, K: tl.constexpr, QUERIES: tl.constexpr, BLOCK: tl.constexpr
):
    cloud = tl.program_id(1)
    row = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    column = tl.arange(0, BLOCK)
    asked, known = row < q, column < n
    distance = tl.zeros((QUERIES, BLOCK), tl.float32)
    for axis in tl.static_range(D):
        a = tl.load(queries + (cloud * q + row) * D + axis, mask=asked, other=0.0)
        b = tl.load(points + (cloud * n + column) * D + axis, mask=known, other=0.0)
        difference = a[:, None] - b[None, :]
        distance += difference * difference
    distance = tl.where(known[None, :], distance, float("inf"))
    for k in tl.static_range(K):
        best = tl.argmin(distance, axis=1)
        tl.store(found + (cloud * q + row) * K + k, best, mask=asked)
        distance = tl.where(column[None, :] == best[:, None], float("inf"), distance)


def farthest_points(points: Float[Tensor, "b n 3"], valid: Bool[Tensor, "b n"], count: int) -> Int[Tensor, "b m"]:
    """Rows of the first ``count`` valid points in farthest-point order, from the one farthest from the origin on.

    Ties go to the earlier row. Where fewer are valid, what follows the last of them means nothing.
    Raises ``ValueError`` for clouds that one program cannot hold.
    """
    batch, n = valid.shape
    if n > MOST_ORDERED:
        raise ValueError(f"the cloud has {n} points; at most {MOST_ORDERED} can be ordered at once: crop or thin it")
    order = torch.empty(batch, count, dtype=torch.int64, device=points.device)
    block = triton.next_power_of_2(n)
    warps = min(32, max(4, block // 256))
    _order[(batch,)](points.contiguous(), valid.to(torch.uint8), order, n, count, BLOCK=block, num_warps=warps)
    return order


def nearest(queries: Float[Tensor, "b q d"], points: Float[Tensor, "b n d"], count: int) -> Int[Tensor, "b q k"]:
    """Rows of the ``count`` nearest points to each query, nearest first; ties go to the earlier row.

    Raises ``ValueError`` where there are more than ``MOST_COMPARED`` points, or fewer than ``count``.
    """
    batch, asked, axes = queries.shape
    n = points.shape[1]
    if not count <= n <= MOST_COMPARED:
        raise ValueError(f"{count} of {n} points are asked for; there must be {count} to {MOST_COMPARED} points")
    found = torch.empty(batch, asked, count, dtype=torch.int64, device=queries.device)
    programs = (triton.cdiv(asked, QUERIES), batch)
    block = triton.next_power_of_2(n)
    _nearest[programs](
        queries.contiguous(),
        points.contiguous(),
        found,
        asked,
        n,
        D=axes,
        K=count,
        QUERIES=QUERIES,
        BLOCK=block,
        num_warps=max(4, QUERIES * block // DISTANCES_PER_WARP),
    )
    return found
