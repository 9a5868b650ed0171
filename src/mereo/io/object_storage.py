"""Objects of an object storage in the place of files: the few things that a dataset does with them, by fsspec.

    s3://BUCKET/FOLDER   S3, or whatever speaks it at AWS_ENDPOINT_URL: s3fs, the extra `storage`
    gs://BUCKET/FOLDER   Google Cloud Storage: gcsfs, the extra `gcs`
    memory://FOLDER      this process's memory, for tests

A put of an object is atomic: others see all of it, or what was there before. Credentials are whatever these libraries
find by themselves (environment, profile, role of the machine); none is taken from a URL, and none is ever printed.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import url2pathname

LIBRARIES = {"s3": ("s3fs", "storage"), "gs": ("gcsfs", "gcs"), "memory": ("fsspec", "storage")}
"""Library of each protocol, and the extra that has it."""

URL = re.compile(r"(?P<protocol>[A-Za-z][A-Za-z0-9+.-]+)://(?P<rest>.*)", re.DOTALL)
"""Text that names a place by a URL; one letter is a drive of Windows."""

MOST_BYTES = 900
"""Length of a folder's name in bytes that leaves room for its files' in the 1,024 that storages allow."""

CONNECT_S, READ_S, ATTEMPTS = 3, 15, 2
"""Seconds until a server must be there, and answer or go on, and attempts: a wrong address is known in ten seconds."""

MISSING_BUCKET = ("NoSuchBucket", "InvalidBucketName")
REFUSED = ("AccessDenied", "403", "Forbidden", "InvalidAccessKeyId", "SignatureDoesNotMatch", "ExpiredToken")
EXISTS = ("PreconditionFailed", "412", "ConditionalRequestConflict")
"""Codes of S3."""

LOG_IN = {
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, or give this machine a role",
    "gs": "log in with `gcloud auth application-default login`, or set GOOGLE_APPLICATION_CREDENTIALS",
}
"""What makes credentials known, of each protocol."""


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
        own = self.url.partition("://")[2] + "/"
        try:
            with self._explained("listed"):
                system = self._system()
                system.invalidate_cache()
                found = system.ls(self.url, detail=False)
        except FileNotFoundError:
            return []
        # an object of the folder's own name is no content of it
        return sorted({place.strip("/").removeprefix(own) for place in found if place.strip("/").startswith(own)})

    def exists(self) -> bool:
        """Whether there is this object; folders are none."""
        try:
            with self._explained("read"):
                return bool(self._system().info(self.url)["type"] == "file")  # isfile takes a lost network for a no
        except FileNotFoundError:
            return False

    is_file = exists

    def read_bytes(self) -> bytes:
        """Content of the object; ``FileNotFoundError`` where there is none."""
        with self._explained("read"):
            content: bytes = self._system().cat_file(self.url)
            return content

    def read_text(self, encoding: str) -> str:
        """Content of the object as text; raises as ``read_bytes`` does, and ``UnicodeDecodeError``."""
        return self.read_bytes().decode(encoding)

    def write_bytes(self, content: bytes) -> None:
        """Put the object, in the place of what has its name."""
        with self._explained("written"):
            self._system().pipe_file(self.url, content)

    def write_new(self, content: bytes) -> None:
        """Put the object if there is none of its name, which storages decide in one step; else ``FileExistsError``.

        A storage that does not know the condition (If-None-Match) puts it all the same: read back whose it is.
        """
        with self._explained("written"):
            self._system().pipe_file(self.url, content, mode="create")

    # --- the library --------------------------------------------------------------------------------------------------

    @property
    def _protocol(self) -> str:
        return self.url.partition(":")[0]

    def _system(self) -> Any:
        library, extra = LIBRARIES[self._protocol]
        try:
            fsspec = import_module("fsspec")
            import_module(library)
        except ImportError:
            raise ImportError(
                f"{library} is needed for {self._protocol}:// places: pip install 'mereo[{extra}]'"
            ) from None
        if self._protocol != "s3":
            return fsspec.filesystem(self._protocol)
        given = import_module("fsspec.config").conf.get("s3", {}).get("config_kwargs", {})
        limits = {
            "connect_timeout": CONNECT_S,
            "read_timeout": READ_S,
            "retries": {"total_max_attempts": ATTEMPTS, "mode": "standard"},
        }
        # one request at a time asks for no sizes before; a shard is smaller than what would be divided
        system = fsspec.filesystem("s3", use_listings_cache=False, max_concurrency=1, config_kwargs=limits | given)
        system.retries = ATTEMPTS
        return system

    @contextmanager
    def _explained(self, done: str) -> Iterator[None]:
        """Say in one sentence what a storage has against it."""
        try:
            yield
        except (ImportError, StorageError, MemoryError):
            raise
        except Exception as error:
            raise self._sentence(error, done) from None

    def _sentence(self, error: Exception, done: str) -> Exception:
        from mereo.io.errors import reason  # loads numpy, which `mereo --help` can do without

        code, bucket = _code(error), self.url.split("/")[2]
        kind, why = type(error).__name__, re.sub(r"//[^/@\s]*@", "//...@", reason(error))
        absent = isinstance(error, FileNotFoundError)
        if code in MISSING_BUCKET or (absent and done == "written"):
            return StorageError(f"{self} cannot be {done}: there is no bucket {bucket!r}; make it, or correct the URL")
        if code in EXISTS or isinstance(error, FileExistsError):
            return FileExistsError(f"{self} exists; it is not overwritten: choose another name")
        if absent:
            return FileNotFoundError(f"{self} does not exist: check the URL")
        if "Credential" in kind:
            cure = LOG_IN.get(self._protocol, "log in")
            return StorageError(f"{self} cannot be {done}: no credentials were found ({kind}); {cure}")
        if code in REFUSED or isinstance(error, PermissionError) or why.startswith("Forbidden"):
            return StorageError(
                f"{self} cannot be {done}: the storage refuses the credentials that it was given "
                f"({code or kind}); check them, and what they may do with the bucket {bucket!r}"
            )
        if code:
            return StorageError(f"{self} cannot be {done}: the storage says {why}; correct that and try again")
        settings = ", AWS_ENDPOINT_URL and AWS_PROFILE" if self._protocol == "s3" else ""
        return StorageError(
            f"{self} cannot be {done}: the storage cannot be reached ({why}); check the network{settings}, then run "
            "the same command again"
        )


Place = Path | ObjectPath


def place_of(given: str | Path | ObjectPath) -> Place:
    """Place that a text means: with a protocol a folder of a storage, without one, or with file://, a local one.

    Raises ``ValueError`` for a URL that is none.
    """
    if not isinstance(given, str):
        return given
    found = URL.fullmatch(given)
    if found is None:
        return Path(given)
    if found["protocol"].lower() == "file":
        parts = urlsplit(given)
        if parts.netloc not in ("", "localhost"):
            raise ValueError(
                f"{given} names another machine; a file URL has three slashes: write file:///absolute/folder"
            )
        return Path(url2pathname(parts.path) if os.name == "nt" else unquote(parts.path))
    return ObjectPath(given)


def _code(error: BaseException | None) -> str:
    """Code of S3's answer that an error, or what it comes from, carries; empty where none answered."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            return str(response.get("Error", {}).get("Code", ""))
        error = error.__cause__
    return ""


def _checked(url: str) -> str:
    """URL without slashes at its end; ``ValueError`` for one that cannot be meant."""
    found = URL.fullmatch(url)
    if found is None or found["protocol"].lower() not in LIBRARIES:
        protocol = "none" if found is None else repr(found["protocol"])
        raise ValueError(
            f"{_shown(url)} has the protocol {protocol}; it must be s3, gs or file: correct it, or name a local folder"
        )
    rest = found["rest"].rstrip("/")
    parts = rest.split("/")
    if "@" in parts[0]:
        raise ValueError(
            f"the URL {found['protocol']}://...@{_shown(parts[0].rpartition('@')[2])} has credentials in it; they do "
            "not belong there: set them in the environment or a profile, as AWS_PROFILE does"
        )
    if len(parts) < (1 if found["protocol"].lower() == "memory" else 2) or not rest:
        raise ValueError(
            f"{_shown(url)} names no folder in a bucket, which is needed: write for example s3://bucket/data"
        )
    if any(part in ("", ".", "..") for part in parts) or not rest.isprintable() or set(rest) & set("?#*[]\\"):
        raise ValueError(
            f"{_shown(url)} has a part that no folder of a storage should have (empty, '.', '..', or one of ?#*[]\\): "
            "choose another name"
        )
    if len(rest.encode(errors="replace")) > MOST_BYTES:
        raise ValueError(
            f"{_shown(url)} has more than {MOST_BYTES} bytes, which leaves none for files: choose a shorter name"
        )
    return f"{found['protocol'].lower()}://{rest}"


def _shown(url: str) -> str:
    text = url if url.isprintable() else ascii(url)[1:-1]
    return text if len(text) <= 100 else f"{text[:100]}..."
