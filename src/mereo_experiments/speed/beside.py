"""Queries beside processes that never rest: what an answer costs on a busy machine, against its fair share."""

import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from mereo.io.cores import cores
from mereo_experiments.speed.roofline import seconds

LIMIT = 1.5
"""Times of the fair share that an answer may take."""

BUSY = "import os; parent = os.getppid(); print('started', flush=True)\nwhile os.getppid() == parent: pass"
"""A process that never rests, and ends with whoever started it."""


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """That many run meanwhile, each on a core where there are enough."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE) for _ in range(count)]
    try:
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@dataclass(frozen=True)
class Share:
    """Time beside busy processes, and the fair one.

    Attributes:
        rule: how many threads were taken.
        threads: how many that were.
        alone: median seconds without the processes, in one thread per core.
        busy: the same beside them, in ``threads``.
        beside: number of processes that never rested.
        there: number of cores.
    """

    rule: str
    threads: int
    alone: float
    busy: float
    beside: int
    there: int

    @property
    def fair(self) -> float:
        """Seconds if the processes and one thread per core shared the cores evenly."""
        return fair_share(self.alone, self.there, self.beside, self.there)

    @property
    def times(self) -> float:
        """Ratio of the busy time to the fair one."""
        return self.busy / self.fair


def fair_share(alone: float, threads: int, beside: int, there: int) -> float:
    """Seconds of what takes ``alone`` seconds in so many threads, where all that wants to run gets an equal share."""
    return alone * max(1.0, (threads + beside) / there)


def measure_beside(work: Callable[[], object], beside: int, rounds: int) -> list[Share]:
    """Shares of ``work`` on the CPU, in a thread for each core that busy processes leave free and in one per core.

    Both take turns with the work alone, so that what else runs meets all.
    """
    there, before = cores(), torch.get_num_threads()
    alone: list[float] = []
    rules = {"as many as are free": max(1, there - beside), "one per core": there}
    busy: dict[str, list[float]] = {rule: [] for rule in rules}
    cpu = torch.device("cpu")
    try:
        for _ in range(rounds):
            torch.set_num_threads(there)
            alone.append(seconds(work, cpu))
            for rule, threads in rules.items():
                torch.set_num_threads(threads)
                with busy_processes(beside):
                    busy[rule].append(seconds(work, cpu))
    finally:
        torch.set_num_threads(before)
    median = statistics.median(alone)
    return [Share(rule, rules[rule], median, statistics.median(busy[rule]), beside, there) for rule in rules]


def shares_table(shares: list[Share], what: str) -> str:
    """Markdown table of shares, times in milliseconds, and a sentence where the first is above the limit."""
    count = shares[0].beside
    lines = [
        f"| {what}, beside {count} busy process{'es' if count > 1 else ''} | threads | alone, ms | fair share, ms "
        "| median, ms | times fair |",
        "|---|---|---|---|---|---|",
    ]
    for one in shares:
        times = " | ".join(f"{1e3 * value:.3g}" for value in (one.alone, one.fair, one.busy))
        lines.append(f"| {one.rule} | {one.threads} | {times} | {one.times:.2f} |")
    if shares[0].times > LIMIT:
        lines += ["", f"This is {shares[0].times:.2f} times the fair share; it must be at most {LIMIT}."]
    return "\n".join(lines) + "\n"
