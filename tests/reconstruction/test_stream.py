"""Streams: the latest frame wins, one bad frame stops nothing, and half-written files are waited for."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mereo.cli import stream as stream_module
from mereo.cli.answers import StreamCommand
from mereo.cli.stream import (
    PATIENCE_S,
    StreamFrame,
    Summary,
    WatchedFolder,
    stream,
    stream_reconstructions,
    watched_frames,
)
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig


def frame(number: int, time_s: float = 0.0) -> StreamFrame:
    return StreamFrame(str(number), time_s, lambda: number)


def content(frame: StreamFrame) -> int:
    return frame.load()


def raise_(problem: Exception) -> None:
    raise problem


def test_every_frame_is_answered_in_order_when_asked_at_the_recorded_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    waiting = SimpleNamespace(perf_counter=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr(stream_module, "time", waiting)
    outcomes = list(stream((frame(i, 7.0 + 0.1 * i) for i in range(4)), content, recorded_pace=True, every_frame=True))
    assert now == pytest.approx([100.3]) and [outcome.result for outcome in outcomes] == [0, 1, 2, 3]
    assert all(o.dropped == 0 and o.error == "" and 0 <= o.work_s <= o.latency_s for o in outcomes)


def test_a_slow_answer_gets_the_latest_frame_and_dropped_ones_are_not_decoded() -> None:
    arrived, begun = ([threading.Event(), threading.Event()] for _ in range(2))
    decoded: list[str] = []

    def frames() -> Iterator[StreamFrame]:
        yield frame(0)
        for number, last in enumerate((11, 13)):
            begun[number].wait(10)
            for i in range(last - (10, 2)[number], last):
                yield frame(i)
            arrived[number].set()

    def slow(frame: StreamFrame) -> int:
        if len(decoded) < 2:
            begun[len(decoded)].set()
            arrived[len(decoded)].wait(10)
        decoded.append(frame.name)
        return frame.load()

    outcomes = list(stream(frames(), slow))
    assert [(o.result, o.dropped) for o in outcomes] == [(0, 0), (10, 9), (12, 1)] and decoded == ["0", "10", "12"]
    assert outcomes[0].latency_s >= outcomes[0].work_s > 0
    summary = Summary()
    for outcome in outcomes:
        summary.add(outcome)
    assert (summary.answered, summary.dropped, summary.failed) == (3, 10, 0)
    assert "10 dropped for newer ones, 0 bad" in str(summary)


@pytest.mark.parametrize(
    "load, sentence",
    [
        (lambda: raise_(ValueError("the file\nis damaged")), "the file is damaged"),
        (lambda: raise_(OSError()), "OSError"),
        (lambda: [][1], "bad cannot be answered (IndexError: list index out of range)"),
        (lambda: raise_(EOFError()), "bad cannot be answered (EOFError): record or write it again"),
        (lambda: json.loads("{"), "bad cannot be answered (JSONDecodeError: Expecting property name"),
        (lambda: Path("no/such.ply").read_bytes(), "no/such.ply: no such file or directory: correct that and try"),
    ],
)
def test_whatever_a_frame_raises_is_its_own_error(load: Callable[[], object], sentence: str) -> None:
    bad, good = stream([StreamFrame("bad", 0.1, load), frame(1)], content, every_frame=True)
    assert bad.name == "bad" and bad.result is None and bad.error.startswith(sentence) and good.result == 1
    summary = Summary()
    summary.add(bad)
    assert "0 frames answered" in str(summary) and "1 bad" in str(summary)


@pytest.mark.parametrize("every_frame", [True, False])
def test_a_broken_sequence_is_raised_after_its_frames(every_frame: bool) -> None:
    def frames() -> Iterator[StreamFrame]:
        yield frame(0)
        raise OSError("the recording is cut off")

    found = []
    with pytest.raises(OSError, match="cut off"):
        for outcome in stream(frames(), content, every_frame=every_frame):
            found.append(outcome.result)
    assert found == [0]


@pytest.mark.parametrize("comes", [True, False])
def test_leaving_early_ends_the_reading_thread(comes: bool) -> None:
    asked = threading.Semaphore(0)

    def endless() -> Iterator[StreamFrame | None]:
        yield frame(0)
        while True:
            asked.acquire(timeout=10)
            yield frame(1) if comes else None

    outcomes = stream(endless(), content)
    assert next(outcomes).result == 0
    outcomes.close()  # type: ignore[attr-defined]
    asked.release(3)
    for thread in threading.enumerate():
        if thread.name == "frames":
            thread.join(5)
            assert not thread.is_alive()


def write(path: Path, content: bytes, changed_s: int) -> Path:
    path.write_bytes(content)
    os.utime(path, (changed_s, changed_s))
    return path


@pytest.fixture
def watched(tmp_path: Path) -> WatchedFolder:
    return WatchedFolder(tmp_path, lambda file: file.suffix == ".ply")


def test_a_file_is_taken_once_when_it_has_come_to_rest_and_forgotten_when_it_goes(watched: WatchedFolder) -> None:
    file = write(watched.folder / "a.ply", b"ply", 1)
    write(watched.folder / "notes.doc", b"not wanted", 1)
    assert watched.look(0.0) == []
    write(file, b"ply, longer", 1)
    assert watched.look(0.1) == []
    assert watched.look(0.2) == [file]
    assert watched.look(0.3) == []
    file.unlink()
    assert watched.look(0.4) == []
    write(file, b"ply, longer", 1)
    assert watched.look(0.5) == [] and watched.look(0.6) == [file]


def test_files_come_in_the_order_in_which_they_were_written_and_again_when_they_change(watched: WatchedFolder) -> None:
    late, early = write(watched.folder / "a.ply", b"1", 9), write(watched.folder / "b.ply", b"2", 3)
    assert watched.look(0.0) == [] and watched.look(0.1) == [early, late]
    write(late, b"2", 10)
    assert watched.look(0.2) == [] and watched.look(0.3) == [late]


def test_an_empty_or_restless_file_is_waited_for_within_bounds(watched: WatchedFolder) -> None:
    empty, restless = write(watched.folder / "a.ply", b"", 1), write(watched.folder / "b.ply", b"1", 1)
    for second in range(int(PATIENCE_S)):
        write(restless, b"1" * second, second)
        assert watched.look(float(second)) == []
    write(restless, b"the end?", 99)
    assert watched.look(PATIENCE_S) == [empty, restless]


def test_watching_ends_with_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(1, 2, (500, 3)))
    monkeypatch.setattr("mereo.cli.stream.answer_frame", interrupted)
    command = StreamCommand(str(tmp_path), weights="rope", watch=True, method="network")
    assert stream_reconstructions(command).answered == 0
    assert capsys.readouterr().err.startswith("stopped\n0 frames answered")


def test_what_cannot_be_watched_is_refused(tmp_path: Path) -> None:
    reading, isolation = InputConfig(), IsolationConfig()
    with pytest.raises(FileNotFoundError, match="does not exist; a folder that can be watched is needed: make it"):
        watched_frames(str(tmp_path / "nowhere"), reading, isolation)
    (tmp_path / "a.ply").touch()
    for source in ("-", str(tmp_path / "a.ply")):
        with pytest.raises(ValueError, match=f"{source} is no folder of frames; only such a folder can be watched"):
            watched_frames(source, reading, isolation)


@pytest.mark.parametrize("given, taken", [(None, "4"), ("1024", "1024")])
def test_the_cache_of_products_is_small_before_torch_is_loaded(given: str | None, taken: str) -> None:
    code = (
        "import os, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': sys.exit(os.environ.get('ONEDNN_PRIMITIVE_CACHE_CAPACITY'))\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from mereo.__main__ import main\n"
        "main(['stream', 'folder', '--weights', 'rope'])"
    )
    variables = {name: value for name, value in os.environ.items() if not name.startswith("ONEDNN")}
    variables |= {} if given is None else {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": given}
    result = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=False)
    assert result.stderr.strip() == taken
