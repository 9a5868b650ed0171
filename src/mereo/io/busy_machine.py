"""Whether a piece of work waits for cores that other processes hold, as Linux tells of every thread; said once.

``/proc/PID/task/TID/schedstat`` counts the nanoseconds that a thread ran, and those that it could have run and waited
for a core. Unlike the load average it knows this process from others, and unlike the clock, waiting for a core from
waiting for a file. Other systems have no such count, and nothing is said there.
"""

import multiprocessing
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from mereo.io.cores import cores

SETTLED_S = 10.0
"""Seconds over which waiting is counted: less would see what starts and ends beside any work."""

MUCH = 0.25
"""Share of the time that threads wait, of that which they run and wait, from which on it is worth a word."""

AT_WORK = 0.5
"""Cores that work must use or ask for, in the mean, before its waiting says anything."""

Times = dict[str, tuple[int, int]]
"""Nanoseconds that each thread ran, and waited for a core, by its path."""

_said = False


def thread_times() -> Times:
    """Times of all threads of this process and of the workers that it has started; empty where nothing tells them."""
    found: Times = {}
    for process in (os.getpid(), *(child.pid for child in multiprocessing.active_children())):
        for path in Path(f"/proc/{process}/task").glob("*/schedstat"):
            try:
                ran, waited, _ = path.read_text().split()
            except (OSError, ValueError):  # it has ended meanwhile
                continue
            found[str(path)] = int(ran), int(waited)
    return found


@dataclass
class BusyWatch:
    """Watch over one piece of work: ``look`` now and then."""

    since: float = field(default_factory=time.monotonic)
    before: Times = field(default_factory=thread_times)

    def look(self) -> str | None:
        """Sentence that the machine is busy, the first time that this is seen in this process; None otherwise."""
        global _said
        now = time.monotonic()
        if _said or now - self.since < SETTLED_S:
            return None
        after = thread_times()
        ran, waited = (
            sum(after[path][kind] - self.before[path][kind] for path in after.keys() & self.before.keys()) / 1e9
            for kind in (0, 1)
        )
        told = describe_waiting(ran, waited, now - self.since)
        self.since, self.before, _said = now, after, told is not None
        return told


def describe_waiting(ran_s: float, waited_s: float, seconds: float) -> str | None:
    """Sentence on threads that ran and waited so long, together, in so many seconds; None where that is not much."""
    asked = ran_s + waited_s
    if asked < AT_WORK * seconds or waited_s < MUCH * asked:
        return None
    threads = os.environ.get("OMP_NUM_THREADS", "")
    used = min(round(asked / seconds), int(threads) if threads.isdecimal() else cores())
    got = max(1, round(ran_s / seconds))
    load = f"load {os.getloadavg()[0]:.1f} on {cores()} cores" if sys.platform != "win32" else f"{cores()} cores"
    fewer = f"work with fewer threads (--threads {got}), " if got < used else ""
    return (
        f"the machine is busy: this work waits {waited_s / asked:.0%} of its time for cores that others hold ({load}): "
        f"{fewer}end the others, or wait for them"
    )
