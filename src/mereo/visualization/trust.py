"""Whether to trust an answer, in one line: what a reader of a result wants to know before all else.

    summary of a result -trust-> Trust (a verdict, why, and what to do)

Nothing is decided here: the verdict is that of ``fitting.registration.recognition``, with what the registration says of
itself, as a summary has both.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Level = Literal["yes", "doubt", "no", "unchecked", "alone"]

VERDICTS: Mapping[Level, str] = {
    "yes": "Trust it",
    "doubt": "Doubtful",
    "no": "Do not trust it",
    "unchecked": "Not checked",
    "alone": "Network alone",
}
"""First words of the line."""

NOT_ASKED = "nothing says whether this is the object"


@dataclass(frozen=True)
class Trust:
    """Verdict on an answer.

    Attributes:
        level: how far it can be trusted; "alone" where no model was registered, which could tell, and "unchecked" where
            one was, but nobody looked.
        why: a phrase, without a full stop.
        cure: what to do, a phrase; None where nothing is to be done, or nothing known.
    """

    level: Level
    why: str
    cure: str | None = None

    @property
    def verdict(self) -> str:
        """First words of the line."""
        return VERDICTS[self.level]

    @property
    def line(self) -> str:
        """One line for people, without what to do."""
        return f"{self.verdict}: {self.why}."


def trust(summary: Mapping[str, Any]) -> Trust:
    """Verdict on the answer that a summary is of; every key of it may be missing.

    Args:
        summary: its ``recognition`` (``Recognition.facts``) and ``registration`` (``registration_facts``) are read.
    """
    recognition, registration = _block(summary, "recognition"), _block(summary, "registration")
    known, reason = recognition.get("known"), recognition.get("reason") or registration.get("refusal")
    explained = _share(registration.get("explained"))
    is_model = registration.get("answer") == "registration"
    if known is not True and not recognition.get("signs") and not registration.get("refusal"):
        told = "" if explained is None else f"; the model explains {explained}"
        return Trust("unchecked" if is_model else "alone", f"{NOT_ASKED}{told}")
    if known is not True:
        # a reason is what was seen, a colon, and what to do about it
        why, _, cure = str(reason or "it was not recognized").removesuffix(".").partition(": ")
        if explained is not None and not is_model and "of the points" not in why:
            why = f"{why}; the model explains only {explained}"
        return Trust("doubt" if known == "unsure" else "no", why, cure or None)
    if not is_model or registration.get("accepted") is False:
        why = "the model explains too little" if explained is None else f"the model explains only {explained}"
        return Trust("doubt", why if is_model else f"{why}, so this is the network's answer")
    told = "" if explained is None else f"; the model explains {explained}"
    return Trust("yes", f"the frame shows the object{told}")


def _block(summary: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = summary.get(key)
    return found if isinstance(found, Mapping) else {}


def _share(value: object) -> str | None:
    """Share of the points in words; None where it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return f"{100 * float(value):.1f}\N{NO-BREAK SPACE}% of the points" if np.isfinite(value) else None
