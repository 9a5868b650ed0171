"""How types are checked while tests run: as mypy does, an int is welcome where a float is expected (PEP 484).

A function within another one is made anew by every call of that one, and with it jaxtyping makes those anew that
check its arguments and its result. They do nothing else, so those of the same names and annotations serve: making them
takes two milliseconds, and some are made a thousand times in a test.
"""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

CHECKED = beartype(conf=BeartypeConf(is_pep484_tower=True))

_made = {}


def check(function: Callable[..., Any]) -> Any:
    """A function with its arguments and result checked; for one within another, as it was made the first time."""
    if function.__module__.startswith("mereo.cli.") and function.__name__ == "__init__":
        return function  # of a command, whose required options are tyro.MISSING before it is parsed
    if "<locals>" not in function.__qualname__ or function.__code__.co_filename != "<string>":
        return CHECKED(function)  # not one that jaxtyping has made
    code = function.__code__
    annotations = tuple(function.__annotations__.items())
    key = (function.__module__, function.__qualname__, code.co_varnames, code.co_argcount, code.co_flags, annotations)
    try:
        made = _made.get(key)
    except TypeError:  # an annotation that cannot be looked up
        return CHECKED(function)
    if made is None:
        made = _made[key] = CHECKED(function)
    return made
