"""Answers to frames as they come: the latest wins, older ones are dropped, a bad one is reported and passed over.

A reading thread waits for frames; the caller's thread answers. Between them there is room for one frame: a newer one
takes the place of one that still waits, so that an answer is never older than the last computation and memory never
grows, however slow the machine is.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from mereo.io.errors import is_foreseen, words_of

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
    reading = _Reading(frames, recorded_pace, every_frame)
    threading.Thread(target=reading.run, daemon=True, name="frames").start()
    try:
        while (taken := reading.slot.take()) is not None:
            frame = taken.item
            start, result, error = time.perf_counter(), None, ""
            try:
                result = answer(frame.load())
            except Exception as problem:  # a damaged frame makes the libraries that parse it raise anything
                error = frame_error(problem, frame.name)
            now = time.perf_counter()
            yield Outcome(frame.name, frame.time_s, result, error, now - taken.arrived_s, now - start, taken.replaced)
        if reading.failure is not None:
            raise reading.failure
    finally:
        reading.slot.stop()


def frame_error(problem: Exception, name: str) -> str:
    """Sentence that says what is wrong with a frame; ``name`` is the frame's."""
    words = words_of(problem)
    return words if is_foreseen(problem) else f"{name} cannot be answered ({words}): record or write it again"


class _Reading(Generic[Content]):
    """The reading thread's side of a stream."""

    def __init__(self, frames: Iterable[StreamFrame[Content] | None], recorded_pace: bool, every_frame: bool) -> None:
        self.frames, self.recorded_pace, self.every_frame = frames, recorded_pace, every_frame
        self.slot = LatestSlot[StreamFrame[Content]]()
        self.failure: Exception | None = None

    def run(self) -> None:
        """Bring every frame to the slot, until it is stopped or the sequence ends."""
        try:
            self._bring()
        except Exception as problem:  # raised in the caller's thread, after the outcomes before it
            self.failure = problem
        self.slot.end()

    def _bring(self) -> None:
        start, zero = time.perf_counter(), None
        for frame in self.frames:
            if frame is None:
                if self.slot.stopped:
                    break
                continue
            zero = frame.time_s if zero is None else zero
            if self.recorded_pace:
                time.sleep(max(0.0, frame.time_s - zero - (time.perf_counter() - start)))
            if not self.slot.put(frame, wait=self.every_frame):
                break


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
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: Taken[Item] | None = None
        self._ended = self._stopped = False

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

    def end(self) -> None:
        """Say that nothing more is brought; what waits is still taken."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Say that nothing more is taken; what waits is dropped."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
