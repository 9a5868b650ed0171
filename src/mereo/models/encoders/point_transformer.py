"""Point Transformer (Zhao et al., ICCV 2021): five blocks of vector self-attention among nearest neighbours.

"The PointTransformer contains 5 transformer blocks" is all that the paper says of it (Henrich et al., appendix B); what
it leaves open is taken from Zhao et al. and listed in docs/design/0009-encoders.md.

Notation: b clouds, n points, m of them kept at a coarser level, k neighbours, c channels.
"""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.models.config import PointTransformerConfig
from mereo.models.encoders.encoding import Encoding, Level, SharedMLP
from mereo.models.ops.neighbors import distinct_distances, gather

STRIDE = 4
"""From one block to the next a quarter of the points stay."""


class VectorAttention(nn.Module):
    """Attention among neighbours with a weight for each channel (Zhao et al., equation 3).

    ``y_i = sum_j softmax_j(gamma(phi x_i - psi x_j + d_ij)) * (alpha x_j + d_ij)``.

    j runs over the neighbours of i, the softmax is taken in each channel, and ``d_ij = theta(p_i - p_j)`` is the
    relative positional encoding (equation 4). Gamma and theta are two linear layers with a ReLU between them.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        # d_ij carries a bias already, and batch normalization removes that of alpha
        self.phi = nn.Linear(width, width, bias=False)
        self.psi = nn.Linear(width, width, bias=False)
        self.alpha = nn.Linear(width, width, bias=False)
        self.theta = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, width))
        # the softmax removes what is added to all neighbours
        self.gamma = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width, bias=False))

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "b n c"]:
        """Attended features at each point; ``index`` are each point's neighbours."""
        place = self.theta(points[:, :, None] - gather(points, index))
        relation = self.phi(features)[:, :, None] - gather(self.psi(features), index) + place
        weight = self.gamma(relation).softmax(dim=2)
        return (weight * (gather(self.alpha(features), index) + place)).sum(dim=2)


class TransformerBlock(nn.Module):
    """Block of vector attention between two linear layers, around a residual connection (Zhao et al., figure 4a)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.enter = SharedMLP((width, width))
        self.attention = VectorAttention(width)
        self.attended = nn.BatchNorm1d(width)
        self.leave = nn.Linear(width, width, bias=False)
        self.left = nn.BatchNorm1d(width)

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"], index: Int[Tensor, "b n k"]
    ) -> Float[Tensor, "b n c"]:
        """Features after the block; ``index`` are each point's neighbours."""
        hidden = self.attention(points, self.enter(features), index).flatten(0, 1)
        change = self.left(self.leave(torch.relu(self.attended(hidden))))
        return torch.relu(features + change.unflatten(0, features.shape[:2]))


class TransitionDown(nn.Module):
    """Step to fewer points: a linear layer at each, then at each kept one the largest of its neighbours (figure 4b)."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.mlp = SharedMLP((before, after))

    def forward(self, features: Float[Tensor, "b n i"], index: Int[Tensor, "b m k"]) -> Float[Tensor, "b m o"]:
        """Features at the kept points; ``index`` are their neighbours among all."""
        return gather(self.mlp(features), index).amax(dim=2)


class PointTransformer(nn.Module):
    """Encoder from a cloud in farthest-point order to a latent vector; levels two and three serve as local features.

    The points of a level are a prefix of those before, so one matrix of distances serves all levels.
    """

    def __init__(self, config: PointTransformerConfig, latent: int) -> None:
        super().__init__()
        widths = config.transformer_widths
        self.neighbors = config.transformer_neighbors
        self.enter = SharedMLP((3, widths[0]))
        self.down = nn.ModuleList(TransitionDown(*pair) for pair in pairwise(widths))
        self.blocks = nn.ModuleList(TransformerBlock(width) for width in widths)
        self.pool = SharedMLP((widths[-1], latent))

    def forward(self, cloud: Float[Tensor, "b n 3"]) -> Encoding:
        """Encoding of each cloud."""
        distances = distinct_distances(cloud)
        count = cloud.shape[1]
        features = self.blocks[0](cloud, self.enter(cloud), _smallest(distances, max(1, self.neighbors // 2)))
        levels: list[Level] = []
        for down, block in zip(self.down, self.blocks[1:], strict=True):
            before, count = count, torch.sym_max(1, count // STRIDE)
            features = down(features, _smallest(distances[:, :count, :before], self.neighbors))
            features = block(cloud[:, :count], features, _smallest(distances[:, :count, :count], self.neighbors))
            levels.append(Level(cloud[:, :count], features))
        latent = self.pool(features).mean(dim=1)  # global average pooling, as Zhao et al. classify
        return Encoding(latent, tuple(levels[:2]))


def _smallest(distances: Float[Tensor, "b m n"], count: int) -> Int[Tensor, "b m k"]:
    return distances.topk(torch.sym_min(count, distances.shape[2]), dim=2, largest=False).indices
