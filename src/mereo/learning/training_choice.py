"""Whether an object is trained, by the scores of the search alone, and at the end which of the answers to use.

Arithmetic on scores, without files or clocks.
"""

from collections.abc import Mapping
from typing import Any, Literal

from mereo.evaluation.metrics import format_score
from mereo.evaluation.tables import CLEARLY

TrainChoice = Literal["auto", "always", "never"]
"""When to train: where the search alone is not good enough, in any case, or not at all."""

Method = Literal["auto", "search", "network"]
"""Who is to answer, as ``--method`` says it: both, the search alone, or the network alone."""

GOOD_ENOUGH = 0.85
"""mIoU from which the search alone is good enough; IoU of an object in one segment."""

LOWEST = 0.5
"""mIoU that each view must have: in one with less, segments that look alike are exchanged."""


def shortcomings(search: Mapping[str, Any]) -> list[str]:
    """Reasons why the search alone is not good enough; none where it is.

    Args:
        search: ``SearchScores.summary``.
    """
    views, missed = search["examples"], round((1 - search["explained"]) * search["examples"])
    reasons = []
    if missed:
        reasons.append(f"{missed} of {views} views are not explained")
    if search["miou"] < GOOD_ENOUGH:
        reasons.append(f"mIoU {format_score(search['miou'])} is below {GOOD_ENOUGH}")
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


def best_method(table: Mapping[str, Mapping[str, Any]]) -> tuple[Method, str]:
    """Choose who is to answer, with the reason in a sentence.

    Of the answers whose mIoU is within ``CLEARLY`` of the best, and that explain as many views, the fastest is taken;
    the network alone, which registers nothing, only where neither of the others is among them.

    Args:
        table: IoU, mIoU, explained share and seconds of "search", "network" and "both", on the same views.
    """
    scores = {name: float(row["miou"] if row["miou"] is not None else row["iou"]) for name, row in table.items()}
    explained = max(table[name]["explained"] for name in ("search", "both"))
    best = max(scores.values())
    good = [name for name in ("search", "both") if scores[name] >= best - CLEARLY]
    good = [name for name in good if table[name]["explained"] == explained] or good
    if not good:
        return "network", f"use the network alone: {_against(scores, 'network', 'both')}"
    if good == ["search", "both"]:
        fastest = min(good, key=lambda name: table[name]["seconds"])
        slower = "both" if fastest == "search" else "search"
        seconds = f"{table[fastest]['seconds']:.2f} s a frame, not {table[slower]['seconds']:.2f} s"
        if fastest == "search":
            return "search", f"use the search alone: as good as both, and faster ({seconds})"
        return "auto", f"use both: as good as the search alone, and faster ({seconds})"
    if good == ["search"]:
        return "search", f"use the search alone: {_against(scores, 'search', 'both')}"
    if scores["both"] < scores["search"] + CLEARLY:
        shares = f"{table['both']['explained']:.0%} of the views, the search alone {table['search']['explained']:.0%}"
        return "auto", f"use both: they explain {shares}"
    return "auto", f"use both: {_against(scores, 'both', 'search')}"


def _against(scores: Mapping[str, float], name: str, other: str) -> str:
    titles = {"search": "of the search alone", "both": "of both", "network": "of the network alone"}
    return f"mIoU {format_score(scores[name])}, not {format_score(scores[other])} {titles[other]}"
