"""A folder that a camera fills: what arrives is answered when it is complete, half-written files are waited for."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mereo.cli.answers import StreamCommand
from mereo.cli.stream import stream_reconstructions
from mereo.io.config import InputConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.stream import PATIENCE_S, WatchedFolder, stream, watched_frames


def points_of(seen: Observation) -> int:
    return len(seen.cloud)


def write(path: Path, content: bytes, changed_s: int) -> Path:
    path.write_bytes(content)
    os.utime(path, (changed_s, changed_s))
    return path


@pytest.fixture
def watched(tmp_path: Path) -> WatchedFolder:
    return WatchedFolder(tmp_path, lambda file: file.suffix == ".ply")


def test_a_file_is_taken_once_when_it_has_come_to_rest(watched: WatchedFolder) -> None:
    file = write(watched.folder / "a.ply", b"ply", 1)
    write(watched.folder / "notes.doc", b"not wanted", 1)
    assert watched.look(0.0) == []
    write(file, b"ply, longer", 1)
    assert watched.look(0.1) == []
    assert watched.look(0.2) == [file]
    assert watched.look(0.3) == []


def test_files_come_in_the_order_in_which_they_were_written(watched: WatchedFolder) -> None:
    late, early = write(watched.folder / "a.ply", b"1", 9), write(watched.folder / "b.ply", b"2", 3)
    assert watched.look(0.0) == [] and watched.look(0.1) == [early, late]


def test_a_file_that_is_written_again_is_taken_again(watched: WatchedFolder) -> None:
    file = write(watched.folder / "latest.ply", b"1", 1)
    assert watched.look(0.0) == [] and watched.look(0.1) == [file]
    write(file, b"2", 2)
    assert watched.look(0.2) == [] and watched.look(0.3) == [file]


def test_an_empty_or_restless_file_is_waited_for_within_bounds(watched: WatchedFolder) -> None:
    empty, restless = write(watched.folder / "a.ply", b"", 1), write(watched.folder / "b.ply", b"1", 1)
    for second in range(int(PATIENCE_S)):
        write(restless, b"1" * second, second)
        assert watched.look(float(second)) == []
    write(restless, b"the end?", 99)
    assert watched.look(PATIENCE_S) == [empty, restless]


def test_a_file_that_goes_is_forgotten(watched: WatchedFolder) -> None:
    file = write(watched.folder / "a.ply", b"1", 1)
    assert watched.look(0.0) == [] and watched.look(0.1) == [file]
    file.unlink()
    assert watched.look(0.2) == []
    write(file, b"1", 1)
    assert watched.look(0.3) == [] and watched.look(0.4) == [file]


def test_frames_are_answered_as_their_files_arrive(tmp_path: Path) -> None:
    np.save(tmp_path / "first.npy", np.ones((40, 3)))
    (tmp_path / "second.npy").touch()
    (tmp_path / ".third.partial.npy").write_bytes(b"a writer renames it when it is whole")
    isolation = IsolationConfig(box=(-9, -9, 0, 9, 9, 9))
    outcomes = stream(watched_frames(str(tmp_path), InputConfig(), isolation), points_of, every_frame=True)
    assert (found := next(outcomes)).name == "first.npy" and found.result == 40
    np.save(tmp_path / "second.npy", np.ones((50, 3)))
    assert (found := next(outcomes)).name == "second.npy" and found.result == 50
    np.save(tmp_path / "first.npy", np.ones((60, 3)))
    assert (found := next(outcomes)).name == "first.npy" and found.result == 60
    outcomes.close()  # type: ignore[attr-defined]


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
