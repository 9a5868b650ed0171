"""Result of a test set: scores of the answer that a user gets, and of each that could have answered."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from mereo.evaluation.candidates import AnswerName, RegistrationErrors
from mereo.evaluation.coverage import RadiusRatios
from mereo.evaluation.ground_truth import TruthGrid
from mereo.evaluation.metrics import Scores, confusion_matrix, intersection_over_union
from mereo.evaluation.reliability import Reliability
from mereo.fitting.registration.recognition import Known
from mereo.geometry.brief import counted, listed
from mereo.geometry.camera import PointCloud
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.geometry.solids import label_grid


@dataclass(frozen=True, eq=False)
class EvaluatedView:
    """View with its true and its predicted labels: a row of the paper's figure of reconstructions.

    Attributes:
        name: label at the left of the row.
        cloud: what the model was given.
        reference: true labels; 0 is empty space.
        predicted: labels by the model, on the same grid.
        origin: centre of voxel [0, 0, 0] in the cloud's frame; that of [i, j, k] is ``origin + [i, j, k] * spacing``.
        spacing: distances of the voxels' centres along each axis.
        colors: colours of the segments; label k has ``colors[k - 1]``.
    """

    name: str
    cloud: PointCloud
    reference: UInt8[np.ndarray, "x y z"]
    predicted: UInt8[np.ndarray, "x y z"]
    origin: Float[np.ndarray, "3"]
    spacing: Float[np.ndarray, "3"]
    colors: Sequence[Color]


@dataclass(frozen=True, eq=False)
class AnswerScores:
    """Scores of one of the answers over a test set.

    Attributes:
        confusion: points by true (row) and predicted (column) label, summed over the set.
        examples: scores of each test case, in order.
        seconds: of each, from the cloud to the answer.
    """

    confusion: Int[np.ndarray, "c c"]
    examples: tuple[Scores, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of a test set: its confusion matrix, from which its scores come, and the scores of each example.

    Attributes:
        names: names of the segments.
        confusion: points by true (row) and predicted (column) label, summed over the set; 0 is empty space.
        examples: scores of each test case by its name.
        views: the first few with their labels, for pictures.
        segmented: whether the model tells segments apart; without, there is no mIoU (NaN).
        answers: the same of each that could have answered; ``confusion`` and ``examples`` are of what a user gets.
        sources: where that answer came from, in each example: network, modes or draws.
        known: whether each example was said to show the object, where a registration was asked for.
        errors: distances of registered points from their true places, where a registration was taken.
        unit_mm: millimetres per scene unit, where they are known.
        coverage: distances of the same points over the radii that are told of them.
        radii_calibrated: whether all of these are.
        reliability: of the network's probabilities.
        calibrated: whether these are.
        seconds: of each example, from the cloud to the answer that a user gets.
    """

    names: tuple[str, ...]
    confusion: Int[np.ndarray, "c c"]
    examples: dict[str, Scores]
    views: tuple[EvaluatedView, ...] = field(default=())
    segmented: bool = True
    answers: dict[AnswerName, AnswerScores] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    errors: RegistrationErrors | None = None
    unit_mm: float | None = None
    coverage: RadiusRatios | None = None
    radii_calibrated: bool = False
    reliability: Reliability = field(default_factory=Reliability)
    calibrated: bool = False
    seconds: tuple[float, ...] = ()

    def __repr__(self) -> str:
        scores, count = self.scores, counted(len(self.examples), "example")
        miou = "" if np.isnan(scores.miou) else f", mIoU {scores.miou:.3f}"
        return f"Evaluation({count}: IoU {scores.iou:.3f}{miou}; {listed(self.names)})"

    @property
    def scores(self) -> Scores:
        """Scores over the whole set, from its one confusion matrix."""
        return intersection_over_union(self.confusion, self.segmented)

    @property
    def example_mean(self) -> tuple[float, float]:
        """Mean IoU and mean mIoU over the examples; NaN where no example has a mIoU."""
        each = self.examples.values()
        mious = [s.miou for s in each if not np.isnan(s.miou)]
        return float(np.mean([s.iou for s in each])), float(np.mean(mious)) if mious else float("nan")


def grid_confusion(truth: TruthGrid, predicted: UInt8[np.ndarray, "x y z"], segments: int) -> Int[np.ndarray, "c c"]:
    """Confusion matrix of the points that count; where the model knows one segment, all true ones are taken as one."""
    labels = np.minimum(truth.grid.labels[truth.kept], segments)
    return confusion_matrix(labels, np.minimum(predicted[truth.kept], segments), segments + 1)


def labels_on(surfaces: SegmentedMesh, grid: LabelGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels of surfaces on a grid in their axes and unit; segments without faces are nowhere."""
    present = [number for number, segment in enumerate(surfaces.segments) if len(segment.faces)]
    if not present:
        return np.zeros_like(grid.labels)
    labels = label_grid(SegmentedMesh(tuple(surfaces.segments[number] for number in present)), *grid.axes())
    return np.array([0, *(number + 1 for number in present)], dtype=np.uint8)[labels]


@dataclass
class Tally:
    """Running sum of the scores of one of the answers."""

    confusion: Int[np.ndarray, "c c"] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    examples: list[Scores] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, confusion: Int[np.ndarray, "c c"], seconds: float, segmented: bool) -> None:
        """Count one more example."""
        self.confusion = confusion if len(self.examples) == 0 else self.confusion + confusion
        self.examples.append(intersection_over_union(confusion, segmented))
        self.seconds.append(seconds)

    @property
    def scores(self) -> AnswerScores:
        """Scores of the set."""
        return AnswerScores(self.confusion, tuple(self.examples), tuple(self.seconds))
