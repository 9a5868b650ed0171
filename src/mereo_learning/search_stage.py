"""The search alone on test views of an object, scored before anything is trained, and kept in ``search.json``."""

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar
from mereo.geometry.metrics import (
    format_score,
    grid_confusion,
    intersection_over_union,
    with_segments_exchanged,
)
from mereo.geometry.solids import label_grid
from mereo.geometry.symmetry import TOLERANCE, describe_symmetries, find_symmetries
from mereo.io.atomic_files import write_json
from mereo.io.progress import progress
from mereo.reconstruction.observation import observe
from mereo.scenes.files.object_files import SEARCH
from mereo.scenes.random_states import kept_model
from mereo.scenes.rest_pose import rest_digest
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig
from mereo_learning.scoring import CELLS, scene_case
from mereo_learning.tables import CLEARLY

# --- scores of the search ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SearchScores:
    """Scores of the search alone, view by view, as ``search.json`` has them.

    Attributes:
        names: names of the segments.
        views: of each view "confusion", cells by true (row) and answered (column) label, "explained", whether the fit
            explains it, and "seconds" from the cloud to the answer.
        swaps: exchanges of segments that no frame tells apart (``StatisticalModel.swaps``).
    """

    names: tuple[str, ...]
    views: Sequence[Mapping[str, Any]]
    swaps: tuple[tuple[int, ...], ...] = ()

    def summary(self) -> dict[str, Any]:
        """IoU, mIoU, that up to symmetry and its lowest of a view, the share of views explained, and median seconds.

        Raises ``KeyError``, ``TypeError`` or ``ValueError`` for views that are none.
        """
        classes = len(self.names) + 1
        confusions = np.array([view["confusion"] for view in self.views], dtype=np.int64).reshape(-1, classes, classes)
        scores = intersection_over_union(confusions.sum(axis=0))
        exchanged = [with_segments_exchanged(view, self.swaps) for view in confusions]
        return {
            "examples": len(self.views),
            "iou": scores.iou,
            "miou": scores.miou,
            "miou_up_to_symmetry": intersection_over_union(np.sum(exchanged, axis=0)).miou,
            "lowest_miou": min(intersection_over_union(view).miou for view in exchanged),
            "explained": float(np.mean([bool(view["explained"]) for view in self.views])),
            "seconds": float(np.median([float(view["seconds"]) for view in self.views])),
        }


def score_search(
    scene: Scene,
    *,
    views: int,
    least: int = 1,
    budget_s: float = float("inf"),
    cells: int = CELLS,
    begun: SearchScores | None = None,
) -> SearchScores:
    """Score the search alone on the test views that ``scoring.evaluate`` takes, in their order.

    Args:
        scene: the object's.
        views: how many.
        least: how many at least, whatever time they take.
        budget_s: seconds after which no further view is begun.
        cells: cells of the grid along each axis.
        begun: scores of the first views, which are not made again.
    """
    registrar = Registrar(None, kept_model(scene), given=scene)
    registrar.prepare()  # no part of a frame's seconds
    started = time.monotonic()
    scored = [] if begun is None else list(begun.views)
    with progress("score the search", views - len(scored), "views") as shown:
        while len(scored) < views and (len(scored) < least or time.monotonic() - started < budget_s):
            scored.append(_scored(scene, registrar, cells, len(scored)))
            shown.advance()
    return SearchScores(scene.rest.names, scored, registrar.model.swaps)


def _scored(scene: Scene, registrar: Registrar, cells: int, index: int) -> dict[str, Any]:
    """Scores of a view, as ``SearchScores.views`` has them; one in which nothing is found scores 0."""
    case = scene_case(scene, GenerateConfig(), TEST_SEED_START, cells, index)
    started = time.perf_counter()
    labels = np.zeros_like(case.truth.grid.labels)
    explained = False
    try:
        answer = answer_frame(observe(case.cloud), None, registrar, scene_unit=case.scene_unit)
        seconds = answer.seconds
        labels = label_grid(answer.surfaces, *case.truth.grid.axes())
        explained = answer.registration is not None and answer.registration.accepted
    except ValueError:  # too few points, or nothing is found in them
        seconds = time.perf_counter() - started
    confusion = grid_confusion(case.truth, labels, len(scene.rest.names))
    return {"confusion": confusion.tolist(), "explained": explained, "seconds": seconds}


# --- the stage --------------------------------------------------------------------------------------------------------

VIEWS, LEAST_VIEWS = 16, 6
"""Test views on which the search is scored, and how many at least where time is short."""

SEARCH_SHARE = 0.1
"""Of the budget, for these views."""


def search_scores(output: Path, scene: Scene, named: str, budget_s: float, cells: int = CELLS) -> SearchScores:
    """Scores of the search alone: those in ``output``, or else of as many views as there is time for.

    ``named`` is the scene's name or absolute file, by which ``load_object`` will know the folder's object.

    Raises ``ValueError`` where the folder has scores of another object, or a file that holds none.
    """
    if (output / SEARCH).is_file():
        return _read(output, scene)
    scores = score_search(scene, views=VIEWS, least=LEAST_VIEWS, budget_s=budget_s, cells=cells)
    _write(output, scene, named, scores)
    return scores


def scores_of_views(output: Path, scene: Scene, named: str, views: int, cells: int = CELLS) -> SearchScores:
    """Scores of the search alone on so many views, of which the folder has some already; the others are added to it."""
    scores = _read(output, scene)
    if len(scores.views) < views:
        scores = score_search(scene, views=views, least=views, cells=cells, begun=scores)
        _write(output, scene, named, scores)
    return replace(scores, views=scores.views[:views])


def search_line(scores: SearchScores) -> str:
    """Sentence on the scores, for the terminal."""
    summary = scores.summary()
    count, seconds = summary["examples"], summary["seconds"]
    either = summary["miou_up_to_symmetry"]
    symmetric = f" ({format_score(either)} up to symmetry)" if either > summary["miou"] + CLEARLY else ""
    return (
        f"search alone, without training: IoU {format_score(summary['iou'])}, mIoU {format_score(summary['miou'])}"
        f"{symmetric} on {count} test views, {round(count * summary['explained'])} of them explained, "
        f"{seconds:.2f} s a frame"
    )


def symmetry_lines(scene: Scene) -> list[str]:
    """Sentences on segments that no frame tells apart, and so no training either."""
    symmetries = find_symmetries(scene.rest, TOLERANCE)
    sentences = describe_symmetries(symmetries, scene.rest.names, of_segments=True)
    return [f"{sentence}, so no training can" for sentence in sentences]


def _digests(scene: Scene) -> dict[str, str | None]:
    """What tells the object and its deformations from others, as datasets have it."""
    definition = hashlib.sha256(scene.definition.encode()).hexdigest() if scene.definition else None
    return {"rest_sha256": rest_digest(scene.rest), "scene_file_sha256": definition}


def _write(output: Path, scene: Scene, named: str, scores: SearchScores) -> None:
    facts = {"scene": named, **_digests(scene), "seed": TEST_SEED_START}
    write_json(output / SEARCH, {**facts, "names": scores.names, "swaps": scores.swaps, "views": scores.views})


def _read(output: Path, scene: Scene) -> SearchScores:
    path = output / SEARCH
    try:
        content = json.loads(path.read_text("utf-8"))
        swaps = tuple(tuple(int(index) for index in swap) for swap in content["swaps"])
        scores = SearchScores(tuple(content["names"]), content["views"], swaps)
        scores.summary()
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} holds no scores; remove it, and they are made again") from None
    if any(content.get(key) != value for key, value in _digests(scene).items()):
        raise ValueError(
            f"{output} was begun with another object or other deformations than {scene.name} has now; it is continued "
            "with equal ones: restore the scene file, or choose another --output"
        )
    return scores


# --- whether to train -------------------------------------------------------------------------------------------------

TrainChoice = Literal["auto", "always", "never"]
"""When to train: where the search alone is not good enough, in any case, or not at all."""

Method = Literal["auto", "search"]
"""Who is to answer, as ``--method`` says it: both, or the search alone."""

GOOD_ENOUGH = 0.85
"""mIoU up to symmetry from which the search alone is good enough; IoU of an object in one segment."""

LOWEST = 0.5
"""mIoU up to symmetry that each view must have: in one with less, segments that look alike are exchanged."""


def shortcomings(search: Mapping[str, Any]) -> list[str]:
    """Reasons why the search alone is not good enough, by its ``SearchScores.summary``; none where it is."""
    views = search["examples"]
    missed = round((1 - search["explained"]) * search["examples"])
    reasons = []
    if missed:
        reasons.append(f"{missed} of {views} views are not explained")
    if search["miou_up_to_symmetry"] < GOOD_ENOUGH:
        reasons.append(f"mIoU {format_score(search['miou_up_to_symmetry'])} is below {GOOD_ENOUGH}")
    if search["lowest_miou"] < LOWEST:
        reasons.append(f"mIoU of the worst view, {format_score(search['lowest_miou'])}, is below {LOWEST}")
    return reasons


def is_to_train(choice: TrainChoice, reasons: list[str]) -> bool:
    """Whether to train, by what the user chose and the shortcomings of the search alone."""
    return choice == "always" or (choice == "auto" and bool(reasons))


def training_reason(choice: TrainChoice, reasons: list[str], is_begun: bool) -> str:
    """Why an object is trained, in a phrase."""
    if is_begun:
        return "that was begun before"
    return "--train is always" if choice == "always" else f"the search alone is not good enough, {', '.join(reasons)}"


def best_method(search: Mapping[str, Any], both: Mapping[str, Any]) -> tuple[Method, str]:
    """Choose who is to answer, the search alone or both, with the reason in a sentence.

    That with the clearly higher mIoU is taken (by ``CLEARLY``), else that which explains more views, else the faster
    one.

    Args:
        search: IoU, mIoU up to symmetry, explained share and seconds of the search alone.
        both: the same of both, on the same views.
    """
    scores = [
        float(row["iou" if row["miou_up_to_symmetry"] is None else "miou_up_to_symmetry"]) for row in (both, search)
    ]
    if abs(scores[0] - scores[1]) > CLEARLY:
        is_both = scores[0] > scores[1]
        better, worse = (format_score(score) for score in sorted(scores, reverse=True))
        reason = f"mIoU {better}, not {worse} of {'the search alone' if is_both else 'both'}"
    elif both["explained"] != search["explained"]:
        is_both = both["explained"] > search["explained"]
        shares = f"{both['explained']:.0%} of the views by both, {search['explained']:.0%} by the search alone"
        reason = f"it explains more, {shares}"
    else:
        is_both = both["seconds"] < search["seconds"]
        times = f"{both['seconds']:.2f} s a frame with both, {search['seconds']:.2f} s with the search alone"
        reason = f"as good as {'the search alone' if is_both else 'both'}, and faster, {times}"
    return ("auto", f"use both: {reason}") if is_both else ("search", f"use the search alone: {reason}")
