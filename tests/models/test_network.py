"""The networks: what they must ignore, what they must share, the paper's equations and sizes, the template."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from shapes import one
from torch import Tensor, nn
from torch.testing import assert_close
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.models.config import Loss, NetworkConfig, Supervision
from mereo.models.decoder import FrequencyEncoding, Prediction, RestLookup
from mereo.models.encoders import PointTransformer, VectorAttention
from mereo.models.model import fold_batch_norm
from mereo.models.neighbors import nearest
from mereo.models.network import Network
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH, rest_distances
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import synthesize
from mereo_learning.config import PRESETS
from mereo_learning.dataset import Dataset
from mereo_learning.losses import occupancy_loss

TINY = PRESETS["tiny"].network
FOLDED = TINY.changed(points=64)


def cloud_of(config: NetworkConfig, batch: int = 2, seed: int = 0) -> Tensor:
    points = torch.randn(batch, config.points, 3, generator=torch.Generator().manual_seed(seed))
    return F.normalize(points, dim=-1)


def viewpoint_of(batch: int = 2) -> Tensor:
    return torch.tensor([[0.2, -0.1, -8.0]]).repeat(batch, 1)


def settled(config: NetworkConfig, segments: int = 3) -> Network:
    """A network whose batch statistics are not the trivial initial ones."""
    torch.manual_seed(3)
    network = Network(config, segments)
    network.train()
    network(cloud_of(config), viewpoint_of(), torch.randn(2, 40, 3))
    return network.eval()


@pytest.mark.parametrize("name", ["paper", "base", "tiny", "large"])
def test_every_preset_answers_with_its_shapes(name: str) -> None:
    network = settled(PRESETS[name].network, segments=5)
    with torch.inference_mode():
        prediction, coarse = network(cloud_of(network.config), viewpoint_of(), torch.randn(2, 11, 3))
    assert prediction.logits.shape == (2, 11, 6) and prediction.distance.shape == (2, 11)
    assert prediction.direction.shape == (2, 11, 3)
    for found in (prediction.rest, coarse):
        assert found is None if name == "paper" else found is not None and found.shape == (2, 11, 3)


def test_paper_preset_has_the_papers_sizes() -> None:
    config = PRESETS["paper"].network
    network = Network(config, 5)
    assert config.latent == 1024
    assert network.decoder.encode.channels == 60
    assert [layer.in_features for layer in network.decoder.hidden] == [512] * 6
    assert len(network.decoder.norms) == 7
    assert network.decoder.latent2.in_features == 1024 and network.decoder.query2.in_features == 60
    assert Network(TINY.changed(encode_positions=False), 5).decoder.query1.in_features == 3  # the paper's ablation
    assert not network.decoder.local and config.additions.sight_neighbors == 0 and network.aligner is None


def test_what_all_clouds_have_in_common_is_not_rounded_to_bfloat16() -> None:
    """Normalization takes a channel's mean away, however large: in bfloat16 it would first erase what differs."""
    torch.manual_seed(0)
    network = Network(TINY.changed(align_points=0, rest_template=False), 3).train()
    encoder, decoder = network.encoder, network.decoder
    with torch.no_grad():  # the first pooled channel is 4 everywhere, and whoever reads it adds 400
        for shared in (encoder.level1.mlp, encoder.level2.mlp, encoder.pool):
            *_, norm, _ = shared.layers
            norm.weight[0], norm.bias[0] = 0.0, 4.0
        attentions = [attention.project for attention in decoder.local]
        for reader in (encoder.level2.mlp.layers[0], encoder.pool.layers[0], decoder.latent1, *attentions):
            reader.weight[:, 0] = 100.0
    inputs = cloud_of(network.config, batch=8), viewpoint_of(8), torch.randn(8, 40, 3)
    exact = network(*inputs).prediction.logits
    with torch.autocast("cpu", torch.bfloat16):
        rounded = network(*inputs).prediction.logits
    assert (rounded - exact).std() < 0.1 * exact.std()


def test_split_latent_layer_equals_concatenation() -> None:
    """W [z; x] = W_z z + W_x x: the paper's concatenated query vector, without building it."""
    network = settled(TINY.changed(local_neighbors=0, sight_neighbors=0, align_points=0))
    decoder = network.decoder
    cloud = cloud_of(TINY)
    points = torch.randn(2, 9, 3)
    with torch.inference_mode():
        latent = network.encoder(cloud).latent
        vector = torch.cat([latent[:, None].expand(-1, 9, -1), decoder.encode(points)], dim=-1)
        first = torch.cat([decoder.latent1.weight, decoder.query1.weight], dim=1)
        skip = torch.cat([decoder.latent2.weight, decoder.query2.weight], dim=1)
        hidden = vector @ first.T
        for number, norm in enumerate(decoder.norms):
            if number > 0:
                hidden = hidden @ decoder.hidden[number - 1].weight.T
            if number == 4:  # after four layers
                hidden = hidden + vector @ skip.T
            hidden = torch.relu(norm(hidden.flatten(0, 1))).view_as(hidden)
        expected = decoder.head(hidden)[..., :4]
        logits = network(cloud, viewpoint_of(), points).prediction.logits
    assert torch.allclose(logits, expected, atol=1e-4)


def test_frequency_encoding_is_the_papers() -> None:
    encode = FrequencyEncoding(-4, 5)
    x = torch.tensor([[[0.07, -0.4, 1.3]]])
    expected = torch.cat(
        [torch.stack([f(2.0**e * torch.pi * c) for c in x[0, 0] for e in range(-4, 6)]) for f in (torch.sin, torch.cos)]
    )
    assert torch.allclose(encode(x)[0, 0], expected, atol=1e-5)


def test_dropout_clears_its_share_and_only_in_training() -> None:
    plain = NetworkConfig().changed(points=64, width=512, depth=1, skip_after=1, mlp_global=(8,))
    networks = [settled(plain.changed(dropout=share)) for share in (0.0, 0.2)]
    networks[1].load_state_dict(networks[0].state_dict())
    queries = torch.randn(2, 40, 3)
    seen = []
    for network in networks:
        network.decoder.head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].detach()))
        for is_training in (False, True):
            network.decoder.train(is_training)
            network(cloud_of(plain), viewpoint_of(), queries)
    in_use, whole, in_use_too, thinned = seen
    assert torch.equal(in_use, in_use_too)
    kept = thinned > 0
    assert torch.allclose(thinned[kept], whole[kept] / 0.8)
    assert kept.sum() / (whole > 0).sum() == pytest.approx(0.8, abs=0.02)


def example_prediction() -> tuple[Prediction, Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    prediction = Prediction(torch.randn(2, 5, 4), torch.randn(2, 5), torch.randn(2, 5, 3))
    return prediction, torch.randint(0, 4, (2, 5)), torch.randn(2, 5), F.normalize(torch.randn(2, 5, 3), dim=-1)


def test_each_term_is_the_papers_and_variants_add_up() -> None:
    """Against the formulas of equation 1, written out."""
    prediction, *truth = example_prediction()
    labels, distances, directions = truth
    full, terms = occupancy_loss(prediction, *truth, Supervision.of("ce+l1+cd"), 100.0)
    probability = prediction.logits.exp() / prediction.logits.exp().sum(dim=-1, keepdim=True)
    assert torch.isclose(terms["ce"], -probability.gather(-1, labels[..., None]).log().mean())
    assert torch.isclose(terms["l1"], (prediction.distance - distances).abs().mean())
    cosine = (prediction.direction * directions).sum(dim=-1) / prediction.direction.norm(dim=-1)
    assert torch.isclose(terms["cd"], -cosine.mean())
    assert torch.isclose(full, terms["ce"] + 100.0 * terms["l1"] + terms["cd"])
    for loss, names in (("ce", {"ce"}), ("l1", {"l1"}), ("ce+l1", {"ce", "l1"})):
        _, part = occupancy_loss(prediction, *truth, Supervision.of(loss), 100.0)
        assert set(part) == names and all(torch.isclose(part[name], terms[name]) for name in names)


@pytest.mark.parametrize("loss, rows", [("ce", [0, 1, 2, 3]), ("l1", [4]), ("ce+l1", [0, 1, 2, 3, 4])])
def test_a_loss_trains_its_own_heads_only(loss: Loss, rows: list[int]) -> None:
    network = settled(TINY.changed(align_points=0), segments=3).train()
    prediction, _ = network(cloud_of(TINY), viewpoint_of(), torch.randn(2, 5, 3))
    _, *truth = example_prediction()
    occupancy_loss(prediction, *truth, Supervision.of(loss), 100.0)[0].backward()
    assert network.decoder.head.weight.grad.abs().amax(dim=1).nonzero().flatten().tolist() == rows


def lived_in(config: NetworkConfig) -> Network:
    torch.manual_seed(0)
    network = Network(config, 3)
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm1d):
            nn.init.normal_(norm.running_mean)  # type: ignore[arg-type]
            nn.init.uniform_(norm.running_var, 0.5, 2.0)  # type: ignore[arg-type]
            nn.init.uniform_(norm.weight, 0.5, 2.0)
            nn.init.normal_(norm.bias)
    return network.eval()


@pytest.mark.parametrize(
    "config",
    [
        FOLDED,
        FOLDED.changed(align_points=0, rest_template=False, local_neighbors=0, sight_neighbors=0),
        FOLDED.changed(align_points=0, rest_template=False, encode_positions=False),
        FOLDED.changed(encoder="point-transformer", transformer_widths=(8, 16, 32), points=128),
    ],
    ids=["everything", "the paper's", "plain positions", "point transformer"],
)
def test_a_folded_network_answers_the_same(config: NetworkConfig) -> None:
    network = lived_in(config)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    folded = fold_batch_norm(network)
    cloud, queries = torch.randn(2, config.points, 3), torch.randn(2, 50, 3)
    cloud[..., 2] += 4.0
    queries[..., 2] += 4.0
    eye = torch.zeros(2, 3)
    with torch.inference_mode():
        expected, found = (each.query(each.encode(cloud, eye), queries) for each in (network, folded))
    for name in ("logits", "distance"):
        assert_close(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-4)
    assert expected.logits.std() > 1e-2
    # the original stays as it was: it can still be saved
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    norms, left = (sum(isinstance(m, nn.BatchNorm1d) for m in each.modules()) for each in (network, folded))
    assert left < norms / 2
    with pytest.raises(ValueError, match="training mode"):
        fold_batch_norm(network.train())


# --- Point Transformer ------------------------------------------------------------------------------------------------


TRANSFORMER = NetworkConfig().changed(
    encoder="point-transformer",
    points=128,
    transformer_widths=(8, 12, 16, 20, 24),
    transformer_neighbors=6,
    mlp_global=(40,),
)


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
    encoder = settled(TRANSFORMER).encoder
    cloud = cloud_of(TRANSFORMER)
    front, again = cloud[:, :80], torch.randperm(80, generator=torch.Generator().manual_seed(2))[:48]
    first = TRANSFORMER.points // 4
    order = torch.randperm(TRANSFORMER.points - first, generator=torch.Generator().manual_seed(2))
    shuffled = torch.cat([cloud[:, :first], cloud[:, first:][:, order]], dim=1)
    filled, otherwise = (torch.cat([front, front[:, rows]], dim=1) for rows in (slice(48), again))
    with torch.inference_mode():
        assert torch.allclose(encoder(filled).latent, encoder(otherwise).latent, atol=1e-5)
        assert torch.allclose(encoder(cloud).latent, encoder(shuffled).latent, atol=1e-5)
        assert not torch.allclose(encoder(cloud).latent, encoder(cloud.flip(2)).latent, atol=1e-3)


def test_paper_sizes() -> None:
    """Five blocks and 1024 numbers; with local features, as many centres and channels as the levels of `base`."""
    network = Network(PRESETS["paper"].network.changed(encoder="point-transformer"), 5)
    assert isinstance(network.encoder, PointTransformer)
    assert [block.leave.in_features for block in network.encoder.blocks] == [32, 64, 128, 256, 512]
    assert network.decoder.latent1.in_features == 1024
    base = PRESETS["base"].network
    cloud = cloud_of(base)
    with torch.inference_mode():
        ours, theirs = (
            [level.features.shape for level in Network(base.changed(encoder=name), 2).eval().encoder(cloud).levels]
            for name in ("pointnet2", "point-transformer")
        )
    assert ours == theirs
    with pytest.raises(ValueError, match=r"transformer_widths are \(8, 16\); a Point Transformer needs at least three"):
        Network(TRANSFORMER.changed(transformer_widths=(8, 16)), 2)


# --- the template -----------------------------------------------------------------------------------------------------


AXIS = torch.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
SPACING = 2 * TEMPLATE_REACH / (TEMPLATE_NODES - 1)


def lookup_of(*fields: Tensor) -> RestLookup:
    lookup = RestLookup(8, len(fields))
    lookup.distance.copy_(torch.stack(fields))
    return lookup


def random_rest(batch: int, queries: int, reach: float = 1.0) -> Tensor:
    return (torch.rand(batch, queries, 3, generator=torch.Generator().manual_seed(4)) * 2 - 1) * reach


def test_linear_fields_are_read_exactly_and_along_the_right_axes() -> None:
    x, y, z = torch.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
    rest = random_rest(3, 50)
    assert torch.allclose(lookup_of(x, y, z).distances(rest), rest, atol=1e-5)


def test_grid_of_a_ball_is_its_signed_distance() -> None:
    """A ball fills the rest box: its radius is the unit of length."""
    ball = toy_scene().rest.segments[3]
    grid = rest_distances(one(ball)).astype(float)
    nodes = np.stack(np.meshgrid(*(AXIS.numpy(),) * 3, indexing="ij"), axis=-1)
    assert np.abs(grid[0] - (np.linalg.norm(nodes, axis=-1) - 1)).max() < 0.02  # the ball is a polyhedron


def test_true_rest_coordinates_find_the_right_segment() -> None:
    scene = toy_scene()
    lookup = lookup_of(*torch.from_numpy(rest_distances(scene.rest)).float())
    queries = synthesize(scene, GenerateConfig(image_size=48), example_rng(3, 0)).queries
    inside = np.flatnonzero(queries.labels)
    found = lookup.distances(torch.from_numpy(queries.rest[inside]).float()[None])[0]
    labels = torch.from_numpy(queries.labels[inside].astype(np.int64)) - 1
    own = found[torch.arange(len(inside)), labels]
    assert (own < SPACING / 2).all()  # trilinear reading rounds edges off by less than this
    clear = -own > SPACING / 2
    assert clear.float().mean() > 0.6 and torch.equal(found.argmin(dim=1)[clear], labels[clear])


def test_a_new_lookup_changes_no_answer() -> None:
    torch.manual_seed(0)
    plain, added = (Network(TINY.changed(rest_template=on), segments=3).eval() for on in (False, True))
    added.load_state_dict(added.state_dict() | plain.state_dict())
    cloud, queries = random_rest(2, TINY.points), random_rest(2, 9)
    with torch.inference_mode():
        before, after = (network(cloud, viewpoint_of(), queries).prediction for network in (plain, added))
    for answer, same in zip(after[:3], before[:3], strict=True):
        assert_close(answer, same)  # products of other widths may be added in another order
    assert before.rest is None and after.rest.shape == queries.shape


def test_what_is_read_corrects_the_coordinates() -> None:
    """The gradient of the answer reaches the predicted coordinates: towards less distance is towards the segment."""
    x, y, z = torch.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
    lookup = lookup_of((x.square() + y.square() + z.square()).sqrt() - 0.1)
    torch.nn.init.constant_(lookup.read.weight, 1.0)
    rest, seen = lookup(torch.zeros(1, 20, 8), random_rest(1, 20, reach=0.5))
    (slope,) = torch.autograd.grad(seen.sum(), rest)
    assert (torch.nn.functional.cosine_similarity(slope, rest, dim=-1) > 0.9).all()


@pytest.mark.slow
def test_a_missing_template_is_made_on_resume(tmp_path: Path) -> None:
    scene = toy_scene()
    settings = GenerateConfig(image_size=48, points=64, sampling=SamplingConfig(per_segment=8))
    for resume in (False, True):
        generate(scene, tmp_path / "data", settings, examples=2, seed=3, resume=resume)
        template = Dataset.load(tmp_path / "data").template
        assert template is not None and np.array_equal(template.numpy(), rest_distances(scene.rest).astype(np.float32))
        (tmp_path / "data" / "template.safetensors").unlink()
    with pytest.raises(ValueError, match=r"template.safetensors cannot be read .*run mereo generate ... --resume"):
        Dataset.load(tmp_path / "data")
