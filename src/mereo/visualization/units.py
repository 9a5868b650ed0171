"""Lengths and volumes for people: in millimetres and cubic centimetres where the unit is known."""

from collections.abc import Sequence
from dataclasses import dataclass

from mereo.geometry.brief import as_exact_as, between, rounded
from mereo.geometry.transforms import Vector


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

    def place(self, point: Vector, radius: float | None = None) -> str:
        """Coordinates of a point of the frame, without the unit's name; with a radius all as exact as that, and it."""
        values = [float(value) for value in point * self.length_factor]
        if radius is None:
            return " ".join(rounded(value) for value in values)
        *near, off = as_exact_as(radius * self.length_factor, *values, radius * self.length_factor)
        return f"{' '.join(near)} ± {off}"

    def volume(self, volume: float, bounds: Sequence[float] | None = None) -> str:
        """Volume of the frame, without the unit's name; with its bounds to the digits of their width, four at most."""
        value = volume * self.volume_factor
        if bounds is None:
            return rounded(value)
        low, high = (bound * self.volume_factor for bound in bounds)
        return between(value, low, high)


UNKNOWN = Unit(None)
"""Unit of a cloud that does not say which it is."""
