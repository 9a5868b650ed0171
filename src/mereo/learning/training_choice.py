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

    Of the search alone and both, that with the clearly higher mIoU is taken (by ``CLEARLY``), else that which explains
    more views, else the faster one; the network alone, which registers nothing, only where it is clearly better still.

    Args:
        table: IoU, mIoU, explained share and seconds of "search", "network" and "both", on the same views.
    """
    scores = {name: float(row["miou"] if row["miou"] is not None else row["iou"]) for name, row in table.items()}
    search, both = table["search"], table["both"]
    if scores["network"] > max(scores["search"], scores["both"]) + CLEARLY:
        return "network", f"use the network alone: mIoU {_than(scores, 'network', 'both')}"
    if abs(scores["both"] - scores["search"]) > CLEARLY:
        is_both = scores["both"] > scores["search"]
        reason = f"mIoU {_than(scores, 'both', 'search') if is_both else _than(scores, 'search', 'both')}"
    elif both["explained"] != search["explained"]:
        is_both = both["explained"] > search["explained"]
        shares = f"{both['explained']:.0%} of the views by both, {search['explained']:.0%} by the search alone"
        reason = f"it explains more, {shares}"
    else:
        is_both = both["seconds"] < search["seconds"]
        times = f"{both['seconds']:.2f} s a frame with both, {search['seconds']:.2f} s with the search alone"
        reason = f"as good as {'the search alone' if is_both else 'both'}, and faster, {times}"
    return ("auto", f"use both: {reason}") if is_both else ("search", f"use the search alone: {reason}")


def _than(scores: Mapping[str, float], name: str, other: str) -> str:
    titles = {"search": "of the search alone", "both": "of both"}
    return f"{format_score(scores[name])}, not {format_score(scores[other])} {titles[other]}"
