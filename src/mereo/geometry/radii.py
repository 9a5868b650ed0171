"""Radii of 95 % of an object's points, as files and pictures take them: at vertices, at any place, on a grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from scipy.spatial import cKDTree

from mereo.geometry.conventions import WholeNumbers
from mereo.geometry.labels import LabelGrid
from mereo.geometry.mesh import Color, Colors, SegmentColors
from mereo.geometry.transforms import Points, Values

STOPS: SegmentColors = ((214, 224, 234), (250, 205, 120), (226, 98, 62), (122, 24, 70))
"""Colours from a radius of none to ``Radii.high``: pale is sure, dark red is not."""


@dataclass(frozen=True, eq=False)
class Radii:
    """Radius around each of an object's points that holds its true place with probability 0.95, in the input's unit.

    Attributes:
        points: first the vertices of all segments, one after the other, then points inside; the input's frame.
        labels: of their segments, from 1 up.
        values: the radii.
        counts: how many vertices each segment has.
        calibrated: whether the radii were calibrated on training views of the object.
    """

    points: Float[ndarray, "m 3"]
    labels: UInt8[ndarray, " m"]
    values: Float[ndarray, " m"]
    counts: WholeNumbers
    calibrated: bool

    @property
    def vertices(self) -> tuple[Float[ndarray, " v"], ...]:
        """Radii of the vertices of each segment."""
        ends = np.cumsum(self.counts)
        return tuple(np.split(self.values[: ends[-1]], ends[:-1]))

    @property
    def high(self) -> float:
        """Radius at which colours end: the greatest but for a twentieth of the vertices."""
        return float(np.quantile(self.values[: sum(self.counts)], 0.95))

    def colors(self, values: Values) -> Colors:
        """Colours (red, green, blue) of radii."""
        return between_stops(values / max(self.high, 1e-30), STOPS).round().astype(np.uint8)

    def scaled(self, factor: float) -> "Radii":
        """The same in another unit."""
        return replace(self, points=self.points * factor, values=self.values * factor)

    @cached_property
    def _trees(self) -> dict[int, tuple[cKDTree, Values]]:
        each = {int(label): np.flatnonzero(self.labels == label) for label in np.unique(self.labels)}
        return {label: (cKDTree(self.points[rows]), self.values[rows]) for label, rows in each.items()}

    def at(self, places: Points, label: int) -> Values:
        """Radii at places in or near a segment, between its nearest points by the inverse of the squared distance."""
        tree, values = self._trees[label]
        distance, near = tree.query(places, k=range(1, min(4, len(values)) + 1))  # a radius is smooth
        weight = 1.0 / np.maximum(distance, 1e-12 * max(1.0, float(np.abs(self.points).max()))) ** 2
        return (weight * values[near]).sum(axis=1) / weight.sum(axis=1)

    def on_grid(self, grid: LabelGrid) -> Float32[ndarray, "x y z"]:
        """Radii at the centres of the voxels of each segment, to three digits; NaN in empty space."""
        result = np.full(grid.labels.shape, np.nan, np.float32)
        for label in self._trees:
            index = np.argwhere(grid.labels == label)
            if len(index):
                # a radius is not known better, and files become a third as large
                result[tuple(index.T)] = rounded_to(self.at(grid.positions(index), label), 3)
        return result


def describe_level(calibrated: bool) -> str:
    """Words for the probability with which a place lies within its radius, and on whose word that is."""
    return "95 %" if calibrated else "95 %, not calibrated"


def rounded_to(values: Values, digits: int) -> Values:
    """Positive numbers to this many decimal digits."""
    unit = 10.0 ** (np.floor(np.log10(np.maximum(values, np.finfo(np.float64).tiny))) - digits + 1)
    return np.round(values / unit) * unit


def between_stops(shares: Values, stops: Sequence[Color]) -> Points:
    """Colours (red, green, blue, 0 to 255) of shares, linear between stops at equal distances.

    What lies below 0 or above 1 has the colour of that end; NaN stays NaN.
    """
    places = np.clip(shares, 0.0, 1.0) * (len(stops) - 1)
    columns = np.asarray(stops, float).T
    return np.stack([np.interp(places, np.arange(len(stops)), column) for column in columns], axis=1)
