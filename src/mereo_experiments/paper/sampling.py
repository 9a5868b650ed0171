"""Samplers of training queries (paper, table 1): Volume Uniform, Label Uniform, SortSample; and two more."""

from dataclasses import replace

from mereo.synthesis.config import GenerateConfig, Sampler, SamplingConfig
from mereo_experiments.paper.result import Claim, Result, Row, better, compare, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Score, Store
from mereo_learning.cases import EvaluatedView

QUESTION = "Which sampler of training queries teaches most?"
COST = "cpu: 10 trainings, 1.2 hours; paper: 15 trainings, 129 million examples shown"

OBJECTS = ("lizard", "human", "engine")

SETTINGS: dict[str, SamplingConfig] = {
    "volume-uniform": SamplingConfig(sampler="volume-uniform"),
    "label-uniform": SamplingConfig(sampler="label-uniform"),
    "sort-sample": SamplingConfig(sampler="sort-sample"),
    "sort-sample, n = 2k": SamplingConfig(sampler="sort-sample", oversample=2),
    "nested-sort-sample": SamplingConfig(sampler="nested-sort-sample"),
}
"""Samplers compared: the paper's three at n = k, what it describes besides, and its authors' later one."""


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of one training per object and sampler, with one recipe and one seed."""
    rows: list[Row] = []
    views: list[list[EvaluatedView]] = []
    for scene in scale.choose(OBJECTS):
        views.append([])
        paper = published()["sampling"].get(scene, {})
        for variant, sampling in SETTINGS.items():
            settings = replace(GenerateConfig(), sampling=sampling)
            weights = store.run(store.dataset(scene, settings, scale.examples), scale.recipe)
            score = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
            rows.append(Row(scene, variant, score, paper.get(variant)))
            views[-1].append(store.view(weights, GenerateConfig(), scale.cells))
    return Result(
        "sampling",
        "Where training queries are drawn",
        scale.name,
        tuple(rows),
        _claims(rows),
        comparisons={"samplers.png": compare("reconstruction error", views, rows)},
    )


def _claims(rows: list[Row]) -> tuple[Claim, ...]:
    scores: dict[str, dict[str, Score]] = {}
    for row in rows:
        scores.setdefault(row.object, {})[row.variant] = row.score
    best: Sampler = "sort-sample"
    return (
        Claim(
            "SortSample is better than Volume Uniform and Label Uniform.",
            {
                name: better(iou[best], iou["volume-uniform"]) and better(iou[best], iou["label-uniform"])
                for name, iou in scores.items()
            },
        ),
        Claim(
            "Volume Uniform is better than Label Uniform (the paper's own table says so of Engine and Human only).",
            {name: better(iou["volume-uniform"], iou["label-uniform"]) for name, iou in scores.items()},
        ),
    )
