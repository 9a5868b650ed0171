"""Lengths and volumes for people: in millimetres and cubic centimetres where the unit is known."""

from dataclasses import dataclass

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
        """Name of the unit that lengths are told in."""
        return "units" if self.metres is None else "mm"

    @property
    def volume_name(self) -> str:
        """Name of the unit that volumes are told in."""
        return "units³" if self.metres is None else "cm³"

    @property
    def length_factor(self) -> float:
        """Factor from a length of the frame to one that is told."""
        return 1.0 if self.metres is None else 1000 * self.metres

    @property
    def volume_factor(self) -> float:
        """Factor from a volume of the frame to one that is told."""
        return 1.0 if self.metres is None else (100 * self.metres) ** 3

    def place(self, point: Float[np.ndarray, "3"]) -> str:
        """Coordinates of a point of the frame, without the unit's name."""
        return " ".join(rounded(float(value)) for value in point * self.length_factor)

    def volume(self, volume: float) -> str:
        """Volume of the frame, without the unit's name."""
        return rounded(volume * self.volume_factor)


UNKNOWN = Unit(None)
"""Unit of a cloud that does not say which it is."""


def rounded(value: float) -> str:
    """Number with three digits, or all before the point: 0.0123, 4.56, 78.9, 12,345."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
