"""Frames as they come: the latest one is answered, older ones are dropped, a bad one is reported and passed over.

A reading thread waits for frames; the caller's thread answers. Between them there is room for one frame: a newer one
takes the place of one that still waits, so that an answer is never older than the last computation and memory never
grows, however slow the machine is.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from mereo.geometry.camera import PointCloud

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """A frame of a sequence.

    Attributes:
        name: for people: a file, a number.
        time_s: when it was recorded, from any zero.
        load: decodes it; called for frames that are answered only.
    """

    name: str
    time_s: float
    load: Callable[[], PointCloud]


@dataclass(frozen=True, eq=False)
class Outcome(Generic[Result]):
    """What became of a frame.

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


class _Slot:
    """Room for one frame between the two threads."""

    def __init__(self, keep_all: bool) -> None:
        self.keep_all, self.changed = keep_all, threading.Condition()
        self.waiting: tuple[StreamFrame, float] | None = None
        self.dropped, self.ended, self.stopped = 0, False, False
        self.failure: Exception | None = None

    def put(self, frame: StreamFrame) -> bool:
        """Leave a frame, in place of one that waits or, with ``keep_all``, after it. False once nobody reads."""
        with self.changed:
            if self.keep_all:
                self.changed.wait_for(lambda: self.waiting is None or self.stopped)
            elif self.waiting is not None:
                self.dropped += 1
            self.waiting = (frame, time.perf_counter())
            self.changed.notify_all()
            return not self.stopped

    def take(self) -> tuple[StreamFrame, float, int] | None:
        """The waiting frame, when it arrived, and how many were dropped for it; None after the last."""
        with self.changed:
            self.changed.wait_for(lambda: self.waiting is not None or self.ended)
            if self.waiting is None:
                return None
            (frame, arrived), dropped = self.waiting, self.dropped
            self.waiting, self.dropped = None, 0
            self.changed.notify_all()
            return frame, arrived, dropped

    def end(self, failure: Exception | None) -> None:
        with self.changed:
            self.ended, self.failure = True, failure
            self.changed.notify_all()

    def stop(self) -> None:
        with self.changed:
            self.stopped = True
            self.changed.notify_all()


def stream(
    frames: Iterable[StreamFrame],
    answer: Callable[[PointCloud], Result],
    *,
    recorded_pace: bool = False,
    every_frame: bool = False,
) -> Iterator[Outcome[Result]]:
    """Answer the latest frame, again and again, until the sequence ends.

    Args:
        frames: the sequence; iterated in a thread of its own, which may wait for the camera.
        answer: from a cloud to whatever is wanted, for example ``lambda cloud: reconstruct(cloud, model, 48)``.
        recorded_pace: frames arrive when their times say, counted from the first; else as fast as they are read.
        every_frame: none is dropped; the sequence waits for the answers.

    Yields one outcome per answered or failed frame. What goes wrong in one frame (``ValueError``, ``OSError``) is its
    outcome's error; what goes wrong in the sequence itself is raised after the outcomes before it.
    """
    slot = _Slot(every_frame)
    threading.Thread(target=_read, args=(frames, slot, recorded_pace), daemon=True, name="frames").start()
    try:
        while (taken := slot.take()) is not None:
            frame, arrived, dropped = taken
            start, result, error = time.perf_counter(), None, ""
            try:
                result = answer(frame.load())
            except (ValueError, OSError) as problem:
                error = " ".join(str(problem).split()) or type(problem).__name__
            now = time.perf_counter()
            yield Outcome(frame.name, frame.time_s, result, error, now - arrived, now - start, dropped)
        if slot.failure is not None:
            raise slot.failure
    finally:
        slot.stop()


def _read(frames: Iterable[StreamFrame], slot: _Slot, recorded_pace: bool) -> None:
    failure = None
    try:
        start, zero = time.perf_counter(), None
        for frame in frames:
            zero = frame.time_s if zero is None else zero
            if recorded_pace:
                time.sleep(max(0.0, frame.time_s - zero - (time.perf_counter() - start)))
            if not slot.put(frame):
                break
    except Exception as problem:
        failure = problem
    slot.end(failure)


@dataclass(frozen=True)
class Summary:
    """A stream in numbers: answers per second, latencies in seconds, and what was not answered."""

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
    """Collects a summary while outcomes pass by."""

    def __init__(self) -> None:
        self.start = time.perf_counter()
        self.latencies: list[float] = []
        self.failed = self.dropped = 0

    def add(self, outcome: Outcome[Result]) -> None:
        self.dropped += outcome.dropped
        if outcome.error:
            self.failed += 1
        else:
            self.latencies.append(outcome.latency_s)

    def summary(self) -> Summary:
        """Up to now; latencies are NaN where nothing was answered."""
        seconds = time.perf_counter() - self.start
        count = len(self.latencies)
        median, worst = np.quantile(self.latencies, [0.5, 0.99]) if count else (np.nan, np.nan)
        return Summary(count, self.failed, self.dropped, count / seconds, float(median), float(worst))
