"""Rigid motions between the camera frame and the frame of an object's rest pose, in batches.

Notation: b clouds, n points, q queries.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mereo.models.device import exact
from mereo.models.ops.svd import svd3


@dataclass(frozen=True, eq=False)
class Alignment:
    """Rigid motion of each cloud, ``aligned = rotation @ x + shift``, from normalized camera coordinates.

    There is no scale: cloud and rest pose are both about two units long, and an unsure estimate would shrink.
    """

    rotation: Float[Tensor, "b 3 3"]
    shift: Float[Tensor, "b 3"]

    def apply(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        """Points from the camera frame to the aligned frame."""
        with exact(points):
            return points @ self.rotation.transpose(1, 2) + self.shift[:, None]

    def turn_back(self, directions: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        """Directions from the aligned frame to the camera's."""
        with exact(directions):
            return directions @ self.rotation


@torch.no_grad()
def fit_rigid(source: Float[Tensor, "b n 3"], target: Float[Tensor, "b n 3"]) -> Alignment:
    """Rotation and shift with the least squared distance of moved ``source`` to ``target`` (Kabsch, 1976)."""
    middle, aim = source.mean(dim=1, keepdim=True), target.mean(dim=1, keepdim=True)
    with exact(source):
        u, _, v = _svd((target - aim).transpose(1, 2) @ (source - middle))
        flip = torch.ones_like(source[:, 0])
        flip[:, 2] = _determinant(u @ v).sign()
        rotation = (u * flip[:, None]) @ v
        return Alignment(rotation, (aim - middle @ rotation.transpose(1, 2))[:, 0])


def _svd(matrix: Float[Tensor, "b 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """``torch.linalg.svd``, whose solver a CUDA graph cannot hold."""
    capturing = matrix.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()
    return svd3(matrix) if capturing else torch.linalg.svd(matrix)


def _determinant(matrix: Float[Tensor, "b 3 3"]) -> Float[Tensor, " b"]:
    """Of three rows, as the volume that they span."""
    a, b, c = matrix.unbind(dim=1)
    return (torch.linalg.cross(a, b, dim=1) * c).sum(dim=1)
