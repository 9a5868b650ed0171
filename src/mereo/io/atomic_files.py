"""Files and folders of results: they appear whole or not at all, and replace only what mereo itself wrote.

An output is made in a scratch folder next to its destination (``.NAME.1a2b3c4d.mereo``) and renamed at the end. The
scratch folder is locked by its process; the system frees locks when a process dies, so the next one that writes there
can tell what a killed one left from work in progress.

Each folder of results holds ``.mereo.json``, a list of all that is in it with the size and time of each file. A folder
is replaced where its content is that list's, unchanged: what somebody has put there, or has edited, stays.
"""

import errno
import json
import math
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mereo.io.errors import AnyPath

try:
    import fcntl

    HAS_LOCKS = True
except ImportError:  # Windows, where what a killed process left stays until its user deletes it
    HAS_LOCKS = False

OLD = ".mereo-old"
"""Name under which an output that is being replaced waits in the scratch folder of its successor."""

MARKER = ".mereo.json"
"""Name of the list in each folder of results."""

EXISTS = "exists; it is not overwritten: choose another name or pass --force"


# --- scratch folders --------------------------------------------------------------------------------------------------


def check_place(path: Path, may_be_link: bool = False) -> None:
    """Raise ``ValueError`` for what cannot be replaced by renaming: links, devices, and names that are none.

    With ``may_be_link`` a link to a directory will do.
    """
    name = repr(str(path))
    if re.search("[\0\ud800-\udfff]", str(path)):
        raise ValueError(f"the output {name} has a zero byte, or bytes that are no UTF-8 text: choose another name")
    # a path makes "s3:/bucket" of "s3://bucket"
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", path.as_posix()) and not Path(path.parts[0]).exists():
        raise ValueError(
            f"the output {path.as_posix().replace(':/', '://', 1)} is a URL, and a local path is needed here; only "
            "datasets go to an object storage: name a folder or file of this machine"
        )
    if path.name in ("", ".."):
        raise ValueError(f"the output {name} has no name of its own, which it needs: name it, as in {path / 'out'}")
    if path.is_symlink() and not (may_be_link and path.is_dir()):
        raise ValueError(f"{path} is a link, which would be lost; an output is written in its own place: name that")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"{path} is a device or pipe; an output is a file or folder: choose another --output")
    above = next((folder for folder in path.parents if folder.exists()), path.parent)
    if above.exists() and not above.is_dir():
        raise ValueError(f"{above} is no folder, so {path.name} cannot be made in it: choose another --output")


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a fresh folder next to ``path``, and remove it at the end, whatever happens; missing parents are made.

    Where the block fails (Ctrl-C too) the parents are removed again. What killed processes left here for ``path`` goes.
    Raises ``OSError`` where the disk is full, and ``PermissionError``.
    """
    remove_abandoned(path.parent, path.name)
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        scratch, lock = _new_scratch(path)
        try:
            yield scratch
        finally:
            _clear(scratch, path)
            if lock is not None:
                os.close(lock)
    except BaseException as error:
        for directory in missing:
            with suppress(OSError):  # another process may have written there meanwhile
                directory.rmdir()
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            full = OSError(f"the disk is full while writing {path}: free space or choose another place")
            full.errno = errno.ENOSPC  # alone: of an error with a system's text the command line shows that
            raise full from error
        raise


def _new_scratch(path: Path) -> tuple[Path, int | None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".mereo", dir=path.parent))
            with suppress(FileNotFoundError):  # another process took it for a leftover, as it was not locked yet
                lock = _lock(scratch, wait=True)
                if scratch.exists():
                    return scratch, lock
                if lock is not None:
                    os.close(lock)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        raise PermissionError(f"{path} cannot be written; its directory is read-only: choose another place") from error


def remove_abandoned(directory: Path, name: str | None = None) -> bool:
    """Remove what killed processes left for a name in a directory, or for any; whether a live one is writing that.

    An output that a killed one had taken away is put back. Without locks nothing is known, and nothing removed.
    """
    is_written = False
    names = ".+" if name is None else re.escape(name)
    items = list[Path]()
    with suppress(OSError):  # it may be missing, or be no one's to list
        items = list(directory.iterdir())
    for scratch in items:
        match = re.fullmatch(rf"\.({names})\.[0-9a-z_]{{8}}\.mereo", scratch.name)
        if match is None or scratch.is_symlink():
            continue
        try:
            lock = _lock(scratch)
        except BlockingIOError:
            is_written = True
        except OSError:  # another user's, or gone by now
            pass
        else:
            if lock is not None:
                _clear(scratch, directory / match[1])
                os.close(lock)
    return is_written


def _lock(scratch: Path, *, wait: bool = False) -> int | None:
    """Lock a scratch folder; the lock is free again when the descriptor is closed. None where there are no locks."""
    if not HAS_LOCKS:
        return None
    lock = os.open(scratch, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            raise
        return None  # some network file systems
    return lock


def _clear(scratch: Path, path: Path) -> None:
    """Remove a scratch folder; an output that was to be replaced and was not goes back to its place when free."""
    old = scratch / OLD
    if old.exists() and (scratch / path.name).exists():  # its successor was not put in its place
        try:
            os.rename(old, path)
        except OSError:
            return
    shutil.rmtree(scratch, ignore_errors=True)


# --- files ------------------------------------------------------------------------------------------------------------


@contextmanager
def atomic_file(path: AnyPath, *, force: bool = True, inputs: Iterable[AnyPath] = ()) -> Iterator[Path]:
    """Yield a path of the same name in a scratch folder; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination; missing parent directories are made (and removed again if the block fails).
        force: replace an existing file.
        inputs: files and folders that are read, which are never replaced.

    Raises ``ValueError`` for a link, a device or no usable name, ``FileExistsError`` for a directory, an input, or
    without ``force`` for what exists or came while the block ran, and ``OSError`` where it cannot be written.
    """
    path = Path(path)
    check_file_place(path, force=force, inputs=inputs)
    with scratch_folder(path) as scratch:
        partial = scratch / path.name
        yield partial
        if force:
            os.replace(partial, path)
            return
        try:
            os.link(partial, path)  # in one step if nothing has the name by now, which a rename on POSIX is not
        except OSError:  # also of a file system without hard links
            if path.exists():
                raise FileExistsError(f"{path} {EXISTS}") from None
            os.rename(partial, path)


def write_file(path: AnyPath, content: str | bytes, *, force: bool = True) -> None:
    """Write a file of this content, whole or not at all; text in UTF-8; raises as ``atomic_file``."""
    with atomic_file(path, force=force) as partial:
        partial.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def check_file_place(path: AnyPath | None, *, force: bool = True, inputs: Iterable[AnyPath] = ()) -> None:
    """Raise as ``atomic_file`` does for a place where no file can be put: before the work, not after. None is none.

    What killed processes left for the file is removed, also where it is refused because it is whole.
    """
    if path is None:
        return
    path = Path(path)
    check_place(path)
    remove_abandoned(path.parent, path.name)
    if path.is_dir():
        raise FileExistsError(f"{path} is a directory; a file is written there: choose another name")
    if path.exists() and not force:
        raise FileExistsError(f"{path} {EXISTS}")
    for place in map(Path, inputs) if path.exists() else ():
        # a file may have several names
        if path.resolve().is_relative_to(place.resolve()) or (place.exists() and path.samefile(place)):
            raise FileExistsError(
                f"{path} is read by this command; it is not replaced, not even by --force: choose another name"
            )


# --- folders of results ---------------------------------------------------------------------------------------------


@contextmanager
def new_directory(path: AnyPath, force: bool = False, inputs: Sequence[AnyPath] = ()) -> Iterator[Path]:
    """Yield an empty temporary directory; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination. An existing empty directory counts as absent.
        force: replace an existing directory, once the new one is complete, if mereo wrote all that it holds.
        inputs: files that are read, which are never replaced.

    Raises ``ValueError`` for a link, a device, a mount point or no usable name, ``FileExistsError`` for a file, for a
    directory with content that mereo did not write, or without ``force`` with any, and ``OSError`` where it cannot be
    written.
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


def check_new_directory(path: Path, force: bool, inputs: Sequence[AnyPath] = ()) -> None:
    """Check what ``new_directory`` may do, before the work; raises as it does.

    An output that a killed process was just replacing is put back.
    """
    check_place(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; a directory is written there: choose another --output")
    if os.path.ismount(path):
        raise ValueError(f"{path} is a mount point, which cannot be renamed: name a folder in it")
    if remove_abandoned(path.parent, path.name):
        raise FileExistsError(f"{path} is being written by another process: wait for it, or choose another --output")
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
    """Raise ``FileExistsError`` where ``folder``, which is or was ``path``, holds what its list does not have so."""
    try:
        known = dict(json.loads((folder / MARKER).read_text("utf-8"))["files"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        known = {}
    stamps = {name: stamp for name, stamp in _stamps(folder).items() if name != MARKER}
    others = [name for name, stamp in stamps.items() if stamp is None or known.get(name) != stamp]
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise FileExistsError(
            f"{path} holds {others[0]}{more}, not written by this version of mereo or changed since; it is not "
            "replaced: move that away, or choose another --output"
        )


def _stamps(folder: Path) -> dict[str, list[int] | None]:
    """Size and time of each file in a folder, by its name there; of a folder nothing, and None for all else."""
    stamps = dict[str, list[int] | None]()
    for item in sorted(folder.rglob("*")):
        facts = item.lstat()
        stamp = [facts.st_size, facts.st_mtime_ns] if stat.S_ISREG(facts.st_mode) else None
        stamps[item.relative_to(folder).as_posix()] = [] if stat.S_ISDIR(facts.st_mode) else stamp
    return stamps


# --- JSON -------------------------------------------------------------------------------------------------------------


JsonObject = dict[str, Any]
"""Object of JSON: values by their names, as ``json`` reads them and ``to_json`` can write them."""


def write_json(path: AnyPath, value: Any, *, force: bool = True) -> None:
    """Write ``to_json`` of a value, indented, whole or not at all; ``force`` as in ``atomic_file``."""
    write_file(path, json_text(value), force=force)


def json_text(value: Any) -> str:
    """Text of ``to_json`` of a value as files have it, indented, with a line's end at its end."""
    return json.dumps(to_json(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def to_json(value: Any) -> Any:
    """Value in terms that JSON knows: arrays become lists, paths text, NaN and infinity null (JSON has neither)."""
    if isinstance(value, dict):
        return {str(key): to_json(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # numpy's; commands that only print their help do not load it
        return to_json(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
