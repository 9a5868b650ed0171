"""Folding changes the arithmetic, not the answers."""

import pytest
import torch
from torch import nn

from mereo.models.config import NetworkConfig
from mereo.models.model import fold_batch_norm
from mereo.models.network import Network
from mereo.training.config import PRESETS

SMALL = PRESETS["tiny"].network.changed(points=64)


def lived_in(config: NetworkConfig) -> Network:
    """A network whose normalization has statistics of its own, as after training."""
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
        SMALL,
        SMALL.changed(align_points=0, rest_template=False, local_neighbors=0, sight_neighbors=0),
        SMALL.changed(align_points=0, rest_template=False, encode_positions=False),
        SMALL.changed(encoder="point-transformer", transformer_widths=(8, 16, 32), points=128),
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
        expected = network.query(network.encode(cloud, eye), queries)
        found = folded.query(folded.encode(cloud, eye), queries)
    torch.testing.assert_close(found.logits, expected.logits, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.distance, expected.distance, rtol=1e-3, atol=1e-4)
    assert expected.logits.std() > 1e-2
    # the original stays as it was: it can still be saved
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    norms = sum(isinstance(module, nn.BatchNorm1d) for module in network.modules())
    assert sum(isinstance(module, nn.BatchNorm1d) for module in folded.modules()) < norms / 2


def test_a_network_in_training_is_refused() -> None:
    with pytest.raises(ValueError, match="training mode"):
        fold_batch_norm(Network(SMALL, 2))
