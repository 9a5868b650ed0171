"""Whether a training gets anywhere: its loss and scores against those of whoever answers the same everywhere.

The best constant answer has the labels' own frequencies as probabilities, whose cross-entropy is their entropy, and
the median of the distances. A network is there after some dozen steps, whatever it is taught; what counts is whether it
gets below (docs/training.md).

Notation: n queries.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from mereo.evaluation.metrics import intersection_over_union

JUDGED = 8
"""Steps whose mean loss is compared."""

SHARE = 0.1
"""Of all steps, after which a run is judged."""

LEARNT = 0.95
"""Share of the constant answer's loss below which something has been learnt."""

ABOVE = 0.1
"""What mIoU must have above the constant answer's: random networks have 0.04."""

SETTLED = 80
"""Steps before which labels say little; until then a run is not doubted whose loss falls."""

EXAMPLES = 512
"""Examples, the first ones, from whose queries the constant answer is taken."""

FALLEN = 0.9
"""Share of the first steps' loss below which it falls."""


@dataclass(frozen=True)
class ConstantAnswer:
    """What the best answers have that are the same everywhere.

    Attributes:
        ce: cross-entropy of the labels' frequencies.
        l1: mean distance from the median of the distances.
        miou: largest mIoU of one label everywhere; IoU, where a network knows no segments.
    """

    ce: float
    l1: float
    miou: float

    @classmethod
    def of(
        cls, labels: UInt8[np.ndarray, "*n"], distances: Float[np.ndarray, "*n"], segmented: bool
    ) -> "ConstantAnswer":
        """Constant answer to queries of these labels and distances; not ``segmented`` means inside or outside alone."""
        counts = np.bincount((labels if segmented else labels > 0).ravel())
        shares = counts[counts > 0] / counts.sum()
        scores = [0.0]
        for label in range(len(counts)):
            confusion = np.zeros((len(counts), len(counts)), dtype=np.int64)
            confusion[:, label] = counts
            found = intersection_over_union(confusion, segmented)
            scores.append(found.miou if segmented else found.iou)
        l1 = float(np.abs(distances - np.median(distances)).mean())
        return cls(float(-(shares * np.log(shares)).sum()), l1, float(np.nanmax(scores)))


class Judge:
    """Judge of one run, who says once that it gets nowhere, or is content and says nothing any more.

    Attributes:
        constant: what it must be better than.
        total: steps of the run.
    """

    def __init__(self, constant: ConstantAnswer, total: int) -> None:
        self.constant, self.total, self.decided = constant, total, False

    def doubt(self, rows: Sequence[Mapping[str, float]]) -> str:
        """Warning, once, where a run with these rows of its record has got nowhere in a tenth of its steps."""
        steps = [row for row in rows if "loss" in row]
        if self.decided or len(steps) < max(2 * JUDGED, SHARE * self.total):
            return ""
        name = "ce" if "ce" in steps[-1] else "l1"
        reached = _mean(steps[-JUDGED:], name) / max(getattr(self.constant, name), 1e-9)
        scores = [row.get("val_miou", row.get("val_iou", 0.0)) for row in rows if "val_iou" in row]
        falls = _mean(steps[-JUDGED:], "loss") < FALLEN * _mean(steps[:JUDGED], "loss")
        if reached < LEARNT or (scores and scores[-1] > self.constant.miou + ABOVE):
            self.decided = True
            return ""
        if falls and len(steps) < min(SETTLED, self.total):
            return ""
        self.decided = True
        what = "labels" if name == "ce" else "distances"
        return (
            f"\nwarning: after {len(steps)} of {self.total} steps the network tells {what} no better than the same "
            f"answer everywhere would ({reached:.0%} of its loss): this training goes nowhere so far; where it stays "
            "so, start from weights of another object (--init), take another --learning-rate, or look at the examples"
        )


def _mean(rows: Sequence[Mapping[str, float]], name: str) -> float:
    return sum(row[name] for row in rows) / len(rows)
