"""Test on real scans of a network that was trained on synthetic views alone (paper, section 4.3).

The paper scans a printed lizard; its scans are not public. Ours are four range scans of the Stanford bunny with known
poses.
"""

from mereo.synthesis.config import GenerateConfig
from mereo_experiments.paper.result import Claim, Result, Row, published
from mereo_experiments.paper.scales import ExperimentScale
from mereo_experiments.paper.store import Store

QUESTION = "How much worse are real scans than synthetic views?"
COST = "cpu: 1 training, 0.1 hours; paper: 1 training, 9 million examples shown"

OBJECTS = ("bunny",)

NOTES = ("The paper's figures are those of its printed lizard (15 scans), ours of the bunny (4 scans).",)


def run(store: Store, scale: ExperimentScale) -> Result:
    """Result of one training: the synthetic score and the real one."""
    weights = store.run(store.dataset("bunny", GenerateConfig(), scale.examples), scale.recipe)
    synthetic = store.score(weights, GenerateConfig(), scale.test_examples, scale.cells)
    real, views = store.scans(weights, scale.cells)
    paper = published()["real-world"]["lizard"]
    rows = (Row("bunny", "synthetic", synthetic, paper["synthetic"]), Row("bunny", "real", real, paper["real"]))
    claim = Claim(
        "Scores on real scans are considerably lower than on synthetic views (IoU by more than 0.1).",
        {"bunny": real.iou < synthetic.iou - 0.1},
    )
    return Result("real-world", "Real scans", scale.name, rows, (claim,), NOTES, views)
