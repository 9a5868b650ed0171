"""``mereo experiment``: see ``commands`` for how commands are written."""

import os
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from mereo.experiments.paper.scales import ExperimentName, ScaleName


@dataclass(frozen=True)
class Experiment:
    """Repeat one of the paper's experiments; the same command again continues a stopped one.

    Attributes:
        name: which one.
        scale: smoke shows in minutes that it runs, cpu takes hours on two cores, paper is the full recipe for a GPU.
        output: folder for datasets, runs, scores and results, shared by all experiments.
        workers: processes that make datasets; 0 means one per core.
    """

    name: Positional[ExperimentName]
    scale: ScaleName = "smoke"
    output: Path = Path("out/experiments")
    workers: int = 0

    def run(self) -> None:
        from mereo.experiments.paper.registry import run_experiment

        workers = self.workers or os.cpu_count() or 1
        directory = run_experiment(self.name, self.scale, self.output, workers)
        print((directory / "table.md").read_text("utf-8"))
        print(f"wrote {directory}")
