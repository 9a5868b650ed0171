"""Folders of results: they appear whole or not at all, and replace only what mereo itself wrote.

Each holds ``.mereo.json``, a list of its files with their SHA-256. A folder is replaced where all of its content is in
that list, unchanged: what somebody has put there, or has edited, stays.
"""

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from mereo.io.atomic_files import write_json
from mereo.io.object_storage import ObjectPath
from mereo.io.scratch_folders import (
    ASIDE,
    REMOVED,
    abandoned,
    check_place,
    is_being_written,
    remove_abandoned,
    remove_all_abandoned,
    scratch_folder,
)

MARKER = ".mereo.json"
"""Name of the list in each folder of results."""


@contextmanager
def new_directory(path: str | Path, force: bool = False, inputs: Sequence[str | Path] = ()) -> Iterator[Path]:
    """Yield an empty temporary directory; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination. An existing empty directory counts as absent.
        force: replace an existing directory, once the new one is complete, if mereo wrote all that it holds.
        inputs: files that are read, which are never replaced.

    Raises:
        ValueError: ``path`` is a link, a device, a mount point or no usable name.
        FileExistsError: ``path`` is a file, or a directory with content and ``force`` is false, or it holds what mereo
            did not write; or one of these came to be while the block ran.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    replaced = check_new_directory(path, force, inputs)
    with scratch_folder(path) as scratch:
        content = scratch / path.name
        content.mkdir()
        yield content
        _write_marker(content)
        if replaced is None or not path.exists():
            _place(content, path)
        else:
            _replace(content, path, replaced, scratch / ASIDE)


def check_new_directory(path: Path, force: bool, inputs: Sequence[str | Path] = ()) -> bytes | None:
    """Check what ``new_directory`` may do, before the work; the list of what it will replace, None for nothing.

    Raises as it does. An output that a killed process was just replacing is put back.
    """
    check_place(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; a directory is written there: choose another --output")
    if os.path.ismount(path):
        raise ValueError(f"{path} is a mount point, which cannot be renamed: name a folder in it")
    if is_being_written(path):
        raise FileExistsError(f"{path} is being written by another process: wait for it, or choose another --output")
    _put_back(path)
    if not path.is_dir() or not any(path.iterdir()):
        return None
    if not force:
        raise FileExistsError(
            f"{path} exists and is not empty; it is not overwritten: choose another --output or pass --force"
        )
    for place in map(Path, inputs):
        if place.exists() and place.resolve().is_relative_to(path.resolve()):
            raise FileExistsError(f"{path} holds {place}, which is read; it is not replaced: choose another --output")
    _check_own(path, path)
    return (path / MARKER).read_bytes()


def _check_own(folder: Path, path: Path) -> None:
    """Raise ``FileExistsError`` where ``folder``, which is or was ``path``, holds what mereo did not write."""
    others = strangers(folder)
    if not others:
        return
    if not (folder / MARKER).is_file():
        raise FileExistsError(
            f"{path} has no {MARKER}, so its content is not mereo's, or an earlier version's; it is not replaced: "
            "choose another --output, or delete it yourself"
        )
    more = f" and {len(others) - 1} more" if len(others) > 1 else ""
    raise FileExistsError(
        f"{path} holds {others[0]}{more}, not written by mereo or changed since; it is not replaced: move that away, "
        "or choose another --output"
    )


# --- the list of what was written -------------------------------------------------------------------------------------


def strangers(folder: Path) -> list[str]:
    """What of a folder's content, by its name in it, the list does not have as it is; links are never in it."""
    written = _read_marker(folder)
    parents = {str(parent) for name in written for parent in PurePosixPath(name).parents}
    found = []
    for place in sorted(folder.rglob("*")):
        name = place.relative_to(folder).as_posix()
        if (
            place.is_symlink()
            or not (place.is_file() or place.is_dir())
            or (name not in parents if place.is_dir() else name != MARKER and written.get(name) != _digest(place))
        ):
            found.append(name)
    return found


def _write_marker(folder: Path) -> None:
    files = {p.relative_to(folder).as_posix(): _digest(p) for p in sorted(folder.rglob("*")) if p.is_file()}
    write_json(folder / MARKER, {"written_by": "mereo", "files": files})


def _read_marker(folder: Path) -> dict[str, Any]:
    """Digests of the files that a folder's list names; none where it has no list."""
    try:
        files = json.loads((folder / MARKER).read_text("utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return files if isinstance(files, dict) else {}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- putting it in its place ------------------------------------------------------------------------------------------


def _place(content: Path, path: Path) -> None:
    """Rename ``content`` to ``path``, which is absent or empty; the system refuses where it no longer is."""
    if os.name == "nt":  # which refuses an empty one too
        with suppress(OSError):
            path.rmdir()
    try:
        os.rename(content, path)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        raise FileExistsError(f"{path} {CAME}") from None


CAME = "was written by another while this ran; it is kept and this result is dropped: run again with another --output"


def _replace(content: Path, path: Path, replaced: bytes, old: Path) -> None:
    """Put ``content`` in the place of ``path``, if that is still what ``replaced`` lists; all else goes back."""
    os.rename(path, old)  # from here on nobody finds it to put something into it
    try:
        if not (old / MARKER).is_file() or (old / MARKER).read_bytes() != replaced:
            raise FileExistsError(f"{path} {CAME}")
        _check_own(old, path)
        _place(content, path)
    except BaseException:
        with suppress(OSError):  # there is something again: the old one waits until that has gone
            os.rename(old, path)
        raise
    _remove_old(old)


def _put_back(path: Path) -> None:
    """Finish what processes did that were killed between taking an old output away and removing it."""
    for scratch in abandoned(path):
        old = scratch / ASIDE
        if old.is_dir() and not path.exists():
            os.rename(old, path)
        elif old.is_dir() and not strangers(old):
            _remove_old(old)
        _remove_written(scratch / REMOVED)
    remove_abandoned(path)


def _remove_old(old: Path) -> None:
    """Remove an output that waits in a scratch folder, first of all its name, so that no part of it is put back."""
    removed = old.with_name(REMOVED)
    with suppress(OSError):  # it is in nobody's way
        os.rename(old, removed)
        _remove_written(removed)


def _remove_written(folder: Path) -> None:
    """Remove the files of a folder that its list names, and then what is empty."""
    written, places = _read_marker(folder), sorted(folder.rglob("*"), reverse=True)
    folders = [place for place in places if place.is_dir() and not place.is_symlink()]
    with suppress(OSError):  # what remains is in nobody's way
        for place in places:
            if place.relative_to(folder).as_posix() in written:
                place.unlink()
        for place in folders:
            place.rmdir()
        (folder / MARKER).unlink(missing_ok=True)  # the last one, for whoever must go on with this
        folder.rmdir()


# --- folders in which work is continued -------------------------------------------------------------------------------


def claim_directory(directory: Path, name: str, settings: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Settings that a directory of earlier work holds, or None where it was made with ``settings`` just now.

    Hidden files do not count: a process that was killed while writing leaves them, and they are removed here. It may
    be a link to a directory, because nothing is put in its place.

    Args:
        directory: where work is done that may be stopped and continued; made when it is missing.
        name: of the JSON file in it that says what the work is.
        settings: what that file says of a new directory.
        kind: of the directory, for messages: "a dataset".

    Raises:
        FileExistsError: it is a file, or holds something but no such file.
        ValueError: its file holds no settings, or it is no place for a directory.
    """
    check_place(directory, may_be_link=True)
    path = directory / name
    if directory.exists() and not directory.is_dir():
        raise FileExistsError(f"{directory} is a file; {kind} is a directory: choose another --output")
    remove_all_abandoned(directory)
    if path.is_file():
        return read_settings(path)
    if directory.is_dir() and any(not file.name.startswith(".") for file in directory.iterdir()):
        raise FileExistsError(f"{directory} is not empty and holds no {name}; choose another --output")
    try:
        write_json(path, settings, force=False)
    except FileExistsError:  # another process came first
        return read_settings(path)
    return None


def read_settings(path: Path | ObjectPath) -> dict[str, Any]:
    """Settings that the file of a place of earlier work holds; ``ValueError`` where it holds none."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise ValueError(f"{path} holds no settings; what it belongs to cannot be continued: choose another --output")
    return found
