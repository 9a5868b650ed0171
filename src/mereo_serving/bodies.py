"""Bodies of requests, as they come, into files of our own names: ``frame.ply``, ``mask.png``, ``intrinsics.json``.

A body is the frame itself, or ``multipart/form-data`` with the parts ``frame``, ``mask`` and ``intrinsics``. Of what a
client calls a file only a known suffix counts, as the format; no name of a client ever becomes a path.
"""

import asyncio
import logging
import shutil
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from mereo.io.readers import CLOUD_READERS, DEPTH_READERS
from mereo_serving.messages import Refused

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

PARTS = ("frame", "mask", "intrinsics")

logging.getLogger("python_multipart").setLevel(logging.CRITICAL + 1)  # it writes to the log what the client reads


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
    kind = content_type.partition(";")[0].strip().lower()
    stated = suffix_of(f"frame.{format.removeprefix('.')}") if format else ""
    if format and not stated:
        raise unknown(f"format is {format[:60]!a}")
    try:
        async with asyncio.timeout(seconds), aclosing(_counted(chunks, most)) as counted:
            if kind == "multipart/form-data":
                return await _take_form(counted, content_type, stated, folder)
            suffix = stated or MEDIA.get(kind, "")
            if not suffix:
                raise unknown(f"the Content-Type is {kind[:60]!a}" if kind else "there is no Content-Type")
            with (folder / f"frame{suffix}").open("xb") as file:
                async for chunk in counted:
                    file.write(chunk)
            return Taken(f"frame{suffix}")
    except TimeoutError:
        raise Refused(408, f"the body has not come within {seconds:g} s; send it faster, or a smaller frame") from None


async def _counted(chunks: AsyncIterator[bytes], most: int) -> AsyncGenerator[bytes, None]:
    count = 0
    async for chunk in chunks:
        count += len(chunk)
        if count > most:
            raise too_large(most)
        yield chunk


class _Form(MultiPartParser):
    is_whole = False

    def on_end(self) -> None:
        self.is_whole = True


async def _take_form(chunks: AsyncGenerator[bytes, None], content_type: str, stated: str, folder: Path) -> Taken:
    async def all_of_it() -> AsyncGenerator[bytes, None]:
        async for chunk in chunks:
            yield chunk
        if not form.is_whole:
            raise Refused(400, "the form is cut off before its last boundary: send it whole")

    form = _Form(Headers({"content-type": content_type}), all_of_it(), max_files=8, max_fields=8)
    names = dict[str, str]()
    try:
        parts = await form.parse()
    except (MultiPartException, ValueError, LookupError, TypeError) as error:  # what mail's parser makes of headers
        raise Refused(400, f"the form cannot be read ({' '.join(str(error).split())}): let a library make it") from None
    try:
        for part, content in parts.multi_items():
            if part not in PARTS:
                raise Refused(422, f"the form has a part {part[:60]!a}; its parts are {', '.join(PARTS)}: leave it out")
            if part in names:
                raise Refused(422, f"the form has two parts {part!r}; each comes once: leave one out")
            names[part] = f"{part}{_suffix(part, content, stated)}"
            with (folder / names[part]).open("xb") as file:
                if isinstance(content, UploadFile):
                    shutil.copyfileobj(content.file, file)
                else:
                    file.write(content.encode())
    finally:
        await parts.close()
    if "frame" not in names:
        raise Refused(422, "the form has no part 'frame'; it holds the depth image or point cloud: add it")
    return Taken(**names)


def _suffix(part: str, content: UploadFile | str, stated: str) -> str:
    if isinstance(content, str):
        if part == "intrinsics":
            return ".json"
        raise Refused(415, f"the part {part!r} is text without a file name: send it as a file")
    given = content.filename or ""
    kind = (content.content_type or "").partition(";")[0].strip().lower()
    end = PurePosixPath(given.replace("\\", "/")).suffix.lower()
    if part == "mask":
        return end if end in MASKS else ".png"
    if part == "intrinsics":
        return ".yaml" if end in YAML or kind.endswith("yaml") else ".json"
    if suffix := stated or suffix_of(given) or MEDIA.get(kind, ""):
        return suffix
    raise unknown(f"the part 'frame' has the Content-Type {kind[:60]!a} and no file name of a known format")


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
