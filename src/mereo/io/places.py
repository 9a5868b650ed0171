"""Places of datasets: local folders, or folders of an object storage, and the files in them, whole or not at all."""

import os
from pathlib import Path
from typing import Any

from mereo.io.atomic_files import atomic_file, json_text
from mereo.io.object_storage import ObjectPath, Place
from mereo.io.output_folders import claim_directory, read_settings


def names_in(folder: Place) -> list[str]:
    """Names of what lies in a folder, sorted, but for hidden files; none where it does not exist.

    Raises as the file system or the storage does.
    """
    if isinstance(folder, ObjectPath):
        return folder.names()
    return sorted(file.name for file in folder.iterdir() if not file.name.startswith(".")) if folder.is_dir() else []


def write_whole(place: Place, content: bytes) -> None:
    """Write a file, whole or not at all, also where the machine loses its power.

    Raises as ``atomic_file`` does, or ``StorageError``.
    """
    if isinstance(place, ObjectPath):
        place.write_bytes(content)
    else:
        with atomic_file(place) as partial:
            partial.write_bytes(content)
            with partial.open("rb+") as file:
                os.fsync(file.fileno())  # NFS tells of a full disk here, and a name comes after its content


def claim(folder: Place, name: str, settings: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Settings that a place of earlier work holds, or None where it was made with ``settings`` just now.

    As ``claim_directory``, for local folders and for those of a storage, where of several that come at a time one puts
    its file and the others find that.
    """
    if isinstance(folder, Path):
        return claim_directory(folder, name, settings, kind)
    path, there = folder / name, folder.names()
    if name in there:
        return read_settings(path)
    if any(not file.startswith(".") for file in there):
        raise FileExistsError(f"{folder} is not empty and holds no {name}; choose another --output")
    content = json_text(settings).encode()
    try:
        path.write_bytes(content, force=False)
    except FileExistsError:  # another process came first
        return read_settings(path)
    found = read_settings(path)  # a storage without conditional puts took both, and keeps the last
    return None if json_text(found).encode() == content else found
