"""PointNet++ (Qi et al., NeurIPS 2017) as the paper uses it: two set abstractions and a global max pool.

Notation: b clouds, n points, m centres, k neighbours, c channels.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.config import PointNet2Config
from mereo.models.encoders.encoding import Encoding, Level, SharedMLP, share
from mereo.models.ops.neighbors import ball_query, gather


class SetAbstraction(nn.Module):
    """Small PointNet on the ball around each centre: ``max_j mlp([f_j, p_j - p_i])`` (PointNet++, section 3.2)."""

    def __init__(self, channels: int, radius: float, neighbors: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.radius, self.neighbors = radius, neighbors
        self.mlp = SharedMLP((channels + 3, *widths))

    def forward(self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"] | None, count: int) -> Level:
        """Level of the first ``count`` points, with features of the balls around them."""
        centers = points[:, :count]
        index = ball_query(centers, points, self.radius, self.neighbors)
        rows = gather(points, index) - centers[:, :, None]
        if features is not None:
            rows = torch.cat([gather(features, index), rows], dim=-1)
        return Level(centers, self.mlp(rows).amax(dim=2))


class PointNet2(nn.Module):
    """Encoder from a cloud in farthest-point order to a latent vector and two levels of local features."""

    def __init__(self, config: PointNet2Config) -> None:
        super().__init__()
        self.ratio1, self.ratio2 = config.ratio1, config.ratio2
        self.level1 = SetAbstraction(0, config.radius1, config.neighbors, config.mlp1)
        self.level2 = SetAbstraction(config.mlp1[-1], config.radius2, config.neighbors, config.mlp2)
        self.pool = SharedMLP((config.mlp2[-1] + 3, *config.mlp_global))

    def forward(self, cloud: Float[Tensor, "b n 3"]) -> Encoding:
        """Encoding of each cloud."""
        count1 = share(cloud.shape[1], self.ratio1)
        count2 = share(count1, self.ratio2)
        level1 = self.level1(cloud, None, count1)
        level2 = self.level2(level1.centers, level1.features, count2)
        latent = self.pool(torch.cat([level2.features, level2.centers], dim=-1)).amax(dim=1)
        return Encoding(latent, (level1, level2))
