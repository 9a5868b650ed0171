"""Encodings, what every encoder gives, and the layer that all of them are made of.

Notation: b clouds, m points of a level, c channels, z latent channels.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.device import exact


@dataclass(frozen=True, eq=False)
class Level:
    """Points of a coarser level (a prefix of the cloud) with their features."""

    centers: Float[Tensor, "b m 3"]
    features: Float[Tensor, "b m c"]


@dataclass(frozen=True, eq=False)
class Encoding:
    """Knowledge of an encoder about a cloud: the paper's latent vector, and levels on the way for local features."""

    latent: Float[Tensor, "b z"]
    levels: tuple[Level, ...]


def share(count: int, ratio: float) -> int:
    """Share of a count, ``max(1, int(count * ratio))``, also of the sizes that an exported graph leaves open."""
    found: int = torch.sym_max(1, torch.sym_int(count * ratio))
    return found


class SharedMLP(nn.Module):
    """Layers of linear map, batch normalization and ReLU, shared by all rows."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            # the bias would be removed by the batch mean
            layers += [nn.Linear(before, after, bias=False), nn.BatchNorm1d(after), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, rows: Float[Tensor, "*r i"]) -> Float[Tensor, "*r o"]:
        """Outputs of the last layer for each row; the first layer computes in float32."""
        first, *rest = self.layers
        with exact(rows):  # coordinates, and pooled features, which have much in common
            hidden = first(rows.reshape(-1, rows.shape[-1]).float())
        for layer in rest:
            hidden = layer(hidden)
        return hidden.reshape(*rows.shape[:-1], -1)
