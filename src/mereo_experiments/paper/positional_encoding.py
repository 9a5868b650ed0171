"""Frequency encoding of the query position, on and off (paper, table 2)."""

from dataclasses import replace

from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.result import Claim, Result, Row, better, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Store

QUESTION = "Does encoding the position by frequencies help?"
COST = "cpu: 4 trainings, 0.5 hours; paper: 10 trainings, 86 million examples shown"

OBJECTS = ("rope", "shapes", "lizard", "robot", "human")


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of two trainings per object, with and without the encoding, that differ in nothing else."""
    rows = []
    holds = {}
    for scene in scale.choose(OBJECTS):
        paper = published()["positional-encoding"].get(scene, {})
        dataset = store.dataset(scene, GenerateConfig(), scale.examples)
        scores = {}
        for variant, encode in (("on", True), ("off", False)):
            recipe = replace(scale.recipe, network=scale.recipe.network.changed(encode_positions=encode))
            weights = store.run(dataset, recipe)
            scores[variant] = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
            rows.append(Row(scene, variant, scores[variant], paper.get(variant)))
        holds[scene] = better(scores["on"], scores["off"])
    claim = Claim("Encoding the position by frequencies is better, by 2 % on average in the paper.", holds)
    return Result("positional-encoding", "Positional encoding", scale.name, tuple(rows), (claim,))
