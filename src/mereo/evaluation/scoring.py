"""Scores on test sets (paper, appendix B), and on synthetic views of a scene; for real scans see ``scan_scoring``.

The joint box of all true segments is divided into 100^3 cells; their centres are labelled by the truth and by the
model, and those outside every segment's enlarged box are dropped. One confusion matrix is summed over the whole set;
IoU and mIoU come from it, and the mean over single examples is reported beside it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from rich.console import Console
from rich.progress import track

from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, confusion_matrix, format_score, intersection_over_union
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import Color, SegmentedMesh
from mereo.models.model import EncodedCloud, Model
from mereo.reconstruction.coarse_to_fine import sample_coarse_to_fine
from mereo.reconstruction.pipeline import segment_names
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view

KEPT_VIEWS = 4
"""Number of examples, the first ones, that keep their labels and are drawn with their errors."""

PICTURE_MARGIN = 12
"""Cells drawn around the truth's box: what a model puts there does not count, but belongs into a picture of it."""

CELLS = 100
"""Cells of the paper's grid along each axis."""


@dataclass(frozen=True, eq=False)
class TestCase:
    """Cloud to be reconstructed and the truth to score it by, both in the same camera frame.

    Attributes:
        name: name in tables, different from other cases' of the set.
        cloud: what the model is given.
        truth: true labels on a grid.
    """

    __test__ = False  # not a test, whatever pytest thinks of the name

    name: str
    cloud: PointCloud
    truth: TruthGrid


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
class Evaluation:
    """Result of a test set: its confusion matrix, from which its scores come, and the scores of each example.

    Attributes:
        names: names of the segments.
        confusion: points by true (row) and predicted (column) label, summed over the set; 0 is empty space.
        examples: scores of each test case by its name.
        views: the first few with their labels, for pictures.
        segmented: whether the model tells segments apart; without, there is no mIoU (NaN).
    """

    names: tuple[str, ...]
    confusion: Int[np.ndarray, "c c"]
    examples: dict[str, Scores]
    views: tuple[EvaluatedView, ...] = field(default=())
    segmented: bool = True

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


# --- one cloud -------------------------------------------------------------------------------------------------------


def predict_grid(model: Model, seen: PointCloud | EncodedCloud, truth: TruthGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the model on the grid of ``truth``, evaluated coarse to fine; ``seen`` is a cloud, or its code."""
    code = seen if isinstance(seen, EncodedCloud) else model.encode(seen)
    logits = partial(model.logits, code)
    grid = truth.grid
    x, y, z = grid.labels.shape
    return sample_coarse_to_fine(logits, grid.origin, grid.spacing, (x, y, z)).labels


def grid_confusion(truth: TruthGrid, predicted: UInt8[np.ndarray, "x y z"], segments: int) -> Int[np.ndarray, "c c"]:
    """Confusion matrix of the points that count; where the model knows one segment, all true ones are taken as one."""
    labels = np.minimum(truth.grid.labels[truth.kept], segments)
    return confusion_matrix(labels, predicted[truth.kept], segments + 1)


def grid_scores(model: Model, seen: PointCloud | EncodedCloud, truth: SegmentedMesh, cells: int = CELLS) -> Scores:
    """Scores of one cloud, or its code, as in the paper; ``truth`` is in the cloud's frame and units.

    Raises ``ValueError`` where the model knows other segments than the truth has.
    """
    check_names(model, truth.names)
    grid = truth_grid(truth, cells)
    segments = len(segment_names(model)[0])
    return intersection_over_union(grid_confusion(grid, predict_grid(model, seen, grid), segments), model.segmented)


def check_names(model: Model, names: Sequence[str]) -> None:
    """Raise ``ValueError`` unless the model's labels mean the same as the truth's."""
    if tuple(names) != model.names:
        raise ValueError(
            f"the weights know the segments {', '.join(model.names)} but the truth has {', '.join(names)}; they must "
            "be the same in the same order: use the weights that belong to this object"
        )


# --- test sets -------------------------------------------------------------------------------------------------------


def evaluate(
    model: Model,
    scene: Scene | str | None = None,
    *,
    examples: int = 128,
    seed: int = TEST_SEED_START,
    cells: int = CELLS,
    progress: bool = False,
    settings: GenerateConfig | None = None,
) -> Evaluation:
    """Scores of a model on synthetic views of a scene, seen as in training: through a noisy depth image.

    Args:
        model: the trained model.
        scene: a scene, its name or its file; by default the built-in one that the model was trained on.
        examples: number of views; example i is made from (seed, i) alone.
        seed: at least ``TEST_SEED_START``: smaller ones are for training.
        cells: cells of the grid along each axis.
        progress: whether to show a bar with the time left.
        settings: the camera (image size, noise, sensor); by default the paper's.

    Raises ``ValueError`` for a training seed, no examples, or another object than the model's.
    """
    if seed < TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; training may have seen it: take a test seed, {TEST_SEED_START} or more")
    if examples < 1:
        raise ValueError(f"{examples} examples are asked for; at least 1 is needed: the paper takes 128")
    if scene is None or isinstance(scene, str):
        scene = load_scene(scene or trained_scene(model))
    check_names(model, scene.rest.names)
    return score_cases(
        model, partial(_scene_case, scene, settings or GenerateConfig(), seed, cells), examples, progress
    )


def trained_scene(model: Model) -> str:
    """Name of the built-in scene that a model was trained on; raises ``ValueError`` where its provenance says none."""
    scene = model.provenance.get("scene")
    if not isinstance(scene, str):
        raise ValueError("the weights do not say which scene they were trained on; name it with --scene")
    if scene not in SCENES:
        raise ValueError(
            f"the weights were trained on the scene {scene!r}, which is not built in; its file is needed: name it with "
            "--scene FILE.yaml"
        )
    return scene


def _scene_case(scene: Scene, settings: GenerateConfig, seed: int, cells: int, index: int) -> TestCase:
    view = sample_view(scene.for_seed(seed), settings, example_rng(seed, index))
    return TestCase(f"{scene.name} {index}", view.depth.to_points(), truth_grid(view.mesh, cells))


def score_cases(model: Model, case: Callable[[int], TestCase], count: int, progress: bool) -> Evaluation:
    """Scores of a model on ``case(0) ... case(count - 1)``, which are made one at a time, as they may be large."""
    names, colors = segment_names(model)
    total = np.zeros((len(names) + 1,) * 2, dtype=np.int64)
    examples: dict[str, Scores] = {}
    views: list[EvaluatedView] = []
    for one, code, predicted in _predictions(model, case, count, progress):
        confusion = grid_confusion(one.truth, predicted, len(names))
        total += confusion
        examples[one.name] = intersection_over_union(confusion, model.segmented)
        if len(views) < KEPT_VIEWS:
            views.append(_evaluated_view(one, model, code, colors))
    return Evaluation(names, total, examples, tuple(views), model.segmented)


def _evaluated_view(one: TestCase, model: Model, code: EncodedCloud, colors: Sequence[Color]) -> EvaluatedView:
    """Truth and prediction on the truth's grid and ``PICTURE_MARGIN`` cells around it."""
    wide = _widened(one.truth)
    reference = np.minimum(wide.grid.labels, np.uint8(len(colors)))
    predicted = predict_grid(model, code, wide)
    return EvaluatedView(one.name, one.cloud, reference, predicted, wide.grid.origin, wide.grid.spacing, colors)


def _widened(truth: TruthGrid) -> TruthGrid:
    """The same cells and ``PICTURE_MARGIN`` more on each side, which are empty, since the box holds every segment."""
    grid = truth.grid
    labels, kept = (np.pad(values, PICTURE_MARGIN) for values in (grid.labels, truth.kept))
    return TruthGrid(replace(grid, labels=labels, origin=grid.origin - PICTURE_MARGIN * grid.spacing), kept)


def _predictions(
    model: Model, case: Callable[[int], TestCase], count: int, progress: bool
) -> Iterator[tuple[TestCase, EncodedCloud, UInt8[np.ndarray, "x y z"]]]:
    for index in track(range(count), "evaluating", console=Console(stderr=True), disable=not progress):
        one = case(index)
        code = model.encode(one.cloud)
        yield one, code, predict_grid(model, code, one.truth)


# --- results ---------------------------------------------------------------------------------------------------------


def metrics(evaluation: Evaluation, facts: dict[str, Any]) -> dict[str, Any]:
    """Content of ``metrics.json``: ``facts`` first, then definition, scores and confusion matrix."""
    scores, (iou, miou) = evaluation.scores, evaluation.example_mean
    return {
        **facts,
        "examples": len(evaluation.examples),
        "definition": f"{CELLS}^3 cell centres of the joint box, kept inside any segment's box enlarged by 50 %; one "
        "confusion matrix over the set; miou is the mean over the segments without empty space",
        "iou": scores.iou,
        "miou": scores.miou,
        "per_segment": dict(zip(evaluation.names, scores.per_segment.tolist(), strict=True)),
        "example_mean": {"iou": iou, "miou": miou},
        "per_example": {name: {"iou": each.iou, "miou": each.miou} for name, each in evaluation.examples.items()},
        "confusion": evaluation.confusion,
    }


def markdown_table(evaluation: Evaluation) -> str:
    """Markdown table of the whole set and the mean over its examples; a dash where a score is undefined."""
    scores, (iou, miou) = evaluation.scores, evaluation.example_mean
    names = " | ".join(evaluation.names)
    values = " | ".join(format_score(value) for value in scores.per_segment)
    blank = " | ".join("" for _ in evaluation.names)
    return (
        f"| {len(evaluation.examples)} examples | IoU | mIoU | {names} |\n"
        f"|---|---|---|{'---|' * len(evaluation.names)}\n"
        f"| whole set | {format_score(scores.iou)} | {format_score(scores.miou)} | {values} |\n"
        f"| mean over examples | {format_score(iou)} | {format_score(miou)} | {blank} |\n"
    )
