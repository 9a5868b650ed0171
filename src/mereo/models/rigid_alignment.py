"""Rigid motions between the camera frame and the frame of an object's rest pose, in batches.

Notation: b clouds, n points, q queries.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mereo.models.device import exact
from mereo.models.neighbors import CloudBatch, VectorBatch


@dataclass(frozen=True, eq=False)
class Alignment:
    """Rigid motion of each cloud, ``aligned = rotation @ x + shift``, from normalized camera coordinates.

    There is no scale: cloud and rest pose are both about two units long, and an unsure estimate would shrink.
    """

    rotation: Float[Tensor, "b 3 3"]
    shift: VectorBatch

    def apply(self, points: CloudBatch) -> CloudBatch:
        """Points from the camera frame to the aligned frame."""
        with exact(points):
            return points @ self.rotation.transpose(1, 2) + self.shift[:, None]

    def turn_back(self, directions: CloudBatch) -> CloudBatch:
        """Directions from the aligned frame to the camera's."""
        with exact(directions):
            return directions @ self.rotation


@torch.no_grad()
def fit_rigid(source: CloudBatch, target: CloudBatch) -> Alignment:
    """Rotation and shift with the least squared distance of moved ``source`` to ``target`` (Kabsch, 1976)."""
    middle = source.mean(dim=1, keepdim=True)
    aim = target.mean(dim=1, keepdim=True)
    with exact(source):
        u, _, v = torch.linalg.svd((target - aim).transpose(1, 2) @ (source - middle))
        flip = torch.ones_like(source[:, 0])
        flip[:, 2] = _determinant(u @ v).sign()
        rotation = (u * flip[:, None]) @ v
        return Alignment(rotation, (aim - middle @ rotation.transpose(1, 2))[:, 0])


def _determinant(matrix: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Of three rows, as the volume that they span."""
    a, b, c = matrix.unbind(dim=1)
    return (torch.linalg.cross(a, b, dim=1) * c).sum(dim=1)


# --- singular values of 3 x 3 matrices --------------------------------------------------------------------------------

# Singular value decomposition of 3 x 3 matrices from plain operations, as ONNX has no operator for it.

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
    return u.to(matrix.dtype), values.to(matrix.dtype), v.transpose(1, 2).to(matrix.dtype)


def _orthogonal(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Both turned in their plane by the smaller of the angles that make the first three numbers orthogonal."""
    product_ = (a[:, :3] * b[:, :3]).sum(dim=1, keepdim=True)
    difference = (b[:, :3].square() - a[:, :3].square()).sum(dim=1, keepdim=True)
    root = (difference.square() + 4 * product_.square()).sqrt()
    tangent = torch.where(difference < 0, -2.0, 2.0) * product_ / (difference.abs() + root).clamp(min=TINY)
    cosine = (1 + tangent.square()).rsqrt()
    sine = tangent * cosine
    return cosine * a - sine * b, sine * a + cosine * b
