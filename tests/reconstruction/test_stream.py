"""Streams: the latest frame wins, one bad frame stops nothing, and half-written files are waited for."""

import io
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from folder_contents import run_mereo
from numpy.random import default_rng
from written_results import segments

from mereo.cli import stream as stream_module
from mereo.cli.answers import StreamCommand
from mereo.cli.stream import (
    PATIENCE_S,
    Answering,
    FrameAnswer,
    Outcome,
    StreamFrame,
    Summary,
    WatchedFolder,
    frames_of,
    stream,
    stream_reconstructions,
    watched_frames,
)
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Names
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.scenes.registry import load_scene
from mereo.synthesis.config import SENSORS, SequenceConfig
from mereo.synthesis.recording import CAMERA, FRAMES, write_recording


def frame(number: int, time_s: float = 0.0) -> StreamFrame:
    return StreamFrame(str(number), time_s, lambda: number)


def content(frame: StreamFrame) -> int:
    return frame.load()


def test_every_frame_is_answered_in_order_when_asked_at_the_recorded_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    waiting = SimpleNamespace(perf_counter=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr(stream_module, "time", waiting)
    outcomes = list(stream((frame(i, 7.0 + 0.1 * i) for i in range(4)), content, recorded_pace=True, every_frame=True))
    assert now == pytest.approx([100.3]) and [outcome.result for outcome in outcomes] == [0, 1, 2, 3]
    assert all(o.dropped == 0 and o.error == "" and 0 <= o.work_s <= o.latency_s for o in outcomes)


def test_a_slow_answer_gets_the_latest_frame_and_dropped_ones_are_not_decoded() -> None:
    arrived, begun = ([threading.Event(), threading.Event()] for _ in range(2))
    decoded = []

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


def damaged() -> None:
    raise ValueError("the file\nis damaged")


@pytest.mark.parametrize(
    "load, sentence",
    [
        (damaged, "the file is damaged"),
        (Mock(side_effect=OSError()), "OSError"),
        (lambda: [][1], "bad cannot be answered (IndexError: list index out of range)"),
        (Mock(side_effect=EOFError()), "bad cannot be answered (EOFError): record or write it again"),
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

    outcomes = stream(frames(), content, every_frame=every_frame)
    assert next(outcomes).result == 0
    with pytest.raises(OSError, match="cut off"):
        next(outcomes)


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
    for thread in [thread for thread in threading.enumerate() if thread.name == "frames"]:
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
    assert [watched.look(time_s) for time_s in (0.1, 0.2, 0.3)] == [[], [file], []]
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    np.save(tmp_path / "a.npy", default_rng(0).uniform(1, 2, (500, 3)))
    monkeypatch.setattr("mereo.cli.stream.answer_frame", Mock(side_effect=KeyboardInterrupt))
    command = StreamCommand(str(tmp_path), weights="rope", watch=True, method="network")
    assert stream_reconstructions(command).answered == 0
    assert capsys.readouterr().err.startswith("stopped\n0 frames answered")


@pytest.mark.parametrize("given, taken", [(None, "4"), ("1024", "1024")])
def test_the_cache_of_products_is_small_before_torch_is_loaded(given: str | None, taken: str) -> None:
    code = (
        "import os, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': sys.exit(os.environ.get('ONEDNN_PRIMITIVE_CACHE_CAPACITY'))\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from mereo.__main__ import main\n"
        "main(['stream', '-', '--weights', 'rope'])"
    )
    variables = {name: value for name, value in os.environ.items() if not name.startswith("ONEDNN")}
    variables |= {} if given is None else {"ONEDNN_PRIMITIVE_CACHE_CAPACITY": given}
    result = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=False)
    assert result.stderr.strip() == taken


COUNT, BAD, RATE_HZ = 6, 3, 30.0


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, InputConfig]:
    """Depth images of a rope that moves, one of them damaged, and how they are read."""
    folder = tmp_path_factory.mktemp("sequence")
    settings = SequenceConfig(seconds=COUNT / RATE_HZ, image_size=96, occluder="none")
    write_recording(folder, load_scene("rope"), settings, ("paper", SENSORS["paper"]), 740_000)
    (folder / FRAMES / f"{BAD:04}.png").write_bytes(b"\x89PNG cut off")
    return folder / FRAMES, InputConfig(intrinsics=folder / CAMERA)


def streamed(capsys: pytest.CaptureFixture, folder: Path, **options: Any) -> tuple[Summary, list[dict], str]:
    """Summary of a stream of the rope's network, the lines that it prints, and what it says beside them."""
    summary = stream_reconstructions(
        StreamCommand(str(folder), weights="rope", resolution=24, method="network", **options)
    )
    out, err = capsys.readouterr()
    return summary, [json.loads(text) for text in out.splitlines()], err


def test_every_frame_is_answered_but_the_bad_one(
    sequence: tuple[Path, InputConfig], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder, reading = sequence
    summary, lines, err = streamed(capsys, folder, every_frame=True, reading=reading, surfaces=tmp_path / "glb")
    assert (summary.answered, summary.failed, summary.dropped) == (COUNT - 1, 1, 0)
    assert [row["frame"] for row in lines] == [f"{number:04}.png" for number in range(COUNT)]
    assert "error" in lines[BAD] and f"{BAD:04}.png" in lines[BAD]["error"]
    assert len(list((tmp_path / "glb").iterdir())) == COUNT - 1
    assert f"{COUNT - 1} frames answered at" in err and "1 bad" in err


def test_an_image_of_another_size_is_not_read_by_the_first_ones_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_module, "at_point", Mock(side_effect=StopIteration))
    answering = Answering(None, None, 24)
    for width, error in ((96, StopIteration), (90, ValueError), (96, StopIteration)):
        camera = SimpleNamespace(width=width, height=72)
        seen = Mock(point=None, **{"frame.whole.camera": camera})
        with pytest.raises(error) as raised:
            answering(StreamFrame("a.png", 0.0, lambda seen=seen: seen))  # type: ignore[misc]
        assert (error is ValueError) == ("a.png has 90 x 72 pixels, and the frames before it" in str(raised.value))


def test_names_on_standard_input_are_frames(
    sequence: tuple[Path, InputConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, reading = sequence
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{folder / '0000.png'}\n\n{folder / '0001.png'}\n"))
    frames = list(frames_of("-", reading, IsolationConfig()))
    assert [Path(frame.name).name for frame in frames] == ["0000.png", "0001.png"]
    assert len(frames[1].load().cloud) > 32


def test_sources_that_are_none_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reading = InputConfig()
    isolation = IsolationConfig()
    with pytest.raises(FileNotFoundError, match="does not exist; a folder that can be watched is needed: make it"):
        watched_frames(str(tmp_path / "nowhere"), reading, isolation)
    with pytest.raises(FileNotFoundError, match="does not exist; a folder of frames"):
        frames_of(str(tmp_path / "nowhere"), reading, isolation)
    with pytest.raises(ValueError, match="has no depth images or point clouds"):
        frames_of(str(tmp_path), reading, isolation)
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(ValueError, match="is a single file"):
        frames_of(str(tmp_path / "a.ply"), reading, isolation)
    for source in ("-", str(tmp_path / "a.ply")):
        with pytest.raises(ValueError, match=f"{source} is no folder of frames; only such a folder can be watched"):
            watched_frames(source, reading, isolation)
    with pytest.raises(ValueError, match="none of the 1 frames could be answered"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="rope"))
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    with pytest.raises(ValueError, match="^no frame came from -; a stream needs one: check that anything writes it$"):
        stream_reconstructions(StreamCommand("-", weights="rope"))
    # before the weights are loaded and any frame is answered
    with pytest.raises(FileExistsError, match="ply is a file; surfaces are written into a folder: choose another"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="none", surfaces=tmp_path / "a.ply"))


def run(monkeypatch: pytest.MonkeyPatch, surfaces: Path, frames: Names, *more: str) -> int:
    """Exit code of a stream in which every frame is answered with the same surfaces."""
    answered = FrameAnswer(segments(), {})
    outcomes = [Outcome(name, 0.0, answered, "", 0.1, 0.1, 0) for name in frames]
    nothing = SimpleNamespace(network=None, registrar=lambda *_: None)
    monkeypatch.setattr("mereo.cli.stream.loaded_object", lambda *_: nothing)
    monkeypatch.setattr("mereo.cli.stream.Answering", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr("mereo.cli.stream.stream", lambda *_, **__: iter(outcomes))
    return run_mereo("stream", "-", "--weights", "rope", "--surfaces", surfaces, *more)


def test_a_stream_replaces_no_surfaces_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("a.npy.glb", "thesis.tex"):
        (out / name).write_text("precious")
    assert run(monkeypatch, out, ("a.npy", "b.npy")) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"mereo: error: {out} exists and is not empty; nothing in it is overwritten")
    assert not said.out and {path.name for path in out.iterdir()} == {"a.npy.glb", "thesis.tex"}
    assert run(monkeypatch, out, ("a.npy", "b.npy"), "--force") == 0
    assert {path.name for path in out.iterdir()} == {"a.npy.glb", "b.npy.glb", "thesis.tex"}
    assert (out / "a.npy.glb").read_bytes()[:4] == b"glTF" and (out / "thesis.tex").read_text() == "precious"


def test_a_frame_replaces_its_own_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert run(monkeypatch, tmp_path / "out", ("c d.npy", "c d.npy", "c_d.npy")) == 0
    first, again, other = (json.loads(line).get("error", "") for line in capsys.readouterr().out.splitlines())
    assert (first, again) == ("", "") and other.endswith("c_d.npy.glb holds the surfaces of c d.npy: rename c_d.npy")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["c_d.npy.glb"]


def test_a_sequence_that_breaks_off_is_told_after_its_frames_and_their_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def frames(*_: object) -> Iterator[StreamFrame]:
        yield StreamFrame("first", 0.0, lambda: PointCloud(np.ones((40, 3))))
        raise ValueError("it is cut off")

    monkeypatch.setattr("mereo.cli.stream.frames_of", frames)
    with pytest.raises(ValueError, match="^it is cut off$"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="rope"))
    out, err = capsys.readouterr()
    assert json.loads(out)["frame"] == "first" and "1 bad" in err
