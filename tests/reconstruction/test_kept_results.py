"""What is there stays: surfaces of a stream and outputs of the examples, as the results of other commands."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from written_results import segments

from mereo import __main__ as command_line
from mereo.cli.stream import SurfaceFolder
from mereo.io.atomic_files import new_directory
from mereo.io.writers.glb import write_segments_glb
from mereo.reconstruction.stream import Outcome

FRAMES = ("a.npy", "b.npy")
EXAMPLES = Path(__file__).parents[2] / "examples"
OUTPUTS = {
    "isolate_object.py": ("--output", "out/kept.png"),
    "loop.py": ("--output", "out/kept.webp"),
    "reconstruct_cloud.py": ("cloud.npy", "out"),
    "sensors.py": ("--output", "out/kept.png"),
    "shipped_weights.py": ("--output", "out/kept.png"),
    "simulate_liver.py": ("--output", "out/kept.npz"),
}


def stream(monkeypatch: pytest.MonkeyPatch, surfaces: Path, frames: tuple[str, ...], *more: str) -> int:
    """Exit code of a stream in which every frame is answered with the same surfaces."""
    answered = SimpleNamespace(surfaces=segments())
    outcomes = [Outcome(name, 0.0, answered, "", 0.1, 0.1, 0) for name in frames]
    nothing = SimpleNamespace(network=None, registrar=lambda _: None)
    monkeypatch.setattr("mereo.cli.stream.loaded_object", lambda *_: nothing)
    monkeypatch.setattr("mereo.cli.stream.Answering", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr("mereo.cli.stream.stream", lambda *_, **__: iter(outcomes))
    monkeypatch.setattr("mereo.cli.stream.line", lambda outcome: {"error": outcome.error})
    return command_line.main(["stream", "-", "--weights", "rope", "--surfaces", str(surfaces), *more])


def test_a_stream_replaces_no_surfaces_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.npy.glb").write_text("precious")
    (out / "thesis.tex").write_text("precious")
    assert stream(monkeypatch, out, FRAMES) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"mereo: error: {out} exists and is not empty; nothing in it is overwritten")
    assert not said.out and {path.name for path in out.iterdir()} == {"a.npy.glb", "thesis.tex"}
    assert stream(monkeypatch, out, FRAMES, "--force") == 0
    assert {path.name for path in out.iterdir()} == {"a.npy.glb", "b.npy.glb", "thesis.tex"}
    assert (out / "a.npy.glb").read_bytes()[:4] == b"glTF" and (out / "thesis.tex").read_text() == "precious"


def test_a_frame_replaces_its_own_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert stream(monkeypatch, tmp_path / "out", ("c d.npy", "c d.npy", "c_d.npy")) == 0
    first, again, other = (json.loads(line)["error"] for line in capsys.readouterr().out.splitlines())
    assert (first, again) == ("", "") and other.endswith("c_d.npy.glb holds the surfaces of c d.npy: rename c_d.npy")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["c_d.npy.glb"]


def test_what_came_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = SurfaceFolder(tmp_path, force=False)
    (tmp_path / "a.npy.glb").write_text("precious")
    outcome = Outcome("a.npy", 0.0, SimpleNamespace(surfaces=segments()), "", 0.1, 0.1, 0)
    assert "exists; it is not overwritten" in folder.written(outcome, "camera").error  # type: ignore[arg-type]
    assert (tmp_path / "a.npy.glb").read_text() == "precious"


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTPUTS)
def test_an_example_replaces_no_file(name: str, tmp_path: Path) -> None:
    place = tmp_path / OUTPUTS[name][1]
    place = place / "thesis.tex" if not place.suffix else place
    place.parent.mkdir(parents=True)
    place.write_text("precious")
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *OUTPUTS[name]],
        cwd=tmp_path,
        env={**os.environ, "JAXTYPING_DISABLE": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode != 0 and "it is not overwritten" in done.stderr and "Traceback" not in done.stderr
    assert place.read_text() == "precious" and len(list(place.parent.iterdir())) == 1


@pytest.mark.parametrize("command", ["reconstruct", "align"])
def test_the_meshes_of_a_scene_are_not_replaced(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even where mereo wrote them: a result that a scene file names as its mesh."""
    with new_directory(tmp_path / "out") as folder:
        write_segments_glb(folder / "segments.glb", segments(), np.eye(3))
    (tmp_path / "s.yaml").write_text("name: s\nunits: m\nmodel: out/segments.glb\n")
    np.save(tmp_path / "cloud.npy", np.ones((300, 3)))
    before = (tmp_path / "out" / "segments.glb").read_bytes()
    more = ["--weights", "rope"]
    arguments = [command, tmp_path / "cloud.npy", "--scene", tmp_path / "s.yaml", "--output", tmp_path / "out"]
    assert command_line.main([*map(str, arguments), *more, "--force"]) == 2
    said = capsys.readouterr().err
    assert "segments.glb, which is read; it is not replaced: choose another --output" in said, said
    assert (tmp_path / "out" / "segments.glb").read_bytes() == before


def test_an_experiment_says_what_to_do_with_older_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Results that a version without lists of files has left; the folder of all the work is not the one to change."""
    older = tmp_path / "results" / "noise-smoke"
    older.mkdir(parents=True)
    (older / "table.md").write_text("precious")
    assert command_line.main(["experiment", "noise", "--output", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"mereo: error: {older} holds table.md, not written by this version of mereo or changed since; it is not "
        "replaced: move it away or delete it, and run the same command again, which keeps the datasets, runs and "
        "scores and writes these results anew\n"
    )
    assert (older / "table.md").read_text() == "precious" and not (tmp_path / "datasets").exists()
