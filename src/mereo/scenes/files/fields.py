"""Kinds of values that a scene file may hold, and their rules: places, directions, ranges, names, colours."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("it must be [least, most]")
    return value


def _pointing(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("it is a direction and must have a length")
    return value


MOST = 1e12
"""Largest number of a scene file: products of a few remain finite."""

Number = Annotated[FiniteFloat, Field(ge=-MOST, le=MOST)]
Byte = Annotated[int, Field(ge=0, le=255)]
Positive = Annotated[FiniteFloat, Field(gt=0, le=MOST)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/\\\x00-\x1f]+$")]
Point = tuple[Number, Number, Number]
Direction = Annotated[Point, AfterValidator(_pointing)]
Range = Annotated[tuple[Number, Number], AfterValidator(_ascending)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ascending)]


class Block(BaseModel):
    """Block of keys: none but its fields, and none of them changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
