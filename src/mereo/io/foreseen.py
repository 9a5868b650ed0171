"""Errors whose text is a sentence for users, told from a fault's, and the line that either is told in.

Light, so that the command line may import it.
"""

import sysconfig
from pathlib import Path
from traceback import walk_tb

from mereo.io.extras import NEEDED, is_torch

PACKAGE = Path(__file__).parents[1]

LIBRARIES = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
"""Where the code of others is; mereo itself may be installed there."""

MOST_CHARACTERS = 300
"""Length of what is quoted of an unforeseen error, of which libraries may make pages."""


def is_foreseen(error: Exception) -> bool:
    """Whether the text of an error is a sentence for users: not what a library's ``ValueError`` says of its arguments.

    Those of the operating system, and imports that fail, name what is wrong themselves.
    """
    if isinstance(error, OSError | ImportError):
        return True
    return isinstance(error, ValueError) and not _raised_in_library(error)


def words_of(error: Exception) -> str:
    """Words of an error in one line: the sentence of a foreseen one, else its type and text.

    An error of the operating system is told by its file and reason, the lack of torch by the extra that brings it.
    """
    if is_torch(error):
        return NEEDED
    if not is_foreseen(error):
        text = printable_line(str(error))
        text = text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."
        return f"{type(error).__name__}: {text}" if text else type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror[0].lower() + error.strerror[1:]
        place = f"{error.filename}: " if error.filename else ""
        return printable_line(f"{place}{reason}: correct that and try again")
    return printable_line(str(error)) or type(error).__name__


def printable_line(text: str) -> str:
    """Text in one line, with what a terminal would obey (files may have it in names) as Python spells it."""
    line = " ".join(text.split())
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def _raised_in_library(error: Exception) -> bool:
    places = [frame.f_code.co_filename for frame, _ in walk_tb(error.__traceback__)]
    return bool(places) and places[-1].startswith(LIBRARIES) and not Path(places[-1]).is_relative_to(PACKAGE)
