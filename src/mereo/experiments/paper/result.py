"""What an experiment found, beside what the paper says: as Markdown, JSON and a bar chart."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from math import isnan
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from mereo.evaluation.scoring import EvaluatedView
from mereo.experiments.paper.store import Score
from mereo.io.atomic_files import atomic_file, new_directory, write_json
from mereo.visualization.error_maps import error_picture

Figures = dict[str, float]
"""``iou`` and ``miou``, or only one of them."""


@cache
def published() -> dict[str, Any]:
    """The paper's figures by experiment, and then as each experiment's table is built."""
    text = resources.files("mereo.experiments.paper").joinpath("published.json").read_text("utf-8")
    figures: dict[str, Any] = json.loads(text)
    return figures


@dataclass(frozen=True)
class Row:
    """One measured variant.

    Attributes:
        object: the scene.
        variant: what was varied.
        score: ours.
        paper: the paper's figures for it, where it has any.
    """

    object: str
    variant: str
    score: Score
    paper: Figures | None = None


@dataclass(frozen=True)
class Claim:
    """One claim of the paper and whether our figures bear it out.

    Attributes:
        text: a sentence.
        holds: by object; objects on which it could not be tried are left out.
    """

    text: str
    holds: dict[str, bool]

    @property
    def verdict(self) -> str:
        """Agreement in a sentence."""
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
    """A table, what to make of it, and how it was made.

    Attributes:
        name, title: of the experiment.
        scale: the budget's name.
        rows: in the table's order.
        claims: of the paper.
        notes: sentences on what differs from the paper's experiment.
        cases: rows of the paper's figure of reconstructions.
        figures: further pictures by the names of their files.
    """

    name: str
    title: str
    scale: str
    rows: tuple[Row, ...]
    claims: tuple[Claim, ...]
    notes: tuple[str, ...] = ()
    cases: tuple[EvaluatedView, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)


def better(score: Score, other: Score) -> bool:
    """By mIoU, or by IoU where one of the two knows no segments."""
    if isnan(score.miou) or isnan(other.miou):
        return score.iou > other.iou
    return score.miou > other.miou


def write_result(result: Result, directory: Path, force: bool = True) -> None:
    """table.md, results.json, figure.png and what other pictures there are in a new directory, whole or not at all."""
    with new_directory(directory, force=force) as partial:
        with atomic_file(partial / "table.md") as path:
            path.write_text(markdown(result), encoding="utf-8")
        write_json(partial / "results.json", _plain(result))
        draw_bars(result, partial / "figure.png")
        if result.cases:
            error_picture(partial / "reconstructions.png", result.cases)
        for name, figure in result.figures.items():
            _save(figure, partial / name)


def markdown(result: Result) -> str:
    """The table with the paper's figures beside ours, and each claim with its verdict."""
    lines = [f"# {result.title}", "", f"Scale `{result.scale}`. {' '.join(result.notes)}".rstrip(), ""]
    lines += [
        "| object | variant | IoU | mIoU | mean IoU | mean mIoU | paper IoU | paper mIoU |",
        "|---|---|" + "---|" * 6,
    ]
    for row in result.rows:
        score, paper = row.score, row.paper or {}
        ours = (score.iou, score.miou, score.example_iou, score.example_miou)
        figures = [*ours, paper.get("iou", float("nan")), paper.get("miou", float("nan"))]
        lines.append(f"| {row.object} | {row.variant} | {' | '.join(_cell(value) for value in figures)} |")
    lines += ["", "IoU and mIoU are over the whole test set, the means over its examples.", ""]
    lines += [f"- {claim.text} {claim.verdict}" for claim in result.claims]
    return "\n".join(lines) + "\n"


def _cell(value: float) -> str:
    return "" if isnan(value) else f"{value:.3f}"


def _plain(result: Result) -> dict[str, Any]:
    """All but the pictures."""
    rows = [asdict(row) for row in result.rows]
    claims = [{**asdict(claim), "verdict": claim.verdict} for claim in result.claims]
    head = {"name": result.name, "title": result.title, "scale": result.scale, "notes": result.notes}
    return {**head, "claims": claims, "rows": rows}


def draw_bars(result: Result, path: Path) -> None:
    """One group of bars per object: IoU (pale) and mIoU (full) of each variant; the paper's figure as a black line."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Patch

    objects = list(dict.fromkeys(row.object for row in result.rows))
    variants = list(dict.fromkeys(row.variant for row in result.rows))
    colors = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.9, len(variants)))
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
    axes.set_ylabel("IoU (pale), mIoU (full), paper (line)")
    axes.set_title(f"{result.title} ({result.scale})", fontsize=10)
    _save(figure, path)
    plt.close(figure)


def _save(figure: Figure, path: Path) -> None:
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=130, format="png")
