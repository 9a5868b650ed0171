"""`mereo stream` on a recorded sequence of a deforming object, thirty frames a second."""

import io
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from written_results import segments

from mereo import __main__ as command_line
from mereo.cli.answers import StreamCommand
from mereo.cli.stream import (
    FrameAnswer,
    Outcome,
    Summary,
    frames_of,
    stream_reconstructions,
)
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.scenes.registry import load_scene
from mereo.synthesis.config import SENSORS, SequenceConfig
from mereo.synthesis.recording import CAMERA, FRAMES, write_recording

COUNT, BAD, RATE_HZ = 6, 3, 30.0


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, InputConfig]:
    """Depth images of a rope that moves, one of them damaged, and how they are read."""
    folder = tmp_path_factory.mktemp("sequence")
    settings = SequenceConfig(seconds=COUNT / RATE_HZ, image_size=96, occluder="none")
    write_recording(folder, load_scene("rope"), settings, ("paper", SENSORS["paper"]), 740_000)
    (folder / FRAMES / f"{BAD:04}.png").write_bytes(b"\x89PNG cut off")
    return folder / FRAMES, InputConfig(intrinsics=folder / CAMERA)


def streamed(capsys: pytest.CaptureFixture[str], folder: Path, **options: Any) -> tuple[Summary, list[dict], str]:
    """Summary of a stream of the rope's network, the lines that it prints, and what it says beside them."""
    summary = stream_reconstructions(
        StreamCommand(str(folder), weights="rope", resolution=24, method="network", **options)
    )
    out, err = capsys.readouterr()
    return summary, [json.loads(text) for text in out.splitlines()], err


def test_every_frame_is_answered_but_the_bad_one(
    sequence: tuple[Path, InputConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, reading = sequence
    summary, lines, err = streamed(capsys, folder, every_frame=True, reading=reading, surfaces=tmp_path / "glb")
    assert (summary.answered, summary.failed, summary.dropped) == (COUNT - 1, 1, 0)
    assert [row["frame"] for row in lines] == [f"{number:04}.png" for number in range(COUNT)]
    assert "error" in lines[BAD] and f"{BAD:04}.png" in lines[BAD]["error"]
    assert len(list((tmp_path / "glb").iterdir())) == COUNT - 1
    assert f"{COUNT - 1} frames answered at" in err and "1 bad" in err


def test_names_on_standard_input_are_frames(
    sequence: tuple[Path, InputConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, reading = sequence
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{folder / '0000.png'}\n\n{folder / '0001.png'}\n"))
    frames = list(frames_of("-", reading, IsolationConfig()))
    assert [Path(frame.name).name for frame in frames] == ["0000.png", "0001.png"]
    assert len(frames[1].load().cloud) > 32


def test_sources_that_are_none_are_refused(tmp_path: Path) -> None:
    reading, isolation = InputConfig(), IsolationConfig()
    with pytest.raises(FileNotFoundError, match="does not exist; a folder of frames"):
        frames_of(str(tmp_path / "nowhere"), reading, isolation)
    with pytest.raises(ValueError, match="has no depth images or point clouds"):
        frames_of(str(tmp_path), reading, isolation)
    (tmp_path / "a.ply").write_text("ply")
    with pytest.raises(ValueError, match="is a single file"):
        frames_of(str(tmp_path / "a.ply"), reading, isolation)
    with pytest.raises(ValueError, match="none of the 1 frames could be answered"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="rope"))
    # before the weights are loaded and any frame is answered
    with pytest.raises(FileExistsError, match="ply is a file; surfaces are written into a folder: choose another"):
        stream_reconstructions(StreamCommand(str(tmp_path), weights="none", surfaces=tmp_path / "a.ply"))


def run(monkeypatch: pytest.MonkeyPatch, surfaces: Path, frames: tuple[str, ...], *more: str) -> int:
    """Exit code of a stream in which every frame is answered with the same surfaces."""
    answered = FrameAnswer(segments(), {})
    outcomes = [Outcome(name, 0.0, answered, "", 0.1, 0.1, 0) for name in frames]
    nothing = SimpleNamespace(network=None, registrar=lambda _: None)
    monkeypatch.setattr("mereo.cli.stream.loaded_object", lambda *_: nothing)
    monkeypatch.setattr("mereo.cli.stream.Answering", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr("mereo.cli.stream.stream", lambda *_, **__: iter(outcomes))
    return command_line.main(["stream", "-", "--weights", "rope", "--surfaces", str(surfaces), *more])


def test_a_stream_replaces_no_surfaces_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.npy.glb").write_text("precious")
    (out / "thesis.tex").write_text("precious")
    assert run(monkeypatch, out, ("a.npy", "b.npy")) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"mereo: error: {out} exists and is not empty; nothing in it is overwritten")
    assert not said.out and {path.name for path in out.iterdir()} == {"a.npy.glb", "thesis.tex"}
    assert run(monkeypatch, out, ("a.npy", "b.npy"), "--force") == 0
    assert {path.name for path in out.iterdir()} == {"a.npy.glb", "b.npy.glb", "thesis.tex"}
    assert (out / "a.npy.glb").read_bytes()[:4] == b"glTF" and (out / "thesis.tex").read_text() == "precious"


def test_a_frame_replaces_its_own_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, tmp_path / "out", ("c d.npy", "c d.npy", "c_d.npy")) == 0
    first, again, other = (json.loads(line).get("error", "") for line in capsys.readouterr().out.splitlines())
    assert (first, again) == ("", "") and other.endswith("c_d.npy.glb holds the surfaces of c d.npy: rename c_d.npy")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["c_d.npy.glb"]
