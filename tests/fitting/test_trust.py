"""The first line of a report says whether to trust the answer, and why."""

from typing import Any

import pytest

from mereo.fitting.registration.recognition import MOST, NOT_EVALUATED, Recognition, Signs
from mereo.visualization.reconstruction_report import VERDICTS, trust

TAKEN = {"answer": "registration", "explained": 0.989, "accepted": True}
KEPT = {"answer": "network", "explained": 0.668, "accepted": False}
FLAT = {"answer": "network", "refusal": "the cloud is flat"}
NOTHING_SAYS = "Network alone: nothing says whether this is the object."


def recognized(known: bool | str, reason: str | None = None) -> Recognition:
    return Recognition(known, reason, 5.0, Signs(size=0.01, unexplained=0.2))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "recognition, registration, level, line, cure",
    [
        (recognized(True), TAKEN, "yes", "Trust it: the frame shows the object; the model explains 98.9 %", None),
        (recognized("unsure", "3% are not: look, or crop"), TAKEN, "doubt", "Doubtful: 3% are not.", "look, or crop"),
        (
            recognized(False, "its size: the unit (-u: m)"),
            TAKEN,
            "no",
            "Do not trust it: its size.",
            "the unit (-u: m)",
        ),
        (
            recognized(False, "apart: look"),
            KEPT,
            "no",
            "Do not trust it: apart; the model explains only 66.8 %",
            "look",
        ),
        (
            recognized(False, "only 30% of the points: turn"),
            KEPT,
            "no",
            "Do not trust it: only 30% of the points.",
            "turn",
        ),
        (Recognition(False, "the cloud is flat", MOST), FLAT, "no", "Do not trust it: the cloud is flat.", None),
        (recognized(True), KEPT, "doubt", "Doubtful: the model explains only 66.8 % of the points, so this is", None),
        (recognized(True), {**TAKEN, "explained": 0.7, "accepted": False}, "doubt", "Doubtful: the model ex", None),
        (NOT_EVALUATED, None, "alone", NOTHING_SAYS, None),
        (None, None, "alone", NOTHING_SAYS, None),
        (
            None,
            TAKEN,
            "unchecked",
            "Not checked: nothing says whether this is the object; the model explains 98.9",
            None,
        ),
    ],
)
def test_a_verdict_is_one_line_with_its_reason(
    recognition: Recognition | None, registration: dict[str, Any] | None, level: str, line: str, cure: str | None
) -> None:
    summary: dict[str, Any] = {} if recognition is None else {"recognition": recognition.facts()}
    found = trust(summary if registration is None else {**summary, "registration": registration})
    verdict = f"{VERDICTS[found.level]}: {found.why}.".replace("\N{NO-BREAK SPACE}", " ")
    assert (found.level, found.cure) == (level, cure) and verdict.startswith(line)


@pytest.mark.parametrize("junk", [None, 3, [], {"known": None, "explained": float("nan"), "answer": 7}])
def test_a_damaged_summary_is_not_trusted(junk: object) -> None:
    assert trust({"recognition": junk, "registration": junk}).level not in ("yes", "doubt")
