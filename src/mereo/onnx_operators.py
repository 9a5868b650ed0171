"""Two operations that ONNX has no operator for, made of those it has: the SVD of 3 x 3 matrices and 3-D sampling.

They take the place of torch's own when a program is exported to ONNX (``torch.export``'s decompositions), with the same
arguments and the same results to rounding.
"""

from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from torch import Tensor

SWEEPS = 5
"""Convergence is quadratic; four sweeps reach double precision on 3 x 3 matrices, and one is to spare."""

TINY = 1e-300


def svd3(matrix: Tensor, full_matrices: bool = True, driver: str | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """U [b, 3, 3], S [b, 3], V^T [b, 3, 3] of ``torch.linalg.svd`` by one-sided Jacobi rotations, in double precision.

    Columns of A are turned in pairs until they are orthogonal, A V = U S (Hestenes, 1958). The third column of U is the
    cross product of the others, so that U is orthogonal even where the smallest singular value is 0.
    """
    identity = torch.eye(3, dtype=torch.float64).expand(len(matrix), 3, 3)
    # below each column of A its column of V, which is turned with it
    columns = list(torch.cat([matrix.double(), identity], dim=1).unbind(dim=2))
    for first, second in ((0, 1), (0, 2), (1, 2)) * SWEEPS:
        columns[first], columns[second] = _orthogonal(columns[first], columns[second])
    stacked = torch.stack(columns, dim=2)
    values = stacked[:, :3].square().sum(dim=1).sqrt()
    values, order = values.topk(3, dim=1)
    stacked = stacked.gather(2, order[:, None].expand(-1, 6, -1))
    main = stacked[:, :3, :2] / values[:, None, :2].clamp(min=TINY)
    u = torch.cat([main, torch.linalg.cross(main[..., 0], main[..., 1], dim=1)[..., None]], dim=2)
    # the sign that the cross product has chosen for the third column goes to V, because singular values have none
    sign = torch.where((u[..., 2] * stacked[:, :3, 2]).sum(dim=1, keepdim=True) < 0, -1.0, 1.0)
    v = torch.cat([stacked[:, 3:, :2], (stacked[:, 3:, 2] * sign)[..., None]], dim=2)
    found = u, values, v.transpose(1, 2)
    return found[0].to(matrix.dtype), found[1].to(matrix.dtype), found[2].to(matrix.dtype)


def _orthogonal(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Both turned in their plane by the smaller of the angles that make the first three numbers orthogonal."""
    product_ = (a[:, :3] * b[:, :3]).sum(dim=1, keepdim=True)
    difference = (b[:, :3].square() - a[:, :3].square()).sum(dim=1, keepdim=True)
    root = (difference.square() + 4 * product_.square()).sqrt()
    tangent = torch.where(difference < 0, -2.0, 2.0) * product_ / (difference.abs() + root).clamp(min=TINY)
    cosine = (1 + tangent.square()).rsqrt()
    sine = tangent * cosine
    return cosine * a - sine * b, sine * a + cosine * b


def trilinear(volume: Tensor, grid: Tensor, interpolation_mode: int, padding_mode: int, align_corners: bool) -> Tensor:
    """``grid_sample`` of a volume [1, c, d, h, w] at places [1, i, j, k, 3] in [-1, 1]: [1, c, i, j, k].

    Only as ``template.RestLookup`` asks for it: linear (0), the border's value beyond it (1), corners aligned.
    """
    assert (interpolation_mode, padding_mode, align_corners) == (0, 1, True), "another sampling than the template's"
    channels, sizes = volume.shape[1], volume.shape[2:]
    # places are x, y, z, the last axis first
    axes = [_between(grid[..., 2 - axis].reshape(-1), size) for axis, size in enumerate(sizes)]
    values = volume.reshape(channels, -1)
    total = torch.zeros_like(axes[0][1])
    for corner in product((0, 1), repeat=3):
        index, weight = torch.zeros_like(axes[0][0]), torch.ones_like(total)
        for (low, part), step, size in zip(axes, corner, sizes, strict=True):
            index = index * size + low + step
            weight = weight * (part if step else 1 - part)
        total = total + weight * values.index_select(1, index)
    return total.reshape(1, channels, *grid.shape[1:4])


def _between(place: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The lower of the two nodes around a place in [-1, 1], and how far towards the upper one it is, 0 to 1."""
    position = ((place + 1) / 2 * (size - 1)).clamp(0, size - 1)
    low = position.floor().clamp(max=size - 2)
    return low.long(), position - low


DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.linalg_svd.default: svd3,
    torch.ops.aten.grid_sampler.default: trilinear,
    torch.ops.aten.grid_sampler_3d.default: trilinear,
}
"""For ``ExportedProgram.run_decompositions``."""
