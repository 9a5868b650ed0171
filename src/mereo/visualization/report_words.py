"""Text of the page of a reconstruction: whether to trust it, facts, the table of its segments and its times.

    summary of a result -trust-> Trust (a verdict, why, and what to do)
                        -page_words-> all text of the page, in known units

Nothing is decided here: the verdict is that of ``fitting.registration.recognition``, with what the registration says of
itself, as a summary has both.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mereo.geometry.radii import describe_level
from mereo.visualization.units import Unit, rounded

# --- trust ------------------------------------------------------------------------------------------------------------

Level = Literal["yes", "doubt", "no", "unchecked", "alone"]

VERDICTS: Mapping[Level, str] = {
    "yes": "Trust it",
    "doubt": "Doubtful",
    "no": "Do not trust it",
    "unchecked": "Not checked",
    "alone": "Network alone",
}
"""First words of the line."""


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


def trust(summary: Mapping[str, Any]) -> Trust:
    """Verdict on the answer that a summary is of; every key of it may be missing.

    Args:
        summary: its ``recognition`` and ``registration`` are read.
    """
    recognition, registration = _block(summary, "recognition"), _block(summary, "registration")
    known, reason = recognition.get("known"), recognition.get("reason") or registration.get("refusal")
    number = _number(registration.get("explained"))
    explained = None if number is None else f"{100 * number:.1f}\N{NO-BREAK SPACE}% of the points"
    model_explains = "" if explained is None else f"; the model explains {explained}"
    is_model = registration.get("answer") == "registration"
    if known is not True and not recognition.get("signs") and not registration.get("refusal"):
        return Trust("unchecked" if is_model else "alone", f"nothing says whether this is the object{model_explains}")
    if known is not True:
        # a reason is what was seen, a colon, and what to do about it
        why, _, cure = str(reason or "it was not recognized").removesuffix(".").partition(": ")
        if explained is not None and not is_model and "of the points" not in why:
            why = f"{why}; the model explains only {explained}"
        return Trust("doubt" if known == "unsure" else "no", why, cure or None)
    if not is_model or registration.get("accepted") is False:
        why = "the model explains too little" if explained is None else f"the model explains only {explained}"
        return Trust("doubt", why if is_model else f"{why}, so this is the network's answer")
    return Trust("yes", f"the frame shows the object{model_explains}")


def _block(summary: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = summary.get(key)
    return value if isinstance(value, Mapping) else {}


def _number(value: object) -> float | None:
    """The value as a finite number; None for everything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return float(value) if np.isfinite(value) else None


# --- page -------------------------------------------------------------------------------------------------------------

STAGES = {
    "encode": "reading the points",
    "fit": "registration",
    "locate": "finding the object",
    "extract": "surfaces",
    "label": "labels of the volume",
    "points": "labels of the points",
    "measure": "measuring",
    "write": "writing files",
}
"""What each stage of ``timings_s`` does; another one keeps its name."""

SHOWN_APART = (
    *("title", "recognition", "radius95", "unit", "unit_m", "source", "frame", "points", "segments", "nested"),
    *("timings_s", "registration", "weights", "spacing", "device", "resolution", "clipped", "calibrated"),
)
"""Keys of a summary that the page shows in another place, or that its units say."""

FOR_PROGRAMS = (
    *("precision", "evaluated_points", "depth_m", "visible_size_m", "invalid_points", "isolation", "carried"),
    "scene_file",
)
"""Keys that only summary.json has."""


DEVICES = {"cpu": "the processor", "cuda": "the GPU"}
DASH, GAP = "\N{EN DASH}", 3 * "\N{NO-BREAK SPACE}"
"""For what there is no number of; between coordinates, which have commas at their thousands."""


def confidence_title(calibrated: bool) -> str:
    """Head of a column of confidences."""
    return "confidence" if calibrated else "confidence, not calibrated"


def page_words(summary: Mapping[str, Any], unit: Unit) -> dict[str, Any]:
    """Texts of the page.

    Args:
        summary: as a ``Report`` has it.
        unit: of the lengths in it.

    Returns ``title``, ``trust`` (level, verdict and why), ``facts`` (phrases), ``warnings`` (sentences), ``heads``
    (of the table), ``units`` (of its lengths and volumes), ``rows`` (centre, volume and confidence of each segment;
    confidence is None where there is none), ``weights`` (their name) and ``timings_s``, seconds of each stage in words.
    """
    verdict = trust(summary)
    times = {name: _number(seconds) for name, seconds in dict(summary.get("timings_s") or {}).items()}
    return {
        "title": str(summary.get("title", "mereo reconstruction")),
        "trust": [verdict.level, f"{VERDICTS[verdict.level]}:", f"{verdict.why}."],
        "facts": _facts(summary, unit, verdict),
        "warnings": _warnings(summary, verdict),
        "heads": _heads(summary, unit),
        "units": [unit.length_name, unit.volume_name],
        "rows": [_row(segment, unit) for segment in summary.get("segments") or ()],
        "weights": str(summary.get("weights") or ""),
        "timings_s": {STAGES.get(name, _plain(name)): value for name, value in times.items() if value is not None},
    }


def _heads(summary: Mapping[str, Any], unit: Unit) -> list[str]:
    """Heads of the table; with radii of 95 % its centres and volumes say how sure they are."""
    sure = isinstance(summary.get("radius95"), Mapping)
    centre, volume = (", ± 95 %", ", 95 % range") if sure else ("", "")
    heads = [f"centre x, y, z{centre} ({unit.length_name})", f"volume{volume} ({unit.volume_name})"]
    segments = summary.get("segments") or ()
    if not segments or any(_number(segment.get("confidence")) is not None for segment in segments):
        heads.append(confidence_title(summary.get("calibrated") is True))
    return ["segment", *heads]


def _facts(summary: Mapping[str, Any], unit: Unit, verdict: Trust) -> list[str]:
    """Where the answer comes from, what it was made with, then whatever else a caller has to say."""
    registration, radius95 = summary.get("registration"), summary.get("radius95")
    facts = [_answer(registration, verdict)] if isinstance(registration, Mapping) else []
    source, spacing = summary.get("source"), _number(summary.get("spacing"))
    if source is not None and str(source) != str(summary.get("title")):
        facts.append(f"from {source}")
    if isinstance(radius95, Mapping):
        middle, most = (rounded(float(radius95[key]) * unit.length_factor) for key in ("median", "max"))
        level = describe_level(bool(radius95.get("calibrated")))
        facts.append(f"surface within {middle} {unit.length_name} in the median, {most} at most ({level})")
    if spacing is not None:
        facts.append(f"voxels of {rounded(spacing * unit.length_factor)} {unit.length_name}")
    if summary.get("device"):
        facts.append(f"computed on {DEVICES.get(str(summary['device']), str(summary['device']))}")
    for key, value in summary.items():
        number = _number(value)
        if key not in SHOWN_APART + FOR_PROGRAMS and (number is not None or isinstance(value, str)):
            facts.append(f"{_plain(key)}: {value if number is None else rounded(number)}")
    return facts


def _answer(registration: Mapping[str, Any], verdict: Trust) -> str:
    explained = _number(registration.get("explained"))
    if registration.get("answer") != "registration":
        return "the network's own answer"
    ways = {"search": "found by a search", "pose": "fitted from the initial pose"}
    how = ways.get(str(registration.get("located_by")), "registered")
    # two of the verdicts say themselves how much it explains
    share = "" if explained is None or verdict.level in ("yes", "unchecked") else f"{explained:.1%}"
    return f"your model, {how}" + (share and f": it explains {share} of the points")


def _warnings(summary: Mapping[str, Any], verdict: Trust) -> list[str]:
    """Sentences on what to do about a result that may not be what it seems; the verdict itself has said why."""
    warnings = [] if verdict.cure is None else [verdict.cure]
    warnings += [str(sentence) for sentence in _block(summary, "registration").get("symmetries") or ()]
    if summary.get("clipped"):
        warnings.append("the object reaches the border of the volume that was searched and may be cut off there")
    return [text[0].upper() + text[1:] + ("" if text.endswith(".") else ".") for text in warnings]


def _row(segment: Mapping[str, Any], unit: Unit) -> list[Any]:
    centre, volume = segment.get("centroid"), _number(segment.get("volume"))
    radius = _number(segment.get("centroid_radius95"))
    words = DASH if centre is None else unit.place(np.asarray(centre, dtype=float), radius)
    place, sign, off = words.partition(" ± ")
    # a narrow page breaks these lines at their plain spaces
    place = GAP.join(place.split()) + (f"{GAP} ±\N{NO-BREAK SPACE}{off}" if sign else "")
    size = DASH if volume is None else unit.volume(volume, segment.get("volume95"))
    return [place, size, _number(segment.get("confidence"))]


def _plain(key: str) -> str:
    return key.replace("_", " ")
