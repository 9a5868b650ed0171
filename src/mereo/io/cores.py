"""Cores and threads: how many there are, and how many a command's libraries may use."""

import math
import os
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import Any

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")
"""Threads of OpenMP (and so torch's), two BLAS libraries and libigl, which read these when they are loaded."""

QUOTAS = (
    ("/sys/fs/cgroup/cpu.max",),
    ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
)
"""Files in which Linux says what share of time a container may have, as quota and period: its second way, its first."""


def cores() -> int:
    """Number of cores that this process may use, a container's quota included."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in QUOTAS:
        with suppress(OSError, ValueError):  # no such file, or "max"
            quota, period = (float(word) for file in files for word in Path(file).read_text().split())
            if quota > 0 and period > 0:  # -1 is no limit
                return max(1, math.ceil(min(count, quota / period)))
    return count


def use_threads(count: int) -> None:
    """Let torch, BLAS and libigl compute in ``count`` threads, in this process and those that it starts.

    0 means one per core that this process may use, unless OMP_NUM_THREADS is set. Libraries that are loaded already
    change too; call it before loading torch, which would have started its threads.
    """
    if count == 0:
        count = cores()
        if os.environ.get(THREAD_VARIABLES[0]) or count >= (os.cpu_count() or 1):
            return
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    if "numpy" in sys.modules:  # without it no library with threads is here
        from threadpoolctl import threadpool_limits

        threadpool_limits(count)


class SharedLimit:
    """Limit of the whole process that several threads may hold at once; the last to leave lifts it."""

    def __init__(self, limit: Callable[[], AbstractContextManager[object]]) -> None:
        self._limit, self._changing, self._holders = limit, threading.Lock(), 0
        self._held = ExitStack()

    def __enter__(self) -> None:
        with self._changing:
            if self._holders == 0:
                self._held.enter_context(self._limit())
            self._holders += 1

    def __exit__(self, *_: object) -> None:
        with self._changing:
            self._holders -= 1
            if self._holders == 0:
                self._held.close()


@cache
def _libraries() -> Any:
    """Libraries that compute in threads; looking for them takes a tenth of a tracked frame's time."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


_BLAS_LIMIT = SharedLimit(lambda: _libraries().limit(limits=1, user_api="blas"))


def limit_blas_threads() -> AbstractContextManager[object]:
    """Hold BLAS to one thread, until the last holder lets go: its sums come out the same on any number of cores.

    And where products are small it is faster than two, on busy cores 20 times.
    """
    return _BLAS_LIMIT


def workers_for(workers: int, threads: int) -> int:
    """Number of worker processes: what is asked for, else as many as threads may be used, else one per core."""
    return workers or threads or cores()
