"""Errors of reading: whatever a parsing library raises becomes one sentence, and what else it says is not shown."""

import ctypes
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mereo.io.size_limits import SizeError, check_bytes

if TYPE_CHECKING:
    from pydantic import ValidationError

MOST_CHARACTERS = 300
"""Length of a library's text in a sentence, which may quote all that it has read."""

for _name in ("trimesh", "nibabel.global"):  # they log tracebacks and repairs, which Python shows where nobody listens
    logging.getLogger(_name).setLevel(logging.CRITICAL + 1)


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Refuse missing, empty and too large files; turn what a library raises in the block into one sentence.

    Args:
        path: the file that is read.
        kind: what it should be, for the sentence: "point cloud".

    Raises ``FileNotFoundError`` or ``ValueError``; ``MemoryError``, ``ImportError`` and ``SizeError`` pass as they are.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a {kind} is needed: check the path")
    if path.is_dir():
        raise ValueError(f"{path} is a directory; a {kind} is needed: name a file in it")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes); a {kind} is needed: export or download it again")
    check_bytes(path, path.stat().st_size)
    try:
        with quiet():
            yield
    except (MemoryError, ImportError, SizeError):
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
