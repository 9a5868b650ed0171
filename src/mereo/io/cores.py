"""Cores and threads: how many there are, and how many a command's libraries may use."""

import os
import sys

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")
"""Threads of OpenMP (and so torch's), two BLAS libraries and libigl, which read these when they are loaded."""


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Let torch, BLAS and libigl compute in ``count`` threads, in this process and those that it starts.

    Libraries that are loaded already are told so; call it before loading torch, which would have started its threads.
    """
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    if "numpy" in sys.modules:  # without it no library with threads is here
        from threadpoolctl import threadpool_limits

        threadpool_limits(count)


def workers_for(workers: int, threads: int) -> int:
    """Number of worker processes: what is asked for, else as many as threads may be used, else one per core."""
    return workers or threads or cores()
