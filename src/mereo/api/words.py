"""Messages in the words of Python: sentences name options as the command line does, and a caller has arguments."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import get_args

from mereo.fitting.config import AnswerMethod

SPEAKS_OPTIONS: ContextVar[bool] = ContextVar("SPEAKS_OPTIONS", default=False)
"""Whether this is the command line, whose words are options."""

ARGUMENTS = {
    "--force": "overwrite=True",
    "--drop-invalid": "drop_invalid=True",
    "--keep-all": "isolation=IsolationConfig(keep_all=True)",
    "--extent": "isolation=IsolationConfig(extent=...)",
    "--frame": "axes",
    "--carry-frame": "files",
    "--carry": "carry",
    **{f"--method {name}": f'method="{name}"' for name in get_args(AnswerMethod)},
    "--box": "isolation=IsolationConfig(box=...)",
    "--depth-range": "isolation=IsolationConfig(depth_range=...)",
}
"""Arguments that are not called as their options are."""

VALUE = r"(?: (?=[0-9A-Z])([\w./]+\w|\w))?"
"""A value behind an option, as messages show it: a number, or a word in capitals."""


def in_python(text: str) -> str:
    """Text in which options are the arguments of Python functions: ``--unit-m 0.001`` is ``unit_m=0.001``."""
    for option in sorted(ARGUMENTS, key=len, reverse=True):
        text = re.sub(rf"{option}(?![\w-])", ARGUMENTS[option], text)
    return re.sub(rf"--([a-z][a-z-]*){VALUE}", _argument, text)


def _argument(found: re.Match[str]) -> str:
    name = found[1].replace("-", "_")
    return name if found[2] is None else f"{name}={found[2].lower() if found[2].isupper() else found[2]}"


@contextmanager
def option_words() -> Iterator[None]:
    """Let the block's errors and warnings keep the options of the command line."""
    before = SPEAKS_OPTIONS.set(True)
    try:
        yield
    finally:
        SPEAKS_OPTIONS.reset(before)


@contextmanager
def python_words() -> Iterator[None]:
    """Raise errors of the block, or of what this decorates, in the words of Python, unless the command line calls."""
    try:
        yield
    except (ValueError, OSError, ImportError, TypeError) as error:
        if not SPEAKS_OPTIONS.get() and error.args and isinstance(error.args[0], str):
            error.args = (in_python(error.args[0]), *error.args[1:])
        raise
