"""Several frames in one command: one model, a folder for each frame, and a bad one stops no other."""

from pathlib import Path

import pytest
from many_frames import content, frames, loads, run

from mereo.cli import reconstruct as many
from mereo.io.atomic_files import MARKER
from mereo.io.config import InputConfig

__all__ = ["loads"]  # a fixture

pytestmark = pytest.mark.usefixtures("small_previews")


def test_each_frame_of_a_folder_gets_what_it_gets_alone(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    (folder / "notes.md").write_text("no frame")
    (folder / ".hidden.npy").touch()
    assert run(folder, "--output", tmp_path / "all") == 0
    assert loads == ["any"]
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == ["a", "b"]
    said = capsys.readouterr().out
    assert f"[1/2] {folder / 'a.npy'}\n" in said and f"[2/2] {folder / 'b.npy'}, " in said and "2 frames" in said
    assert run(folder / "b.npy", "--output", tmp_path / "one") == 0
    assert content(tmp_path / "one") == content(tmp_path / "all/b")


def test_a_bad_frame_is_its_own(tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    folder = frames(tmp_path / "frames", "good.npy")
    (folder / "bad.ply").write_text("nonsense")
    assert run(folder, tmp_path / "missing.npy", "--output", tmp_path / "out") == 2
    printed = capsys.readouterr()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good"]
    first, second, last = (line for line in printed.err.splitlines() if line.startswith("mereo: error: "))
    assert "bad.ply cannot be read as a point cloud" in first and "missing.npy" in second
    assert "2 of 3 frames could not be reconstructed" in last
    rows = [line for line in printed.out.splitlines() if "bad.ply" in line or "missing.npy" in line]
    assert all("none" in row for row in rows[2:]) and len(rows) == 4, "a heading and a row of the table each"


def test_results_that_are_there_are_kept_without_force(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = frames(tmp_path / "frames", "a.npy"), tmp_path / "out"
    (out / "a").mkdir(parents=True)
    (out / "a/mine.txt").write_text("keep")
    assert run(folder, "--output", out) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    assert run(folder, "--output", out, "--force") == 2
    assert "not written by this version of mereo" in capsys.readouterr().err
    assert [path.name for path in (out / "a").iterdir()] == ["mine.txt"]


def test_what_is_no_frames_fault_stops_before_the_work(
    tmp_path: Path, loads: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    out = tmp_path / "out"
    for options, sentence in (
        (("--carry-frame", "scene"), "nothing is carried"),
        (("--carry", tmp_path / "no.stl"), "no.stl"),
        (("--scene", tmp_path / "no.yaml", "--method", "modes"), "no.yaml"),
    ):
        assert run(folder, "--output", out, *options) == 2
        printed = capsys.readouterr()
        assert sentence in printed.err and printed.err.count("\n") == 1 and not out.exists(), printed.err
    out.mkdir()
    (out / MARKER).write_text("{}")
    assert run(folder, "--output", out) == 2
    assert "is a folder of results; each frame gets a folder of its own" in capsys.readouterr().err
    assert run("--output", tmp_path / "out") == 2
    assert "no input is given; name a frame" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert run(tmp_path / "empty", "--output", tmp_path / "out") == 2
    assert "has no depth images or point clouds" in capsys.readouterr().err


def test_folders_are_called_by_as_much_of_the_name_as_tells_frames_apart(tmp_path: Path) -> None:
    names = lambda *files: many.folder_names([tmp_path / file for file in files])  # noqa: E731
    assert names("one/a.ply", "one/b.ply") == ["a", "b"]
    assert names("one/a.ply", "one/a.npy") == ["a.ply", "a.npy"]
    assert names("one/a.ply", "two/a.ply") == ["one-a.ply", "two-a.ply"]
    with pytest.raises(ValueError, match=r"would both be written to 'one-a.ply': reconstruct them one at a time"):
        names("x/one/a.ply", "y/one/a.ply")
    with pytest.raises(ValueError, match="would both"):
        names("one/a.ply", "one/A.ply")
    folder = frames(tmp_path / "frames", "a.npy", "b.npy")
    assert many.list_frames([folder / "b.npy", folder], InputConfig()) == [folder / "b.npy", folder / "a.npy"]
