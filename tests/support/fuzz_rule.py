"""The rule for every input: it is taken, or refused with one sentence, soon, in little memory, and silently.

A refusal is an error that the command line knows as its user's (exit code 2), whose text is one line that names the
file. Nothing is written. What else comes out is a fault of mereo.
"""

import faulthandler
import os
import resource
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from traceback import extract_tb
from types import FrameType

from mereo.io.errors import LIMIT_VARIABLE, PACKAGE, is_foreseen, words_of

MOST_SECONDS, MOST_GB = 60.0, 2.0
"""An input that takes longer hangs: what is taken here takes a second on a slow machine."""

MOST_CHARACTERS = 3000
READING_GB = "1"
"""Limit on the memory of reading while the rule is checked; the default alone is more than the rule allows."""

SILENT = (DeprecationWarning, PendingDeprecationWarning, ResourceWarning, ImportWarning)
"""Warnings that Python shows to nobody."""


class TooSlow(BaseException):
    """Signal that the time is over; no ``except Exception`` holds it up."""


@dataclass(frozen=True)
class Fault:
    """Breach of the rule.

    Attributes:
        kind: what makes two faults the same: the error and the line of mereo that it came through.
        text: the whole of it.
    """

    kind: str
    text: str


@contextmanager
def limits(seconds: float = MOST_SECONDS, gigabytes: float = MOST_GB) -> Iterator[None]:
    """Let a block have so much time and so much more memory than there is now; after thrice the time all ends."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = Path("/proc/self/statm")
    if pages.exists():
        now = int(pages.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + int(gigabytes * 1e9), hard))
    before = signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(3 * seconds, exit=True)  # where a library holds up the signal for ever
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooSlow


def fault_of(read: Callable[[Path], object], path: Path, names: tuple[str, ...] = ()) -> tuple[bool, Fault | None]:
    """Whether an input was taken, and how that broke the rule, if it did.

    Args:
        read: what reads it.
        path: the input.
        names: of its parts, any of which a refusal may name instead.
    """
    error: BaseException | None = None
    before = listing(path.parent)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        os.environ[LIMIT_VARIABLE] = READING_GB
        try:
            with limits():
                read(path)
        except (Exception, TooSlow, SystemExit) as caught:
            error = caught
        finally:
            del os.environ[LIMIT_VARIABLE]
    fault = None if error is None else _fault_of_error(error, (path.name, *names))
    strange = [
        w for w in warned if not issubclass(w.category, SILENT) and not w.category.__module__.startswith("mereo")
    ]
    if fault is None and strange:
        kind = f"{strange[0].category.__name__} at {strange[0].filename}:{strange[0].lineno}"
        fault = Fault(kind, f"{kind}: {strange[0].message}; then {error!r}")
    if fault is None and listing(path.parent) != before:
        fault = Fault("written", f"{sorted(set(listing(path.parent)) ^ set(before))}")
    return error is None, fault


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Files of a folder, with what changes when they do."""
    found = {str(p.relative_to(folder)): p.stat() for p in folder.rglob("*")}
    return {name: (stat.st_size, stat.st_mtime_ns) for name, stat in found.items()}


def _fault_of_error(error: BaseException, names: tuple[str, ...]) -> Fault | None:
    mine = [f for f in extract_tb(error.__traceback__) if Path(f.filename).is_relative_to(PACKAGE)]
    where = f"{Path(mine[-1].filename).name}:{mine[-1].lineno}" if mine else "?"
    if isinstance(error, TooSlow):
        last = extract_tb(error.__traceback__)[-3:]
        return Fault(f"too slow in {where}", f"in {[f'{Path(f.filename).name}:{f.lineno}' for f in last]}")
    text = str(error)
    kind = f"{type(error).__name__} in {where}"
    if not isinstance(error, Exception) or not is_foreseen(error):
        return Fault(kind, f"{type(error).__name__}: {text[:600]}")
    said = words_of(error)
    wrong = {
        "of several lines": len(text.splitlines()) > 1,
        "with control characters": not said.replace("\u00a0", " ").isprintable(),
        "without the file's name": not any(name in said for name in names),
        "too long": len(text) > MOST_CHARACTERS,
    }
    found = [rule for rule, broken in wrong.items() if broken]
    return Fault(f"sentence {' and '.join(found)} from {where}", text[:600]) if found else None
