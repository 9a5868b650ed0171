"""Alignment of an observed cloud with the object's rest pose, before anything else looks at it.

A free camera shows an object in any orientation, and a network that must recognize each of them separately learns
slowly. Here a small network first predicts rest-pose coordinates (normalized object coordinates; Wang et al., CVPR
2019) at the observed points; the rigid motion that fits them best takes cloud and queries into the rest pose's frame.
What deformation and the estimate's error leave over is for the network behind it. Regressing the rotation directly, as
T-Net does (PointNet; Qi et al., CVPR 2017), learned far more slowly: docs/design/0003-alignment.md.

Notation: b clouds, n points, q queries.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.config import NetworkConfig
from mereo.models.decoder import ConditionedMLP
from mereo.models.encoders.pointnet2 import PointNet2
from mereo.models.rigid_alignment import Alignment, fit_rigid


class Aligned(NamedTuple):
    """Rigid motion of each cloud, and the rest coordinates predicted at the queries, for the loss."""

    alignment: Alignment
    rest: Float[Tensor, "b q 3"]


class AlignmentNet(nn.Module):
    """Network from a cloud in farthest-point order to its ``Alignment``, by way of rest coordinates."""

    FITTED = 128
    """Observed points whose coordinates are predicted and fitted."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.points = config.additions.align_points
        small = replace(
            config,
            encoder="pointnet2",  # whatever the network's own is: a small cloud needs no other
            pointnet2=replace(config.pointnet2, neighbors=min(config.pointnet2.neighbors, 16), ratio1=0.5),
            decoder=replace(config.decoder, depth=3, skip_after=2, dropout=0.0),
            additions=replace(config.additions, sight_neighbors=0),
        )
        self.encoder = PointNet2(small.pointnet2)
        self.decoder = ConditionedMLP(small, outputs=3)

    def forward(self, cloud: Float[Tensor, "b n 3"], queries: Float[Tensor, "b q 3"] | None = None) -> Aligned:
        """Alignment of each cloud, and rest coordinates at ``queries`` (none where there are none)."""
        seen = cloud[:, : self.FITTED]
        unused = torch.zeros_like(cloud[:, 0])  # the viewpoint: rest coordinates need no lines of sight
        code = self.decoder.prepare(self.encoder(cloud[:, : self.points]), cloud, unused)
        places = seen if queries is None else torch.cat([seen, queries], dim=1)
        rest, _ = self.decoder.features(code, places)
        alignment = fit_rigid(seen, rest[:, : seen.shape[1]].detach())
        return Aligned(alignment, rest[:, seen.shape[1] :])
