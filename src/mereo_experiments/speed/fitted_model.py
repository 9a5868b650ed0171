"""Model of any preset that knows one view: as costly to ask as a trained one, and with surfaces to extract."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import PALETTE
from mereo.geometry.transforms import Normalizer
from mereo.models.model import Box, Model
from mereo.models.network import Network
from mereo.synthesis.sample_views import SampleView
from mereo_learning.config import PRESETS

STEPS, QUERIES = 200, 2048
"""Number of training steps, and of queries in each."""


def fitted_model(preset: str, view: SampleView) -> Model:
    """Model with a preset's network, fitted to the labels of one view (in seconds to a minute on a CPU).

    It knows nothing else: how long it takes can be measured with it, not how good it is.
    """
    grid, kept = view.truth.grid, view.truth.kept
    torch.manual_seed(0)
    network = Network(PRESETS[preset].network.changed(dropout=0.0), len(grid.names))
    model = Model(network, grid.names, tuple(PALETTE[i % len(PALETTE)] for i in range(len(grid.names))))
    cloud, normalizer = model.normalized_cloud(view.depth.to_points())
    model = replace(model, domain=_domain(grid, normalizer))
    viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    cells = [np.argwhere(kept & mask) for mask in (grid.labels > 0, grid.labels == 0)]
    rng = np.random.default_rng(0)

    def draw() -> tuple[Float[Tensor, "1 q 3"], Int[Tensor, " q"]]:
        chosen = np.concatenate([side[rng.integers(len(side), size=QUERIES // 2)] for side in cells])
        queries = normalizer.apply(grid.positions(chosen)).astype(np.float32)
        return torch.from_numpy(queries)[None], torch.from_numpy(grid.labels[tuple(chosen.T)].astype(np.int64))

    network.train()
    if network.aligner is not None:
        network.aligner.eval()  # one view teaches no alignment: any that stays the same will do
    for _ in range(STEPS):
        queries, labels = draw()
        loss = nn.functional.cross_entropy(network(cloud, viewpoint, queries).prediction.logits[0], labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    # so few steps leave the running statistics behind: take them anew
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm1d) and norm.training:
            norm.reset_running_stats()
            norm.momentum = None  # a plain mean of what follows
    with torch.no_grad():
        for _ in range(8):
            network(cloud, viewpoint, draw()[0])
    network.eval().requires_grad_(False)
    return model


def _domain(grid: LabelGrid, normalizer: Normalizer) -> Box:
    """The box that the view teaches, normalized; as from a trained network nothing is answered beyond it."""
    corners = normalizer.apply(np.stack([grid.origin, grid.origin + grid.spacing * grid.labels.shape]))
    (x0, y0, z0), (x1, y1, z1) = corners.tolist()
    return (x0, y0, z0), (x1, y1, z1)
