"""Scores of an object without weights on synthetic views: each is answered by the search, and nothing is trained.

scene -kept_model-> statistical model -search in each view-> SearchScores
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.results import grid_confusion
from mereo.evaluation.scoring import CELLS, scene_case
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar
from mereo.geometry.solids import label_grid
from mereo.io.progress import progress
from mereo.reconstruction.observation import observe
from mereo.scenes.kept_model import kept_model
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig


@dataclass(frozen=True, eq=False)
class SearchScores:
    """Scores of the search alone, view by view.

    Attributes:
        names: names of the segments.
        confusions: cells by true (row) and answered (column) label, of each view.
        explained: whether the fit explains the view.
        seconds: of each view, from the cloud to the answer.
    """

    names: tuple[str, ...]
    confusions: Int[np.ndarray, "n c c"]
    explained: Bool[np.ndarray, " n"]
    seconds: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.seconds)

    @property
    def scores(self) -> Scores:
        """Scores of all views together, from the sum of their confusion matrices."""
        return intersection_over_union(self.confusions.sum(axis=0))

    @property
    def median_s(self) -> float:
        """Median seconds of a view."""
        return float(np.median(self.seconds))

    def first(self, count: int) -> "SearchScores":
        """Scores of the first views alone."""
        return SearchScores(self.names, self.confusions[:count], self.explained[:count], self.seconds[:count])

    def summary(self) -> dict[str, Any]:
        """IoU, mIoU, the share of views that are explained, the lowest mIoU of a view, and median seconds."""
        scores = self.scores
        return {
            "examples": len(self),
            "iou": scores.iou,
            "miou": scores.miou,
            "lowest_miou": min(intersection_over_union(one).miou for one in self.confusions),
            "explained": float(self.explained.mean()),
            "seconds": self.median_s,
        }

    def content(self) -> dict[str, Any]:
        """All of it in terms that JSON knows, as ``of_content`` reads it."""
        views = zip(self.confusions.tolist(), self.explained.tolist(), self.seconds.tolist(), strict=True)
        return {
            "names": list(self.names),
            "views": [
                {"confusion": confusion, "explained": explained, "seconds": seconds}
                for confusion, explained, seconds in views
            ],
        }

    @classmethod
    def of_content(cls, content: Mapping[str, Any]) -> "SearchScores":
        """Scores that ``content`` has made; raises ``KeyError``, ``TypeError`` or ``ValueError`` for anything else."""
        names, views = tuple(content["names"]), content["views"]
        classes = len(names) + 1
        return cls(
            names,
            np.array([view["confusion"] for view in views], dtype=np.int64).reshape(len(views), classes, classes),
            np.array([view["explained"] for view in views], dtype=bool),
            np.array([view["seconds"] for view in views], dtype=float),
        )


def score_search(
    scene: Scene,
    *,
    views: int,
    least: int = 1,
    budget_s: float = float("inf"),
    cells: int = CELLS,
    seed: int = TEST_SEED_START,
    begun: SearchScores | None = None,
) -> SearchScores:
    """Score the search alone on the views that ``scoring.evaluate`` takes, in their order.

    Args:
        scene: the object's.
        views: how many.
        least: how many at least, whatever time they take.
        budget_s: seconds after which no further view is begun.
        cells: cells of the grid along each axis.
        seed: of the views; at least ``TEST_SEED_START``, where training shall not have seen them.
        begun: scores of the first views, which are not made again.
    """
    registrar = Registrar(None, kept_model(scene), given=scene)
    registrar.prepare()  # no part of a frame's seconds
    names, started = scene.rest.names, time.monotonic()
    rows: list[tuple[Int[np.ndarray, "c c"], bool, float]] = []
    if begun is not None:
        rows += zip(begun.confusions, begun.explained.tolist(), begun.seconds.tolist(), strict=True)
    with progress("score the search", views - len(rows), "views") as shown:
        while len(rows) < views and (len(rows) < least or time.monotonic() - started < budget_s):
            rows.append(_scored(scene, registrar, seed, cells, len(rows)))
            shown.advance()
    confusions, explained, seconds = zip(*rows, strict=True)
    return SearchScores(names, np.stack(confusions), np.array(explained), np.array(seconds))


def _scored(
    scene: Scene, registrar: Registrar, seed: int, cells: int, index: int
) -> tuple[Int[np.ndarray, "c c"], bool, float]:
    """Confusion matrix, whether the view is explained, and seconds; a view in which nothing is found scores 0."""
    case = scene_case(scene, GenerateConfig(), seed, cells, index)
    started = time.perf_counter()
    labels, explained = np.zeros_like(case.truth.grid.labels), False
    try:
        answer = answer_frame(observe(case.cloud), None, registrar, scene_unit=case.scene_unit)
        seconds = answer.seconds
        labels = label_grid(answer.surfaces, *case.truth.grid.axes())
        explained = answer.registration is not None and answer.registration.accepted
    except ValueError:  # too few points, or nothing is found in them
        seconds = time.perf_counter() - started
    return grid_confusion(case.truth, labels, len(scene.rest.names)), explained, seconds
