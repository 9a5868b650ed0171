"""``mereo bench``: see ``commands`` for how commands are written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mereo.models.config import Precision
from mereo.training.config import PresetName


@dataclass(frozen=True)
class BenchCommand:
    """Time every stage of an answer against this machine's floor, and against the straightforward implementation.

    Attributes:
        weights: a shipped name or a file; without it the preset's network is fitted to one shipped frame first.
        preset: the architecture to fit.
        device: where the network runs; preprocessing is always on the CPU.
        precision: of the network's products; auto takes bfloat16 on CUDA and on CPUs that are much faster in it.
        repeats: of each stage.
        rival: time the straightforward implementation too (minutes on a CPU), and check that it gives the same labels.
        output: a JSON file for the figures.
    """

    weights: str | None = None
    preset: PresetName = "paper"
    device: Literal["cpu", "cuda"] = "cpu"
    precision: Precision = "float32"
    repeats: int = 7
    rival: bool = False
    output: Path | None = None

    def run(self) -> None:
        from mereo.experiments.speed.report import benchmark
        from mereo.models.device import find_device

        if self.repeats < 1:
            raise ValueError(f"{self.repeats} repeats are asked for; at least 1 is needed: 7 are usual")
        device = find_device(self.device)
        benchmark(self.weights, self.preset, device, self.precision, self.repeats, self.rival, self.output)
