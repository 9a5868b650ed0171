"""Files and directories that appear whole or not at all.

Everything is first written beside its destination under a temporary name and renamed at the end, so that a reader never
sees half a file and an error, Ctrl-C or a full disk leaves nothing behind.
"""

import errno
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np


@contextmanager
def atomic_file(path: str | Path, *, force: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same suffix; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination; missing parent directories are made (and removed again if the block fails).
        force: replace an existing file.

    Raises:
        FileExistsError: ``path`` exists and ``force`` is false, or it is a directory.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    if path.is_dir():
        raise FileExistsError(f"{path} is a directory; a file is written there: choose another name")
    if path.exists() and not force:
        raise FileExistsError(f"{path} exists; it is not overwritten: choose another name or pass --force")
    with _temporary(path) as partial:
        yield partial
        os.replace(partial, path)


@contextmanager
def new_directory(path: str | Path, force: bool = False) -> Iterator[Path]:
    """Yield an empty temporary directory beside ``path``; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination. An existing empty directory counts as absent.
        force: replace an existing directory and all it holds, once the new one is complete.

    Raises:
        FileExistsError: ``path`` is a file, or a directory with content and ``force`` is false.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; a directory is written there: choose another --output")
    if path.is_dir() and any(path.iterdir()) and not force:
        raise FileExistsError(
            f"{path} exists and is not empty; it is not overwritten: choose another --output or pass --force"
        )
    with _temporary(path) as partial:
        partial.mkdir()
        yield partial
        _swap_directory(partial, path)


def _swap_directory(partial: Path, path: Path) -> None:
    """Put ``partial`` in the place of ``path``; the old content goes only after the new one is there."""
    if not path.exists():
        os.rename(partial, path)
        return
    old = partial.with_name(partial.name + "-old")
    os.rename(path, old)
    try:
        os.rename(partial, path)
    except BaseException:
        os.rename(old, path)
        raise
    shutil.rmtree(old)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yield a fresh sibling name with the suffix of ``path``; on any exception (Ctrl-C too) remove what is there."""
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    made: list[Path] = []
    try:
        made = _make_parents(path.parent)
        yield partial
    except BaseException as error:
        _remove(partial, made)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise OSError(
                errno.ENOSPC, f"the disk is full while writing {path}; free space or choose another place"
            ) from error
        if isinstance(error, PermissionError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise PermissionError(
                f"{path} cannot be written; its directory is read-only: choose another place"
            ) from error
        raise


def _make_parents(directory: Path) -> list[Path]:
    """Make ``directory``; the directories that were missing are returned, the deepest first."""
    missing = [place for place in (directory, *directory.parents) if not place.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    return missing


def _remove(partial: Path, made: list[Path]) -> None:
    if partial.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
    else:
        partial.unlink(missing_ok=True)
    for directory in made:
        with suppress(OSError):  # another process may have written there meanwhile
            directory.rmdir()


def claim_directory(directory: Path, name: str, settings: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Settings that a directory of earlier work holds, or None where it was made with ``settings`` just now.

    Hidden files do not count: a process that was killed while writing leaves them.

    Args:
        directory: where work is done that may be stopped and continued; made when it is missing.
        name: of the JSON file in it that says what the work is.
        settings: what that file says of a new directory.
        kind: of the directory, for messages: "a dataset".

    Raises:
        FileExistsError: it is a file, or holds something but no such file.
        ValueError: its file holds no settings.
    """
    path = directory / name
    if directory.exists() and not directory.is_dir():
        raise FileExistsError(f"{directory} is a file; {kind} is a directory: choose another --output")
    if path.is_file():
        return _read_settings(path)
    if directory.is_dir() and any(not file.name.startswith(".") for file in directory.iterdir()):
        raise FileExistsError(f"{directory} is not empty and holds no {name}; choose another --output")
    write_json(path, settings)
    return None


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise ValueError(f"{path} holds no settings; what it belongs to cannot be continued: choose another --output")
    return found


def write_json(path: str | Path, value: Any) -> None:
    """Write ``to_json`` of a value, indented, whole or not at all."""
    with atomic_file(path) as partial:
        partial.write_text(json.dumps(to_json(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")


def to_json(value: Any) -> Any:
    """Value in terms that JSON knows: arrays become lists, paths text, NaN and infinity null (JSON has neither)."""
    if isinstance(value, dict):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_json(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
