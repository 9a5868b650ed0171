"""Colours between stops: the scales by which surfaces and points are coloured, in files as on pages."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mereo.geometry.mesh import Color


def between_stops(shares: Float[np.ndarray, " n"], stops: Sequence[Color]) -> Float[np.ndarray, "n 3"]:
    """Colours (red, green, blue, 0 to 255) of shares, linear between stops at equal distances.

    What lies below 0 or above 1 has the colour of that end; NaN stays NaN.
    """
    places = np.clip(shares, 0.0, 1.0) * (len(stops) - 1)
    columns = np.asarray(stops, dtype=float).T
    return np.stack([np.interp(places, np.arange(len(stops)), column) for column in columns], axis=1)
