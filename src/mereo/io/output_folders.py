"""Folders of results: they appear whole or not at all, and replace only what mereo itself wrote.

Each holds ``.mereo.json``, a list of all that is in it with the size and time of each file. A folder is replaced where
its content is that list's, unchanged: what somebody has put there, or has edited, stays.
"""

import json
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mereo.io.atomic_files import (
    OLD,
    check_place,
    is_being_written,
    json_text,
    remove_abandoned,
    remove_all_abandoned,
    scratch_folder,
    write_json,
)
from mereo.io.object_storage import ObjectPath

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
    check_new_directory(path, force, inputs)
    with scratch_folder(path) as scratch:
        content = scratch / path.name
        content.mkdir()
        yield content
        (content / MARKER).write_text(json_text({"written_by": "mereo", "files": _stamps(content)}), "utf-8")
        if force and _has_content(path):
            os.rename(path, scratch / OLD)  # from here on nobody finds it to put something into it
            _check_ours(scratch / OLD, path)  # where this raises, ``scratch_folder`` puts it back
        with suppress(OSError):  # Windows renames nothing to an empty folder
            path.rmdir()
        try:
            os.rename(content, path)
        except OSError:
            if not path.exists():
                raise
            raise FileExistsError(
                f"{path} was written by another while this ran; it is kept and this result is dropped: run again with "
                "another --output"
            ) from None


def check_new_directory(path: Path, force: bool, inputs: Sequence[str | Path] = ()) -> None:
    """Check what ``new_directory`` may do, before the work; raises as it does.

    An output that a killed process was just replacing is put back.
    """
    check_place(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; a directory is written there: choose another --output")
    if os.path.ismount(path):
        raise ValueError(f"{path} is a mount point, which cannot be renamed: name a folder in it")
    if is_being_written(path):
        raise FileExistsError(f"{path} is being written by another process: wait for it, or choose another --output")
    remove_abandoned(path)
    if not _has_content(path):
        return
    if not force:
        raise FileExistsError(
            f"{path} exists and is not empty; it is not overwritten: choose another --output or pass --force"
        )
    for place in map(Path, inputs):
        if place.exists() and place.resolve().is_relative_to(path.resolve()):
            raise FileExistsError(f"{path} holds {place}, which is read; it is not replaced: choose another --output")
    _check_ours(path, path)


def _has_content(path: Path) -> bool:
    return path.is_dir() and any(path.iterdir())


def _check_ours(folder: Path, path: Path) -> None:
    """Raise ``FileExistsError`` where ``folder``, which is or was ``path``, holds what mereo did not write."""
    others = unexpected_files(folder)
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise FileExistsError(
            f"{path} holds {others[0]}{more}, not written by this version of mereo or changed since; it is not "
            "replaced: move that away, or choose another --output"
        )


def unexpected_files(folder: Path) -> list[str]:
    """Names in a folder of what its list does not have as it is; links are never in it."""
    try:
        listed = json.loads((folder / MARKER).read_text("utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        listed = {}
    known = listed if isinstance(listed, dict) else {}
    return [
        name
        for name, stamp in _stamps(folder).items()
        if name != MARKER and (stamp is None or known.get(name) != stamp)
    ]


def _stamps(folder: Path) -> dict[str, list[int] | None]:
    """Size and time of each file in a folder, by its name there; of a folder nothing, and None for all else."""
    found = dict[str, list[int] | None]()
    for place in sorted(folder.rglob("*")):
        facts = place.lstat()
        stamp = [facts.st_size, facts.st_mtime_ns] if stat.S_ISREG(facts.st_mode) else None
        found[place.relative_to(folder).as_posix()] = [] if stat.S_ISDIR(facts.st_mode) else stamp
    return found


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
