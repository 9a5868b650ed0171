"""Cores and threads: how many there are, how many are free, and how many a command's libraries may use."""

import math
import os
import sys
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")
"""Threads of OpenMP (and so torch's), two BLAS libraries and libigl, which read these when they are loaded."""

QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)
"""Files in which Linux says what share of time a container may have, as quota and period: its second way, its first."""

STATISTICS = Path("/proc/stat")
"""File in which Linux counts what each core did, in ticks."""

SHORTEST_S = 0.2
"""Seconds over which free cores are counted at least: a tick is a hundredth."""


def cores() -> int:
    """Number of cores that this process may use, a container's quota included."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(there, _quota())))


def _quota() -> float:
    """Cores' worth of time that this process's container may have; infinite where nothing limits it."""
    for files in QUOTAS:
        try:
            quota, period = (float(word) for file in files for word in Path(file).read_text().split())
        except (OSError, ValueError):  # no such file, or "max"
            continue
        if quota > 0 and period > 0:  # -1 is no limit
            return quota / period
    return math.inf


@dataclass(frozen=True)
class FreeCores:
    """Count, from its making on, of the cores that this process has or could have: idle ones, and those it uses.

    On Linux ``/proc/stat`` tells it of the last fractions of a second; elsewhere the load average of the last minute
    does, and Windows has neither.
    """

    at_s: float = field(default_factory=time.monotonic)
    own_s: float = field(default_factory=time.process_time)
    idle_s: float | None = field(default_factory=lambda: _idle_s())

    def now(self) -> float:
        """Mean number since then, waiting until it is worth something; ``cores()`` where nothing tells it."""
        if self.idle_s is None:
            return cores() - os.getloadavg()[0] if hasattr(os, "getloadavg") else cores()
        time.sleep(max(0.0, SHORTEST_S - (time.monotonic() - self.at_s)))
        used = (_idle_s() or 0.0) - self.idle_s + time.process_time() - self.own_s
        return min(used / (time.monotonic() - self.at_s), cores())


def _idle_s() -> float | None:
    """Seconds that the cores of this process were idle since the machine started, together; None if nothing tells."""
    try:
        lines = STATISTICS.read_text().splitlines()
        ours = {f"cpu{number}" for number in os.sched_getaffinity(0)}
        rows = [line.split() for line in lines]
        ticks = sum(int(row[4]) + int(row[5]) for row in rows if row and row[0] in ours)  # idle, waiting for a disk
        return ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):  # another system
        return None


def threads_for(free: float, there: int) -> int:
    """Number of threads that is fastest where ``free`` of ``there`` cores are free: one each, on half of them at least.

    Threads of one product wait for the slowest, so one that shares a core slows all. But on a machine that others fill,
    work gets as much of it as it has threads, and fewer than half would give more away than the waiting costs.
    """
    return max(math.ceil(there / 2), min(there, round(free)))


def use_free_cores(watch: FreeCores) -> int:
    """Let libraries compute on the cores that are free, unless OMP_NUM_THREADS is set; returns the number of threads.

    On an idle machine, and where the user has decided, nothing changes.
    """
    stated = os.environ.get(THREAD_VARIABLES[0], "")
    if stated:
        return int(stated) if stated.isdecimal() else cores()
    there = cores()
    count = threads_for(watch.now(), there)
    if count < there:  # what ran for a moment is over now: only what goes on is counted twice
        count = max(count, threads_for(FreeCores().now(), there))
    if count < (os.cpu_count() or 1):
        use_threads(count)
    return count


def use_threads(count: int) -> None:
    """Let torch, BLAS and libigl compute in ``count`` threads, in this process and those that it starts.

    Libraries that are loaded already are told so; call it before loading torch, which would have started its threads.
    """
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    if "numpy" in sys.modules:  # without it no library with threads is here
        from threadpoolctl import threadpool_limits

        threadpool_limits(count)


class _OneBlasThread:
    """Limit of BLAS to one thread that several threads of a program may hold at once; the last to leave lifts it."""

    def __init__(self) -> None:
        self._changing, self._holders = threading.Lock(), 0
        self._limit: AbstractContextManager[object] | None = None

    def __enter__(self) -> None:
        from threadpoolctl import threadpool_limits

        with self._changing:
            if self._holders == 0:
                self._limit = threadpool_limits(1, "blas")
            self._holders += 1

    def __exit__(self, *_: object) -> None:
        with self._changing:
            self._holders -= 1
            if self._holders == 0 and self._limit is not None:
                self._limit.__exit__(None, None, None)


_ONE_BLAS_THREAD = _OneBlasThread()


def one_blas_thread() -> AbstractContextManager[object]:
    """Hold BLAS to one thread: its sums come out the same on any number of cores.

    And where products are small it is faster than two, on busy cores 20 times. The limit is the whole process's, and
    lasts until the last thread that holds it lets go.
    """
    return _ONE_BLAS_THREAD


def workers_for(workers: int, threads: int) -> int:
    """Number of worker processes: what is asked for, else as many as threads may be used, else one per core."""
    return workers or threads or cores()
