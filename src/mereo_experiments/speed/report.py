"""Report of ``mereo bench``: what it prints and writes."""

import os
import platform
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import palette_color
from mereo.geometry.transforms import Normalizer
from mereo.io.atomic_files import write_json
from mereo.io.cores import cores
from mereo.models.config import Precision
from mereo.models.device import cpu_features
from mereo.models.model import Box, Model
from mereo.models.network import Network
from mereo.models.weights import load_model
from mereo.synthesis.sample_views import SampleView, load_view, shipped_views
from mereo_experiments.speed.stages import Bench, Machine, Stage, measure_machine, random_points
from mereo_learning.config import PRESETS

QUERIES = 40_000
"""Number of points that precisions are compared at."""


@dataclass(frozen=True)
class Cost:
    """Change of a model's answers by a lower precision, at ``QUERIES`` points of the object's box.

    Attributes:
        labels: share of points with another label.
        distance: mean change of the distance, as a share of half the longest visible side.
    """

    labels: float
    distance: float


@dataclass(frozen=True)
class Measured:
    """Times of all stages, and on what they were measured.

    Attributes:
        stages: each stage of an answer.
        facts: of the machine and the network.
        cost: what a lower precision changes; None in single precision.
    """

    stages: list[Stage]
    facts: dict[str, Any]
    cost: Cost | None

    def print(self) -> None:
        """Print the table."""
        print(table(self.stages, self.facts, self.cost))

    def write(self, path: Path, force: bool = False) -> None:
        """Write all as JSON; raises ``FileExistsError`` as ``atomic_file`` does."""
        rows = [{**asdict(stage), "ratio": stage.ratio} for stage in self.stages]
        cost = None if self.cost is None else asdict(self.cost)
        write_json(path, {**self.facts, "cost": cost, "stages": rows}, force=force)


def benchmark(
    weights: str | None,
    preset: str,
    device: torch.device,
    precision: Precision,
    repeats: int,
    rival: bool,
) -> Measured:
    """Time all stages of an answer.

    Args:
        weights: a shipped name or a file, with a shipped view of its object; None fits the preset's network first.
        preset: name of the architecture to fit.
        device: where the network runs.
        precision: precision of the network's products.
        repeats: repetitions of each stage.
        rival: whether to time the straightforward implementation too.

    Raises ``ValueError`` for weights of an object without a shipped view.
    """
    load = {"load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None}  # before anything is measured
    model, view = _subject(weights, preset)
    model.network.to(device)
    fast = replace(model, precision=precision)
    machine = measure_machine(device, fast.working_dtype)
    stages = Bench(fast, view, machine, repeats, rival).run()
    facts = load | _facts(weights or f"preset {preset}, fitted to one frame", fast, machine)
    cost = _cost(model, fast, view) if fast.working_dtype is not torch.float32 else None
    return Measured(stages, facts, cost)


def _subject(weights: str | None, preset: str) -> tuple[Model, SampleView]:
    if weights is None:
        view = load_view(shipped_views()[0])
        return fitted_model(preset, view), view
    model = load_model(weights)
    scene = str(model.provenance.get("scene"))
    if scene not in shipped_views():
        raise ValueError(
            f"the weights know {scene!r}, of which no frame is shipped; there are frames of "
            f"{', '.join(shipped_views())}: time the architecture instead, with --preset"
        )
    return model, load_view(scene)


def _facts(subject: str, model: Model, machine: Machine) -> dict[str, Any]:
    device = model.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    return {
        "model": subject,
        "device": f"{device.type}, {name}",
        "cores": cores(),
        "threads": torch.get_num_threads(),
        "amx": bool(cpu_features()["amx"]),
        "precision": model.working_precision,
        "gigaflops": machine.operations / 1e9,
        "gigabytes_per_second": machine.bandwidth / 1e9,
    }


def _cost(exact: Model, fast: Model, view: SampleView) -> Cost:
    cloud = view.depth.to_points()
    points = random_points(view, QUERIES, seed=1)
    code = exact.encode(cloud)
    exact_answer = exact.query(code, points)
    fast_answer = fast.query(fast.encode(cloud), points)
    change = np.abs(exact_answer.distance - fast_answer.distance).mean() * code.normalizer.scale
    return Cost(float((exact_answer.label != fast_answer.label).mean()), float(change))


def table(stages: list[Stage], facts: dict[str, Any], cost: Cost | None = None) -> str:
    """Markdown table of the stages, times in milliseconds, under a line of facts about model and machine."""
    lines = [
        f"{facts['model']}; {facts['device']}, {facts['threads']} threads of {facts['cores']} cores, AMX "
        f"{'yes' if facts['amx'] else 'no'}, {facts['precision']}; products {facts['gigaflops']:.0f} GFLOP/s, "
        f"copies {facts['gigabytes_per_second']:.0f} GB/s"
        + ("" if facts["load"] is None else f"; load {facts['load']:.1f} before it began"),
        "",
        "| stage | median, ms | 99 %, ms | floor, ms | times the floor | straightforward, ms | faster | other labels |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for stage in stages:
        cells = [stage.median, stage.slowest, stage.floor]
        rival = "" if stage.rival is None else f"{1e3 * stage.rival:.0f}"
        ratio = "" if stage.ratio is None else f"{stage.ratio:.1f}"
        other = "" if stage.differing is None else f"{stage.differing:.3%}"
        times = " | ".join(f"{1e3 * value:.3g}" for value in cells)
        lines.append(f"| {stage.name} | {times} | {stage.median / stage.floor:.1f} | {rival} | {ratio} | {other} |")
    if cost is not None:
        lines += [
            "",
            f"Against float32: {cost.labels:.2%} of labels change, distances by {cost.distance:.2g} of half the "
            "object's longest visible side on average.",
        ]
    return "\n".join(lines) + "\n"


# --- a network of any preset ------------------------------------------------------------------------------------------

STEPS, BATCH = 200, 2048
"""Number of training steps, and of queries in each."""


def fitted_model(preset: str, view: SampleView) -> Model:
    """Model with a preset's network, fitted to the labels of one view (in seconds to a minute on a CPU).

    It knows nothing else: how long it takes can be measured with it, not how good it is.
    """
    grid, kept = view.truth.grid, view.truth.kept
    torch.manual_seed(0)
    network = Network(PRESETS[preset].network.changed(dropout=0.0), len(grid.names))
    model = Model(network, grid.names, tuple(palette_color(i) for i in range(len(grid.names))))
    cloud, normalizer = model.normalized_cloud(view.depth.to_points())
    model = replace(model, domain=_domain(grid, normalizer))
    viewpoint = torch.from_numpy(normalizer.viewpoint[None].astype(np.float32))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    cells = [np.argwhere(kept & mask) for mask in (grid.labels > 0, grid.labels == 0)]
    rng = np.random.default_rng(0)

    def draw() -> tuple[Float[Tensor, "1 q 3"], Int[Tensor, " q"]]:
        chosen = np.concatenate([side[rng.integers(len(side), size=BATCH // 2)] for side in cells])
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
    # so few steps leave the running statistics behind: compute them again
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
