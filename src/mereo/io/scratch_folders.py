"""Scratch folders beside an output, in which it is made before it is renamed; those of killed processes are removed.

``.NAME.1a2b3c4d.partial`` holds a file that its process keeps locked, so that another one can tell whether that process
still lives, and that it was mereo's at all. The system frees locks when a process dies, however it does.
"""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl

    LOCKS = True
except ImportError:  # Windows, where such folders stay until their user deletes them
    LOCKS = False

LOCK = ".mereo-lock"
"""Name of the locked file in a scratch folder."""

ASIDE = ".mereo-old"
"""Name under which an output that is being replaced waits there; whoever put it there takes it out again."""

REMOVED = ".mereo-removed"
"""Name of such an output from when its files are being removed: it may lack some, so it is never put back."""

PROTOCOL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
"""First part of what a path makes of a URL."""

MOST_BYTES = 255 - len("..1a2b3c4d.partial")
"""Length of a name in bytes that leaves room for that of its scratch folder on every usual file system."""


def check_place(path: Path, may_be_link: bool = False) -> None:
    """Raise ``ValueError`` for what cannot be replaced by renaming: links, devices, and names that are none.

    With ``may_be_link`` a link to a directory will do.
    """
    try:
        longest = max(path.parts, key=lambda part: len(part.encode()), default="")
    except UnicodeEncodeError:
        raise ValueError(f"the output {str(path)!r} has bytes that are no UTF-8 text: choose another name") from None
    if "\0" in str(path):
        raise ValueError(f"the output {str(path)!r} has a zero byte, which no name may have: choose another name")
    if len(path.parts) > 1 and PROTOCOL.fullmatch(path.parts[0]) and not Path(path.parts[0]).exists():
        raise ValueError(
            f"the output {path.parts[0]}//{'/'.join(path.parts[1:])} is a URL, and a local path is needed here; only "
            "datasets go to an object storage: name a folder or file of this machine"
        )
    if path.name in ("", ".."):
        raise ValueError(f"the output '{path}' has no name of its own, which it needs: name it, as in {path / 'out'}")
    if len(longest.encode()) > MOST_BYTES:
        raise ValueError(
            f"the output has a name of {len(longest.encode())} bytes ({longest[:20]}...); at most {MOST_BYTES} can be "
            "written: choose a shorter one"
        )
    if path.is_symlink() and not (may_be_link and path.is_dir()):
        raise ValueError(f"{path} is a link, which would be lost; an output is written in its own place: name that")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"{path} is a device or pipe; an output is a file or folder: choose another --output")
    above = next((place for place in path.parents if place.exists()), path.parent)
    if above.exists() and not above.is_dir():
        raise ValueError(f"{above} is no folder, so {path.name} cannot be made in it: choose another --output")


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Yield a fresh folder beside ``path``, and remove it at the end, whatever happens; missing parents are made.

    Where the block fails (Ctrl-C too) the parents are removed again. What killed processes left here for ``path`` goes.

    Raises:
        OSError: the disk is full.
        PermissionError: the place cannot be written to.
    """
    made: list[Path] = []
    try:
        with _writable(path):
            made = _make_parents(path.parent)
            remove_abandoned(path)
            scratch, lock = _lock_new(path)
        try:
            yield scratch
        finally:
            os.close(lock)  # Windows removes no open file
            _remove(scratch)
    except BaseException as error:
        for directory in made:
            with suppress(OSError):  # another process may have written there meanwhile
                directory.rmdir()
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise _full_disk(path) from error
        raise


def _full_disk(path: Path) -> OSError:
    """Error whose text is the whole sentence: the command line adds a cure to texts of the operating system."""
    error = OSError(f"the disk is full while writing {path}: free space or choose another place")
    error.errno = errno.ENOSPC
    return error


@contextmanager
def _writable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        raise PermissionError(f"{path} cannot be written; its directory is read-only: choose another place") from error


def _make_parents(directory: Path) -> list[Path]:
    """Make ``directory``; the directories that were missing are returned, the deepest first."""
    missing = [place for place in (directory, *directory.parents) if not place.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    return missing


def _lock_new(path: Path) -> tuple[Path, int]:
    """A new scratch folder and the descriptor of its lock."""
    while True:
        scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        scratch.mkdir()
        # between these lines another process may have found it without a lock, or with one that nobody holds
        try:
            lock = os.open(scratch / LOCK, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        except FileNotFoundError:
            continue
        if _try_lock(lock) is not False and os.fstat(lock).st_nlink:
            return scratch, lock
        os.close(lock)


def _try_lock(descriptor: int) -> bool | None:
    """Whether the lock is ours now; False where another process holds it, None where there are no locks."""
    if not LOCKS:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # some network file systems
        return None
    return True


def abandoned(path: Path) -> Iterator[Path]:
    """Scratch folders for ``path`` whose processes are dead, each locked until the next one is asked for."""
    return (scratch for scratch, ours in _scratches(path) if ours)


def remove_abandoned(path: Path) -> None:
    """Remove what killed processes left for ``path``; an output that waits there to be put back stays."""
    for scratch in abandoned(path):
        _remove(scratch)


def remove_all_abandoned(directory: Path) -> None:
    """Remove what killed processes left for any file of a directory in which work is continued."""
    for scratch, ours in _scratches(directory / "any", ".+"):
        if ours:
            _remove(scratch)


def is_being_written(path: Path) -> bool:
    """Whether a process that lives, this one too, has a scratch folder for ``path``."""
    return any(ours is False for _, ours in _scratches(path))


def _scratches(path: Path, names: str = "") -> Iterator[tuple[Path, bool | None]]:
    """All scratch folders for ``path``, or beside it for ``names``, a pattern; with what ``_try_lock`` says of each."""
    name = re.compile(rf"\.(?:{names or re.escape(path.name)})\.[0-9a-f]{{8}}\.partial")
    found: list[Path] = []
    with suppress(OSError), os.scandir(path.parent) as entries:  # it may be missing, or be no one's to list
        found = [Path(entry) for entry in entries if name.fullmatch(entry.name) and not entry.is_symlink()]
    for scratch in found:
        try:
            lock = os.open(scratch / LOCK, os.O_RDWR)
        except OSError:  # not made by mereo, or by another user, or gone by now
            with suppress(OSError):  # where it is empty, a process was killed before it made the lock, or without it
                scratch.rmdir()
            continue
        try:
            yield scratch, _try_lock(lock)
        finally:
            os.close(lock)


def _remove(scratch: Path) -> None:
    """Remove a scratch folder, unless an output waits in it; the lock last, by which the next one knows it for ours."""
    if any((scratch / name).exists() for name in (ASIDE, REMOVED)):  # it may hold what is not ours
        return
    with suppress(OSError):  # the next one tries again
        for place in scratch.iterdir():
            if place.is_dir() and not place.is_symlink():
                shutil.rmtree(place, ignore_errors=True)
            elif place.name != LOCK:
                place.unlink()
        (scratch / LOCK).unlink()
        scratch.rmdir()
