"""Reliability of probabilities: how often answers that are given with so much confidence are right.

The expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017) is the mean distance of the share of
right answers from their confidence, over bins of equal width, weighed by how many answers fall into each. Confidence is
the probability of the answered label, over the cells of the paper's metric (``evaluation.ground_truth``).
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mereo.evaluation.ground_truth import TruthGrid
from mereo.models.trained import EncodedCloud, Trained

BINS = 15
"""Bins of equal width, as in the papers."""

ASKED = 20_000
"""Cells of a view that are asked for, at most, evenly drawn: all of them would take longer than the evaluation."""


@dataclass(frozen=True, eq=False)
class AskedCells:
    """What a network says at some of the cells that count, and what is true there.

    Attributes:
        points: the cells' centres, in the cloud's frame and unit.
        truth: their labels.
    """

    points: Float[np.ndarray, "n 3"]
    truth: UInt8[np.ndarray, " n"]

    @classmethod
    def of(cls, truth: TruthGrid, count: int = ASKED) -> "AskedCells":
        """Cells that count, the same ones every time."""
        kept = np.argwhere(truth.kept)
        if len(kept) > count:
            kept = kept[np.sort(np.random.default_rng(0).choice(len(kept), count, replace=False))]
        return cls(truth.grid.positions(kept), truth.grid.labels[tuple(kept.T)])


@dataclass
class Reliability:
    """Answers counted by their confidence.

    Attributes:
        count: of answers in each bin.
        confidence: sum of theirs.
        right: how many are right.
    """

    count: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))
    confidence: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))
    right: Float[np.ndarray, " b"] = field(default_factory=lambda: np.zeros(BINS))

    def add(self, confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> None:
        """Count further answers, by the probability of what was answered and whether that is right."""
        index = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
        self.count += np.bincount(index, minlength=BINS)
        self.confidence += np.bincount(index, weights=confidence, minlength=BINS)
        self.right += np.bincount(index, weights=right, minlength=BINS)

    def add_view(self, model: Trained, code: EncodedCloud, truth: TruthGrid) -> None:
        """Count what a network answers about a view; one that tells no segments apart is asked for the whole."""
        cells = AskedCells.of(truth)
        found = model.query(code, cells.points)
        true = np.minimum(cells.truth, found.probability.shape[1] - 1)
        rows = np.arange(len(true))
        self.add(found.probability[rows, found.label].astype(np.float64), found.label == true)

    def add_all(self, other: "Reliability") -> None:
        """Count what another one has counted."""
        self.count += other.count
        self.confidence += other.confidence
        self.right += other.right

    @property
    def ece(self) -> float:
        """Expected calibration error, 0 to 1; NaN without answers."""
        total = self.count.sum()
        return float(np.abs(self.right - self.confidence).sum() / total) if total else float("nan")

    def facts(self) -> list[dict[str, Any]]:
        """Bins that have answers: their share of all, mean confidence and share of right ones."""
        filled = np.flatnonzero(self.count)
        return [
            {
                "share": float(self.count[i] / self.count.sum()),
                "confidence": float(self.confidence[i] / self.count[i]),
                "right": float(self.right[i] / self.count[i]),
            }
            for i in filled
        ]
