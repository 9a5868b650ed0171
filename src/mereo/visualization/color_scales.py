"""Colours of numbers: the map viridis, scales with their words, and the numbers by which surfaces are coloured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial import cKDTree

from mereo.geometry.brief import as_exact_as
from mereo.geometry.conventions import Names
from mereo.geometry.mesh import Colors, Segment, SegmentColors, SegmentedMesh, vertex_normals
from mereo.geometry.radii import STOPS, Radii, between_stops, describe_level
from mereo.geometry.transforms import Points, Values
from mereo.models.trained import Answer

Ask = Callable[[Points], Answer]
"""Function that answers as a model does at points in the frame of the surfaces."""

CONFIDENCE_STEP = 0.02
"""Distance to either side of a surface at which the model is evaluated, as a share of the object's longest side."""


# The map viridis, from dark violet to yellow, by Nathaniel Smith, Stéfan van der Walt and Eric Firing, in the public
# domain (CC0). It is here as a table, because most pictures need nothing else of matplotlib, which is as large as all
# other libraries for pictures together.

_HEX = (
    "44015444025544035745055845065a45085b46095c460b5e460c5f460e61470f6247116347126547146647156747166947186a48196b481a6c"
    "481c6e481d6f481e70482071482172482273482374472575472676472777472878472a79472b7a472c7b462d7c462f7c46307d46317e45327f"
    "45347f453580453681443781443982433a83433b83433c84423d84423e854240854141864142864043874044873f45873f47883e48883e4989"
    "3d4a893d4b893d4c893c4d8a3c4e8a3b508a3b518a3a528b3a538b39548b39558b38568b38578c37588c37598c365a8c365b8c355c8c355d8c"
    "345e8d345f8d33608d33618d32628d32638d31648d31658d31668d30678d30688d2f698d2f6a8d2e6b8e2e6c8e2e6d8e2d6e8e2d6f8e2c708e"
    "2c718e2c728e2b738e2b748e2a758e2a768e2a778e29788e29798e287a8e287a8e287b8e277c8e277d8e277e8e267f8e26808e26818e25828e"
    "25838d24848d24858d24868d23878d23888d23898d22898d228a8d228b8d218c8d218d8c218e8c208f8c20908c20918c1f928c1f938b1f948b"
    "1f958b1f968b1e978a1e988a1e998a1e998a1e9a891e9b891e9c891e9d881e9e881e9f881ea0871fa1871fa2861fa38620a48520a58521a685"
    "21a78422a78423a88323a98224aa8225ab8126ac8127ad8028ae7f29af7f2ab07e2bb17d2cb17d2eb27c2fb37b30b47a32b57a33b67935b778"
    "36b87738b97639b9763bba753dbb743ebc7340bd7242be7144be7045bf6f47c06e49c16d4bc26c4dc26b4fc36951c46853c56755c66657c665"
    "59c7645bc8625ec96160c96062ca5f64cb5d67cc5c69cc5b6bcd596dce5870ce5672cf5574d05477d05279d1517cd24f7ed24e81d34c83d34b"
    "86d44988d5478bd5468dd64490d64392d74195d73f97d83e9ad83c9dd93a9fd938a2da37a5da35a7db33aadb32addc30afdc2eb2dd2cb5dd2b"
    "b7dd29bade27bdde26bfdf24c2df22c5df21c7e01fcae01ecde01dcfe11cd2e11bd4e11ad7e219dae218dce218dfe318e1e318e4e318e7e419"
    "e9e419ece41aeee51bf1e51cf3e51ef6e61ff8e621fae622fde724"
)
"""Its 256 colours, six digits each."""

TABLE: UInt8[ndarray, "256 3"] = np.frombuffer(bytes.fromhex(_HEX), np.uint8).reshape(256, 3)
"""Colours from the least number to the greatest; read-only."""


def viridis(values: Float[ndarray, "*shape"]) -> UInt8[ndarray, "*shape 3"]:
    """Colour of each value between 0 (dark) and 1 (bright); what lies outside has that of the nearer end, NaN of 0."""
    index = np.clip(np.nan_to_num(np.asarray(values, float)) * len(TABLE), 0, len(TABLE) - 1)
    return TABLE[index.astype(np.int64)]


@dataclass(frozen=True)
class ColorScale:
    """Scale of colours for numbers from ``low`` to ``high``; what lies beyond has the colour of that end.

    Attributes:
        title: what the numbers are.
        low: number at the scale's lower end.
        high: number at its upper end.
        stops: colours at equal distances from one end to the other.
        words: what stands below it, at equal distances from one end to the other.
    """

    title: str
    low: float
    high: float
    stops: SegmentColors
    words: Names

    def colors(self, values: Values) -> Colors:
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


def distance_scale(values: Sequence[Float[ndarray, " _"]], unit: str) -> ColorScale:
    """Scale for ``observed_distance`` of all segments; it ends at the largest but for a twentieth of the vertices."""
    joint = np.concatenate([*values, np.zeros(1)])
    high = max(float(np.quantile(joint, 0.95)), 1e-9)
    return ColorScale(
        "distance to the nearest observed point", 0.0, high, STOPS, ("0, seen", f"{high:.3g}{unit}, guessed")
    )


def radius_scale(radii: Radii, unit: str) -> ColorScale:
    """Scale for radii of 95 % in the unit that is named, with a number at each of its colours."""
    title = f"error radius: the true place is within it ({describe_level(radii.calibrated)})"
    high = max(radii.high, 1e-9)
    *less, most = as_exact_as(high, *np.linspace(0.0, high, len(STOPS)))
    return ColorScale(title, 0.0, high, STOPS, (*less, f"\N{GREATER-THAN OR EQUAL TO} {most}{unit}"))


def confidence(surfaces: SegmentedMesh, ask: Ask) -> list[Float[ndarray, " _"]]:
    """Confidence of each surface at every vertex, 0 to 1: how decidedly the model changes its mind across it.

    On the surface itself the winner's probability says nothing: it is where the winner changes, so that two classes
    are equally likely there. Here the segment's probability a step inside is compared with that a step outside: 1 means
    that the border is known to a step of ``CONFIDENCE_STEP`` of the object, 0 that the model has no idea where it is.
    A segment that holds nested ones counts with all of them.
    """
    filled = [segment for segment in surfaces.segments if len(segment.vertices)]
    if not filled:
        return [np.zeros(0) for _ in surfaces.segments]
    corners = np.concatenate([segment.vertices for segment in filled])
    step = CONFIDENCE_STEP * float((corners.max(axis=0) - corners.min(axis=0)).max())
    held = [
        [label, *(i + 1 for i, o in surfaces.nesting if o == label - 1)] for label in range(1, len(surfaces.names) + 1)
    ]
    return [_confidence(s, labels, ask, step) for s, labels in zip(surfaces.segments, held, strict=True)]


def _confidence(segment: Segment, labels: list[int], ask: Ask, step: float) -> Float[ndarray, " v"]:
    if len(segment.vertices) == 0:
        return np.zeros(0)
    offset = step * vertex_normals(segment)
    inside, outside = (ask(segment.vertices + sign * offset).probability[:, labels].sum(axis=1) for sign in (-1, 1))
    return np.clip(inside - outside, 0.0, 1.0).astype(float)


def observed_distance(surfaces: SegmentedMesh, observed: Points) -> list[Float[ndarray, " _"]]:
    """Distance from every vertex to the nearest observed point: what is far from all of them is a guess."""
    tree = cKDTree(observed)
    return [tree.query(s.vertices)[0] if len(s.vertices) else np.zeros(0) for s in surfaces.segments]
