"""Folders of datasets, local or in an object storage (by fsspec), and their files, whole or not at all.

    s3://BUCKET/FOLDER   S3, or whatever speaks it at AWS_ENDPOINT_URL: s3fs, the extra `storage`
    gs://BUCKET/FOLDER   Google Cloud Storage: gcsfs, the extra `gcs`
    memory://FOLDER      this process's memory, for tests

A put of an object is atomic: others see all of it, or what was there before. Credentials are whatever these libraries
find by themselves (environment, profile, role of the machine); none is taken from a URL, and none is ever printed.
"""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from mereo.io.atomic_files import atomic_file, claim_directory, json_text, read_settings

LIBRARIES = {"s3": ("s3fs", "storage"), "gs": ("gcsfs", "gcs"), "memory": ("fsspec", "storage")}
"""Library of each protocol, and the extra that has it."""

URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.*)", re.DOTALL)
"""Text that names a place by a URL; one letter is a drive of Windows."""

TIMEOUTS = {"connect_timeout": 3, "read_timeout": 15, "retries": {"total_max_attempts": 2, "mode": "standard"}}
"""What S3 is given, in seconds, so that a wrong address is known in ten."""


class StorageError(OSError):
    """Refusal of a storage, or none to be reached; its text is a whole sentence. Nothing is known of the object."""


@dataclass(frozen=True, order=True)
class ObjectPath:
    """Object, or what lies below its name as if in a folder; it has those methods of ``Path`` that datasets need.

    Attributes:
        url: protocol://BUCKET/NAME, without a slash at the end.

    Raises ``ValueError`` for a URL that is none, or none of these storages. Every method raises ``ImportError`` without
    the protocol's library and ``StorageError`` where the storage refuses or cannot be reached.
    """

    url: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "url", _checked(self.url))

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> "ObjectPath":
        return ObjectPath(f"{self.url}/{name}")

    @property
    def name(self) -> str:
        """Last part of the name."""
        return self.url.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """Last part of the name without its suffix."""
        return self.name.rpartition(".")[0] or self.name

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

    def exists(self) -> bool:
        """Whether there is this object; folders are none."""
        try:
            with self._system() as system:
                return bool(system.info(self.url)["type"] == "file")  # isfile takes a lost network for a no
        except FileNotFoundError:
            return False

    is_file = exists

    def read_bytes(self) -> bytes:
        """Content of the object; ``FileNotFoundError`` where there is none."""
        with self._system() as system:
            content: bytes = system.cat_file(self.url)
            return content

    def read_text(self, encoding: str) -> str:
        """Content of the object as text; raises as ``read_bytes`` does, and ``UnicodeDecodeError``."""
        return self.read_bytes().decode(encoding)

    def write_bytes(self, content: bytes, *, force: bool = True) -> None:
        """Put the object; without ``force`` only if there is none of its name, else ``FileExistsError``.

        A storage that does not know this condition (If-None-Match) puts it all the same: read back whose it is.
        """
        with self._system() as system:
            system.pipe_file(self.url, content, mode="overwrite" if force else "create")

    @contextmanager
    def _system(self) -> Iterator[Any]:
        """The protocol's file system, whose errors become one sentence."""
        protocol, bucket = self.url.split("://")[0], self.url.split("/")[2]
        library, extra = LIBRARIES[protocol]
        try:
            fsspec = import_module("fsspec")
            import_module(library)
        except ImportError:
            raise ImportError(f"{library} is needed for {protocol}:// places: pip install 'mereo[{extra}]'") from None
        try:
            given = import_module("fsspec.config").conf.get("s3", {}).get("config_kwargs", {})
            options = {"use_listings_cache": False, "max_concurrency": 1, "config_kwargs": TIMEOUTS | given}
            system = fsspec.filesystem(protocol, **(options if protocol == "s3" else {}))
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


def place_of(given: str | Path | ObjectPath) -> Place:
    """Place that a text means: with a protocol a folder of a storage, without one, or with file://, a local one.

    Raises ``ValueError`` for a URL that is none.
    """
    if not isinstance(given, str):
        return given
    match = URL.fullmatch(given)
    if match is None:
        return Path(given)
    if match[1].lower() != "file":
        return ObjectPath(given)
    parts = urlsplit(given)
    if parts.netloc not in ("", "localhost"):
        raise ValueError(f"{given} names another machine; a file URL has three slashes: write file:///absolute/folder")
    return Path(unquote(parts.path))


def _checked(url: str) -> str:
    """URL without slashes at its end; ``ValueError`` for one that cannot be meant."""
    match = URL.fullmatch(url)
    protocol, rest = (match[1].lower(), match[2].rstrip("/")) if match else ("", "")
    bucket, _, name = rest.partition("/")
    shown = f"{protocol or 'a URL'}://...@..." if "@" in bucket else ascii(url)[1:-1][:100]
    if "@" in bucket:
        raise ValueError(f"{shown} has credentials in it: set them in the environment or a profile, as AWS_PROFILE")
    if protocol not in LIBRARIES:
        raise ValueError(f"{shown} has none of the protocols s3, gs and file: correct it, or name a local folder")
    parts = rest.split("/")
    if not (name or (bucket and protocol == "memory")) or set(rest) & set("?#*[]\\") or {"", ".", ".."} & set(parts):
        raise ValueError(f"{shown} names no folder in a bucket, which is needed: write for example s3://bucket/data")
    if not rest.isprintable() or len(rest.encode(errors="replace")) > 900:
        raise ValueError(f"{shown} is no name that a storage takes: choose a shorter one, of letters and digits")
    return f"{protocol}://{rest}"


# --- files of a dataset -----------------------------------------------------------------------------------------------


def names_in(folder: Place) -> list[str]:
    """Names of what lies in a folder, sorted, but for hidden files; none where it does not exist.

    Raises as the file system or the storage does.
    """
    if isinstance(folder, ObjectPath):
        return folder.names()
    return sorted(file.name for file in folder.iterdir() if not file.name.startswith(".")) if folder.is_dir() else []


def write_whole(place: Place, content: bytes) -> str:
    """Write a file, whole or not at all, also where the machine loses its power; its SHA-256 is returned.

    Raises as ``atomic_file`` does, or ``StorageError``.
    """
    if isinstance(place, ObjectPath):
        place.write_bytes(content)
    else:
        with atomic_file(place) as partial:
            partial.write_bytes(content)
            with partial.open("rb+") as file:
                os.fsync(file.fileno())  # NFS tells of a full disk here, and a name comes after its content
    return sha256(content)


def sha256(content: bytes) -> str:
    """Digest of a file, as ``sha256sum`` prints it."""
    return hashlib.sha256(content).hexdigest()


def claim(folder: Place, name: str, settings: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Settings that a place of earlier work holds, or None where it was made with ``settings`` just now.

    As ``claim_directory``, for local folders and for those of a storage, where of several that come at a time one puts
    its file and the others read that.
    """
    if isinstance(folder, Path):
        return claim_directory(folder, name, settings, kind)
    path, names = folder / name, folder.names()
    if name in names:
        return read_settings(path)
    if any(not file.startswith(".") for file in names):
        raise FileExistsError(f"{folder} is not empty and holds no {name}; choose another --output")
    content = json_text(settings).encode()
    try:
        path.write_bytes(content, force=False)
    except FileExistsError:  # another process came first
        return read_settings(path)
    stored = read_settings(path)  # a storage without conditional puts took both, and keeps the last
    return None if json_text(stored).encode() == content else stored
