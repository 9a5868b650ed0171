"""Kinds of numbers that settings may hold, and their rules: checked when settings are made, and shown in the help.

``batch: Count = 40`` says it once, and ``check_bounds`` in ``__post_init__`` holds it. NaN and infinity pass nowhere.
Light, so that the command line may import it.
"""

import math
from dataclasses import MISSING, dataclass, fields
from functools import lru_cache, partial
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from tyro.conf import arg

from mereo.geometry.conventions import MIN_POINTS, Facts, WholeNumbers
from mereo.io.errors import value_text


@dataclass(frozen=True)
class Bounds:
    """Interval of finite numbers, without ``least`` where ``above`` and without ``most`` where ``below``.

    Of a tuple, which may not be empty, all numbers must lie in it.
    """

    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    below: bool = False

    @property
    def rule(self) -> str:
        """Words for the interval: "from 0 to 1", "at least 1", "greater than 0"."""
        if math.isinf(self.least):
            return "a finite number"
        if math.isinf(self.most):
            return f"greater than {self.least:g}" if self.above else f"at least {self.least:g}"
        lower = f"above {self.least:g}" if self.above else f"from {self.least:g}"
        return f"{lower} to below {self.most:g}" if self.below else f"{lower} to {self.most:g}"

    def holds(self, value: float) -> bool:
        """Whether a number lies in the interval."""
        inside = self.least <= value <= self.most and abs(value) < math.inf
        return inside and not (self.above and value == self.least) and not (self.below and value == self.most)


def _within(least: float, most: float = math.inf, *, above: bool = False, below: bool = False) -> tuple[Bounds, Any]:
    bounds = Bounds(least, most, above, below)
    return bounds, arg(help_behavior_hint=lambda default: f"(default: {default}; {bounds.rule})")


# The upper bounds are far above all that has been of use: a slip of a few digits would take all memory before anything
# could be said.
Count = Annotated[int, *_within(1)]
CountOrNone = Annotated[int, *_within(0)]
IndexOrNone = Annotated[int | None, *_within(0)]
Threads = Annotated[int, *_within(0, 1024)]
Workers = Annotated[int, *_within(0, 1024)]
Points = Annotated[int, *_within(MIN_POINTS, 2**20)]
ImageSize = Annotated[int, *_within(8, 8192)]
Width = Annotated[int, *_within(1, 8192)]
Widths = Annotated[WholeNumbers, *_within(1, 8192)]
Neighbors = Annotated[int, *_within(1, 1024)]
NeighborsOrNone = Annotated[int, *_within(0, 1024)]
Batch = Annotated[int, *_within(1, 65536)]
Queries = Annotated[int, *_within(1, 100_000)]
Times = Annotated[int, *_within(1, 1000)]
Depth = Annotated[int, *_within(1, 1000)]
States = Annotated[int, *_within(1, 20_000)]
Exponent = Annotated[int, *_within(-30, 30)]
Cells = Annotated[int, *_within(4, 4096)]
Port = Annotated[int, *_within(0, 65535)]
Seed = Annotated[int, *_within(0, 2**63, below=True)]  # what torch takes
Radius = Annotated[float, *_within(0, 1000, above=True)]
Positive = Annotated[float, *_within(0, above=True)]
Number = Annotated[float, *_within(-math.inf)]
PositiveOrUnknown = Annotated[float | None, *_within(0, above=True)]
NotNegative = Annotated[float, *_within(0)]
Aperture = Annotated[float, *_within(0, 360, above=True)]
Multiple = Annotated[float, *_within(0, 1000)]
Probability = Annotated[float, *_within(0, 1)]
ProperFraction = Annotated[float, *_within(0, 1, below=True)]
Share = Annotated[float, *_within(0, 1, above=True)]
ShareRange = Annotated[tuple[float, float], *_within(0, 1, above=True)]
Instances = Annotated[int | Literal["all"], *_within(1)]  # of an object in a whole frame


GROUP = arg(name="")
"""Of settings whose options are called as their fields, without a prefix."""


_kinds = lru_cache(maxsize=64)(partial(get_type_hints, include_extras=True))


def check_bounds(settings: Any, prefix: str = "") -> None:
    """Raise ``ValueError`` for the first field of a dataclass whose ``Bounds``, literals or truth value do not hold.

    ``prefix`` is what the options of these fields begin with, for the sentence; ``--`` turns names into options.
    """
    check_values(type(settings), {item.name: getattr(settings, item.name) for item in fields(settings)}, prefix)


def check_values(settings: type, values: Facts, prefix: str = "") -> None:
    """Raise ``ValueError`` as ``check_bounds`` does, for values by field of which a dataclass is yet to be made."""
    kinds = _kinds(settings)
    for item in fields(settings):
        rule = _broken_rule(kinds[item.name], values[item.name]) if item.name in values else None
        if rule is not None:
            name = prefix + (item.name.replace("_", "-") if prefix == "--" else item.name)
            known = item.default not in (MISSING, None)
            cure = f"give for example {_text(item.default)}" if known else "correct it"
            raise ValueError(f"{name} is {_text(values[item.name])}; it must be {rule}: {cure}")


def check_value(name: str, value: object, kind: Any, example: object) -> None:
    """Raise ``ValueError`` for an argument that its kind, of this module or a ``Literal``, does not allow."""
    if (rule := _broken_rule(kind, value)) is not None:
        raise ValueError(f"{name} is {_text(value)}; it must be {rule}: give for example {_text(example)}")


def _broken_rule(kind: Any, value: Any) -> str | None:
    """Rule that a value breaks; None where it breaks none, or its kind has none."""
    if get_origin(kind) is Literal:
        return None if value in get_args(kind) else f"one of {', '.join(map(str, get_args(kind)))}"
    if kind is bool:
        return None if isinstance(value, bool) else "true or false"
    bounds = next((extra for extra in getattr(kind, "__metadata__", ()) if isinstance(extra, Bounds)), None)
    plain = get_args(kind)[0] if bounds else None
    words = [word for part in get_args(plain) if get_origin(part) is Literal for word in get_args(part)]
    if bounds is None or (value is None and NoneType in get_args(plain)) or value in words:
        return None
    many = get_origin(plain) is tuple
    whole = plain is int or int in get_args(plain)
    values = value if many and isinstance(value, tuple) else (value,) if not many else ()
    number: Any = Integral if whole else Real
    if values and all(isinstance(v, number) and not isinstance(v, bool) and bounds.holds(v) for v in values):
        return None
    return f"{'whole numbers, each ' if many and whole else 'a whole number, ' if whole else ''}{bounds.rule}"


def _text(value: object) -> str:
    return " ".join(map(value_text, value)) if isinstance(value, tuple) else value_text(value)
