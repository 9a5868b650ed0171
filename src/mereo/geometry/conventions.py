"""Conventions shared by every room: axes of clouds, names of workspaces, units of length, least number of points."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

MIN_POINTS = 32
"""Fewer observed points say too little about an object: they are refused, drawn again, or left as they were."""


class NoFit(ValueError):
    """Frame to which no model can be fitted, for a reason that its sender can mend."""


LARGEST = 1e12
"""Coordinate in any unit that is beyond every scan; products of larger ones may be infinite."""


Names = tuple[str, ...]
"""Names in an order, mostly that of the labels."""


Range = tuple[float, float]
"""Least and greatest value."""


Pair = tuple[int, int]
"""Two whole numbers that belong together: two indices, two counts, a column and a row."""


WholeNumbers = tuple[int, ...]
"""Whole numbers in an order, such as the lengths of an array's axes."""


GridShape = tuple[int, int, int]
"""Numbers of cells or nodes along x, y and z."""


Triple = tuple[float, float, float]
"""Numbers along x, y and z, as settings have them."""


Facts = Mapping[str, Any]
"""Values by their names, any of which may be missing."""


Texts = dict[str, str]
"""Texts by their names."""


CloudAxes = Literal["camera", "scanner"]
"""Axes of a point cloud: camera is x right, y down, z forward; scanner is y up, z toward the scanner."""


WorkspaceName = Literal["own", "cone", "sphere"]
"""Places where a virtual camera may be: as the scene states them, on one side of the object, or all around it."""


Way = Literal["auto", "rigid", "soft", "stiff", "articulated"]
"""How an object deforms: not at all, as a soft or a stiff elastic solid, by its joints, or as its meshes suggest."""


LengthUnit = Literal["mm", "cm", "m", "in"]
"""Unit of length that files and options may name."""


UNITS_M: Mapping[str, float] = MappingProxyType({"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254})
"""Metres in each of these units."""


def check_real(values: Any, name: str) -> None:
    """Raise ``ValueError`` for an array, called so, of anything but real numbers: complex ones, truth values, texts."""
    kind = getattr(values, "dtype", type(values).__name__)
    if getattr(kind, "kind", "") not in tuple("fiu"):
        raise ValueError(
            f"{name} has values of type {kind}; they must be real numbers: give an array of floats or integers"
        )
