"""What is no place for an output is refused, and before any work."""

import os
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from scene_files import HEAD, write_bar, write_mesh
from shapes import box

from mereo import __main__ as command_line
from mereo.io.atomic_files import atomic_file, check_new_directory, new_directory
from mereo.io.object_storage import claim

NO_PLACES = {
    "": "the output '.' has no name of its own",
    "..": "the output '..' has no name of its own",
    "a\udcff": r"the output 'a\\udcff' has .* no UTF-8 text: choose another name",
    "a\0b": r"the output 'a\\x00b' has a zero byte",
    "link": "link is a link, which would be lost; an output is written in its own place: name that",
    "pipe/deep/out": "pipe is no folder, so out cannot be made in it: choose another --output",
    "pipe": "is a device or pipe; an output is a file or folder: choose another --output",
}


@pytest.mark.parametrize("name", NO_PLACES)
@pytest.mark.parametrize("make", [new_directory, atomic_file], ids=["folder", "file"])
def test_what_is_no_place_for_an_output_is_refused_before_the_work(
    make: Callable[..., AbstractContextManager[Path]], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("target").mkdir()
    Path("link").symlink_to("target")
    os.mkfifo("pipe")
    before = sorted(tmp_path.rglob("*"))
    for force in (True, False):
        with pytest.raises(ValueError, match=NO_PLACES[name]), make(name, force=force):
            pytest.fail("the work was begun")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_may_lie_behind_a_link(tmp_path: Path) -> None:
    """Nothing is put in the place of a folder in which work is continued."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to("disk")
    assert claim(tmp_path / "run", "config.json", {"a": 1}, "a run") is None
    assert os.listdir(tmp_path / "disk") == ["config.json"] and (tmp_path / "run").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    for path in (Path(""), Path(".."), tmp_path / "pipe"):
        with pytest.raises(ValueError, match="has no name|is a device"):
            claim(path, "config.json", {}, "a run")


def test_a_mount_point_is_no_place_for_a_new_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "ismount", lambda path: path == tmp_path)
    with pytest.raises(ValueError, match="is a mount point, which cannot be renamed: name a folder in it"):
        check_new_directory(tmp_path, force=True)


@pytest.mark.parametrize(
    "command",
    [
        "reconstruct cloud.npy --weights rope --output {}",
        "export rope --output {}",
        "evaluate rope --output {}",
        "generate rope --examples 2 --output {}",
        "train data --output {}",
        "align cloud.npy --scene rope --weights rope --output {}",
        "stream . --weights rope --surfaces {}",
        "scene preview rope --output {}",
        "bench --weights rope --output {}",
        "demo --output {}",
    ],
)
def test_every_command_refuses_a_pipe_first(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    assert command_line.main(command.format("pipe").split()) == 2
    assert "mereo: error: pipe is a device or pipe" in capsys.readouterr().err
    assert Path("pipe").is_fifo() and os.listdir() == ["pipe"]


def test_force_replaces_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_bar(tmp_path)
    command, output = ["scene", "export", "bar.yaml", "--output", "rest.ply"], Path("rest.ply")
    output.write_text("old")
    before = sorted(os.listdir())
    assert command_line.main(command) == 2 and output.read_text() == "old"
    for _ in range(2):
        assert command_line.main([*command, "--force"]) == 0
        assert output.stat().st_size > 1000 and sorted(os.listdir()) == before


@pytest.mark.parametrize(
    "command",
    [
        "reconstruct left.ply --weights rope --output {}",
        "scene export bar.yaml --output right.ply",
        "scene export bar.yaml --output linked.ply",
        "scene preview bar.yaml --output bar.yaml",
        "scene preview bar.yaml --output left.ply",
        "bench --weights weights.safetensors --output weights.safetensors",
    ],
)
def test_not_even_force_replaces_an_input(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By whatever name: the mesh of a scene file, the file itself, an asset of a built-in scene, weights."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MEREO_ASSETS", str(tmp_path / "assets"))
    for name, low in (("left", 0), ("right", 20)):
        write_mesh(box((low, 0, 0), (low + 20, 10, 10), name), Path(f"{name}.ply"))
    Path("bar.yaml").write_text(HEAD.replace(".stl", ".ply"))
    os.link("right.ply", "linked.ply")
    Path("assets/bunny").mkdir(parents=True)
    for name in ("weights.safetensors", "assets/bunny/bunny.off"):
        Path(name).write_text("precious")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert command_line.main([*command.format(tmp_path).split(), "--force"]) == 2
    assert re.search("is read.*; it is not replaced.*: choose another", capsys.readouterr().err)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
