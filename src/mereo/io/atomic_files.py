"""Files that appear whole or not at all, and values as JSON.

Everything is first written in a scratch folder beside its destination and renamed at the end, so that a reader never
sees half a file and an error, Ctrl-C or a full disk leaves nothing behind.
"""

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mereo.io.scratch_folders import check_place, remove_abandoned, scratch_folder


@contextmanager
def atomic_file(path: str | Path, *, force: bool = True, inputs: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Yield a path of the same name in a scratch folder; rename it to ``path`` when the block succeeds.

    Args:
        path: the destination; missing parent directories are made (and removed again if the block fails).
        force: replace an existing file.
        inputs: files and folders that are read, which are never replaced.

    Raises:
        ValueError: ``path`` is a link, a device or no usable name.
        FileExistsError: ``path`` exists and ``force`` is false, also where it came while the block ran; or it is a
            directory, or one of the inputs.
        OSError: the disk is full, or the place cannot be written to.
    """
    path = Path(path)
    check_file_place(path, force=force, inputs=inputs)
    with scratch_folder(path) as scratch:
        partial = scratch / path.name
        yield partial
        if force:
            os.replace(partial, path)
        else:
            _place_new(partial, path)


EXISTS = "exists; it is not overwritten: choose another name or pass --force"


def check_file_place(path: str | Path | None, *, force: bool = True, inputs: Iterable[str | Path] = ()) -> None:
    """Raise as ``atomic_file`` does for a place where no file can be put: before the work, not after. None is none.

    What killed processes left for the file is removed, also where it is refused because it is whole.
    """
    if path is None:
        return
    path = Path(path)
    check_place(path)
    remove_abandoned(path)
    if path.is_dir():
        raise FileExistsError(f"{path} is a directory; a file is written there: choose another name")
    if path.exists() and not force:
        raise FileExistsError(f"{path} {EXISTS}")
    if path.exists() and any(_holds(Path(place), path) for place in inputs):
        raise FileExistsError(
            f"{path} is read by this command; it is not replaced, not even by --force: choose another name"
        )


def _holds(place: Path, path: Path) -> bool:
    """Whether ``path``, which exists, is the file ``place`` by whatever name, or lies in the folder ``place``."""
    if place.is_dir():
        return path.resolve().is_relative_to(place.resolve())
    return place.exists() and path.samefile(place)


def _place_new(partial: Path, path: Path) -> None:
    """Give a file its name if nothing has that by now, which a link does in one step and a rename on POSIX does not."""
    try:
        os.link(partial, path)
    except FileExistsError:
        raise FileExistsError(f"{path} {EXISTS}") from None
    except OSError:  # a file system without hard links
        if path.exists():
            raise FileExistsError(f"{path} {EXISTS}") from None
        os.rename(partial, path)


def write_json(path: str | Path, value: Any, *, force: bool = True) -> None:
    """Write ``to_json`` of a value, indented, whole or not at all; ``force`` as in ``atomic_file``."""
    with atomic_file(path, force=force) as partial:
        partial.write_text(json_text(value), "utf-8")


def json_text(value: Any) -> str:
    """Text of ``to_json`` of a value as files have it, indented, with a line's end at its end."""
    return json.dumps(to_json(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


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
