"""Point Transformer: its attention against the paper's equation, and what the encoder must ignore."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mereo.models.config import NetworkConfig
from mereo.models.encoders import PointTransformer, VectorAttention
from mereo.models.neighbors import nearest
from mereo.models.network import Network
from mereo_learning.config import PRESETS

TINY = NetworkConfig().changed(
    encoder="point-transformer",
    points=128,
    transformer_widths=(8, 12, 16, 20, 24),
    transformer_neighbors=6,
    mlp_global=(40,),
)


def cloud_of(points: int = TINY.points, batch: int = 2, seed: int = 0) -> Tensor:
    return F.normalize(torch.randn(batch, points, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def settled(config: NetworkConfig = TINY) -> PointTransformer:
    """In evaluation mode, with batch statistics that are not the trivial initial ones."""
    torch.manual_seed(1)
    encoder = PointTransformer(config.transformer, config.latent).train()
    encoder(cloud_of(config.points, batch=4))
    return encoder.eval()


def attended(layer: VectorAttention, p: Tensor, x: Tensor, neighbors: list[int], i: int) -> Tensor:
    """Equation 3 of Zhao et al. for one point, term by term."""

    def two_layers(mlp: torch.nn.Sequential, v: Tensor) -> Tensor:
        hidden = torch.clamp(mlp[0].weight @ v + mlp[0].bias, min=0)
        out = mlp[2].weight @ hidden
        return out if mlp[2].bias is None else out + mlp[2].bias

    exponents, values = [], []
    for j in neighbors:
        delta = two_layers(layer.theta, p[i] - p[j])
        relation = layer.phi.weight @ x[i] - layer.psi.weight @ x[j] + delta
        exponents.append(two_layers(layer.gamma, relation).exp())
        values.append(layer.alpha.weight @ x[j] + delta)
    total = sum(exponents[1:], exponents[0])
    return sum((e / total * v for e, v in zip(exponents, values, strict=True)), torch.zeros_like(values[0]))


def test_vector_attention_is_equation_3() -> None:
    torch.manual_seed(0)
    layer = VectorAttention(6)
    points, features = torch.randn(2, 10, 3), torch.randn(2, 10, 6)
    index = nearest(points, points, 4)
    with torch.no_grad():
        fast = layer(points, features, index)
        for b in range(2):
            slow = [attended(layer, points[b], features[b], index[b, i].tolist(), i) for i in range(10)]
            assert torch.allclose(fast[b], torch.stack(slow), atol=1e-5)


def test_encoder_ignores_which_points_fill_up_a_cloud_and_the_order_of_what_is_not_kept() -> None:
    """The first quarter are the points of the second level; the rest is a set."""
    encoder, cloud = settled(), cloud_of()
    front, again = cloud[:, :80], torch.randperm(80, generator=torch.Generator().manual_seed(2))[:48]
    with torch.inference_mode():
        one = encoder(torch.cat([front, front[:, :48]], dim=1)).latent
        other = encoder(torch.cat([front, front[:, again]], dim=1)).latent
        assert torch.allclose(one, other, atol=1e-5)
    first = TINY.points // 4
    order = torch.randperm(TINY.points - first, generator=torch.Generator().manual_seed(2))
    shuffled = torch.cat([cloud[:, :first], cloud[:, first:][:, order]], dim=1)
    with torch.inference_mode():
        assert torch.allclose(encoder(cloud).latent, encoder(shuffled).latent, atol=1e-5)
        assert not torch.allclose(encoder(cloud).latent, encoder(cloud.flip(2)).latent, atol=1e-3)


def test_paper_sizes() -> None:
    """Five blocks and 1024 numbers; with local features, as many centres and channels as the levels of `base`."""
    network = Network(PRESETS["paper"].network.changed(encoder="point-transformer"), 5)
    assert isinstance(network.encoder, PointTransformer)
    assert [block.leave.in_features for block in network.encoder.blocks] == [32, 64, 128, 256, 512]
    assert network.decoder.latent1.in_features == 1024
    base = PRESETS["base"].network
    cloud = cloud_of(base.points)
    networks = [
        Network(base.changed(encoder=name, align_points=0), 2).eval() for name in ("pointnet2", "point-transformer")
    ]
    with torch.inference_mode():
        ours, theirs = ([level.features.shape for level in each.encoder(cloud).levels] for each in networks)
    assert ours == theirs
    with pytest.raises(ValueError, match=r"transformer_widths are \(8, 16\); a Point Transformer needs at least three"):
        Network(TINY.changed(transformer_widths=(8, 16)), 2)
