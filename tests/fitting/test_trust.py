"""The first line of a report says whether to trust the answer, and why."""

from typing import Any

import pytest

from mereo.fitting.registration.recognition import MOST, NOT_EVALUATED, Recognition, Signs
from mereo.visualization.reconstruction_report import VERDICTS, trust

SIGNS = Signs(size=0.01, unexplained=0.2)
TAKEN = {"answer": "registration", "explained": 0.989, "accepted": True}
KEPT = {"answer": "network", "explained": 0.668, "accepted": False}


def summary(recognition: Recognition | None, registration: dict[str, Any] | None) -> dict[str, Any]:
    told: dict[str, Any] = {} if recognition is None else {"recognition": recognition.facts()}
    return told if registration is None else {**told, "registration": registration}


def recognized(known: bool | str, reason: str | None) -> Recognition:
    return Recognition(known, reason, 5.0, SIGNS)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "recognition, registration, level, line, cure",
    [
        (
            recognized(True, None),
            TAKEN,
            "yes",
            "Trust it: the frame shows the object; the model explains 98.9 % of the points.",
            None,
        ),
        (
            recognized("unsure", "3% of the points are not the model's: look at the result, or crop"),
            TAKEN,
            "doubt",
            "Doubtful: 3% of the points are not the model's.",
            "look at the result, or crop",
        ),
        (
            recognized(False, "its size differs by a factor of 25.4: correct the unit (--unit-m: metres)"),
            TAKEN,
            "no",
            "Do not trust it: its size differs by a factor of 25.4.",
            "correct the unit (--unit-m: metres)",
        ),
        (
            recognized(False, "both have the same places apart: look at it"),
            KEPT,
            "no",
            "Do not trust it: both have the same places apart; the model explains only 66.8 % of the points.",
            "look at it",
        ),
        (
            recognized(False, "only 30% of the points can be the model's: turn the cloud"),
            KEPT,
            "no",
            "Do not trust it: only 30% of the points can be the model's.",
            "turn the cloud",
        ),
        (
            Recognition(False, "the cloud is flat", MOST),
            {"answer": "network", "refusal": "the cloud is flat"},
            "no",
            "Do not trust it: the cloud is flat.",
            None,
        ),
        (
            recognized(True, None),
            KEPT,
            "doubt",
            "Doubtful: the model explains only 66.8 % of the points, so this is the network's answer.",
            None,
        ),
        (
            recognized(True, None),
            {**TAKEN, "explained": 0.7, "accepted": False},
            "doubt",
            "Doubtful: the model explains only 70.0 % of the points.",
            None,
        ),
        (NOT_EVALUATED, None, "alone", "Network alone: nothing says whether this is the object.", None),
        (None, None, "alone", "Network alone: nothing says whether this is the object.", None),
        (
            None,
            TAKEN,
            "unchecked",
            "Not checked: nothing says whether this is the object; the model explains 98.9 % of the points.",
            None,
        ),
    ],
)
def test_a_verdict_is_one_line_with_its_reason(
    recognition: Recognition | None, registration: dict[str, Any] | None, level: str, line: str, cure: str | None
) -> None:
    found = trust(summary(recognition, registration))
    told = f"{VERDICTS[found.level]}: {found.why}."
    assert (found.level, told.replace("\N{NO-BREAK SPACE}", " "), found.cure) == (level, line, cure)


@pytest.mark.parametrize("junk", [None, 3, "x", [], {"known": None, "explained": float("nan"), "answer": 7}])
def test_a_damaged_summary_is_not_trusted(junk: object) -> None:
    assert trust({"recognition": junk, "registration": junk}).level not in ("yes", "doubt")
