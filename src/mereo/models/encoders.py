"""Encodings, what every encoder gives, and the layer that all of them are made of.

Notation: b clouds, n points, m of them at a coarser level, k neighbours, e training examples, c and z channels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.geometry.conventions import WholeNumbers
from mereo.models.config import AutodecoderConfig, PointNet2Config, PointTransformerConfig
from mereo.models.device import exact
from mereo.models.neighbors import CloudBatch, NeighborIndices, ball_query, distinct_distances, gather

Latents = Float[Tensor, "b z"]
"""Latent code of each example of a batch."""

Features = Float[Tensor, "b n c"]
"""Features of each point."""


@dataclass(frozen=True, eq=False)
class Level:
    """Points of a coarser level (a prefix of the cloud) with their features."""

    centers: Float[Tensor, "b m 3"]
    features: Float[Tensor, "b m c"]


@dataclass(frozen=True, eq=False)
class Encoding:
    """Knowledge of an encoder about a cloud: the paper's latent vector, and levels on the way for local features."""

    latent: Latents
    levels: tuple[Level, ...]


def share(count: int, ratio: float) -> int:
    """Share of a count, ``max(1, int(count * ratio))``, also of the sizes that an exported graph leaves open."""
    return torch.sym_max(1, torch.sym_int(count * ratio))


class SharedMLP(nn.Module):
    """Layers of linear map, batch normalization and ReLU, shared by all rows."""

    def __init__(self, widths: WholeNumbers) -> None:
        super().__init__()
        layers = list[nn.Module]()
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


# --- PointNet++ -------------------------------------------------------------------------------------------------------

# PointNet++ (Qi et al., NeurIPS 2017) as the paper uses it: two set abstractions and a global max pool.


class SetAbstraction(nn.Module):
    """Small PointNet on the ball around each centre: ``max_j mlp([f_j, p_j - p_i])`` (PointNet++, section 3.2)."""

    def __init__(self, channels: int, radius: float, neighbors: int, widths: WholeNumbers) -> None:
        super().__init__()
        self.radius, self.neighbors = radius, neighbors
        self.mlp = SharedMLP((channels + 3, *widths))

    def forward(self, points: CloudBatch, features: Features | None, count: int) -> Level:
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

    def forward(self, cloud: CloudBatch) -> Encoding:
        """Encoding of each cloud."""
        count1 = share(cloud.shape[1], self.ratio1)
        count2 = share(count1, self.ratio2)
        level1 = self.level1(cloud, None, count1)
        level2 = self.level2(level1.centers, level1.features, count2)
        latent = self.pool(torch.cat([level2.features, level2.centers], dim=-1)).amax(dim=1)
        return Encoding(latent, (level1, level2))


# --- Point Transformer ------------------------------------------------------------------------------------------------

# Point Transformer (Zhao et al., ICCV 2021): five blocks of vector self-attention among nearest neighbours.
#
# "The PointTransformer contains 5 transformer blocks" is all that the paper says of it (Henrich et al., appendix B);
# what it leaves open is taken from Zhao et al. and listed in docs/design/0009-encoders.md.

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

    def forward(self, points: CloudBatch, features: Features, index: Int[Tensor, "b n k"]) -> Features:
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

    def forward(self, points: CloudBatch, features: Features, index: Int[Tensor, "b n k"]) -> Features:
        """Features after the block; ``index`` are each point's neighbours."""
        hidden = self.attention(points, self.enter(features), index).flatten(0, 1)
        change = self.left(self.leave(torch.relu(self.attended(hidden))))
        return torch.relu(features + change.unflatten(0, features.shape[:2]))


class TransitionDown(nn.Module):
    """Step to fewer points: a linear layer at each, then at each kept one the largest of its neighbours (figure 4b)."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.mlp = SharedMLP((before, after))

    def forward(self, features: Float[Tensor, "b n i"], index: NeighborIndices) -> Float[Tensor, "b m o"]:
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

    def forward(self, cloud: CloudBatch) -> Encoding:
        """Encoding of each cloud."""
        distances = distinct_distances(cloud)
        count = cloud.shape[1]
        features = self.blocks[0](cloud, self.enter(cloud), _smallest(distances, max(1, self.neighbors // 2)))
        levels = list[Level]()
        for down, block in zip(self.down, self.blocks[1:], strict=True):
            before = count
            count = torch.sym_max(1, count // STRIDE)
            features = down(features, _smallest(distances[:, :count, :before], self.neighbors))
            features = block(cloud[:, :count], features, _smallest(distances[:, :count, :count], self.neighbors))
            levels.append(Level(cloud[:, :count], features))
        latent = self.pool(features).mean(dim=1)  # global average pooling, as Zhao et al. classify
        return Encoding(latent, tuple(levels[:2]))


def _smallest(distances: Float[Tensor, "b m n"], count: int) -> NeighborIndices:
    return distances.topk(torch.sym_min(count, distances.shape[2]), dim=2, largest=False).indices


# --- autodecoder ------------------------------------------------------------------------------------------------------

# Autodecoder of DeepSDF (Park et al., CVPR 2019), extended to segments by the decoder behind it.
#
# There is no encoder network. Each training example has a code of its own, trained like the weights. The code of a new
# cloud is searched for: "the input point cloud is reinterpreted as the locus of points where the signed distance should
# be zero" (Henrich et al., appendix B). Segments follow from a code that explains the distances.

CODES = "encoder.codes"
"""Name of the training examples' codes among a network's parameters."""


class Autodecoder(nn.Module):
    """Codes of the training examples, and the search for the code of a new cloud.

    Attributes:
        codes: of the training examples; None in a network that is only used.
        mean: their mean, from which a search starts.
        axes: their principal axes, each as long as their standard deviation along it; None where the search does not
            use them.
    """

    def __init__(self, config: AutodecoderConfig, latent: int) -> None:
        super().__init__()
        self.steps, self.rate, self.penalty = config.search_steps, config.search_rate, config.code_penalty
        self.codes: nn.Parameter | None
        self.register_parameter("codes", None)
        self.mean: Tensor
        self.register_buffer("mean", torch.zeros(latent))
        self.spread_penalty = config.spread_penalty
        self.axes: Tensor | None
        self.register_buffer("axes", torch.zeros(latent, latent) if config.spread_penalty else None)

    def add_codes(self, examples: int, length: float) -> None:
        """Make random codes for training, about ``length`` away from the mean (which is zero in a new network)."""
        width = len(self.mean)
        self.codes = nn.Parameter(self.mean + length * torch.randn(examples, width) / math.sqrt(width))

    @torch.no_grad()
    def update_distribution(self) -> None:
        """Take mean and axes of the codes as they are now."""
        if self.codes is None:
            return
        self.mean.copy_(self.codes.mean(dim=0))
        if self.axes is not None:
            centered = (self.codes - self.mean).double()
            variance, axes = torch.linalg.eigh(centered.T @ centered / len(centered))
            self.axes.copy_((variance.clamp(min=0).sqrt() * axes).T)

    def code(self, index: Int[Tensor, " b"]) -> Latents:
        """Trained codes of training examples."""
        assert self.codes is not None, "weights hold no codes of training examples"
        return nn.functional.embedding(index, self.codes)

    def length_penalty(self, code: Latents) -> Float[Tensor, " b"]:
        """Gaussian prior on codes, relative to a mean distance (DeepSDF, equations 9 and 10)."""
        return self.penalty * code.square().sum(dim=1)

    def search(self, distance: Callable[[Latents], Float[Tensor, "b n"]], clouds: int) -> Latents:
        """Codes under which the observed points are nearest to a surface.

        ``distance`` answers with the signed distance at each cloud's observed points. Deterministic, and the clouds of
        a batch do not influence each other. Gradients are taken for the codes only, whatever the caller's mode.
        """
        start = self.mean if self.axes is None else torch.zeros_like(self.mean)
        place = start.repeat(clouds, 1).requires_grad_()  # codes, or standard deviations from the mean along each axis
        optimizer = torch.optim.Adam([place], lr=self.rate)
        for _ in range(self.steps):
            with torch.enable_grad():
                spread = self.spread_penalty * place.square().sum(dim=1)
                prior = self.length_penalty(place) if self.axes is None else spread
                error = distance(self._code_at(place)).abs().mean(dim=1) + prior
                (place.grad,) = torch.autograd.grad(error.sum(), place)
            optimizer.step()
        return self._code_at(place).detach()

    def _code_at(self, place: Latents) -> Latents:
        return place if self.axes is None else self.mean + place @ self.axes
