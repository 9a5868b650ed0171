"""Singular value decomposition of 3 x 3 matrices from plain operations, for graphs that cannot hold a solver's.

ONNX has no operator for it, and a CUDA graph cannot hold torch's, which looks at its own result on the host.
"""

import torch
from torch import Tensor

SWEEPS = 5
"""Number of rounds of rotations: convergence is quadratic, four reach double precision, and one is to spare."""

TINY = 1e-300


def svd3(matrix: Tensor, full_matrices: bool = True, driver: str | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Singular value decomposition of 3 x 3 matrices by one-sided Jacobi rotations, in double precision.

    U [b, 3, 3], S [b, 3], V^T [b, 3, 3], arguments and results as of ``torch.linalg.svd``.

    Columns of A are turned in pairs until they are orthogonal, A V = U S (Hestenes, 1958). The third column of U is the
    cross product of the others, so that U is orthogonal even where the smallest singular value is 0.
    """
    identity = torch.eye(3, dtype=torch.float64, device=matrix.device).expand(len(matrix), 3, 3)
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
