"""Streams: the latest frame wins, memory stays bounded, one bad frame stops nothing."""

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mereo.geometry.camera import PointCloud
from mereo.reconstruction import stream as stream_module
from mereo.reconstruction.stream import Counter, Outcome, StreamFrame, stream


def frame(number: int, time_s: float = 0.0) -> StreamFrame[PointCloud]:
    return StreamFrame(str(number), time_s, lambda: PointCloud(np.full((40, 3), number, dtype=float)))


def number_of(cloud: PointCloud) -> int:
    return int(cloud.points[0, 0])


def test_every_frame_is_answered_in_order_when_asked() -> None:
    outcomes = list(stream((frame(i) for i in range(20)), number_of, every_frame=True))
    assert [o.result for o in outcomes] == list(range(20))
    assert all(o.dropped == 0 and o.error == "" and 0 <= o.work_s <= o.latency_s for o in outcomes)


def test_a_slow_answer_gets_the_latest_frame() -> None:
    """Ten frames arrive while the first is answered: the next answer is for the tenth."""
    arrived, begun = threading.Event(), threading.Event()

    def frames() -> Iterator[StreamFrame[PointCloud]]:
        yield frame(0)
        begun.wait(10)
        for i in range(1, 11):
            yield frame(i)
        arrived.set()

    def slow(cloud: PointCloud) -> int:
        begun.set()
        arrived.wait(10)
        return number_of(cloud)

    outcomes = list(stream(frames(), slow))
    assert [(o.result, o.dropped) for o in outcomes] == [(0, 0), (10, 9)]
    counter = Counter()
    for outcome in outcomes:
        counter.add(outcome)
    summary = counter.summary()
    assert (summary.answered, summary.dropped, summary.failed) == (2, 9, 0)
    assert summary.latency_median_s <= summary.latency_99_s
    assert "9 dropped for newer ones, 0 bad" in str(summary)


def test_dropped_frames_are_not_decoded() -> None:
    decoded: list[int] = []
    ready = threading.Event()

    def loading(i: int) -> StreamFrame[PointCloud]:
        def load() -> PointCloud:
            ready.wait(10)
            decoded.append(i)
            return PointCloud(np.full((40, 3), i, dtype=float))

        return StreamFrame(str(i), 0.0, load)

    def frames() -> Iterator[StreamFrame[PointCloud]]:
        for i in range(50):
            yield loading(i)
        ready.set()

    outcomes = list(stream(frames(), number_of))
    assert [o.result for o in outcomes] == decoded
    assert decoded[-1] == 49
    assert len(decoded) + sum(o.dropped for o in outcomes) == 50
    assert len(decoded) <= 2


def test_a_bad_frame_is_reported_and_passed_over() -> None:
    def load() -> PointCloud:
        raise ValueError("the file\nis damaged")

    frames = [frame(0), StreamFrame("bad", 0.1, load), frame(2)]
    outcomes = list(stream(frames, number_of, every_frame=True))
    assert [(o.name, o.result, o.error) for o in outcomes] == [
        ("0", 0, ""),
        ("bad", None, "the file is damaged"),
        ("2", 2, ""),
    ]
    counter = Counter()
    counter.add(outcomes[1])
    assert "0 frames answered" in str(counter.summary()) and "1 bad" in str(counter.summary())


@pytest.mark.parametrize(
    "problem, sentence",
    [
        (ValueError("all points coincide"), "all points coincide"),
        (OSError(), "OSError"),
        (IndexError("list index\nout of range"), "bad cannot be answered (IndexError: list index out of range)"),
        (EOFError(), "bad cannot be answered (EOFError): record or write it again"),
        (MemoryError("Unable to allocate 8 EiB"), "bad cannot be answered (MemoryError: Unable to allocate 8 EiB)"),
    ],
)
def test_whatever_a_frame_raises_is_its_own_error(problem: Exception, sentence: str) -> None:
    def load() -> PointCloud:
        raise problem

    frames = [StreamFrame("bad", 0.0, load), frame(1)]
    bad, good = stream(frames, number_of, every_frame=True)
    assert bad.result is None and bad.error.startswith(sentence) and good.result == 1


def test_a_librarys_own_error_names_the_frame() -> None:
    bad, lost = stream(
        [
            StreamFrame("bad.json", 0.0, lambda: json.loads("{")),
            StreamFrame("lost", 0.0, lambda: Path("no/such.ply").read_bytes()),
        ],
        bool,
        every_frame=True,
    )
    assert bad.error.startswith("bad.json cannot be answered (JSONDecodeError: Expecting property name")
    assert bad.error.endswith("): record or write it again")
    assert lost.error == "no/such.ply: no such file or directory: correct that and try again"


def test_the_memory_of_a_summary_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.reconstruction.stream.RECENT", 3)
    counter = Counter()
    for latency_s in (100.0, 1.0, 2.0, 3.0):
        counter.add(Outcome("", 0.0, 0, "", latency_s, 0.0, 0))
    assert len(counter.latencies) == 3
    assert counter.summary().answered == 4 and counter.summary().latency_median_s == 2.0


def test_a_broken_sequence_is_raised_after_its_frames() -> None:
    def frames() -> Iterator[StreamFrame[PointCloud]]:
        yield frame(0)
        raise OSError("the recording is cut off")

    found = []
    with pytest.raises(OSError, match="cut off"):
        for outcome in stream(frames(), number_of, every_frame=True):
            found.append(outcome.result)
    assert found == [0]


def test_frames_keep_their_recorded_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a time that passes by waiting alone."""
    now = [100.0]
    waiting = SimpleNamespace(perf_counter=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr(stream_module, "time", waiting)
    frames = (frame(i, 7.0 + 0.1 * i) for i in range(4))
    outcomes = list(stream(frames, number_of, recorded_pace=True, every_frame=True))
    assert now == pytest.approx([100.3]) and [outcome.result for outcome in outcomes] == [0, 1, 2, 3]


def test_leaving_early_ends_a_thread_for_which_nothing_comes() -> None:
    asked = threading.Semaphore(0)

    def quiet() -> Iterator[StreamFrame[PointCloud] | None]:
        yield frame(0)
        while True:
            asked.acquire(timeout=10)
            yield None

    outcomes = stream(quiet(), number_of)
    assert next(outcomes).result == 0
    outcomes.close()  # type: ignore[attr-defined]
    asked.release(2)
    for thread in threading.enumerate():
        if thread.name == "frames":
            thread.join(5)
            assert not thread.is_alive()


def test_leaving_early_ends_the_reading_thread() -> None:
    def endless() -> Iterator[StreamFrame[PointCloud]]:
        i = 0
        while True:
            yield frame(i)
            i += 1

    for every_frame in (True, False):
        outcomes = stream(endless(), number_of, every_frame=every_frame)
        next(outcomes)
        outcomes.close()  # type: ignore[attr-defined]
    deadline = time.monotonic() + 5
    while any(thread.name == "frames" for thread in threading.enumerate()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not any(thread.name == "frames" for thread in threading.enumerate())
