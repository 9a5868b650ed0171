"""What the page of a reconstruction says: facts, the table of its segments and its times, in words and known units.

``reconstruction_report`` is about the page's shapes and bytes; here is all of its text that depends on a result.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mereo.geometry.radii import level_told
from mereo.visualization.trust import Trust, trust
from mereo.visualization.units import Unit, rounded

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

SAID_ELSEWHERE = frozenset(
    {
        "title",
        "recognition",
        "radius95",
        "unit",
        "unit_m",
        "source",
        "frame",
        "points",
        "segments",
        "nested",
        "timings_s",
        "registration",
    }
)
"""Keys of a summary that the page shows in another place, or that its units say."""

FOR_PROGRAMS = frozenset(
    {
        "precision",
        "evaluated_points",
        "depth_m",
        "visible_size_m",
        "invalid_points",
        "isolation",
        "carried",
        "scene_file",
    }
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
        summary: as ``write_report`` takes it.
        unit: of the lengths in it.

    Returns ``title``, ``trust`` (level, verdict and why), ``facts`` (phrases), ``warnings`` (sentences), ``heads``
    (of the table), ``units`` (of its lengths and volumes), ``rows`` (centre, volume and confidence of each segment;
    confidence is None where there is none), ``weights`` (their name) and ``timings_s``, seconds of each stage in words.
    """
    verdict = trust(summary)
    title = confidence_title(summary.get("calibrated") is True)
    times = {name: _number(seconds) for name, seconds in dict(summary.get("timings_s") or {}).items()}
    return {
        "title": str(summary.get("title", "mereo reconstruction")),
        "trust": [verdict.level, f"{verdict.verdict}:", f"{verdict.why}."],
        "facts": _facts(summary, unit, verdict),
        "warnings": _warnings(summary, verdict),
        "heads": _heads(summary, unit, title),
        "units": [unit.length_name, unit.volume_name],
        "rows": [_row(told, unit) for told in summary.get("segments") or ()],
        "weights": str(summary.get("weights") or ""),
        "timings_s": {STAGES.get(name, _plain(name)): value for name, value in times.items() if value is not None},
    }


def _heads(summary: Mapping[str, Any], unit: Unit, confidence: str) -> list[str]:
    """Heads of the table; with radii of 95 % its centres and volumes say how sure they are."""
    sure = isinstance(summary.get("radius95"), Mapping)
    centre, volume = (", ± 95 %", ", 95 % range") if sure else ("", "")
    heads = [f"centre x, y, z{centre} ({unit.length_name})", f"volume{volume} ({unit.volume_name})"]
    known = any(_number(told.get("confidence")) is not None for told in summary.get("segments") or ())
    return ["segment", *heads, *([confidence] if known or not summary.get("segments") else [])]


def _facts(summary: Mapping[str, Any], unit: Unit, verdict: Trust) -> list[str]:
    """Where the answer comes from, what it was made with, then whatever else a caller has to say."""
    registration = summary.get("registration")
    facts = [_answer(registration, verdict)] if isinstance(registration, Mapping) else []
    source, spacing = summary.get("source"), _number(summary.get("spacing"))
    if source is not None and str(source) != str(summary.get("title")):
        facts.append(f"from {source}")
    if isinstance(summary.get("radius95"), Mapping):
        facts.append(_sure(summary["radius95"], unit))
    if spacing is not None:
        facts.append(f"voxels of {rounded(spacing * unit.length_factor)} {unit.length_name}")
    if summary.get("device"):
        facts.append(f"computed on {DEVICES.get(str(summary['device']), str(summary['device']))}")
    said = SAID_ELSEWHERE | FOR_PROGRAMS | {"weights", "spacing", "device", "resolution", "clipped", "calibrated"}
    for key, value in summary.items():
        number = None if isinstance(value, bool) else _number(value)
        if key not in said and (number is not None or isinstance(value, str)):
            facts.append(f"{_plain(key)}: {value if number is None else rounded(number)}")
    return facts


def _sure(radius95: Mapping[str, Any], unit: Unit) -> str:
    middle, most = (rounded(float(radius95[key]) * unit.length_factor) for key in ("median", "max"))
    level = level_told(bool(radius95.get("calibrated")))
    return f"surface within {middle} {unit.length_name} in the median, {most} at most ({level})"


def _answer(registration: Mapping[str, Any], verdict: Trust) -> str:
    explained = _number(registration.get("explained"))
    if registration.get("answer") != "registration":
        return "the network's own answer"
    found = "your model, found by a search" if registration.get("found_by") == "search" else "your model, registered"
    if explained is None or verdict.level in ("yes", "unchecked"):  # which say it themselves
        return found
    return f"{found}: it explains {explained:.1%} of the points"


def _warnings(summary: Mapping[str, Any], verdict: Trust) -> list[str]:
    """Sentences on what to do about a result that may not be what it seems; the verdict itself has said why."""
    warnings = [] if verdict.cure is None else [verdict.cure]
    if summary.get("clipped"):
        warnings.append("the object reaches the border of the volume that was searched and may be cut off there")
    return [text[0].upper() + text[1:] + ("" if text.endswith(".") else ".") for text in warnings]


def _row(told: Mapping[str, Any], unit: Unit) -> list[Any]:
    centre, volume = told.get("centroid"), _number(told.get("volume"))
    radius, between = _number(told.get("centroid_radius95")), told.get("volume95")
    words = DASH if centre is None else unit.place(np.asarray(centre, dtype=float), radius)
    place, sign, off = words.partition(" ± ")
    # a narrow page breaks these lines at their plain spaces
    place = GAP.join(place.split()) + (f"{GAP} ±\N{NO-BREAK SPACE}{off}" if sign else "")
    size = DASH if volume is None else unit.volume(volume, between)
    return [place, size, _number(told.get("confidence"))]


def _number(value: object) -> float | None:
    """The value as a finite number; None for everything else."""
    if not isinstance(value, int | float | np.integer | np.floating) or not np.isfinite(value):
        return None
    return float(value)


def _plain(key: str) -> str:
    return key.replace("_", " ")
