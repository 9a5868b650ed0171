"""Operators that ONNX lacks, made of those it has: the SVD of 3 x 3 matrices and 3-D sampling.

They take the place of torch's own when a program is exported to ONNX (``torch.export``'s decompositions), with the same
arguments and the same results to rounding.
"""

from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from torch import Tensor

from mereo.models.rigid_alignment import svd3


def trilinear(volume: Tensor, grid: Tensor, interpolation_mode: int, padding_mode: int, align_corners: bool) -> Tensor:
    """Trilinear ``grid_sample`` of a volume [1, c, d, h, w] at [1, i, j, k, 3] in [-1, 1]: [1, c, i, j, k].

    Only as ``template_lookup.RestLookup`` asks for it: linear (0), the border's value beyond it (1), corners aligned.
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
"""Replacements of torch's operators, for ``ExportedProgram.run_decompositions``."""
