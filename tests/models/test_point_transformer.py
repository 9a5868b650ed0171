"""Point Transformer: its attention against the paper's equation, and what the encoder must ignore."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mereo.models.config import NetworkConfig
from mereo.models.encoders import PointTransformer, TransitionDown, VectorAttention
from mereo.models.neighbors import distinct_distances, nearest
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


def test_attention_sees_relative_places_only() -> None:
    layer = VectorAttention(6)
    points, features = torch.randn(2, 10, 3), torch.randn(2, 10, 6)
    index = nearest(points, points, 4)
    with torch.no_grad():
        here, there = layer(points, features, index), layer(points + 3.0, features, index)
        assert torch.allclose(here, there, atol=1e-4)
        assert not torch.allclose(here, layer(2 * points, features, index), atol=1e-2)


def test_transition_down_takes_the_largest_of_each_neighbourhood() -> None:
    torch.manual_seed(0)
    down = TransitionDown(5, 7).eval()
    features, points = torch.randn(2, 20, 5), torch.randn(2, 20, 3)
    index = nearest(points[:, :5], points, 4)
    with torch.no_grad():
        found = down(features, index)
        for b, m in ((0, 0), (1, 4)):
            each = torch.stack([down.mlp(features[b, j]) for j in index[b, m].tolist()])
            assert torch.allclose(found[b, m], each.amax(dim=0), atol=1e-6)


def test_repeated_points_are_nobodys_neighbours() -> None:
    """Against a slow reference: the nearest of the points that do not repeat an earlier one."""
    cloud = cloud_of(12)
    cloud = torch.cat([cloud, cloud[:, [3, 0, 7, 3]]], dim=1)
    index = distinct_distances(cloud).topk(5, dim=2, largest=False).indices
    for b in range(2):
        for i in range(16):
            reach = (cloud[b, :12] - cloud[b, i]).square().sum(dim=1)
            assert index[b, i].tolist() == reach.argsort()[:5].tolist()


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


def test_its_levels_are_prefixes_of_the_cloud() -> None:
    encoding, cloud = settled()(cloud_of()), cloud_of()
    assert [level.features.shape for level in encoding.levels] == [(2, 32, 12), (2, 8, 16)]
    for level in encoding.levels:
        assert torch.equal(level.centers, cloud[:, : level.centers.shape[1]])


def test_gradient_reaches_every_parameter() -> None:
    """With two points or more in the last block: one alone has nothing to weigh.

    But for the bias of scores, of which a softmax takes nothing: its gradient is rounding, of any size.
    """
    torch.manual_seed(0)
    network = Network(TINY.changed(points=512, width=24, local_neighbors=3, local_width=8), segments=3).train()
    prediction, coarse = network(cloud_of(512, batch=4), torch.tensor([[0.0, 0.0, -8.0]] * 4), torch.randn(4, 30, 3))
    sum(output.square().sum() for output in (*prediction, coarse) if output is not None).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 1e-7 or name.endswith("score.bias"), name


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
