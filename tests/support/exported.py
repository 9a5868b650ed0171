"""Models to export: random, but every part of the network says something, and differently at every place."""

import numpy as np
import torch

from mereo.geometry.mesh import PALETTE
from mereo.models.config import NetworkConfig
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.scenes.rest_pose import TEMPLATE_NODES, TEMPLATE_REACH
from mereo_learning.config import PRESETS

NAMES = ("head", "left ear", "tail")

TINY = PRESETS["tiny"].network

SMALL = NetworkConfig().changed(
    points=96, neighbors=16, mlp1=(16, 16), mlp2=(16, 24), mlp_global=(24, 32), width=32, depth=3, skip_after=2
)
"""The paper's structure in small: no alignment, no local features, no template."""

CASES: dict[str, tuple[NetworkConfig, str]] = {
    "plain": (SMALL.changed(sight_neighbors=4), "l1"),
    "everything": (TINY, "ce+l1+cd"),
    "transformer": (
        TINY.changed(encoder="point-transformer", points=320, transformer_widths=(8, 16, 24, 32, 40)),
        "ce+l1+cd",
    ),
}


def model_of(config: NetworkConfig, loss: str) -> Model:
    """With the statistics of two batches, and a template that is a ball for each segment."""
    torch.manual_seed(3)
    network = Network(config, len(NAMES))
    if config.additions.rest_template:
        lookup = network.decoder.lookup
        assert lookup is not None
        axis = torch.linspace(-TEMPLATE_REACH, TEMPLATE_REACH, TEMPLATE_NODES)
        places = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        centers = torch.tensor([[0.3, 0.0, 0.1], [-0.2, 0.5, 0.0], [0.0, -0.4, -0.6]])
        lookup.distance.copy_(torch.stack([(places - center).norm(dim=-1) - 0.5 for center in centers]))
        for layer in (lookup.where, lookup.read):
            torch.nn.init.normal_(layer.weight, std=0.1)
    clouds = torch.stack([torch.from_numpy(seen(config.points, seed)) for seed in (0, 1)])
    network.train()
    with torch.no_grad():
        for _ in range(2):
            network(clouds, torch.tensor([[0.2, -0.1, -8.0]] * 2), 2 * torch.rand(2, 64, 3) - 1)
    domain = ((-1.2, -1.2, -1.2), (1.2, 1.2, 1.4))
    return Model(
        network.eval().requires_grad_(False), NAMES, PALETTE[: len(NAMES)], loss, {"scene": "rope"}, domain=domain
    )


def seen(count: int, seed: int) -> np.ndarray:
    """Normalized points on a bent surface, in random order, float32."""
    u, v = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    return np.stack([u, 0.7 * v, 0.4 * np.sin(2 * u) + 0.3 * v * v], axis=1).astype(np.float32)
