"""Sources of a stream's frames: a folder, complete or still filled, a ROS recording, file names on standard input."""

import io
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mereo.io.config import InputConfig
from mereo.io.readers import CLOUD_READERS, DEPTH_READERS
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame, read_frames
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object
from mereo.reconstruction.stream import StreamFrame

# --- watched folders --------------------------------------------------------------------------------------------------

# Folder into which a camera's program writes: its files in the order in which they become complete.
#
# No system tells when a writer is done. A file counts as complete when it is not empty and has not changed between two
# looks. One that never comes to rest is handed over all the same after a while, so that whoever reads it says what is
# wrong with it; one that was handed over too early comes again when it has changed.

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


# --- stream sources ---------------------------------------------------------------------------------------------------

STANDARD_INPUT = "-"
"""Source that means names of files on standard input."""


def frames_of(
    source: str, reading: InputConfig, isolation: IsolationConfig, rate_hz: float = 30.0
) -> Iterator[StreamFrame[Observation]]:
    """Frames of a source, in order; each is decoded when it is answered.

    Args:
        source: a folder of depth images or point clouds (in the order of their names), a ROS recording, or ``-`` for
            names of files, one a line, as they are written.
        reading: how a file is read.
        isolation: what is left out of it.
        rate_hz: at which a folder was recorded; recordings have their own times.

    Raises ``FileNotFoundError``, or ``ValueError`` for a folder without frames and a rate that is not positive.
    """
    if not 0 < rate_hz < float("inf"):
        raise ValueError(f"the rate is {rate_hz} Hz; it must be positive: give the frames per second, for example 30")
    if source == STANDARD_INPUT:
        return _named(reading, isolation)
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a folder of frames or a ROS recording is needed, or -")
    if is_recording(path):
        return _recorded(path, reading, isolation)
    if not path.is_dir():
        raise ValueError(f"{path} is a single file; for one frame use `mereo reconstruct`, here name its folder")
    return (
        StreamFrame(file.name, i / rate_hz, _loader(partial(read_frame, file, reading), isolation))
        for i, file in enumerate(frames_in(path, reading))
    )


def frames_in(folder: Path, reading: InputConfig) -> list[Path]:
    """Depth images and point clouds of a folder in the order of their names; ``ValueError`` where it has none."""
    files = sorted(file for file in folder.iterdir() if _is_frame(file, reading))
    if not files:
        raise ValueError(f"{folder} has no depth images or point clouds; a folder of frames is needed: check the path")
    return files


def watched_frames(
    source: str, reading: InputConfig, isolation: IsolationConfig
) -> Iterator[StreamFrame[Observation] | None]:
    """Frames of a folder as their files arrive, without end; None where nothing new has come.

    Files that are there already come first. One that is written again is a new frame; see ``watched_folder`` on when a
    file is complete. Times count from the start.

    Raises ``FileNotFoundError``, or ``ValueError`` for what is no folder; ``OSError`` where it is removed meanwhile.
    """
    path = Path(source)
    if source != STANDARD_INPUT and not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a folder that can be watched is needed: make it first")
    if not path.is_dir() or is_recording(path):
        raise ValueError(f"{source} is no folder of frames; only such a folder can be watched: leave out --watch")
    return _arriving(WatchedFolder(path, lambda file: _is_frame(file, reading)), reading, isolation)


def _arriving(
    folder: WatchedFolder, reading: InputConfig, isolation: IsolationConfig
) -> Iterator[StreamFrame[Observation] | None]:
    start = time.perf_counter()
    while True:
        begun = time.perf_counter()
        for file in folder.look(begun):
            load = _loader(partial(read_frame, file, reading), isolation)
            yield StreamFrame(file.name, time.perf_counter() - start, load)
        yield None
        time.sleep(max(LOOK_S, time.perf_counter() - begun))  # at most half of the time in a folder of many files


def _is_frame(file: Path, reading: InputConfig) -> bool:
    """Whether the name of a file is a frame's; hidden ones are those that a writer renames when they are complete."""
    known = file.suffix.lower() in CLOUD_READERS or file.suffix.lower() in DEPTH_READERS
    return known and not file.name.startswith(".") and file != reading.mask and file.is_file()


def _named(reading: InputConfig, isolation: IsolationConfig) -> Iterator[StreamFrame[Observation]]:
    start = time.perf_counter()
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="surrogateescape")  # names are bytes: one that is no UTF-8 is still a file's
    for line in sys.stdin:
        if name := line.strip():
            load = _loader(partial(read_frame, name, reading), isolation)
            yield StreamFrame(name, time.perf_counter() - start, load)


def _recorded(path: Path, reading: InputConfig, isolation: IsolationConfig) -> Iterator[StreamFrame[Observation]]:
    for message, read in read_frames(path, reading):
        yield StreamFrame(message.name, message.time_s, _loader(read, isolation))


def _loader(read: Callable[[], SensorFrame], isolation: IsolationConfig) -> Callable[[], Observation]:
    return lambda: find_object(read(), isolation)
