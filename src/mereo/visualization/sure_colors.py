"""How sure a registered model is, as bytes for the page of a reconstruction: of its surfaces, and of what decides them.

Registration -sure_colors-> SureColors -of_surface, of_points-> a byte for each vertex and each observed point
"""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty import Explanation
from mereo.geometry.mesh import Color, Segment
from mereo.geometry.radii import STOPS, Radii, between_stops, level_told
from mereo.visualization.units import Unit, rounded

UNEXPLAINED = 255
"""Byte of an observed point that the model does not explain; all others are less."""

MOST = 254
"""Byte of the point that decides a centroid most."""

WEIGHTS: tuple[Color, ...] = ((150, 156, 168), (40, 120, 255), (255, 176, 0))
"""Colours of observed points from those that decide nothing of a place to those that decide most of it; seen on dark
and on light."""

RED: Color = (229, 40, 50)
"""Colour of unexplained points."""


@dataclass(frozen=True, eq=False)
class SureColors:
    """What a page shows of how sure a registered model is.

    Attributes:
        radii: of its points.
        names: of its segments.
        centroids: what decides the centroid of each segment.
        unit: of the lengths that the page tells.
    """

    radii: Radii
    names: tuple[str, ...]
    centroids: tuple[Explanation, ...]
    unit: Unit

    def of_surface(self, part: Segment) -> str | None:
        """A byte for each vertex, 255 at ``Radii.high``, as base64; None for what is no segment of the model."""
        if part.name not in self.names or not len(part.vertices):
            return None
        share = self.radii.at(part.vertices, self.names.index(part.name) + 1) / max(self.radii.high, 1e-30)
        return _base64(np.rint(255 * np.clip(share, 0.0, 1.0)))

    def of_points(self, points: Float[np.ndarray, "n 3"]) -> list[UInt8[np.ndarray, " n"]]:
        """For each segment ``point_marks`` of its centroid."""
        return [point_marks(one, points) for one in self.centroids]

    def page_data(self, marks: list[UInt8[np.ndarray, " n"]] | None) -> dict[str, Any]:
        """What the page needs beside the bytes of the surfaces."""
        high = rounded(self.radii.high * self.unit.length_factor)
        return {
            "stops": [list(color) for color in STOPS],
            "weights": [list(color) for color in WEIGHTS],
            "unexplained": list(RED),
            "ends": ["0", f"{high} {self.unit.length_name}"],
            "title": f"the true place is so far away at most ({level_told(self.radii.calibrated)})",
            "centroids": [
                {"name": name, "marks": _base64(one), "shares": shares_told(told)}
                for name, one, told in zip(self.names, marks or (), self.centroids, strict=True)
            ],
        }


def point_marks(one: Explanation, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """A byte for each observed point: how much it decides a place, 0 to ``MOST``, or that it is ``UNEXPLAINED``.

    The weights are those of the fit's observed samples, which stand for the points around them.
    """
    away, nearest = cKDTree(one.points).query(points)
    share = one.weights[nearest] / max(float(one.weights.max()), np.finfo(np.float64).tiny)
    marks: UInt8[np.ndarray, " n"] = np.rint(MOST * share).astype(np.uint8)
    if len(one.unexplained):
        lost = cKDTree(one.unexplained).query(points)[0]
        marks[(lost <= away) & (lost < _spacing(one.points))] = UNEXPLAINED
    return marks


def mark_colors(marks: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours (red, green, blue) of ``point_marks``."""
    mixed = between_stops(marks / MOST, WEIGHTS)
    return np.where((marks == UNEXPLAINED)[:, None], RED, mixed).round().astype(np.uint8)


def sure_colors(registered: Registration, unit: Unit) -> SureColors | None:
    """What a page shows of a registration; None where it was read from a file."""
    sure = registered.uncertainty
    if sure is None:
        return None
    found = (registered.explain(name) for name in registered.model.rest.names)
    centroids = tuple(one for one in found if one is not None)
    return SureColors(sure.radii(registered.material), registered.model.rest.names, centroids, unit)


SAID = {
    "points": "the points' noise",
    "network": "what the network says",
    "silhouette": "its outline",
    "states": "the states that it can have",
}
"""Each kind of evidence in words."""


def shares_told(one: Explanation) -> str:
    """What leaves a place unsure, in words, largest first."""
    order = sorted(one.shares.items(), key=lambda item: -item[1])
    return ", ".join(f"{SAID[name]} {share:.0%}" for name, share in order if share >= 0.005)


def _spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """Distance between neighbouring points, about."""
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1])) if len(points) > 1 else np.inf


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.astype(np.uint8).tobytes()).decode("ascii")
