"""Errors of reading: whatever a parsing library raises becomes one sentence, and what else it says is not shown.

A header of a few bytes can promise terabytes, and a megabyte of zip can hold a gigabyte. So while a file is read, the
process may take only so much more memory: ``DEFAULT_GB``, or what the environment variable ``MEREO_MAX_FILE_GB`` says.
"""

import ctypes
import io
import logging
import math
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

try:
    import resource
except ImportError:  # Windows, where a file's own size alone is limited
    resource = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from pydantic import ValidationError

MOST_CHARACTERS = 300
"""Length of a library's text in a sentence, which may quote all that it has read."""

LIMIT_VARIABLE = "MEREO_MAX_FILE_GB"

DEFAULT_GB = 8.0
"""Gigabytes (of 10^9 bytes) that reading a file may take: 50 million points of text, or 500 million voxels."""

PAGES = Path("/proc/self/statm")
"""Where Linux, which alone holds a process to such a limit, says how much it has."""

for _name in ("trimesh", "nibabel.global"):  # they log tracebacks and repairs, which Python shows where nobody listens
    logging.getLogger(_name).setLevel(logging.CRITICAL + 1)


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


def check_bytes(path: str | Path, size: int) -> None:
    """Raise ``SizeError`` where ``size``, the bytes of ``path``, is over the limit."""
    if size > max_bytes():
        raise _too_large(path)


def _too_large(path: str | Path) -> SizeError:
    limit = max_bytes() / 1e9
    return SizeError(
        f"{path} takes more than {limit:g} GB of memory to read: check that it is what it should be, export less, or "
        f"raise the limit with {LIMIT_VARIABLE}={math.ceil(2 * limit)}"
    )


class _MemoryLimit:
    """Limit of the memory of this process that several threads may set at once; the last to leave lifts it."""

    def __init__(self) -> None:
        self._changing, self._holders, self._before = threading.Lock(), 0, (-1, -1)

    def __enter__(self) -> None:
        more = max_bytes()
        with self._changing:
            if self._holders == 0:
                self._before = resource.getrlimit(resource.RLIMIT_AS)
                now = int(PAGES.read_text().split()[0]) * resource.getpagesize()
                bounds = [limit for limit in self._before if limit != resource.RLIM_INFINITY]
                resource.setrlimit(resource.RLIMIT_AS, (min([now + more, *bounds]), self._before[1]))
            self._holders += 1

    def __exit__(self, *_: object) -> None:
        with self._changing:
            self._holders -= 1
            if self._holders == 0:
                resource.setrlimit(resource.RLIMIT_AS, self._before)


_MEMORY_LIMIT = _MemoryLimit()


@contextmanager
def limited_memory(path: str | Path) -> Iterator[None]:
    """Let a block that reads ``path`` take only so much more memory; raises ``SizeError`` where it needs more."""
    try:
        with _MEMORY_LIMIT if PAGES.exists() else nullcontext():
            yield
    except MemoryError:
        raise _too_large(path) from None


def check_count(count: int, found: int, what: str) -> None:
    """Raise ``ValueError`` (its reason only) for a negative count, or one of more than was ``found``."""
    if count < 0:
        raise ValueError(f"its header states {count} {what}")
    if found < count:
        raise ValueError(f"it is truncated: {found} of {count} {what}")


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Refuse missing, empty and too large files; turn what a library raises in the block into one sentence.

    Args:
        path: the file that is read.
        kind: what it should be, for the sentence: "point cloud".

    Raises ``FileNotFoundError`` or ``ValueError``; ``ImportError`` and ``SizeError`` pass as they are.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a {kind} is needed: check the path")
    if path.is_dir():
        raise ValueError(f"{path} is a directory; a {kind} is needed: name a file in it")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file; a {kind} is needed: save it to a file and name that")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes); a {kind} is needed: export or download it again")
    check_bytes(path, path.stat().st_size)
    try:
        with quiet(), limited_memory(path):
            yield
    except (ImportError, SizeError):
        raise
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a {kind} ({reason(error)}): export or download it again") from error


def first_problem(error: "ValidationError") -> str:
    """What pydantic found wrong first, and where: "its 'iou': Input should be a valid number"."""
    first = error.errors()[0]
    return f"its {'.'.join(map(str, first['loc'])) or 'content'!r}: {first['msg']}"


@contextmanager
def quiet() -> Iterator[None]:
    """Let libraries warn of nothing: of damage the sentence is enough, and lost values are checked where they matter.

    mereo's own warnings pass.
    """
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
    _flush()
    kept = [os.dup(stream) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(nowhere, stream)
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        _flush()
        for stream, place in zip((1, 2), kept, strict=True):
            os.dup2(place, stream)
            os.close(place)
        os.close(nowhere)


def _flush() -> None:
    """Write out what Python and C still hold of the process's streams."""
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)


def reason(error: Exception) -> str:
    """First line of a library's text, which may be several sentences; the error's type where there is none."""
    text = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".;: ")
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."
