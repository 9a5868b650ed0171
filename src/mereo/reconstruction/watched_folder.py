"""Folder into which a camera's program writes: its files in the order in which they become complete.

No system tells when a writer is done. A file counts as complete when it is not empty and has not changed between two
looks. One that never comes to rest is handed over all the same after a while, so that whoever reads it says what is
wrong with it; one that was handed over too early comes again when it has changed.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

LOOK_S = 0.05
"""Seconds between two looks."""

PATIENCE_S = 10.0
"""Seconds after which a file that is still empty, or still changes, is handed over as it is."""

Version = tuple[int, int]
"""Time of the last change in nanoseconds, and size in bytes."""


@dataclass(frozen=True)
class _Waiting:
    """File that is perhaps still written: its version at the last look, and when it was first seen."""

    version: Version
    since_s: float


class WatchedFolder:
    """Files of a folder, each handed over once for every time that it was written.

    Attributes:
        folder: the folder; what lies deeper is not seen.
        wanted: which of its files count.
    """

    def __init__(self, folder: Path, wanted: Callable[[Path], bool]) -> None:
        self.folder, self.wanted = folder, wanted
        self._taken: dict[Path, Version] = {}
        self._waiting: dict[Path, _Waiting] = {}

    def look(self, now_s: float) -> list[Path]:
        """Files that are complete since the last look, the oldest first; ``now_s`` is the time by any clock.

        Raises ``OSError`` where the folder is gone.
        """
        there = self._versions()
        self._taken = {file: version for file, version in self._taken.items() if file in there}
        before, self._waiting, complete = self._waiting, {}, []
        for file, version in there.items():
            if self._taken.get(file) == version:
                continue
            known = before.get(file, _Waiting((0, -1), now_s))
            at_rest = known.version == version and version[1] > 0
            if at_rest or now_s - known.since_s >= PATIENCE_S:
                self._taken[file] = version
                complete.append(file)
            else:
                self._waiting[file] = _Waiting(version, known.since_s)
        return sorted(complete, key=lambda file: (there[file][0], file.name))

    def _versions(self) -> dict[Path, Version]:
        found = {}
        with os.scandir(self.folder) as entries:
            for entry in entries:
                try:
                    if self.wanted(Path(entry.path)):
                        facts = entry.stat()
                        found[Path(entry.path)] = (facts.st_mtime_ns, facts.st_size)
                except FileNotFoundError:  # removed or renamed meanwhile
                    continue
        return found
