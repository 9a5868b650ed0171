"""Queries while other processes never rest: what an answer costs on a busy machine, against its fair share."""

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
    """Time while other processes are busy, and the fair one.

    Attributes:
        rule: how many threads were taken.
        threads: how many that were.
        alone: median seconds without the processes, in one thread per core.
        busy: the same with them, in ``threads``.
        processes: number of processes that never rested.
        core_count: number of cores.
    """

    rule: str
    threads: int
    alone: float
    busy: float
    processes: int
    core_count: int

    @property
    def fair(self) -> float:
        """Seconds if the processes and one thread per core shared the cores evenly."""
        return fair_share(self.alone, self.core_count, self.processes, self.core_count)

    @property
    def times(self) -> float:
        """Ratio of the busy time to the fair one."""
        return self.busy / self.fair


def fair_share(alone: float, threads: int, processes: int, core_count: int) -> float:
    """Seconds of what takes ``alone`` seconds in so many threads, where all that wants to run gets an equal share."""
    return alone * max(1.0, (threads + processes) / core_count)


def measure_under_load(work: Callable[[], object], processes: int, rounds: int) -> list[Share]:
    """Shares of ``work`` on the CPU, in a thread for each core that busy processes leave free and in one per core.

    Both take turns with the work alone, so that what else runs meets all.
    """
    core_count, before = cores(), torch.get_num_threads()
    alone: list[float] = []
    rules = {"as many as are free": max(1, core_count - processes), "one per core": core_count}
    busy: dict[str, list[float]] = {rule: [] for rule in rules}
    cpu = torch.device("cpu")
    try:
        for _ in range(rounds):
            torch.set_num_threads(core_count)
            alone.append(seconds(work, cpu))
            for rule, threads in rules.items():
                torch.set_num_threads(threads)
                with busy_processes(processes):
                    busy[rule].append(seconds(work, cpu))
    finally:
        torch.set_num_threads(before)
    median = statistics.median(alone)
    return [Share(rule, rules[rule], median, statistics.median(busy[rule]), processes, core_count) for rule in rules]


def shares_table(shares: list[Share], what: str) -> str:
    """Markdown table of shares, times in milliseconds, and a sentence where the first is above the limit."""
    count = shares[0].processes
    lines = [
        f"| {what}, with {count} busy process{'es' if count > 1 else ''} | threads | alone, ms | fair share, ms "
        "| median, ms | times fair |",
        "|---|---|---|---|---|---|",
    ]
    for share in shares:
        times = " | ".join(f"{1e3 * value:.3g}" for value in (share.alone, share.fair, share.busy))
        lines.append(f"| {share.rule} | {share.threads} | {times} | {share.times:.2f} |")
    if shares[0].times > LIMIT:
        lines += ["", f"This is {shares[0].times:.2f} times the fair share; it must be at most {LIMIT}."]
    return "\n".join(lines) + "\n"
