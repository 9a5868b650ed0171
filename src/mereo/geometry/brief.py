"""Words for one line that stands for a value: what a notebook or a debugger shows instead of its arrays."""

from collections.abc import Iterable
from math import floor, isfinite, log10

import numpy as np

from mereo.geometry.transforms import Points

FEW = 6
"""Names that are listed before the others are only counted."""


def listed(names: Iterable[str]) -> str:
    """Names with commas; of more than ``FEW`` the first ones, and how many there are."""
    every = list(names)
    return ", ".join(every) if len(every) <= FEW else f"{', '.join(every[: FEW - 1])}, ... ({len(every)})"


def counted(count: int, what: str) -> str:
    """Number with a noun, whose plural ends in s."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def sides(points: Points) -> str:
    """Sides of the box around points, such as "31.5 x 17.6 x 19.1"; "empty" around none."""
    return " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0)) if len(points) else "empty"


def rounded(value: float) -> str:
    """Number with three digits, or all before the point: 0.0123, 4.56, 78.9, 12,345."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def as_exact_as(error: float, *values: float) -> list[str]:
    """Numbers with as many decimals as show two digits of an error: 0.187 makes 24.7 into 24.70, and 3.75 into 24.7."""
    if not (isfinite(error) and error > 0):
        return [rounded(value) for value in values]
    decimals = max(0, 1 - floor(log10(error)))
    # adding 0.0 makes a zero of a negative zero
    return [f"{round(value, decimals) + 0.0:,.{decimals}f}" for value in values]


def between(value: float, low: float, high: float) -> str:
    """Number with its bounds in as many digits as their width allows, but no decimals from the fifth digit on.

    Without bounds where those digits do not tell them apart.
    """
    middle, least, most = as_exact_as(max(high - low, abs(value) / 100), value, low, high)
    return middle if least == most else f"{middle} ({least} to {most})"
