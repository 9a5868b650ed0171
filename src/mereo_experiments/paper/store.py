"""Datasets, runs and scores under names made from their content, so that experiments share and never repeat them.

    ROOT/datasets/SCENE-KEY   ROOT/runs/SCENE-KEY   ROOT/scores/SCENE-KEY

A key is a hash of everything that decides the content. What was stopped half-way is continued.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mereo.fitting.config import AnswerMethod
from mereo.io.atomic_files import write_json
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.scales import TRAINING_SEED
from mereo_learning.cases import EvaluatedView
from mereo_learning.config import TrainConfig
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.scoring import EvaluationConfig, evaluate
from mereo_learning.shards import MANIFEST, NOT_COMPARED, DatasetConfig, generate, make_manifest
from mereo_learning.tables import read_metrics
from mereo_learning.trainer import train

NETWORK: AnswerMethod = "network"
"""The paper's experiments are about networks: no registered model answers in their place."""

FINISHED = "finished.json"
"""Name of a file that is written into a run's folder after its last step."""


@dataclass(frozen=True)
class Score:
    """Score of a model: IoU and mIoU over a whole test set (paper, appendix B), and the means over its examples.

    Attributes:
        iou: of all segments as one, over the whole set.
        miou: mean over the segments, over the whole set; NaN for a model that knows no segments.
        example_iou: mean of the examples' IoU.
        example_miou: mean of the examples' mIoU; NaN for a model that knows no segments.
        per_segment: IoU of each segment over the whole set, by name; NaN where it occurs nowhere.
    """

    iou: float
    miou: float
    example_iou: float
    example_miou: float
    per_segment: dict[str, float]


@dataclass(frozen=True)
class Store:
    """Folder in which datasets, runs and scores are made once and found again.

    Attributes:
        root: the folder.
        workers: number of processes that make datasets, which does not change them.
    """

    root: Path
    workers: int = 1

    def dataset(self, scene: str, settings: GenerateConfig, examples: int) -> Path:
        """Folder of a training set, made or found."""
        manifest = make_manifest(load_scene(scene), settings, examples, TRAINING_SEED)
        decisive = {key: value for key, value in manifest.items() if key not in NOT_COMPARED}
        path = self.root / "datasets" / f"{scene}-{content_key(decisive)}"
        _say("dataset", path)
        started = (path / MANIFEST).exists()
        generate(scene, path, DatasetConfig(settings, examples, TRAINING_SEED), workers=self.workers, resume=started)
        return path

    def run(self, dataset: Path, config: TrainConfig) -> Path:
        """Weights' file of a training run, made, continued or found."""
        path = self.root / "runs" / f"{scene_of(dataset)}-{content_key([dataset.name, config.to_dict()])}"
        weights = path / "weights.safetensors"
        _say("run", path)
        if not (path / FINISHED).exists():
            train(dataset, path, config)
            write_json(path / FINISHED, {"dataset": dataset.name})
        return weights

    def score(self, weights: Path, settings: GenerateConfig, examples: int, cells: int) -> Score:
        """Score of a run's network, which answers alone, on test views that are seen as ``settings`` say."""
        scene = scene_of(weights.parent)
        key = content_key([weights.parent.name, asdict(settings), examples, cells, TEST_SEED_START, NETWORK])
        path = self.root / "scores" / f"{scene}-{key}"
        _say("score", path)
        if not path.exists():
            config = EvaluationConfig(examples=examples, cells=cells, settings=settings, method=NETWORK)
            evaluate_weights(weights, path, config)
        return read_score(path / "metrics.json")

    def view(self, weights: Path, settings: GenerateConfig, cells: int) -> EvaluatedView:
        """First test view of a run's network with its labels, for pictures."""
        config = EvaluationConfig(examples=1, cells=cells, settings=settings, method=NETWORK)
        return evaluate(load_model(weights), config).views[0]

    def scans(self, weights: Path, cells: int) -> tuple[Score, tuple[EvaluatedView, ...]]:
        """Score of a run's network on the real scans of the bunny, and each of them with its labels."""
        config = EvaluationConfig(scans=(), cells=cells, method=NETWORK)
        evaluation = evaluate(load_model(weights), config, progress=True)
        scores, mean = evaluation.scores, evaluation.example_mean
        per_segment = dict(zip(evaluation.names, map(float, scores.per_segment), strict=True))
        return Score(scores.iou, scores.miou, *mean, per_segment), evaluation.views


def read_score(path: Path) -> Score:
    """Score from the ``metrics.json`` of an evaluation, in which null stands for NaN."""
    metrics = read_metrics(path)
    mean, segments = _with_nan(metrics["example_mean"]), _with_nan(metrics["per_segment"])
    scores = _with_nan({name: metrics[name] for name in ("iou", "miou")})
    return Score(scores["iou"], scores["miou"], mean["iou"], mean["miou"], segments)


def _with_nan(read: dict[str, float | None]) -> dict[str, float]:
    return {key: float("nan") if value is None else value for key, value in read.items()}


def content_key(value: Any) -> str:
    """Twelve hexadecimal digits that stand for a JSON value."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def scene_of(path: Path) -> str:
    """Scene of a folder of datasets, runs or scores."""
    return path.name.rsplit("-", 1)[0]


def _say(kind: str, path: Path) -> None:
    print(f"{kind} {path.name}", flush=True)
