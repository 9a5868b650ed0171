"""The search alone on test views of an object, scored before anything is trained, and kept in ``search.json``."""

import hashlib
import json
from pathlib import Path

from mereo.evaluation.metrics import format_score
from mereo.evaluation.scoring import CELLS
from mereo.evaluation.search_scores import SearchScores, score_search
from mereo.io.atomic_files import write_json
from mereo.learning.object_files import SEARCH
from mereo.scenes.rest_pose import rest_digest
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START

VIEWS, LEAST_VIEWS = 16, 6
"""Test views on which the search is scored, and how many at least where time is short."""

SEARCH_SHARE = 0.1
"""Of the budget, for these views."""


def search_scores(output: Path, scene: Scene, named: str, budget_s: float, cells: int = CELLS) -> SearchScores:
    """Scores of the search alone: those in ``output``, or else of as many views as there is time for.

    Args:
        output: the folder of what is learnt.
        scene: the object's.
        named: the scene's name or absolute file, by which ``load_object`` will know the folder's object.
        budget_s: seconds for all views.
        cells: cells of the grid along each axis.

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
    if len(scores) < views:
        scores = score_search(scene, views=views, least=views, cells=cells, begun=scores)
        _write(output, scene, named, scores)
    return scores.first(views)


def search_line(scores: SearchScores) -> str:
    """Sentence on the scores, for the terminal."""
    summary = scores.summary()
    return (
        f"search alone, without training: IoU {format_score(summary['iou'])}, mIoU {format_score(summary['miou'])} on "
        f"{len(scores)} test views, {int(scores.explained.sum())} of them explained, {scores.median_s:.2f} s a frame"
    )


def _digests(scene: Scene) -> dict[str, str | None]:
    """What tells the object and its deformations from others, as datasets have it."""
    definition = hashlib.sha256(scene.definition.encode()).hexdigest() if scene.definition else None
    return {"rest_sha256": rest_digest(scene.rest), "scene_file_sha256": definition}


def _write(output: Path, scene: Scene, named: str, scores: SearchScores) -> None:
    write_json(output / SEARCH, {"scene": named, **_digests(scene), "seed": TEST_SEED_START, **scores.content()})


def _read(output: Path, scene: Scene) -> SearchScores:
    path = output / SEARCH
    try:
        content = json.loads(path.read_text("utf-8"))
        scores = SearchScores.of_content(content)
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} holds no scores; remove it, and they are made again") from None
    if any(content.get(key) != value for key, value in _digests(scene).items()):
        raise ValueError(
            f"{output} was begun with another object or other deformations than {scene.name} has now; it is continued "
            "with equal ones: restore the scene file, or choose another --output"
        )
    return scores
