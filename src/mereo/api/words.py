"""Messages in the words of Python: sentences name options as the command line does, and a caller has arguments."""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ContextDecorator, contextmanager
from contextvars import ContextVar
from dataclasses import fields, replace
from functools import wraps
from inspect import Parameter, signature
from typing import Any, TypeVar, get_args

from mereo.fitting.config import AnswerMethod
from mereo.geometry.conventions import Facts, Names
from mereo.io.config import CarryFrame
from mereo.io.errors import nearest
from mereo.reconstruction.config import Extent

SPEAKS_OPTIONS: ContextVar[bool] = ContextVar("SPEAKS_OPTIONS", default=False)
"""Whether this is the command line, whose words are options."""

ARGUMENTS = {
    "--force": "overwrite=True",
    "--drop-invalid": "drop_invalid=True",
    "--keep-all": "keep_all=True",
    "--remove-plane": "remove_plane=True",
    "--remove-outliers": "remove_outliers=True",
    "--largest-cluster": "largest_cluster=True",
    "--depth-range 0.4 0.9": "depth_range=(0.4, 0.9)",
    "--point 320 240": "point=(320, 240)",
    **{f"--extent {extent}": f'extent="{extent}"' for extent in get_args(Extent)},
    "--frame": "axes",
    "--carry-frame": "files",
    **{f"--carry-frame {name}": f'files="{name}"' for name in get_args(CarryFrame)},
    "--carry": "carry",
    **{f"--method {name}": f'method="{name}"' for name in get_args(AnswerMethod)},
}
"""Arguments that are not called as their options are."""

OPTION = re.compile(r"--([a-z][a-z-]*)(?: (?=[0-9A-Z])([\w./]+\w|\w))?")
"""An option, and a value behind it as messages show it: a number, or a word in capitals."""


def in_python(text: str) -> str:
    """Text in which options are the arguments of Python functions: ``--unit-m 0.001`` is ``unit_m=0.001``."""
    for option in sorted(ARGUMENTS, key=len, reverse=True):
        text = re.sub(rf"{option}(?![\w-])", ARGUMENTS[option], text)
    return OPTION.sub(_argument, text)


def _argument(option: re.Match[str]) -> str:
    name = option[1].replace("-", "_")
    value = option[2]
    return name if value is None else f"{name}={value.lower() if value.isupper() else value}"


def in_callers_words(text: str) -> str:
    """Text as it is where the command line calls, else in the words of Python."""
    return text if SPEAKS_OPTIONS.get() else in_python(text)


@contextmanager
def option_words() -> Iterator[None]:
    """Let the block's errors and warnings keep the options of the command line."""
    before = SPEAKS_OPTIONS.set(True)
    try:
        yield
    finally:
        SPEAKS_OPTIONS.reset(before)


Call = TypeVar("Call", bound=Callable[..., Any])


class python_words(ContextDecorator):
    """Raise errors of the block, or of what this decorates, in the words of Python, unless the command line calls.

    What it decorates also refuses arguments that it does not have, as ``check_names`` does.
    """

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | OSError | ImportError | TypeError) and isinstance((*error.args, 0)[0], str):
            error.args = (in_callers_words(error.args[0]), *error.args[1:])

    def __call__(self, function: Call) -> Call:
        """The function with all of this."""
        given = signature(function).parameters
        known = [name for name in given if name != "self"]
        is_open = any(each.kind == Parameter.VAR_KEYWORD for each in given.values())  # it checks them itself

        @wraps(function)
        def checked(*arguments: Any, **options: Any) -> Any:
            with self:
                check_names(() if is_open else options, known)
                return function(*arguments, **options)

        return checked  # type: ignore[return-value]


# --- options by their names -------------------------------------------------------------------------------------------

Settings = TypeVar("Settings")


def names_of(settings: type) -> Names:
    """Names of a dataclass's fields."""
    return tuple(item.name for item in fields(settings))


def check_names(given: Iterable[str], known: Collection[str], places: Mapping[str, str] | None = None) -> None:
    """Raise ``TypeError`` for the first name of no option, with the nearest, or where ``places`` has it."""
    for name in given:
        if name in known:
            continue
        cure = (places or {}).get(name)
        if cure is None:
            near = nearest(name.lower(), known)
            cure = f"is {near} meant?" if near else f"the options are {', '.join(sorted(known))}"
        raise TypeError(f"there is no option {name!r} here: {cure}")


def with_changes(settings: Settings, changes: Facts) -> Settings:
    """Settings with some fields changed; raises ``TypeError`` as ``check_names``, and as the settings' own checks."""
    check_names(changes, names_of(type(settings)))
    return replace(settings, **changes)  # type: ignore[type-var]
