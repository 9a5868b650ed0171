"""Result of an experiment, compared with what the paper says: as Markdown, JSON and a bar chart."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np

from mereo.geometry.metrics import format_score
from mereo.io.atomic_files import atomic_file, new_directory, write_json
from mereo.io.extras import pyplot
from mereo.visualization.color_scales import viridis
from mereo_experiments.paper.store import Score
from mereo_learning.cases import EvaluatedView
from mereo_learning.error_maps import Comparison, Shown, comparison_picture, error_picture

Figures = dict[str, float]
"""Scores published in the paper: ``iou`` and ``miou``, or only one of them."""


@cache
def published() -> dict[str, Any]:
    """Scores published in the paper, by experiment, and then as each experiment's table is built."""
    text = resources.files("mereo_experiments.paper").joinpath("published.json").read_text("utf-8")
    figures: dict[str, Any] = json.loads(text)
    return figures


@dataclass(frozen=True)
class Row:
    """Score of one variant, a row of an experiment's table.

    Attributes:
        object: name of the scene.
        variant: what was varied, in words.
        score: what was measured here.
        paper: what the paper says of it on its own scene, where it does.
        lacks: what this variant has not, and others of the table have.
    """

    object: str
    variant: str
    score: Score
    paper: Figures | None = None
    lacks: str = ""


@dataclass(frozen=True)
class Claim:
    """Claim of the paper, and whether what was measured here bears it out.

    Attributes:
        text: the claim in a sentence.
        holds: whether it holds, by object; objects on which it could not be tried are left out.
    """

    text: str
    holds: dict[str, bool]

    @property
    def verdict(self) -> str:
        """Sentence that says for which objects the claim holds."""
        yes = [name for name, held in self.holds.items() if held]
        no = [name for name, held in self.holds.items() if not held]
        if not self.holds:
            return "Not tried here."
        if not no:
            return f"We agree ({', '.join(yes)})."
        if not yes:
            return f"We do not agree ({', '.join(no)})."
        return f"We agree for {', '.join(yes)}, not for {', '.join(no)}."


@dataclass(frozen=True)
class Result:
    """Result of an experiment: a table, what to make of it, and how it was made.

    Attributes:
        name: name of the experiment.
        title: heading of the table.
        scale: name of the budget.
        rows: variants in the table's order.
        claims: claims of the paper.
        notes: sentences on what differs from the paper's experiment.
        views: rows of the paper's figure of reconstructions.
        comparisons: pictures of answers side by side by the names of their files.
    """

    name: str
    title: str
    scale: str
    rows: tuple[Row, ...]
    claims: tuple[Claim, ...]
    notes: tuple[str, ...] = ()
    views: tuple[EvaluatedView, ...] = ()
    comparisons: Mapping[str, Comparison] = field(default_factory=dict)


def better(score: Score, other: Score) -> bool:
    """Whether a score is better than another: by mIoU, or by IoU where one of the two knows no segments."""
    if isnan(score.miou) or isnan(other.miou):
        return score.iou > other.iou
    return score.miou > other.miou


def compare(shown: Shown, views: Sequence[Sequence[EvaluatedView]], rows: Sequence[Row]) -> Comparison:
    """Picture of one view of each of a table's rows, in its order: an object's variants side by side."""
    words = iter(f"{row.variant}: {_scores(row.score)}" for row in rows)
    return Comparison(shown, views, [[next(words) for _ in each] for each in views])


def _scores(score: Score) -> str:
    return f"IoU {score.iou:.3f}" + ("" if isnan(score.miou) else f", mIoU {score.miou:.3f}")


def write_result(result: Result, directory: Path, force: bool = True) -> None:
    """Write table.md, results.json, figure.png and further pictures into a new directory, whole or not at all."""
    with new_directory(directory, force=force) as partial:
        with atomic_file(partial / "table.md") as path:
            path.write_text(markdown(result), encoding="utf-8")
        write_json(partial / "results.json", _plain(result))
        draw_bars(result, partial / "figure.png")
        if result.views:
            error_picture(partial / "reconstructions.png", result.views)
        for name, comparison in result.comparisons.items():
            comparison_picture(partial / name, comparison)


NOT_COMPARED = (
    "The paper's figures are of its own scenes, which are not published: they tell which variant was better there, and "
    "are no measure for ours."
)


def markdown(result: Result) -> str:
    """Markdown table with the paper's scores behind ours, and each claim with its verdict."""
    head = ["object", "variant", "IoU", "mIoU", "mean IoU", "mean mIoU", "paper's scene: IoU", "mIoU"]
    lacking = any(row.lacks for row in result.rows)
    head += ["lacks"] * lacking
    lines = [f"# {result.title}", "", f"Scale `{result.scale}`. {' '.join(result.notes)}".rstrip(), ""]
    lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in result.rows:
        score = row.score
        paper = row.paper or {}
        ours = (score.iou, score.miou, score.example_iou, score.example_miou)
        figures = [*ours, paper.get("iou", float("nan")), paper.get("miou", float("nan"))]
        cells = [row.object, row.variant, *(format_score(value, "") for value in figures), *[row.lacks] * lacking]
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", f"IoU and mIoU are over the whole test set, the means over its examples. {NOT_COMPARED}", ""]
    lines += [f"- {claim.text} {claim.verdict}" for claim in result.claims]
    return "\n".join(lines) + "\n"


def _plain(result: Result) -> dict[str, Any]:
    """All but the pictures."""
    rows = [asdict(row) for row in result.rows]
    claims = [{**asdict(claim), "verdict": claim.verdict} for claim in result.claims]
    head = {"name": result.name, "title": result.title, "scale": result.scale, "notes": result.notes}
    return {**head, "claims": claims, "rows": rows}


def draw_bars(result: Result, path: Path) -> None:
    """Draw a group of bars per object: IoU (pale) and mIoU (full) of each variant; lines: the paper's, on its scene."""
    from matplotlib.patches import Patch

    objects = list(dict.fromkeys(row.object for row in result.rows))
    variants = list(dict.fromkeys(row.variant for row in result.rows))
    plt = pyplot()
    colors = viridis(np.linspace(0.05, 0.9, len(variants))) / 255
    width = 0.8 / len(variants)
    inches = max(6.5, 0.45 * len(result.rows) + 1.5)
    figure, axes = plt.subplots(figsize=(inches, 4.2), layout="constrained")
    for row in result.rows:
        number = variants.index(row.variant)
        x = objects.index(row.object) + (number - (len(variants) - 1) / 2) * width
        axes.bar(x, row.score.iou, width * 0.9, color=colors[number], alpha=0.35)
        if not isnan(row.score.miou):
            axes.bar(x, row.score.miou, width * 0.55, color=colors[number])
        for value in (row.paper or {}).values():
            axes.plot([x - width * 0.45, x + width * 0.45], [value, value], color="black", linewidth=1.2)
    handles = [Patch(color=color) for color in colors]
    columns = max(1, int(inches * 12) // (max(map(len, variants)) + 6))  # about twelve letters to an inch
    figure.legend(handles, variants, fontsize=8, ncols=columns, loc="outside lower center")
    axes.set_xticks(range(len(objects)), objects)
    axes.set_ylim(0, 1)
    axes.set_ylabel("IoU (pale), mIoU (full), the paper's scene (line)")
    axes.set_title(f"{result.title} ({result.scale})", fontsize=10)
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=130, format="png")
    plt.close(figure)
