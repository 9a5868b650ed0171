"""Lengths and volumes for people: in millimetres and cubic centimetres where the unit is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Unit:
    """Unit of lengths in a frame.

    Attributes:
        metres: in one unit; None where that is not known.
    """

    metres: float | None

    @property
    def length_name(self) -> str:
        """Name of the unit in which lengths are written."""
        return "units" if self.metres is None else "mm"

    @property
    def volume_name(self) -> str:
        """Name of the unit in which volumes are written."""
        return "units³" if self.metres is None else "cm³"

    @property
    def length_factor(self) -> float:
        """Factor from a length of the frame to the written one."""
        return 1.0 if self.metres is None else 1000 * self.metres

    @property
    def volume_factor(self) -> float:
        """Factor from a volume of the frame to the written one."""
        return 1.0 if self.metres is None else (100 * self.metres) ** 3

    def place(self, point: Float[np.ndarray, "3"], radius: float | None = None) -> str:
        """Coordinates of a point of the frame, without the unit's name; with a radius all as exact as that, and it."""
        values = [float(value) for value in point * self.length_factor]
        if radius is None:
            return " ".join(rounded(value) for value in values)
        *near, off = as_exact_as(radius * self.length_factor, *values, radius * self.length_factor)
        return f"{' '.join(near)} ± {off}"

    def volume(self, volume: float, between: Sequence[float] | None = None) -> str:
        """Volume of the frame, without the unit's name; with its bounds all as exact as they are wide, and these."""
        value = volume * self.volume_factor
        if between is None:
            return rounded(value)
        low, high = (bound * self.volume_factor for bound in between)
        middle, least, most = as_exact_as(high - low, value, low, high)
        return f"{middle} ({least} to {most})"


UNKNOWN = Unit(None)
"""Unit of a cloud that does not say which it is."""


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
