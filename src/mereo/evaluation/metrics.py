"""Metrics of the paper (appendix B): IoU and mIoU from one confusion matrix over a whole test set."""

from dataclasses import dataclass
from math import isnan

import numpy as np
from jaxtyping import Float, Int, Integer


@dataclass(frozen=True, eq=False)
class Scores:
    """Intersections over union, each in 0..1; NaN where a class occurs neither in truth nor in prediction.

    Attributes:
        iou: all segments as one class, against empty space.
        miou: mean over the segments, empty space left out; NaN where the model tells no segments apart.
        per_segment: one value per segment.
    """

    iou: float
    miou: float
    per_segment: Float[np.ndarray, " s"]


def confusion_matrix(
    truth: Integer[np.ndarray, "*n"], prediction: Integer[np.ndarray, "*n"], classes: int
) -> Int[np.ndarray, "c c"]:
    """Counts of points by true class (row) and predicted class (column)."""
    index = truth.astype(np.int64).ravel() * classes + prediction.astype(np.int64).ravel()
    return np.bincount(index, minlength=classes * classes).reshape(classes, classes)


def intersection_over_union(confusion: Int[np.ndarray, "c c"], segmented: bool = True) -> Scores:
    """Intersections over union, ``TP / (TP + FP + FN)``, from a confusion matrix.

    Args:
        confusion: counts of points by true (row) and predicted (column) class; 0 is empty space, whose false positives
            count against the segments.
        segmented: False means that class 1 is the whole object; then there is no mIoU, as for the paper's L1 loss.
    """
    with np.errstate(invalid="ignore"):
        hit = np.diag(confusion)[1:].astype(float)
        union = confusion[1:].sum(axis=1) + confusion[:, 1:].sum(axis=0) - hit
        per_segment = hit / union
        occupied = confusion[1:, 1:].sum().astype(float)
        iou = occupied / (confusion.sum() - confusion[0, 0])
    present = per_segment[~np.isnan(per_segment)]
    miou = float(present.mean()) if segmented and len(present) else float("nan")
    return Scores(float(iou), miou, per_segment)


def format_score(score: float | None, missing: str = "-") -> str:
    """Score with three decimals as a table shows it, or ``missing`` where it is undefined (NaN, or JSON's null)."""
    return missing if score is None or isnan(score) else f"{score:.3f}"
