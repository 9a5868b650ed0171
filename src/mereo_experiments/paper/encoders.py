"""Lizard and Human by each encoder, in a picture (paper, section 4.4, figure of encoders)."""

from mereo.models.config import Loss
from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.encoders_losses import AUTODECODER_RECIPE, ENCODERS, lacks, recipe
from mereo_experiments.paper.result import Claim, Result, Row, better, compare, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Score, Store
from mereo_learning.cases import EvaluatedView

QUESTION = "What does each encoder make of one view of Lizard and of Human?"
COST = "cpu: 6 trainings, 5.5 hours; paper: 6 trainings, 92 million examples shown"

OBJECTS = ("lizard", "human")

LOSS: Loss = "ce+l1"


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of three trainings per object, the same as in ``encoders_losses``, whose runs are found where it ran."""
    rows: list[Row] = []
    views: list[list[EvaluatedView]] = []
    scores: dict[tuple[str, str], Score] = {}
    objects = scale.choose(OBJECTS)
    for scene in objects:
        views.append([])
        dataset = store.dataset(scene, GenerateConfig(), scale.examples)
        for encoder in ENCODERS:
            config = recipe(scale, encoder, LOSS)
            assert config is not None, "every encoder learns from distances"
            weights = store.run(dataset, config)
            score = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
            scores[scene, encoder] = score
            paper = published()["encoders-losses"][scene][encoder][LOSS]
            rows.append(Row(scene, encoder, score, paper, lacks(scale, encoder, LOSS)))
            views[-1].append(store.view(weights, GenerateConfig(), scale.cells))
    claim = Claim(
        "PointNet++ is better than Point Transformer and the autodecoder.",
        {
            name: all(better(scores[name, "pointnet2"], scores[name, other]) for other in ENCODERS[1:])
            for name in objects
        },
    )
    return Result(
        "encoders",
        "Lizard and Human by each encoder",
        scale.name,
        tuple(rows),
        (claim,),
        (AUTODECODER_RECIPE,),
        comparisons={"encoders.png": compare("segmentation", views, rows)},
    )
