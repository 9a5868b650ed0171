"""Words for one line that stands for a value: what a notebook or a debugger shows instead of its arrays."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

FEW = 6
"""Names that are listed before the others are only counted."""


def listed(names: Iterable[str], most: int = FEW) -> str:
    """Names with commas; of more than ``most`` the first ones, and how many there are."""
    every = list(names)
    return ", ".join(every) if len(every) <= most else f"{', '.join(every[: most - 1])}, ... ({len(every)})"


def counted(count: int, what: str) -> str:
    """Number with a noun, whose plural ends in s."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def sides(points: Float[np.ndarray, "n 3"]) -> str:
    """Sides of the box around points, such as "31.5 x 17.6 x 19.1"; "empty" around none."""
    return " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0)) if len(points) else "empty"
