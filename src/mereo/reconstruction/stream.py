"""Answers to frames as they come: the latest wins, older ones are dropped, a bad one is reported and passed over.

    folder, recording, names -frames_of, watched_frames-> StreamFrame -stream-> Outcome

A reading thread waits for frames; the caller's thread answers. Between them there is room for one frame: a newer one
takes the place of one that still waits, so that an answer is never older than the last computation and memory never
grows, however slow the machine is.
"""

import io
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from mereo.io.config import InputConfig
from mereo.io.errors import is_foreseen, words_of
from mereo.io.readers import CLOUD_READERS, DEPTH_READERS
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame, read_frames
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object

Content = TypeVar("Content")
Result = TypeVar("Result")

RECENT = 10_000
"""Answers whose latencies a summary is made of: a stream may run for weeks in the same memory."""


@dataclass(frozen=True, eq=False)
class StreamFrame(Generic[Content]):
    """Frame of a sequence, decoded when it is answered.

    Attributes:
        name: for people: a file, a number.
        time_s: when it was recorded, from any zero.
        load: decodes it; called for frames that are answered only.
    """

    name: str
    time_s: float
    load: Callable[[], Content]


@dataclass(frozen=True, eq=False)
class Outcome(Generic[Result]):
    """Outcome of a frame: its answer or error, and the time it took.

    Attributes:
        name, time_s: of the frame.
        result: the answer; None where it failed.
        error: one sentence; empty where it did not fail.
        latency_s: from the frame's arrival to its answer, waiting included.
        work_s: the decoding and answering in it.
        dropped: frames that were replaced by newer ones since the last outcome.
    """

    name: str
    time_s: float
    result: Result | None
    error: str
    latency_s: float
    work_s: float
    dropped: int


def stream(
    frames: Iterable[StreamFrame[Content] | None],
    answer: Callable[[Content], Result],
    *,
    recorded_pace: bool = False,
    every_frame: bool = False,
) -> Iterator[Outcome[Result]]:
    """Answer the latest frame, again and again, until the sequence ends.

    Args:
        frames: the sequence; iterated in a thread of its own, which may wait for the camera. A None says that nothing
            new has come, and lets a thread that waits see that the stream has been left.
        answer: from a cloud to whatever is wanted, for example ``lambda cloud: reconstruct(cloud, model, 48)``.
        recorded_pace: frames arrive when their times say, counted from the first; else as fast as they are read.
        every_frame: none is dropped; the sequence waits for the answers.

    Yields one outcome per answered or failed frame. Whatever goes wrong in one frame is its outcome's error; what goes
    wrong in the sequence itself is raised after the outcomes before it.
    """
    slot = LatestSlot[StreamFrame[Content]]()
    threading.Thread(
        target=_bring_frames, args=(frames, slot, recorded_pace, every_frame), daemon=True, name="frames"
    ).start()
    try:
        while (taken := slot.take()) is not None:
            frame = taken.item
            start, result, error = time.perf_counter(), None, ""
            try:
                result = answer(frame.load())
            except Exception as problem:  # a damaged frame makes the libraries that parse it raise anything
                error = frame_error(problem, frame.name)
            now = time.perf_counter()
            yield Outcome(frame.name, frame.time_s, result, error, now - taken.arrived_s, now - start, taken.replaced)
        if slot.failure is not None:
            raise slot.failure
    finally:
        slot.stop()


def _bring_frames(
    frames: Iterable[StreamFrame[Content] | None],
    slot: "LatestSlot[StreamFrame[Content]]",
    recorded_pace: bool,
    every_frame: bool,
) -> None:
    """Bring every frame to the slot, until it is stopped or the sequence ends: the reading thread's work."""
    failure: Exception | None = None
    try:
        start, zero = time.perf_counter(), None
        for frame in frames:
            if frame is None:
                if slot.stopped:
                    break
                continue
            zero = frame.time_s if zero is None else zero
            if recorded_pace:
                time.sleep(max(0.0, frame.time_s - zero - (time.perf_counter() - start)))
            if not slot.put(frame, wait=every_frame):
                break
    except Exception as problem:  # raised in the caller's thread, after the outcomes before it
        failure = problem
    slot.end(failure)


def frame_error(problem: Exception, name: str) -> str:
    """Sentence that says what is wrong with a frame; ``name`` is the frame's."""
    words = words_of(problem)
    return words if is_foreseen(problem) else f"{name} cannot be answered ({words}): record or write it again"


@dataclass(frozen=True)
class Summary:
    """Numbers of a stream: answers per second, latencies in seconds (the last ``RECENT``), what was not answered."""

    answered: int
    failed: int
    dropped: int
    rate_hz: float
    latency_median_s: float
    latency_99_s: float

    def __str__(self) -> str:
        return (
            f"{self.answered} frames answered at {self.rate_hz:.1f} Hz, latency {1e3 * self.latency_median_s:.0f} ms "
            f"(median), {1e3 * self.latency_99_s:.0f} ms (99 %); {self.dropped} dropped for newer ones, "
            f"{self.failed} bad"
        )


class Counter:
    """Counter of outcomes that pass by, for their summary."""

    def __init__(self) -> None:
        self.start = time.perf_counter()
        self.latencies = deque[float](maxlen=RECENT)
        self.answered = self.failed = self.dropped = 0

    def add(self, outcome: Outcome[Result]) -> None:
        """Count an outcome."""
        self.dropped += outcome.dropped
        if outcome.error:
            self.failed += 1
        else:
            self.answered += 1
            self.latencies.append(outcome.latency_s)

    def summary(self) -> Summary:
        """Numbers of the stream up to now; latencies are NaN where nothing was answered."""
        seconds = time.perf_counter() - self.start
        median, worst = np.quantile(self.latencies, [0.5, 0.99]) if self.latencies else (np.nan, np.nan)
        rate_hz = self.answered / seconds
        return Summary(self.answered, self.failed, self.dropped, rate_hz, float(median), float(worst))


# --- the latest item --------------------------------------------------------------------------------------------------

# Room for one item between a thread that brings and one that works: a newer one takes the place of one that waits.

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Taken(Generic[Item]):
    """Item out of a ``LatestSlot``.

    Attributes:
        item: what was put there.
        arrived_s: when it came to wait there, by ``time.perf_counter``.
        replaced: how many items gave way since the last one that was taken.
    """

    item: Item
    arrived_s: float
    replaced: int


class LatestSlot(Generic[Item]):
    """Room for one item, which a newer one replaces, so that no work is older than the one before it took.

    Any thread may call any method.

    Attributes:
        failure: what ended the sequence of items before its end, None without such an error.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: Taken[Item] | None = None
        self._ended = self._stopped = False
        self.failure: Exception | None = None

    @property
    def stopped(self) -> bool:
        """Whether ``stop`` was called."""
        return self._stopped

    def put(self, item: Item, *, wait: bool = False) -> bool:
        """Leave an item, in place of one that waits, or with ``wait`` once that is taken; False after ``stop``."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._stopped or self._waiting is None)
            replaced = 0 if self._waiting is None else self._waiting.replaced + 1
            self._waiting = Taken(item, time.perf_counter(), replaced)
            self._changed.notify_all()
            return not self._stopped

    def take(self, timeout_s: float | None = None) -> Taken[Item] | None:
        """Waiting item, or the next one that comes within ``timeout_s``; by default it waits as long as it takes.

        None where none has come in time, after the last one, and after ``stop``.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._ended or self._waiting is not None, timeout_s)
            taken, self._waiting = self._waiting, None
            self._changed.notify_all()
            return None if self._stopped else taken

    def end(self, failure: Exception | None = None) -> None:
        """Say that nothing more is brought, and why where something failed; what waits is still taken."""
        with self._changed:
            self._ended, self.failure = True, failure
            self._changed.notify_all()

    def stop(self) -> None:
        """Say that nothing more is taken; what waits is dropped."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()


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
        present = self._versions()
        self._taken = {file: version for file, version in self._taken.items() if file in present}
        before, self._waiting, complete = self._waiting, {}, []
        for file, version in present.items():
            if self._taken.get(file) == version:
                continue
            known = before.get(file, _Waiting((0, -1), now_s))
            at_rest = known.version == version and version[1] > 0
            if at_rest or now_s - known.since_s >= PATIENCE_S:
                self._taken[file] = version
                complete.append(file)
            else:
                self._waiting[file] = _Waiting(version, known.since_s)
        return sorted(complete, key=lambda file: (present[file][0], file.name))

    def _versions(self) -> dict[Path, Version]:
        versions = {}
        with os.scandir(self.folder) as entries:
            for entry in entries:
                try:
                    if self.wanted(Path(entry.path)):
                        facts = entry.stat()
                        versions[Path(entry.path)] = (facts.st_mtime_ns, facts.st_size)
                except FileNotFoundError:  # removed or renamed meanwhile
                    continue
        return versions


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
        messages = read_frames(path, reading)
        return (StreamFrame(message.name, message.time_s, _loader(read, isolation)) for message, read in messages)
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

    Files that are there already come first. One that is written again is a new frame; see ``WatchedFolder`` on when a
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


def _loader(read: Callable[[], SensorFrame], isolation: IsolationConfig) -> Callable[[], Observation]:
    return lambda: find_object(read(), isolation)
