"""Functions for tasks of a cluster, in a module that is loaded in no time: every worker that starts loads it anew."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from mereo.io.cores import THREAD_VARIABLES

Cancelled = Callable[[], bool]


def square(number: int, cancelled: Cancelled) -> int:
    return number * number


def report(number: int, cancelled: Cancelled) -> tuple[int, list[str | None], str | None]:
    return os.getpid(), [os.environ.get(name) for name in THREAD_VARIABLES], os.environ.get("CUDA_VISIBLE_DEVICES")


def fail_on_three(number: int, cancelled: Cancelled) -> int:
    if number == 3:
        raise ValueError("three is bad: pass another number")
    return number


def die_once(place: tuple[str, int], cancelled: Cancelled) -> int:
    """Kills its worker, the first time, where the number is odd."""
    folder, number = place
    mark = Path(folder) / str(number)
    if number % 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return number


def die(number: int, cancelled: Cancelled) -> int:
    if number:
        os.kill(os.getpid(), 9)
    return number


def wait_long(number: int, cancelled: Cancelled) -> int:
    time.sleep(60.0 * number)
    return number
