"""Errors: whatever a library raises becomes one sentence for users, and what else it says is not shown.

A header of a few bytes can promise terabytes. So while a file is read, the process may take only so much more memory:
``DEFAULT_GB``, or what the environment variable ``MEREO_MAX_FILE_GB`` says. Light, for the command line.
"""

import ctypes
import io
import logging
import math
import os
import sys
import sysconfig
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from difflib import get_close_matches
from dis import opmap
from pathlib import Path
from typing import TYPE_CHECKING

from mereo.io.cores import SharedLimit
from mereo.io.extras import NEEDED, is_torch

try:
    import resource
except ImportError:  # Windows, where a file's own size alone is limited
    resource = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from pydantic import ValidationError

PACKAGE = Path(__file__).parents[1]

LIBRARIES = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
"""Where the code of others is; mereo itself may be installed there."""

MOST_CHARACTERS = 300
"""Length of what is quoted of a library's text, which may quote all that it has read."""

MOST_OF_VALUE = 60
"""Length of what is quoted of a value."""

CLOSE = 0.7
"""Least likeness, as ``difflib`` has it, of a word to the one that is meant: `unit` is like `units`, `quiet` is not."""

AnyPath = str | Path
"""Path of a file or folder, as people write it or as Python has it."""

C_LIBRARY = "ucrtbase" if sys.platform == "win32" else None
"""Library of C that Python and what it loads print by; None is what this process has loaded already."""

LIMIT_VARIABLE = "MEREO_MAX_FILE_GB"

DEFAULT_GB = 8.0
"""Gigabytes (of 10^9 bytes) that reading a file may take: 50 million points of text, or 500 million voxels."""

PAGES = Path("/proc/self/statm")
"""Where Linux, which alone holds a process to such a limit, says how much it has."""

for _name in (
    "trimesh",
    "nibabel.global",
    "yourdfpy",
):  # they log tracebacks and repairs, which Python shows where nobody listens
    logging.getLogger(_name).setLevel(logging.CRITICAL + 1)


# --- sentences for users ----------------------------------------------------------------------------------------------


def is_foreseen(error: Exception) -> bool:
    """Whether the text of an error is a sentence for users: not what a library's ``ValueError`` says of its arguments.

    Those of the operating system, and imports that fail, name what is wrong themselves. Compiled libraries have no
    frames of their own: what they raise comes from a call of ours, and not from a ``raise``.
    """
    if isinstance(error, OSError | ImportError):
        return True
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not isinstance(error, ValueError):
        return isinstance(error, ValueError)
    code = last.tb_frame.f_code
    is_ours = not code.co_filename.startswith(LIBRARIES) or Path(code.co_filename).is_relative_to(PACKAGE)
    return is_ours and code.co_code[last.tb_lasti] == opmap["RAISE_VARARGS"]


def words_of(error: Exception) -> str:
    """Words of an error in one line: the sentence of a foreseen one, else its type and text.

    An error of the operating system is described by its file and reason, the lack of torch by the extra that brings it.
    """
    if is_torch(error):
        return NEEDED
    if not is_foreseen(error):
        text = _shortened(printable_line(str(error)))
        return f"{type(error).__name__}: {text}" if text else type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        what = error.strerror[0].lower() + error.strerror[1:]
        return printable_line(f"{f'{error.filename}: ' if error.filename else ''}{what}: correct that and try again")
    return printable_line(str(error)) or type(error).__name__


def printable_line(text: str) -> str:
    """Text in one line, with what a terminal would obey (files may have it in names) as Python spells it."""
    line = " ".join(text.split())
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def value_text(value: object) -> str:
    """Value as Python writes it, in one line and not too long: what a sentence says of an argument."""
    text = printable_line(repr(value))
    return text if len(text) <= MOST_OF_VALUE else f"{text[:MOST_OF_VALUE]}..."


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Known word that is plainly meant by one that is not known; None where none is so much like it."""
    return next(iter(get_close_matches(word, list(known), 1, CLOSE)), None)


def reason(error: Exception) -> str:
    """First line of a library's text, which may be several sentences; the error's type where there is none."""
    return _shortened((str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".;: "))


def _shortened(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."


def first_problem(error: "ValidationError") -> str:
    """What pydantic found wrong first, and where: "its 'iou': Input should be a valid number"."""
    first = error.errors()[0]
    return f"its {'.'.join(map(str, first['loc'])) or 'content'!r}: {first['msg']}"


# --- limits of memory -------------------------------------------------------------------------------------------------


class SizeError(ValueError):
    """Refusal of a file that takes more memory than the limit; its text is a whole sentence."""


def max_bytes() -> int:
    """Limit in bytes. Raises ``SizeError`` where ``MEREO_MAX_FILE_GB`` is no positive number."""
    text = os.environ.get(LIMIT_VARIABLE, "") or str(DEFAULT_GB)
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        raise SizeError(f"{LIMIT_VARIABLE} is {text!r}; it must be a positive number of gigabytes: correct or unset it")
    return int(limit * 1e9)


def check_size(path: AnyPath, size: int) -> None:
    """Raise ``SizeError`` for a file whose ``size`` in bytes, stored or by its header in memory, is over the limit."""
    if size > max_bytes():
        raise _too_large(path)


def _too_large(path: AnyPath) -> SizeError:
    limit = max_bytes() / 1e9
    return SizeError(
        f"{path} takes more than {limit:g} GB of memory to read: check that it is what it should be, export less, or "
        f"raise the limit with {LIMIT_VARIABLE}={math.ceil(2 * limit)}"
    )


@contextmanager
def _memory_limit() -> Iterator[None]:
    more = max_bytes()
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(PAGES.read_text().split()[0]) * resource.getpagesize()
    bounds = [limit for limit in before if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min([now + more, *bounds]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


_MEMORY_LIMIT = SharedLimit(_memory_limit)


@contextmanager
def limited_memory(path: AnyPath) -> Iterator[None]:
    """Let a block that reads ``path`` take only so much more memory; raises ``SizeError`` where it needs more."""
    try:
        with _MEMORY_LIMIT if PAGES.exists() else nullcontext():
            yield
    except MemoryError:
        raise _too_large(path) from None


# --- reading ----------------------------------------------------------------------------------------------------------


def checked_path(value: object, name: str) -> Path:
    """Path that an argument of this name is; ``ValueError`` for what is neither a text nor a path."""
    if not isinstance(value, AnyPath):
        raise ValueError(f"{name} is {value_text(value)}; it must be a path: give a text or a pathlib.Path")
    return Path(value)


def check_suffix(path: Path, known: Iterable[str], kind: str) -> None:
    """Raise ``ValueError`` for a file whose suffix is none of those that a kind of files has."""
    if path.exists() and path.suffix.lower() not in known:
        suffixes = ", ".join(known)
        raise ValueError(f"{path} has the suffix {path.suffix!r}; a {kind} is one of {suffixes}: convert or rename it")


def check_count(count: int, available: int, what: str) -> None:
    """Raise ``ValueError`` (its reason only) for a negative count, or one of more than is ``available``."""
    if count < 0:
        raise ValueError(f"its header states {count} {what}")
    if available < count:
        raise ValueError(f"it is truncated: {available} of {count} {what}")


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Refuse missing, empty and too large files; turn what a library raises in the block into one sentence.

    ``kind`` is what it should be: "point cloud". Raises ``FileNotFoundError`` or ``ValueError``; ``ImportError`` and
    ``SizeError`` pass as they are.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a {kind} is needed: check the path")
    if not path.is_file():
        what = "a directory" if path.is_dir() else "not a regular file"
        raise ValueError(f"{path} is {what}; a {kind} is needed: name a file")
    if (size := path.stat().st_size) == 0:
        raise ValueError(f"{path} is empty (0 bytes); a {kind} is needed: export or download it again")
    check_size(path, size)
    try:
        with quiet(), limited_memory(path):
            yield
    except (ImportError, SizeError):
        raise
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a {kind} ({reason(error)}): export or download it again") from error


@contextmanager
def quiet() -> Iterator[None]:
    """Let libraries warn of nothing: of damage the sentence is enough, and lost values are checked where they matter.

    mereo's own warnings pass.
    """
    import numpy as np  # not above, as the command line starts without it

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.filterwarnings("ignore", category=UserWarning, module=r"(PIL|nibabel|nrrd|trimesh|numpy|tifffile)\b")
        warnings.filterwarnings("ignore", "Reading `.npy` or `.npz` file required additional header parsing")
        warnings.filterwarnings("ignore", category=RuntimeWarning)
        yield


@contextmanager
def without_output() -> Iterator[None]:
    """Drop what compiled libraries print in the block, to Python's streams or to the process's.

    What other threads print at that moment is lost too.
    """

    def flush() -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        ctypes.CDLL(C_LIBRARY).fflush(None)

    flush()
    kept = [os.dup(stream) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        flush()
        for stream, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)
