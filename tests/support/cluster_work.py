"""Functions for other processes and for tasks, in a module that is loaded in no time: every worker loads it anew."""

import os
import time
from pathlib import Path

from mereo.io.cores import THREAD_VARIABLES


def square(number: int) -> int:
    return number * number


def report(number: int) -> tuple[int, list[str | None], str | None]:
    return os.getpid(), [os.environ.get(name) for name in THREAD_VARIABLES], os.environ.get("CUDA_VISIBLE_DEVICES")


def fail_on_three(number: int) -> int:
    if number == 3:
        raise ValueError("three is bad: pass another number")
    return number


def die_once(place: tuple[str, int]) -> int:
    """Kills its worker, the first time, where the number is odd."""
    folder, number = place
    mark = Path(folder) / str(number)
    if number % 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return number


def die(number: int) -> int:
    if number:
        os.kill(os.getpid(), 9)
    return number


def wait_long(number: int) -> int:
    time.sleep(60.0 * number)
    return number
