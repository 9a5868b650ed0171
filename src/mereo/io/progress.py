"""Progress of long work, in one style for all: stage, done, rate and time left, on standard error.

    train    ━━━━━━━━━━━━╸━━━━━━━━━━  step 120 of 300, 24.0 examples/s, 90 s left, loss 1.234

is a bar on a terminal, else the same as a plain line now and then. What others print meanwhile stays above it.
"""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

LINE_EVERY_S = 10.0
"""Seconds between two plain lines."""


@dataclass
class Progress:
    """Progress of one stage of ``total`` units of work, which ``progress`` makes.

    ``unit`` is what these are, in the plural; with ``each`` examples in a unit the rate is of examples.
    """

    stage: str
    total: int
    unit: str
    each: int
    quiet: bool
    bar: Bar | None = None
    done: int = 0

    def __post_init__(self) -> None:
        self._task = None if self.bar is None else self.bar.add_task("", total=self.total, stage=self.stage)
        self._started = self._shown = time.monotonic()
        self._paused_s = 0.0

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count ``count`` more units as done; ``note`` is shown behind the time left."""
        now = time.monotonic()
        self.done += count
        rate = self.done / max(now - self._started - self._paused_s, 1e-9)
        left_s = (self.total - self.done) / max(rate, 1e-9)
        speed = f"{rate:.{1 if rate >= 0.1 else 3}f} {self.unit}/s"
        if self.each:
            speed = f"{rate * self.each:.1f} examples/s"
        parts = (f"{self.done} of {self.total} {self.unit}", speed, f"{duration(left_s)} left", note)
        text = ", ".join(part for part in parts if part)
        if self.bar is not None and self._task is not None:
            self.bar.update(self._task, completed=self.done, description=text)
        elif not self.quiet and now - self._shown >= LINE_EVERY_S:
            _print(f"{self.stage}: {text}")
            self._shown = now

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Block whose time is no unit's: what is done between them."""
        begun = time.monotonic()
        try:
            yield
        finally:
            self._paused_s += time.monotonic() - begun


@contextmanager
def progress(
    stage: str, total: int, unit: str = "examples", *, each: int = 0, quiet: bool = False
) -> Iterator[Progress]:
    """Context of a ``Progress``, which is shown; at its end a line with the time it took, unless it failed."""
    console = Console(stderr=True, highlight=False)
    bar = None
    if console.is_terminal and not quiet:
        columns = TextColumn("{task.fields[stage]}"), BarColumn(), TextColumn("{task.description}")
        # text that goes into a file is not drawn on the terminal
        bar = Bar(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty())
    with bar or nullcontext():
        shown = Progress(stage, total, unit, each, quiet, bar)
        yield shown
    if shown.done and not quiet:
        _print(f"{stage}: {shown.done} {unit} in {duration(time.monotonic() - shown._started)}")


def tracked(stage: str, count: int, unit: str, *, quiet: bool = False) -> Iterator[int]:
    """Numbers from 0 to ``count`` - 1, with the progress of what is done for each."""
    with progress(stage, count, unit, quiet=quiet) as shown:
        for index in range(count):
            yield index
            shown.advance()


SHOWS_STAGES: ContextVar[bool] = ContextVar("SHOWS_STAGES", default=False)
"""Whether ``stage`` shows anything; commands that answer single frames set it."""

STAGE_S = 2.0
"""Seconds from which on a stage is shown."""


@contextmanager
def shown_stages() -> Iterator[None]:
    """Context in which every ``stage`` that takes long is shown."""
    token = SHOWS_STAGES.set(True)
    try:
        yield
    finally:
        SHOWS_STAGES.reset(token)


@contextmanager
def stage(text: str) -> Iterator[None]:
    """Context of a stage without a count ("register the model"), shown on standard error once it takes ``STAGE_S``."""
    if not SHOWS_STAGES.get():
        yield
        return
    started = time.monotonic()
    ended = threading.Event()

    def show() -> None:
        wait_s = STAGE_S
        while not ended.wait(wait_s):
            _print(f"{text}: {duration(time.monotonic() - started)} so far")
            wait_s = LINE_EVERY_S

    thread = threading.Thread(target=show, daemon=True, name="stage")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _print(line: str) -> None:
    print(f"{line}\n", end="", file=sys.stderr, flush=True)  # at once: lines of several threads do not mix


def duration(seconds: float) -> str:
    """Seconds in words: "45 s", "12 min", "3 h 05 min"."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"
