"""Results of an evaluation as ``metrics.json`` and as a table."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError

from mereo.evaluation.cases import AnswerScores, Evaluation
from mereo.evaluation.metrics import Scores, format_score, intersection_over_union
from mereo.evaluation.scoring import CELLS
from mereo.geometry.conventions import WorkspaceName
from mereo.io.errors import first_problem, readable
from mereo.synthesis.config import SensorConfig

CLEARLY = 0.01
"""Least difference in mIoU (in IoU where there is no mIoU) by which another answer counts as clearly better."""


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
        "seconds": float(np.median(evaluation.seconds)) if evaluation.seconds else None,
        "per_segment": dict(zip(evaluation.names, scores.per_segment.tolist(), strict=True)),
        "example_mean": {"iou": iou, "miou": miou},
        "per_example": per_example(evaluation),
        "confusion": evaluation.confusion,
        "ece": evaluation.reliability.ece,
        "calibrated": evaluation.calibrated,
        "reliability": evaluation.reliability.facts(),
        **answers(evaluation),
    }


def per_example(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """Each example's scores, who answered it, and whether it was said to show the object; None where nothing was."""
    count = len(evaluation.examples)
    sources = evaluation.sources if len(evaluation.sources) == count else (None,) * count
    known = evaluation.known if len(evaluation.known) == count else (None,) * count
    each = zip(evaluation.examples.items(), sources, known, strict=True)
    return {
        name: {"iou": scores.iou, "miou": scores.miou, "answered_by": source, "known": said}
        for (name, scores), source, said in each
    }


def answers(evaluation: Evaluation) -> dict[str, Any]:
    """Part of ``metrics.json`` that compares who could have answered: network, modes, full.

    Each has ``miou_tenth``, the mIoU that a tenth of its examples do not reach. ``chosen`` has the share of examples
    by where the scored answer came from, ``better`` the share in which another answer would have been better than it by
    more than ``CLEARLY``. ``registration_error`` and ``coverage95``, the share of true places within the registration's
    radii, are None where none was taken, and so is ``known``, the share of examples by whether they are said to show
    the object, where no registration was asked for.
    """
    count = max(1, len(evaluation.sources))
    sources = {name: evaluation.sources.count(name) / count for name in ("network", "rest", "modes", "draws")}
    taken = list(evaluation.examples.values())
    better = {
        name: float(
            np.mean([_value(other) > _value(one) + CLEARLY for other, one in zip(all_.examples, taken, strict=True)])
        )
        for name, all_ in evaluation.answers.items()
    }
    errors = None if evaluation.errors is None else evaluation.errors.summary(evaluation.unit_mm)
    return {
        **{name: _answer(found, evaluation.segmented) for name, found in evaluation.answers.items()},
        "chosen": sources,
        "better": better,
        "registration_error": errors,
        "coverage95": coverage(evaluation),
        "known": recognition(evaluation),
    }


def recognition(evaluation: Evaluation) -> dict[str, float] | None:
    """Share of the examples that are said to show the object, not to, and unsure; None where nothing was said."""
    if not evaluation.known:
        return None
    words = [str(one).lower() for one in evaluation.known]
    return {word: words.count(word) / len(words) for word in ("true", "unsure", "false")}


def recognition_line(found: Mapping[str, float]) -> str:
    """Sentence on ``recognition``."""
    return f"Said to show the object: {found['true']:.1%}; unsure {found['unsure']:.1%}, not {found['false']:.1%}."


def coverage(evaluation: Evaluation) -> dict[str, float | bool | None] | None:
    """Share of the true places within the radii of 95 %, and medians of these; None where none was registered."""
    if evaluation.coverage is None:
        return None
    return {**evaluation.coverage.summary(evaluation.unit_mm), "calibrated": evaluation.radii_calibrated}


def coverage_line(found: Mapping[str, Any]) -> str:
    """Sentence on ``coverage``."""
    shares = ", ".join(f"{name} {found[name]:.1%}" for name in ("seen", "hidden") if found[name] is not None)
    medians = [
        f"{name} {found[f'radius_{name}']:.3g} scene units"
        + ("" if found[f"radius_{name}_mm"] is None else f" ({found[f'radius_{name}_mm']:.3g} mm)")
        for name in ("seen", "hidden")
        if found[f"radius_{name}"] is not None
    ]
    how = "calibrated" if found["calibrated"] else "not calibrated"
    return (
        f"Radii of 95 % ({how}) hold {found['all']:.1%} of the true places: {shares}. In the median they are "
        f"{', '.join(medians)}."
    )


def _value(scores: Scores) -> float:
    return scores.iou if np.isnan(scores.miou) else scores.miou


def _answer(found: AnswerScores, segmented: bool) -> dict[str, float]:
    scores = intersection_over_union(found.confusion, segmented)
    tenth = float(np.quantile([one.miou for one in found.examples], 0.1))
    return {"iou": scores.iou, "miou": scores.miou, "seconds": float(np.median(found.seconds)), "miou_tenth": tenth}


def markdown_table(evaluation: Evaluation) -> str:
    """Markdown table of the whole set and the mean over its examples, and a line on the radii; a dash for no score."""
    scores, (iou, miou) = evaluation.scores, evaluation.example_mean
    names = " | ".join(evaluation.names)
    values = " | ".join(format_score(value) for value in scores.per_segment)
    blank = " | ".join("" for _ in evaluation.names)
    found, said = coverage(evaluation), recognition(evaluation)
    return (
        f"| {len(evaluation.examples)} examples | IoU | mIoU | {names} |\n"
        f"|---|---|---|{'---|' * len(evaluation.names)}\n"
        f"| whole set | {format_score(scores.iou)} | {format_score(scores.miou)} | {values} |\n"
        f"| mean over examples | {format_score(iou)} | {format_score(miou)} | {blank} |\n"
        + _answer_rows(evaluation, blank)
        + ("" if found is None else f"\n{coverage_line(found)}\n")
        + ("" if said is None else f"\n{recognition_line(said)}\n")
    )


def _answer_rows(evaluation: Evaluation, blank: str) -> str:
    """Rows of the whole set by who answers, where more than the network could."""
    if len(evaluation.answers) < 2:
        return ""
    rows = ""
    for name, found in evaluation.answers.items():
        each = _answer(found, evaluation.segmented)
        title = f"{name} alone, {each['seconds']:.2f} s"
        rows += f"| {title} | {format_score(each['iou'])} | {format_score(each['miou'])} | {blank} |\n"
    return rows


# --- read again -------------------------------------------------------------------------------------------------------

Score = Annotated[float, Field(ge=0, le=1)] | None
"""Null stands for NaN, the score of what is not there."""


class _Mean(BaseModel):
    model_config = ConfigDict(strict=True)
    iou: Score
    miou: Score


class _Timed(_Mean):
    seconds: FiniteFloat


def _sensor(value: object) -> object:
    """Sensor of the terms that a file states."""
    if not isinstance(value, dict):
        return value
    try:
        return SensorConfig(**value)
    except TypeError:
        raise ValueError(f"{', '.join(map(str, value))} are no terms of a camera") from None


class _Written(_Mean):
    """What is read of a file, as any version has written it."""

    per_segment: dict[str, Score]
    examples: int = 0
    seed: int = 0
    noise_std: FiniteFloat = 0.0
    image_size: int = 0
    workspace: WorkspaceName = "own"
    sensor: Annotated[SensorConfig | None, BeforeValidator(_sensor)] = None
    scans: list[str] = []
    example_mean: _Mean | None = None
    network: _Timed | None = None
    modes: _Timed | None = None
    full: _Timed | None = None


def read_metrics(path: Path) -> dict[str, Any]:
    """Content of a ``metrics.json``, with None where a score is undefined.

    Raises ``FileNotFoundError``, and ``ValueError`` where it is not what ``mereo evaluate`` writes.
    """
    with readable(path, "table of scores"):
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    try:
        given = _Written.model_validate(found).model_fields_set
    except ValidationError as error:
        raise ValueError(f"{path} is not what mereo evaluate writes ({first_problem(error)}): evaluate again") from None
    if not {"scans"} <= given and not {"examples", "seed"} <= given:
        raise ValueError(f"{path} says neither its scans nor its examples and their seed: evaluate again")
    return found
