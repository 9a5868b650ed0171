"""Colours of surfaces by a number at each vertex, and the scales that turn numbers into colours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from mereo.geometry.mesh import Color, Segment, SegmentedMesh, vertex_normals
from mereo.geometry.radii import STOPS, Radii, between_stops, level_told
from mereo.models.trained import Answer

Ask = Callable[[Float[np.ndarray, "n 3"]], Answer]
"""Function that answers as a model does at points in the frame of the surfaces."""

CONFIDENCE_STEP = 0.02
"""Distance to either side of a surface at which the model is asked, as a share of the object's longest side."""


@dataclass(frozen=True)
class ColorScale:
    """Scale of colours for numbers from ``low`` to ``high``; what lies beyond has the colour of that end.

    Attributes:
        title: what the numbers are.
        low: number at the scale's lower end.
        high: number at its upper end.
        stops: colours at equal distances from one end to the other.
        words: what the two ends mean.
    """

    title: str
    low: float
    high: float
    stops: tuple[Color, ...]
    words: tuple[str, str]

    def colors(self, values: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
        """Colours (red, green, blue) of numbers, linear between the stops; NaN is grey."""
        mixed = between_stops((values - self.low) / (self.high - self.low), self.stops)
        return np.where(np.isnan(values)[:, None], 128.0, mixed).round().astype(np.uint8)


CONFIDENCE = ColorScale(
    "confidence of the surface",
    0.0,
    1.0,
    ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)),
    ("0, a guess", "1, certain"),
)


def distance_scale(values: Sequence[Float[np.ndarray, " _"]], unit: str) -> ColorScale:
    """Scale for ``observed_distance`` of all segments; it ends at the largest but for a twentieth of the vertices."""
    joint = np.concatenate([*values, np.zeros(1)])
    high = max(float(np.quantile(joint, 0.95)), 1e-9)
    return ColorScale(
        "distance to the nearest observed point", 0.0, high, STOPS, ("0, seen", f"{high:.3g}{unit}, guessed")
    )


def radius_scale(radii: Radii, unit: str) -> ColorScale:
    """Scale for radii of 95 % in the unit that is named."""
    title = f"true places are within ({level_told(radii.calibrated)})"
    return ColorScale(title, 0.0, max(radii.high, 1e-9), STOPS, (f"0{unit}, sure", f"{radii.high:.3g}{unit}"))


def confidence(surfaces: SegmentedMesh, ask: Ask) -> list[Float[np.ndarray, " _"]]:
    """Confidence of each surface at every vertex, 0 to 1: how decidedly the model changes its mind across it.

    On the surface itself the winner's probability says nothing: it is where the winner changes, so that two classes
    are equally likely there. Here the segment's probability a step inside is compared with that a step outside: 1 means
    that the border is known to a step of ``CONFIDENCE_STEP`` of the object, 0 that the model has no idea where it is.
    A segment that holds nested ones counts with all of them.
    """
    found = [segment for segment in surfaces.segments if len(segment.vertices)]
    if not found:
        return [np.zeros(0) for _ in surfaces.segments]
    corners = np.concatenate([segment.vertices for segment in found])
    step = CONFIDENCE_STEP * float((corners.max(axis=0) - corners.min(axis=0)).max())
    held = [
        [label, *(i + 1 for i, o in surfaces.nesting if o == label - 1)] for label in range(1, len(surfaces.names) + 1)
    ]
    return [_confidence(s, labels, ask, step) for s, labels in zip(surfaces.segments, held, strict=True)]


def _confidence(segment: Segment, labels: list[int], ask: Ask, step: float) -> Float[np.ndarray, " v"]:
    if len(segment.vertices) == 0:
        return np.zeros(0)
    offset = step * vertex_normals(segment)
    inside, outside = (ask(segment.vertices + sign * offset).probability[:, labels].sum(axis=1) for sign in (-1, 1))
    result: Float[np.ndarray, " v"] = np.clip(inside - outside, 0.0, 1.0).astype(np.float64)
    return result


def observed_distance(surfaces: SegmentedMesh, observed: Float[np.ndarray, "n 3"]) -> list[Float[np.ndarray, " _"]]:
    """Distance from every vertex to the nearest observed point: what is far from all of them is a guess."""
    tree = cKDTree(observed)
    return [tree.query(s.vertices)[0] if len(s.vertices) else np.zeros(0) for s in surfaces.segments]
