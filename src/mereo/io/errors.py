"""Errors of reading: whatever a parsing library raises becomes one sentence."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mereo.io.size_limits import SizeError, check_bytes


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
        yield
    except (MemoryError, ImportError, SizeError):
        raise
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a {kind} ({reason(error)}): export or download it again") from error


def reason(error: Exception) -> str:
    """First line of a library's text, which may be several sentences; the error's type where there is none."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".;: ")
