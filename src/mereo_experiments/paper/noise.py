"""Networks trained at one level of depth noise, tested at every level (paper, appendix C, table 3)."""

from dataclasses import replace

from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.result import Claim, Result, Row, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Score, Store

QUESTION = "What does noise in the depth cost, seen in training or not?"
COST = "cpu: 6 trainings, 0.7 hours; paper: 6 trainings, 52 million examples shown"

OBJECTS = ("robot", "rope")
"""Scenes: the paper's, and one more."""

LEVELS = (0.1, 0.5, 2.0)
"""Standard deviations of the depth noise in scene units."""


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of three trainings and nine evaluations per object."""
    rows, claims = [], []
    scores: dict[tuple[str, float, float], Score] = {}
    objects = scale.choose(OBJECTS)
    for scene in objects:
        for train in LEVELS:
            dataset = store.dataset(scene, replace(GenerateConfig(), noise_std=train), scale.examples)
            weights = store.run(dataset, scale.recipe)
            for test in LEVELS:
                settings = replace(GenerateConfig(), noise_std=test)
                scores[scene, train, test] = store.score(weights, settings, scale.test_examples, scale.cells)
                paper = published()["noise"][str(train)][str(test)] if scene == "robot" else None
                rows.append(Row(scene, f"trained at {train}, tested at {test}", scores[scene, train, test], paper))
    low, middle, high = LEVELS
    claims = [
        Claim(
            "Noise far above that of the training data breaks the reconstruction (IoU falls by more than a third).",
            {name: scores[name, low, high].iou < scores[name, low, low].iou * 2 / 3 for name in objects},
        ),
        Claim(
            "A network trained at the highest noise does as well at every level (IoU within 0.02).",
            {
                name: max(scores[name, high, test].iou for test in LEVELS)
                - min(scores[name, high, test].iou for test in LEVELS)
                <= 0.02
                for name in objects
            },
        ),
        Claim(
            "The best network at each level is the one trained at that level.",
            {
                name: all(
                    scores[name, test, test].iou >= max(scores[name, train, test].iou for train in LEVELS)
                    for test in (low, middle, high)
                )
                for name in objects
            },
        ),
    ]
    return Result("noise", "Noise in the depth camera", scale.name, tuple(rows), tuple(claims))
