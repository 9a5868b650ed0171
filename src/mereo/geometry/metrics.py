"""Metrics of the paper (appendix B): truth on a grid, and IoU and mIoU from one confusion matrix over a test set."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan

import numpy as np
from jaxtyping import Float, Int, Integer
from numpy import ndarray

from mereo.geometry.labels import GridLabels, LabelGrid, VoxelMask
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import label_grid

Confusion = Int[ndarray, "c c"]
"""Numbers of places, by their true label and the predicted one."""


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
    per_segment: Float[ndarray, " s"]


def confusion_matrix(truth: Integer[ndarray, "*n"], prediction: Integer[ndarray, "*n"], classes: int) -> Confusion:
    """Counts of points by true class (row) and predicted class (column)."""
    index = truth.astype(np.int64).ravel() * classes + prediction.astype(np.int64).ravel()
    return np.bincount(index, minlength=classes * classes).reshape(classes, classes)


def intersection_over_union(confusion: Confusion, segmented: bool = True) -> Scores:
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


def with_segments_exchanged(confusion: Confusion, swaps: Sequence[Sequence[int]]) -> Confusion:
    """Confusion matrix up to symmetry: of the true segments as they are, or exchanged, what gives the greatest mIoU.

    Args:
        confusion: counts of points of one view, by true (row) and predicted (column) class; 0 is empty space.
        swaps: for each symmetry of the object and each segment, the index of the one whose place it takes
            (``Symmetry.lands_on``).
    """
    exchanged = [confusion[[0, *(index + 1 for index in swap)]] for swap in swaps]
    return max([confusion, *exchanged], key=lambda each: intersection_over_union(each).miou)


def format_score(score: float | None, missing: str = "-") -> str:
    """Score with three decimals as a table shows it, or ``missing`` where it is undefined (NaN, or JSON's null)."""
    return missing if score is None or isnan(score) else f"{score:.3f}"


# --- ground truth -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TruthGrid:
    """Ground truth of an evaluation: true labels on a grid, and which of its cells count (paper, appendix B).

    Attributes:
        grid: true labels at the centres of the cells into which the joint box of all segments is divided.
        kept: which of them count: those in the enlarged box of at least one segment.
    """

    grid: LabelGrid
    kept: VoxelMask

    def scaled(self, factor: float) -> "TruthGrid":
        """The same with all lengths ``factor`` times as long."""
        grid = replace(self.grid, origin=factor * self.grid.origin, spacing=factor * self.grid.spacing)
        return TruthGrid(grid, self.kept)


def truth_grid(mesh: SegmentedMesh, cells: int = 100) -> TruthGrid:
    """Ground truth at the centres of ``cells`` ** 3 cells, into which the joint box of all segments is divided."""
    low, high = mesh.bounds
    spacing = (high - low) / cells
    origin = low + spacing / 2
    x, y, z = (origin[axis] + np.arange(cells) * spacing[axis] for axis in range(3))
    kept = np.zeros((cells, cells, cells), bool)
    for segment in mesh.segments:
        first, last = segment.bounds
        margin = 0.25 * (last - first)  # on each side: 50 % in all, as in the paper
        inside = [(c >= a) & (c <= b) for c, a, b in zip((x, y, z), first - margin, last + margin, strict=True)]
        kept[np.ix_(*inside)] = True
    return TruthGrid(LabelGrid(label_grid(mesh, x, y, z), origin, spacing, mesh.names), kept)


def grid_confusion(truth: TruthGrid, predicted: GridLabels, segments: int) -> Confusion:
    """Confusion matrix of the points that count; where the model knows one segment, all true ones are taken as one."""
    labels = np.minimum(truth.grid.labels[truth.kept], segments)
    return confusion_matrix(labels, np.minimum(predicted[truth.kept], segments), segments + 1)


def labels_on(surfaces: SegmentedMesh, grid: LabelGrid) -> GridLabels:
    """Labels of surfaces on a grid in their axes and unit; segments without faces are nowhere."""
    present = [number for number, segment in enumerate(surfaces.segments) if len(segment.faces)]
    if not present:
        return np.zeros_like(grid.labels)
    labels = label_grid(SegmentedMesh(tuple(surfaces.segments[number] for number in present)), *grid.axes())
    return np.array([0, *(number + 1 for number in present)], np.uint8)[labels]
