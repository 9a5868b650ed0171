"""Outputs appear whole or not at all, and what is written is what comes back."""

import errno
import json
import os
import stat
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from folder_contents import contents

from mereo.io.atomic_files import atomic_file, new_directory, write_json
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
    loaded = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert loaded == {"a": [0, 1, 2], "b": [0.5, None], "c": "x", "é": True}


def test_a_directory_is_claimed_once(tmp_path: Path) -> None:
    """Whoever comes later, with whatever settings, is told those of the first."""
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
