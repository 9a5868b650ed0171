"""Nearest neighbours as a Triton kernel: the step that plain PyTorch does badly on a GPU.

PyTorch writes all distances and selects from them. Here neighbours are selected where the distances are made. Triton
comes with PyTorch's CUDA builds for Linux.

Notation: b clouds, n points, q queries, d 2 or 3 coordinates, k neighbours.
"""

# mypy: disable-error-code="untyped-decorator, no-untyped-def"
# what Triton compiles has its own types

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

MOST_COMPARED = 2048
"""Number of points that a query may be compared with."""

QUERIES = 16
"""Number of queries of one program."""

DISTANCES_PER_WARP = 2048
"""Distances of one warp: 64 in each thread, which has room for twice as many numbers."""


@triton.jit
def _nearest(queries, points, rows, q, n, D: tl.constexpr, K: tl.constexpr, QUERIES: tl.constexpr, BLOCK: tl.constexpr):
    cloud = tl.program_id(1)
    row = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    column = tl.arange(0, BLOCK)
    wanted, known = row < q, column < n
    distance = tl.zeros((QUERIES, BLOCK), tl.float32)
    for axis in tl.static_range(D):
        a = tl.load(queries + (cloud * q + row) * D + axis, mask=wanted, other=0.0)
        b = tl.load(points + (cloud * n + column) * D + axis, mask=known, other=0.0)
        difference = a[:, None] - b[None, :]
        distance += difference * difference
    distance = tl.where(known[None, :], distance, float("inf"))
    for k in tl.static_range(K):
        best = tl.argmin(distance, axis=1)
        tl.store(rows + (cloud * q + row) * K + k, best, mask=wanted)
        distance = tl.where(column[None, :] == best[:, None], float("inf"), distance)


def nearest(queries: Float[Tensor, "b q d"], points: Float[Tensor, "b n d"], count: int) -> Int[Tensor, "b q k"]:
    """Rows of the ``count`` nearest points to each query, nearest first; ties go to the earlier row.

    Raises ``ValueError`` where there are more than ``MOST_COMPARED`` points, or fewer than ``count``.
    """
    batch, count_q, axes = queries.shape
    n = points.shape[1]
    if not count <= n <= MOST_COMPARED:
        raise ValueError(f"{count} of {n} points are asked for; there must be {count} to {MOST_COMPARED} points")
    rows = torch.empty(batch, count_q, count, dtype=torch.int64, device=queries.device)
    programs = (triton.cdiv(count_q, QUERIES), batch)
    block = triton.next_power_of_2(n)
    _nearest[programs](
        queries.contiguous(),
        points.contiguous(),
        rows,
        count_q,
        n,
        D=axes,
        K=count,
        QUERIES=QUERIES,
        BLOCK=block,
        num_warps=max(4, QUERIES * block // DISTANCES_PER_WARP),
    )
    return rows
