"""Progress of a long piece of work: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def progress(total: int) -> Iterator[Callable[[int], None]]:
    """Context that shows progress: yields a function that takes the number of new examples.

    It draws a bar on a terminal, and prints a line now and then elsewhere.
    """
    bar = Progress(BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), transient=True)
    task = bar.add_task("", total=total)
    terminal, done = sys.stdout.isatty(), 0
    start = shown = time.monotonic()

    def advance(count: int) -> None:
        nonlocal done, shown
        done, now = done + count, time.monotonic()
        rate = done / max(now - start, 1e-9)
        text = f"{rate:.1f} examples/s, {_duration((total - done) / rate)} left"
        if terminal:
            bar.update(task, completed=done, description=text)
        elif now - shown >= SECONDS_BETWEEN_LINES:
            print(f"{done} of {total}, {text}", flush=True)
            shown = now

    with bar if terminal else nullcontext():
        yield advance
    print(f"{done} examples made in {_duration(time.monotonic() - start)}", flush=True)


def _duration(seconds: float) -> str:
    """Seconds in words."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"
