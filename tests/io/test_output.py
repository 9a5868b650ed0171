"""Outputs appear whole or not at all, and what is written is what comes back."""

import errno
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from folder_contents import contents, read_json

from mereo.io.atomic_files import MARKER, OLD, atomic_file, new_directory, write_json
from mereo.io.errors import words_of
from mereo.io.object_storage import claim

INTERRUPTIONS = [ValueError("no"), KeyboardInterrupt(), SystemExit(1)]


def test_a_file_appears_at_the_end_with_ordinary_permissions(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.txt"
    with atomic_file(path) as partial:
        assert partial.name == "a.txt"
        assert partial.parent.parent == path.parent, "so that a rename will do"
        partial.write_text("whole")
        assert not path.exists()
    assert contents(tmp_path / "deep" / "er") == {"a.txt": b"whole"}
    plain = tmp_path / "plain"
    plain.write_text("")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


@pytest.mark.parametrize("interruption", INTERRUPTIONS, ids=lambda e: type(e).__name__)
def test_an_interruption_leaves_everything_as_it_was(tmp_path: Path, interruption: BaseException) -> None:
    (tmp_path / "old.txt").write_text("old")
    with new_directory(tmp_path / "old") as first:
        (first / "x").write_text("old")
    before = contents(tmp_path)
    for path in (tmp_path / "old.txt", tmp_path / "new" / "deep" / "a.txt"):
        with pytest.raises(type(interruption)), atomic_file(path) as partial:
            partial.write_text("half")
            raise interruption
    for path in (tmp_path / "old", tmp_path / "fresh" / "deep"):
        with pytest.raises(type(interruption)), new_directory(path, force=True) as partial:
            (partial / "sub").mkdir()
            (partial / "sub" / "half").write_text("half")
            raise interruption
    assert contents(tmp_path) == before


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    for name, place in (("a.bin", atomic_file(tmp_path / "a.bin")), ("d", new_directory(tmp_path / "d"))):
        with pytest.raises(OSError, match=r"disk is full while writing .*free space") as caught, place as partial:
            (partial / "f" if partial.is_dir() else partial).write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert caught.value.errno == errno.ENOSPC
        assert words_of(caught.value) == (
            f"the disk is full while writing {tmp_path / name}: free space or choose another place"
        )
    assert contents(tmp_path) == {}


def test_existing_outputs_are_kept_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    (tmp_path / "d").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "d" / "x").write_text("old")
    for place, sentence in (
        (atomic_file(tmp_path / "a", force=False), r"exists; it is not overwritten: .*--force"),
        (new_directory(tmp_path / "d"), r"not empty; it is not overwritten: .*--force"),
        (new_directory(tmp_path / "a", force=True), "is a file; a directory"),
        (atomic_file(tmp_path / "d"), "is a directory; a file"),
    ):
        with pytest.raises(FileExistsError, match=sentence), place:
            pass
    with new_directory(tmp_path / "empty") as partial:
        (partial / "y").write_text("new")
    after = contents(tmp_path)
    assert json.loads(after.pop("empty/.mereo.json"))["files"].keys() == {"y"}
    assert after == {"a": b"old", "d": b"", "d/x": b"old", "empty": b"", "empty/y": b"new"}


def test_a_file_that_came_meanwhile_is_kept_unless_forced(tmp_path: Path) -> None:
    for force, kept in ((False, "theirs"), (True, "ours")):
        path = tmp_path / f"{force}.txt"
        with suppress(FileExistsError), atomic_file(path, force=force) as partial:
            partial.write_text("ours")
            path.write_text("theirs")
        assert path.read_text() == kept and len(contents(tmp_path)) == 1 + force


def test_json_knows_arrays_and_has_no_nan(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json", {"a": np.arange(3), "b": (np.float32(0.5), float("nan")), "c": Path("x"), "é": True}
    )
    loaded = read_json(tmp_path / "a.json")
    assert loaded == {"a": [0, 1, 2], "b": [0.5, None], "c": "x", "é": True}


def test_a_directory_is_claimed_once(tmp_path: Path) -> None:
    place = tmp_path / "deep" / "new"
    (place / ".settings.json.1a2b3c4d.mereo").mkdir(parents=True)  # what a killed process left
    assert claim(place, "settings.json", {"a": [1, 2.5]}, "a run") is None
    (place / "result.txt").write_text("much work")
    assert claim(place, "settings.json", {"a": 3}, "a run") == {"a": [1, 2.5]}


def test_a_directory_of_something_else_is_not_claimed(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=r"is not empty and holds no settings\.json; choose another --output"):
        claim(tmp_path, "settings.json", {}, "a run")
    with pytest.raises(FileExistsError, match="thesis.tex is a file; a run is a directory: choose another --output"):
        claim(tmp_path / "thesis.tex", "settings.json", {}, "a run")
    assert contents(tmp_path) == before
    for text in ("{", "[1]"):
        (tmp_path / "settings.json").write_text(text)
        with pytest.raises(ValueError, match="holds no settings; .* cannot be continued: choose another --output"):
            claim(tmp_path, "settings.json", {}, "a run")


# --- folders of results replace what mereo wrote and nothing else, whoever comes between or dies half-way -------------


def write(path: Path, text: str, force: bool = False) -> None:
    with new_directory(path, force) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a.txt").write_text(text)


def read(path: Path) -> str:
    return (path / "deep" / "a.txt").read_text()


def test_what_mereo_wrote_is_replaced_when_forced(tmp_path: Path) -> None:
    write(tmp_path / "out", "first")
    write(tmp_path / "out", "second", force=True)
    assert read(tmp_path / "out") == "second" and os.listdir(tmp_path) == ["out"]
    shutil.move(tmp_path / "out", tmp_path / "elsewhere")
    (tmp_path / "elsewhere/deep/a.txt").unlink()
    write(tmp_path / "elsewhere", "third", force=True)
    assert read(tmp_path / "elsewhere") == "third"


CHANGES = {
    "another file": (
        lambda folder: (folder / "deep/mine.txt").write_text("precious"),
        r"holds deep/mine\.txt, not written by this version of mereo or .*: move that away, or choose another",
    ),
    "an edit": (lambda folder: (folder / "deep/a.txt").write_text("corrected"), r"holds deep/a\.txt, not written by"),
    "a link": (lambda folder: (folder / "deep/link").symlink_to(folder), r"holds deep/link, not written"),
    "a folder": (lambda folder: (folder / "mine").mkdir(), r"holds mine, not written"),
    "no list": (lambda folder: (folder / MARKER).unlink(), r"holds deep and 1 more, not written"),
    "a bad list": (lambda folder: (folder / MARKER).write_text('{"files": 3}'), r"holds deep and 1 more, not written"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_folder_with_anything_else_in_it_is_kept_and_refused_before_the_work(change: str, tmp_path: Path) -> None:
    make, sentence = CHANGES[change]
    write(tmp_path / "out", "first")
    before = {}
    with (
        pytest.raises(FileExistsError, match="out (holds|was written)"),
        new_directory(tmp_path / "out", True) as folder,
    ):
        (folder / "b.txt").write_text("second")
        make(tmp_path / "out")
        before = contents(tmp_path / "out")
    assert contents(tmp_path / "out") == before and os.listdir(tmp_path) == ["out"]
    with pytest.raises(FileExistsError, match=sentence), new_directory(tmp_path / "out", force=True):
        pytest.fail("the work was begun")
    assert contents(tmp_path / "out") == before and os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("existing", ["absent", "empty"])
def test_an_output_that_is_filled_during_the_work_is_kept(existing: str, tmp_path: Path) -> None:
    """By a person, and by another run: the first one to end has its result there, the second one says so."""
    if existing == "empty":
        (tmp_path / "out").mkdir()
    message = "was written by another while this ran; it is kept and this result is dropped: run again with another"
    with pytest.raises(FileExistsError, match=message), new_directory(tmp_path / "out") as folder:
        (folder / "b.txt").write_text("ours")
        (tmp_path / "out").mkdir(exist_ok=True)
        (tmp_path / "out/a.txt").write_text("theirs")
    assert contents(tmp_path) == {"out": b"", "out/a.txt": b"theirs"}


def test_two_runs_at_once_into_one_folder_are_refused_at_once(tmp_path: Path) -> None:
    with (
        new_directory(tmp_path / "out"),
        pytest.raises(FileExistsError, match="is being written by another process: wait for it, or choose another"),
        new_directory(tmp_path / "out"),
    ):
        pass


def test_the_input_is_never_replaced(tmp_path: Path) -> None:
    write(tmp_path / "out", "first")
    inputs = [tmp_path / "missing", tmp_path / "out/deep/a.txt"]
    with (
        pytest.raises(FileExistsError, match=r"out holds .*a\.txt, which is read; it is not replaced: choose another"),
        new_directory(tmp_path / "out", True, inputs),
    ):
        pytest.fail("the work was begun")


DIES = """
import os, signal, sys
from mereo.io import atomic_files
plain, left = os.rename, iter(range(int(sys.argv[2]) - 1))
def rename(*places):
    plain(*places)
    next(left, None) is not None or os.kill(os.getpid(), signal.SIGKILL)
os.rename = rename
with atomic_files.new_directory(sys.argv[1], force=True) as folder:
    (folder / "b.txt").touch()
"""


@pytest.mark.parametrize("renames", [1, 2])
def test_a_process_killed_while_it_replaces_loses_neither_result(renames: int, tmp_path: Path) -> None:
    """Between the two renames the old one is put back; after them the new one is there, and is whole."""
    out = tmp_path / "out"
    write(out, "first")
    done = subprocess.run([sys.executable, "-c", DIES, str(out), str(renames)], capture_output=True, timeout=60)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert any((tmp_path / name / OLD).is_dir() for name in os.listdir(tmp_path))
    with pytest.raises(FileExistsError, match="not overwritten"):  # after it was put back
        write(out, "second")
    assert (out / "deep/a.txt").exists() == (renames == 1) and (out / MARKER).exists()
    assert os.listdir(tmp_path) == ["out"]


def test_a_living_process_keeps_what_it_is_writing(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "a.txt") as first:
        first.write_text("first")
        with atomic_file(tmp_path / "a.txt") as second:
            second.write_text("second")
        assert (tmp_path / "a.txt").read_text() == "second"
    assert contents(tmp_path) == {"a.txt": b"first"}
