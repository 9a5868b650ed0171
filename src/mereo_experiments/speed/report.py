"""Report of ``mereo bench``: what it prints and writes."""

import os
import platform
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mereo.io.atomic_files import write_json
from mereo.io.cores import cores
from mereo.models.config import Precision
from mereo.models.device import cpu_features
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.synthesis.sample_views import SampleView, load_view, shipped_views
from mereo_experiments.speed.fitted_model import fitted_model
from mereo_experiments.speed.roofline import Machine, measure_machine
from mereo_experiments.speed.stages import Bench, Stage, random_points

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
    exact_answer, fast_answer = exact.query(code, points), fast.query(fast.encode(cloud), points)
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
