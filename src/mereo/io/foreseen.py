"""Errors whose text is a sentence for users, told from a fault's; light, so that the command line may import it."""

import sysconfig
from pathlib import Path
from traceback import walk_tb

PACKAGE = Path(__file__).parents[1]

LIBRARIES = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
"""Where the code of others is; mereo itself may be installed there."""


def is_foreseen(error: Exception) -> bool:
    """Whether the text of an error is a sentence for users: not what a library's ``ValueError`` says of its arguments.

    Those of the operating system, and imports that fail, name what is wrong themselves.
    """
    if isinstance(error, OSError | ImportError):
        return True
    return isinstance(error, ValueError) and not _raised_in_library(error)


def _raised_in_library(error: Exception) -> bool:
    places = [frame.f_code.co_filename for frame, _ in walk_tb(error.__traceback__)]
    return bool(places) and places[-1].startswith(LIBRARIES) and not Path(places[-1]).is_relative_to(PACKAGE)
