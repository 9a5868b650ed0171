"""Memory that this process may still take."""

import os
from pathlib import Path

MEMORY = Path("/proc/meminfo")
"""File in which Linux says how much memory could be had without swapping."""

LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Files in which Linux says what a container may have, and what it has: its second way, its first."""


def free_bytes() -> int | None:
    """Bytes of memory that are free, or could be made so, a container's limit included; None where nothing tells."""
    there = _available()
    left = [limit - used for limit, used in (_of_container(*files) for files in LIMITS) if limit is not None]
    return min([*left, *([] if there is None else [there])], default=None)


def _available() -> int | None:
    try:
        lines = dict(line.split(":", 1) for line in MEMORY.read_text().splitlines() if ":" in line)
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, LookupError):
        pass
    try:  # another system: half of what is built in
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return None


def _of_container(limit: str, used: str) -> tuple[int | None, int]:
    """Limit and use of a container's memory; a file cache counts as used, so that there may be more than is told."""
    try:
        return int(Path(limit).read_text()), int(Path(used).read_text())
    except (OSError, ValueError):  # no such file, or "max"
        return None, 0
