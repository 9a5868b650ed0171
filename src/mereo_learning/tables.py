"""Results of an evaluation as ``metrics.json`` and as a table."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError

from mereo.geometry.conventions import WorkspaceName
from mereo.geometry.metrics import format_score, intersection_over_union
from mereo.io.errors import first_problem, readable
from mereo.synthesis.config import SensorConfig
from mereo_learning.cases import AnswerScores, Evaluation
from mereo_learning.scoring import CELLS

CLEARLY = 0.01
"""Least difference in mIoU (in IoU where there is no mIoU) by which another answer counts as clearly better."""


def metrics(evaluation: Evaluation, facts: dict[str, Any]) -> dict[str, Any]:
    """Content of ``metrics.json``: ``facts`` first, then definition, scores and confusion matrix.

    Of the network alone there is also ``miou_tenth``, the mIoU that a tenth of its examples do not reach. ``chosen``
    has the share of examples by where the scored answer came from.
    ``registration_error`` and ``coverage95``, the share of true positions within the registration's radii, are None
    where none was taken, and so is ``known``, the share of examples by whether they are said to show the object, where
    no registration was asked for.
    """
    scores, (iou, miou), errors = evaluation.scores, evaluation.example_mean, evaluation.errors
    count = len(evaluation.examples)
    sources = evaluation.sources if len(evaluation.sources) == count else (None,) * count
    words = [str(known).lower() for known in evaluation.known]
    known = evaluation.known if len(evaluation.known) == count else (None,) * count
    return {
        **facts,
        "examples": count,
        "definition": f"{CELLS}^3 cell centres of the joint box, kept inside any segment's box enlarged by 50 %; one "
        "confusion matrix over the set; miou is the mean over the segments without empty space; up to symmetry, "
        "segments that no frame tells apart are exchanged in an example where that suits the answer",
        "iou": scores.iou,
        "miou": scores.miou,
        "miou_up_to_symmetry": evaluation.miou_up_to_symmetry,
        "seconds": float(np.median(evaluation.seconds)) if evaluation.seconds else None,
        "per_segment": dict(zip(evaluation.names, scores.per_segment.tolist(), strict=True)),
        "example_mean": {"iou": iou, "miou": miou},
        "per_example": {
            name: {"iou": example.iou, "miou": example.miou, "answered_by": source, "known": is_known}
            for (name, example), source, is_known in zip(evaluation.examples.items(), sources, known, strict=True)
        },
        "confusion": evaluation.confusion,
        "ece": evaluation.reliability.ece,
        "calibrated": evaluation.calibrated,
        "reliability": evaluation.reliability.facts(),
        **({} if evaluation.network is None else {"network": _answer(evaluation.network, evaluation.segmented)}),
        "chosen": {
            name: evaluation.sources.count(name) / max(1, len(evaluation.sources))
            for name in ("network", "rest", "modes", "draws")
        },
        "registration_error": None if errors is None else errors.summary(evaluation.unit_mm),
        "coverage95": None if errors is None else errors.coverage(evaluation.unit_mm),
        "known": {word: words.count(word) / len(words) for word in ("true", "unsure", "false")} if words else None,
    }


def _answer(answer: AnswerScores, segmented: bool) -> dict[str, float]:
    scores = intersection_over_union(answer.confusion, segmented)
    tenth = float(np.quantile([example.miou for example in answer.examples], 0.1))
    return {
        "iou": scores.iou,
        "miou": scores.miou,
        "miou_up_to_symmetry": answer.miou_up_to_symmetry,
        "seconds": float(np.median(answer.seconds)),
        "miou_tenth": tenth,
    }


def certainty_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Sentences on ``coverage95`` and ``known`` of ``metrics``, where these are not None."""
    lines = []
    radii = metrics.get("coverage95")
    known = metrics.get("known")
    if radii is not None:
        shares = ", ".join(f"{name} {radii[name]:.1%}" for name in ("seen", "hidden") if radii[name] is not None)
        medians = [
            f"{name} {radii[f'radius_{name}']:.3g} scene units"
            + ("" if radii[f"radius_{name}_mm"] is None else f" ({radii[f'radius_{name}_mm']:.3g} mm)")
            for name in ("seen", "hidden")
            if radii[f"radius_{name}"] is not None
        ]
        how = "calibrated" if radii["calibrated"] else "not calibrated"
        lines.append(
            f"Radii of 95 % ({how}) hold {radii['all']:.1%} of the true places: {shares}. In the median they are "
            f"{', '.join(medians)}."
        )
    if known is not None:
        shares = f"{known['true']:.1%}; unsure {known['unsure']:.1%}, not {known['false']:.1%}"
        lines.append(f"Said to show the object: {shares}.")
    return lines


def markdown_table(evaluation: Evaluation) -> str:
    """Markdown table of the whole set and the mean over its examples, and a line on the radii; a dash for no score.

    Also a row of the network alone, where more than it could answer.
    """
    values = metrics(evaluation, {})
    blank = " | ".join("" for _ in evaluation.names)
    rows = [("whole set", values, " | ".join(format_score(value) for value in evaluation.scores.per_segment))]
    rows.append(("mean over examples", values["example_mean"], blank))
    if evaluation.known and evaluation.network is not None:
        rows.append((f"network alone, {values['network']['seconds']:.2f} s", values["network"], blank))
    head = f"| {len(evaluation.examples)} examples | IoU | mIoU | {' | '.join(evaluation.names)} |\n"
    return (
        f"{head}|---|---|---|{'---|' * len(evaluation.names)}\n"
        + "".join(
            f"| {title} | {format_score(s['iou'])} | {format_score(s['miou'])} | {rest} |\n" for title, s, rest in rows
        )
        + "".join(f"\n{line}\n" for line in certainty_lines(values))
    )


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


def read_metrics(path: Path) -> dict[str, Any]:
    """Content of a ``metrics.json``, with None where a score is undefined.

    Raises ``FileNotFoundError``, and ``ValueError`` where it is not what ``mereo evaluate`` writes.
    """
    with readable(path, "table of scores"):
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    try:
        given = _Written.model_validate(content).model_fields_set
    except ValidationError as error:
        raise ValueError(f"{path} is not what mereo evaluate writes ({first_problem(error)}): evaluate again") from None
    if not {"scans"} <= given and not {"examples", "seed"} <= given:
        raise ValueError(f"{path} says neither its scans nor its examples and their seed: evaluate again")
    return content
