"""Folders of datasets, local or in an object storage (by fsspec), and their files, whole or not at all.

    s3://BUCKET/FOLDER   S3, or whatever speaks it at AWS_ENDPOINT_URL: s3fs, the extra `storage`
    gs://BUCKET/FOLDER   Google Cloud Storage: gcsfs, the extra `gcs`
    memory://FOLDER      this process's memory, for tests

A put of an object is atomic. Credentials are whatever these libraries find by themselves (environment, profile, role of
the machine); none is taken from a URL, and none is ever printed.
"""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mereo.io.atomic_files import JsonObject, atomic_file, check_place, json_text, remove_abandoned, write_json
from mereo.io.errors import AnyPath, checked_path
from mereo.io.extras import library

LIBRARIES = {"s3": ("s3fs", "storage"), "gs": ("gcsfs", "gcs"), "memory": ("fsspec", "storage")}
"""Library of each protocol, and the extra that has it."""

TIMEOUTS = {"connect_timeout": 3, "read_timeout": 15, "retries": {"total_max_attempts": 2, "mode": "standard"}}
S3 = {"use_listings_cache": False, "max_concurrency": 1, "config_kwargs": TIMEOUTS}
"""What S3 is given, so that a wrong address is known in ten seconds."""


class StorageError(OSError):
    """Refusal of a storage, or none to be reached; its text is a whole sentence. Nothing is known of the object."""


@dataclass(frozen=True)
class ObjectPath:
    """Object, or what lies below its name as if in a folder; it has those methods of ``Path`` that datasets need.

    Attributes:
        url: protocol://BUCKET/NAME, without a slash at the end.

    Raises ``ValueError`` for a URL that is none, or none of these storages. Every method raises ``ImportError`` without
    the protocol's library and ``StorageError`` where the storage refuses or cannot be reached.
    """

    url: str

    def __post_init__(self) -> None:
        protocol, _, rest = self.url.partition("://")
        protocol = protocol.lower()
        parts = rest.rstrip("/").split("/")
        if "@" in parts[0]:
            raise ValueError(
                f"{protocol}://...@... has credentials in it: set them in the environment or a profile, as AWS_PROFILE"
            )
        has_folder = len(parts) > 1 or protocol == "memory"
        is_plain = rest.isprintable() and not set(rest) & set("?#*[]\\") and not {"", ".", ".."} & set(parts)
        if protocol not in LIBRARIES or not has_folder or not is_plain:
            raise ValueError(
                f"{ascii(self.url)[1:-1][:100]} names no folder of a storage, s3 or gs, which is needed: write for "
                "example s3://bucket/data, or name a local folder"
            )
        object.__setattr__(self, "url", f"{protocol}://{'/'.join(parts)}")

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> "ObjectPath":
        return ObjectPath(f"{self.url}/{name}")

    @property
    def name(self) -> str:
        """Last part of the name."""
        return self.url.rpartition("/")[2]

    def names(self) -> list[str]:
        """Names of the objects in this folder, sorted; none where there is nothing."""
        folder = self.url.partition("://")[2] + "/"
        try:
            with self._system() as system:
                system.invalidate_cache()
                keys = [key.strip("/") for key in system.ls(self.url, detail=False)]
        except FileNotFoundError:
            return []
        return sorted({key.removeprefix(folder) for key in keys if key.startswith(folder)})

    def is_file(self) -> bool:
        """Whether there is this object; folders are none."""
        try:
            with self._system() as system:
                return bool(system.info(self.url)["type"] == "file")  # isfile takes a lost network for a no
        except FileNotFoundError:
            return False

    def read_bytes(self) -> bytes:
        """Content of the object; ``FileNotFoundError`` where there is none."""
        with self._system() as system:
            return system.cat_file(self.url)

    def read_text(self, encoding: str) -> str:
        """Content of the object as text; raises as ``read_bytes`` does, and ``UnicodeDecodeError``."""
        return self.read_bytes().decode(encoding)

    def write_bytes(self, content: bytes, *, force: bool = True) -> None:
        """Put the object; without ``force`` only if there is none of its name, else ``FileExistsError``."""
        with self._system() as system:
            system.pipe_file(self.url, content, mode="overwrite" if force else "create")

    @contextmanager
    def _system(self) -> Iterator[Any]:
        """The protocol's file system, whose errors become one sentence."""
        protocol, bucket = self.url.split("://")[0], self.url.split("/")[2]
        name, extra = LIBRARIES[protocol]
        library(name, extra, self)
        fsspec = library("fsspec", extra, self)
        try:
            system = fsspec.filesystem(protocol, **(S3 if protocol == "s3" else {}))
            if protocol == "s3":
                system.retries = 2
            yield system
        except Exception as error:
            code = str(getattr(error.__cause__ or error, "response", ""))  # S3's answer
            if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in code:
                raise FileNotFoundError(f"{self} does not exist: check the URL") from None
            if isinstance(error, FileExistsError) or "PreconditionFailed" in code or "ConditionalRequest" in code:
                raise FileExistsError(f"{self} exists; it is not overwritten: choose another name") from None
            why = re.sub(r"//[^/@\s]*@", "//...@", " ".join(str(error).split()))[:300] or type(error).__name__
            raise StorageError(
                f"{self} cannot be used ({why}): check the bucket {bucket!r}, your credentials for it and the network"
            ) from None


Place = Path | ObjectPath


def place_of(given: AnyPath | ObjectPath) -> Place:
    """Place that a text means: with a protocol a folder of a storage (raises as ``ObjectPath``), else a local one."""
    if not isinstance(given, str):
        return given if isinstance(given, ObjectPath) else checked_path(given, "the folder")
    # one letter is a drive of Windows
    return ObjectPath(given) if re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", given) else Path(given)


def names_in(folder: Place) -> list[str]:
    """Names of what lies in a folder, sorted, but for hidden files; none where it does not exist."""
    if isinstance(folder, ObjectPath):
        return folder.names()
    return sorted(file.name for file in folder.iterdir() if not file.name.startswith(".")) if folder.is_dir() else []


def write_whole(place: Place, content: bytes) -> None:
    """Write a file, whole or not at all, also where the machine loses its power; raises as the place does."""
    if isinstance(place, ObjectPath):
        place.write_bytes(content)
        return
    with atomic_file(place) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # NFS tells of a full disk here, and a name comes after its content


def claim(folder: Place, name: str, settings: JsonObject, kind: str) -> JsonObject | None:
    """Settings that a place of earlier work holds, or None where it was made with ``settings`` just now.

    Of several processes or machines that come at a time one puts its file and the others read that. Hidden files do not
    count, and what killed processes left is removed. A local place may be a link to a directory.

    Args:
        folder: where work is done that may be stopped and continued; made when it is missing.
        name: of the JSON file in it that says what the work is.
        settings: what that file says of a new folder.
        kind: of the folder, for messages: "a dataset".

    Raises ``FileExistsError`` for a file, or a folder that holds something but no such file, and ``ValueError`` where
    that holds no settings.
    """
    path = folder / name
    content = json_text(settings)
    if isinstance(folder, Path):
        check_place(folder, may_be_link=True)
        if folder.exists() and not folder.is_dir():
            raise FileExistsError(f"{folder} is a file; {kind} is a directory: choose another --output")
        remove_abandoned(folder)
    names = names_in(folder)
    if name in names:
        return _settings(path)
    if names:
        raise FileExistsError(f"{folder} is not empty and holds no {name}; choose another --output")
    try:
        if isinstance(path, Path):
            write_json(path, settings, force=False)
        else:
            path.write_bytes(content.encode(), force=False)
    except FileExistsError:  # another process came first
        return _settings(path)
    stored = _settings(path)  # a storage without conditional puts took both, and keeps the last
    return None if json_text(stored) == content else stored


def _settings(path: Place) -> JsonObject:
    try:
        settings = json.loads(path.read_text("utf-8"))
    except ValueError:
        settings = None
    if not isinstance(settings, dict):
        raise ValueError(f"{path} holds no settings; what it belongs to cannot be continued: choose another --output")
    return settings
