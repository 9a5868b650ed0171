"""Costs of experiments: they are run on a store that only counts.

So the figures of `mereo experiment list` follow what the experiments do, and cannot differ from it.
"""

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud
from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.registry import EXPERIMENTS, experiment, results_directory
from mereo_experiments.paper.scales import SCALES
from mereo_experiments.paper.store import FINISHED, Score, Store, content_key, scene_of
from mereo_learning.cases import EvaluatedView
from mereo_learning.config import TrainConfig

SEEN_PER_S = 27.0
"""Examples that a core showed to networks of scale ``cpu`` per second, datasets and tests included: experiments 10."""

UNKNOWN = Score(math.nan, math.nan, math.nan, math.nan, {})


@dataclass(frozen=True)
class Plan(Store):
    """Store that makes nothing and counts what it is asked for.

    Attributes:
        made: examples of each dataset.
        seen: examples that each training shows.
        tested: views of each test.
    """

    made: dict[Path, int] = field(default_factory=dict)
    seen: dict[Path, int] = field(default_factory=dict)
    tested: dict[str, int] = field(default_factory=dict)

    def dataset(self, scene: str, settings: GenerateConfig, examples: int) -> Path:
        """Path that stands for a training set."""
        path = Path(f"{scene}-{content_key([asdict(settings), examples])}")
        self.made[path] = examples
        return path

    def run(self, dataset: Path, config: TrainConfig) -> Path:
        """Path that stands for a training."""
        path = Path(f"{scene_of(dataset)}-{content_key([dataset.name, config.to_dict()])}")
        learnt = self.made[dataset] - min(config.holdout, self.made[dataset] // 10)
        self.seen[path] = math.ceil(config.epochs * learnt / config.batch) * config.batch
        return path / "weights.safetensors"

    def score(self, weights: Path, settings: GenerateConfig, examples: int, cells: int) -> Score:
        """Score of nothing."""
        self.tested[content_key([str(weights), asdict(settings), examples, cells])] = examples
        return UNKNOWN

    def view(self, weights: Path, settings: GenerateConfig, cells: int) -> EvaluatedView:
        """View of nothing."""
        empty = np.zeros((1, 1, 1), dtype=np.uint8)
        return EvaluatedView(str(weights), PointCloud(np.zeros((1, 3))), empty, empty, np.zeros(3), np.ones(3), ())

    def scans(self, weights: Path, cells: int) -> tuple[Score, tuple[EvaluatedView, ...]]:
        """Score of nothing."""
        return UNKNOWN, ()


@dataclass(frozen=True)
class Cost:
    """Cost of an experiment that finds nothing made.

    Attributes:
        trainings: number of networks.
        made: examples of all datasets together.
        seen: examples shown to all networks together.
        tested: test views of all evaluations together.
    """

    trainings: int
    made: int
    seen: int
    tested: int


def cost(name: str, scale: str) -> Cost:
    """Cost of an experiment at a scale."""
    plan = Plan(Path())
    experiment(name).run(plan, SCALES[scale])
    return Cost(len(plan.seen), sum(plan.made.values()), sum(plan.seen.values()), sum(plan.tested.values()))


def list_experiments(root: Path) -> None:
    """Print each experiment with what it answers, its costs and those of its results that a folder holds."""
    for name in EXPERIMENTS:
        places = [results_directory(root, name, scale) for scale in SCALES]
        written = [path.parent.name for place in places for path in root.glob(f"results/{place.name}*/results.json")]
        results = ", ".join(sorted(folder.removeprefix(f"{name}-") for folder in written)) or "none"
        print(f"{name}: {experiment(name).QUESTION}\n    {_costs(name)}\n    results here: {results}")
    finished = len(list(root.glob(f"runs/*/{FINISHED}")))
    Console(markup=False, emoji=False).print(
        f"\nRun one by: mereo experiment NAME --scale cpu. Results are in {root / 'results'}, each with a table.md. "
        f"{counted(finished, 'finished training')} there: experiments share them and repeat none. Costs are those of "
        "an empty folder; hours of one core as they were measured (docs/experiments.md, entry 10). Scale paper is for "
        "a GPU, on which nobody has timed it; scale smoke takes minutes, and shows only that an experiment runs.",
        highlight=False,
    )


def _costs(name: str) -> str:
    cpu, paper = cost(name, "cpu"), cost(name, "paper")
    hours = cpu.seen / SEEN_PER_S / 3600
    return (
        f"cpu: {counted(cpu.trainings, 'training')}, {hours:.1f} hours; "
        f"paper: {counted(paper.trainings, 'training')}, {paper.seen / 1e6:.0f} million examples shown"
    )
