"""Reconstruction and segmentation of every object (paper, section 4.2 and appendix A)."""

from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.result import Claim, Result, Row, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Score, Store
from mereo_learning.cases import EvaluatedView

QUESTION = "How well is each object reconstructed and segmented?"
COST = "cpu: 10 trainings, 1.2 hours; paper: 20 trainings, 115 million examples shown"

OBJECTS = ("rope", "shapes", "robot", "lizard", "sheet", "bunny", "human", "skull", "liver", "engine")


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of one training per object and recipe; with a rival recipe both are reported on the same data."""
    rows: list[Row] = []
    views: list[EvaluatedView] = []
    ours: dict[str, Score] = {}
    recipes = {"recipe": scale.recipe} if scale.rival is None else {"paper": scale.recipe, "large": scale.rival}
    for scene in scale.choose(OBJECTS) if scale.chosen or not scale.decides else OBJECTS:
        dataset = store.dataset(scene, GenerateConfig(), scale.examples)
        for variant, recipe in recipes.items():
            weights = store.run(dataset, recipe)
            ours[scene] = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
            rows.append(Row(scene, variant, ours[scene], published()["reconstruction"].get(scene)))
        views.append(store.view(weights, GenerateConfig(), scale.cells))
    claims = (
        Claim(
            "IoU is close to mIoU (within 0.15), so to reconstruct is harder than to segment; Rope is the paper's "
            "exception.",
            {name: abs(score.iou - score.miou) <= 0.15 for name, score in ours.items()},
        ),
    )
    return Result(
        "reconstruction", "Reconstruction of every object", scale.name, tuple(rows), claims, views=tuple(views)
    )
