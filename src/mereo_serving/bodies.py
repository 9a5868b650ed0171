"""Bodies of requests, as they come, into files of our own names: ``frame.ply``, ``mask.png``, ``intrinsics.json``.

A body is the frame itself, or ``multipart/form-data`` with the parts ``frame``, ``mask`` and ``intrinsics``. Of what a
client calls a file only a known suffix counts, as the format; no name of a client ever becomes a path.
"""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, BinaryIO

from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header

from mereo.io.readers import CLOUD_READERS, DEPTH_READERS
from mereo_serving.refusals import Refused

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

SUFFIXES = tuple(sorted({*CLOUD_READERS, *DEPTH_READERS}))
"""Suffixes of what can be a frame."""

MEDIA = {
    "image/png": ".png",
    "image/tiff": ".tif",
    "image/x-exr": ".exr",
    "image/aces": ".exr",
    "application/x-npy": ".npy",
    "application/x-npz": ".npz",
    "application/ply": ".ply",
    "application/x-ply": ".ply",
    "model/ply": ".ply",
    "text/csv": ".csv",
    "text/plain": ".xyz",
}
"""Suffix of each media type that names a format."""

MASKS, YAML = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"), (".yaml", ".yml")

logging.getLogger("python_multipart").setLevel(logging.CRITICAL + 1)  # it tells the log what the client is told

MOST_BOUNDARY = 70
"""Most characters of a boundary (RFC 2046)."""

MOST_HEADER = 8192
"""Most bytes of the headers of a part."""


@dataclass(frozen=True)
class Taken:
    """Names of the files that a body has become; None where there is none."""

    frame: str
    mask: str | None = None
    intrinsics: str | None = None


async def take(
    chunks: AsyncIterator[bytes], content_type: str, format: str | None, folder: Path, most: int, seconds: float
) -> Taken:
    """Write a body into a folder.

    Args:
        chunks: of the body.
        content_type: header of the request.
        format: suffix of the frame's format as the request states it, which counts before all else.
        folder: that exists.
        most: bytes of the body.
        seconds: in which it must have come.

    Raises ``Refused``: 400 for a body that is no such form, 408 for one that does not come, 413 for one that is too
    large, 415 for an unknown format and 422 for parts that are missing or unknown.
    """
    kind, options = header_options(content_type)
    stated = suffix_of(f"frame.{format.removeprefix('.')}") if format else ""
    if format and not stated:
        raise unknown(f"format is {format[:60]!a}")
    with ExitStack() as files:
        if kind == "multipart/form-data":
            if not (boundary := options.get("boundary")):
                raise Refused(400, "the form has no boundary; its Content-Type must state one: let a library make it")
            if len(boundary) > MOST_BOUNDARY:
                raise Refused(
                    400,
                    f"the form's boundary has {len(boundary)} characters; at most {MOST_BOUNDARY} are allowed: let a "
                    "library make it",
                )
            parts: _Parts | _Whole = _Parts(folder, stated, boundary.encode("latin-1"), files)
        else:
            suffix = stated or MEDIA.get(kind, "")
            if not suffix:
                raise unknown(f"the Content-Type is {kind[:60]!a}" if kind else "there is no Content-Type")
            parts = _Whole(folder, suffix, files)
        try:
            async with asyncio.timeout(seconds):
                count = 0
                async for chunk in chunks:
                    count += len(chunk)
                    if count > most:
                        raise too_large(most)
                    parts.write(chunk)
        except TimeoutError:
            raise Refused(
                408, f"the body has not come within {seconds:g} s; send it faster, or a smaller frame"
            ) from None
        except MultipartParseError as error:
            raise Refused(400, f"the form cannot be read ({error}): let a library make it") from None
        return parts.taken()


def header_options(text: str) -> tuple[str, dict[str, str]]:
    """Value and options of a header such as Content-Type, all latin-1; raises ``Refused`` (400) for nonsense."""
    try:
        value, options = parse_options_header(text)
    except (ValueError, LookupError, TypeError):  # what the parser of mail, which is behind it, makes of it
        raise Refused(400, f"the header {text[:60]!a} cannot be read: let a library make it") from None
    read = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in options.items()}
    return value.decode("latin-1").lower(), read


def too_large(most: int) -> Refused:
    """Refusal of a body."""
    return Refused(413, f"the body has more than {most / 1e6:g} MB, the most that is taken: crop or thin out the frame")


def unknown(what: str) -> Refused:
    """Refusal of a format."""
    known = ", ".join(SUFFIXES)
    return Refused(415, f"{what}; a frame is one of {known}: name it in the address, as in ?format=ply")


def suffix_of(name: str) -> str:
    """Suffix by which a frame is read, of whatever name; "" where it is none."""
    suffix = PurePosixPath(name.replace("\\", "/")).suffix.lower()
    return suffix if suffix in SUFFIXES else ""


class _Whole:
    """Body that is the frame itself."""

    def __init__(self, folder: Path, suffix: str, files: ExitStack) -> None:
        self._name = f"frame{suffix}"
        self._file: BinaryIO = files.enter_context((folder / self._name).open("xb"))

    def write(self, chunk: bytes) -> None:
        self._file.write(chunk)

    def taken(self) -> Taken:
        self._file.flush()
        return Taken(self._name)


@dataclass
class _Part:
    """Headers of a part, as they come."""

    names: list[bytearray] = field(default_factory=list)
    values: list[bytearray] = field(default_factory=list)
    size: int = 0

    def headers(self) -> dict[str, str]:
        return {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in zip(self.names, self.values, strict=True)
        }


class _Parts:
    """Form whose parts are written as they come."""

    def __init__(self, folder: Path, stated: str, boundary: bytes, files: ExitStack) -> None:
        self._folder, self._stated, self._files = folder, stated, files
        self._part, self._file, self._ended = _Part(), None, False
        self._parts: dict[str, str] = {}
        self._open: list[BinaryIO] = []
        callbacks: "MultipartCallbacks" = {
            "on_part_begin": self._begin,
            "on_header_begin": self._next_header,
            "on_header_field": self._header_field,
            "on_header_value": self._header_value,
            "on_headers_finished": self._place,
            "on_part_data": self._data,
            "on_end": self._end,
        }
        self._parser = MultipartParser(boundary, callbacks)

    def write(self, chunk: bytes) -> None:
        self._parser.write(chunk)

    def taken(self) -> Taken:
        if not self._ended:
            raise Refused(400, "the form is cut off before its last boundary: send it whole")
        if "frame" not in self._parts:
            raise Refused(422, "the form has no part 'frame'; it holds the depth image or point cloud: add it")
        for file in self._open:
            file.flush()
        return Taken(self._parts["frame"], self._parts.get("mask"), self._parts.get("intrinsics"))

    def _begin(self) -> None:
        self._part = _Part()

    def _next_header(self) -> None:
        self._part.names.append(bytearray())
        self._part.values.append(bytearray())

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._header(self._part.names, data[start:end])

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._header(self._part.values, data[start:end])

    def _data(self, data: bytes, start: int, end: int) -> None:
        self._open[-1].write(data[start:end])

    def _header(self, texts: list[bytearray], piece: bytes) -> None:
        self._part.size += len(piece)
        if self._part.size > MOST_HEADER:
            raise Refused(
                400, f"a part of the form has more than {MOST_HEADER} bytes of headers: let a library make it"
            )
        texts[-1] += piece

    def _place(self) -> None:
        """Open the file of a part, now that its headers are known."""
        headers = self._part.headers()
        _, options = header_options(headers.get("content-disposition", ""))
        part = options.get("name", "")
        if part not in ("frame", "mask", "intrinsics"):
            raise Refused(
                422, f"the form has a part {part[:60]!a}; its parts are frame, mask, intrinsics: leave it out"
            )
        if part in self._parts:
            raise Refused(422, f"the form has two parts {part!r}; each comes once: leave one out")
        given = options.get("filename", "")
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        name = f"{part}{self._suffix(part, given, kind)}"
        self._parts[part] = name
        self._open.append(self._files.enter_context((self._folder / name).open("xb")))

    def _suffix(self, part: str, given: str, kind: str) -> str:
        end = PurePosixPath(given.replace("\\", "/")).suffix.lower()
        if part == "mask":
            return end if end in MASKS else ".png"
        if part == "intrinsics":
            return ".yaml" if end in YAML or kind.endswith("yaml") else ".json"
        suffix = self._stated or suffix_of(given) or MEDIA.get(kind, "")
        if not suffix:
            raise unknown(f"the part 'frame' has the Content-Type {kind[:60]!a} and no file name of a known format")
        return suffix

    def _end(self) -> None:
        self._ended = True
