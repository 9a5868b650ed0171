"""Damage to files: bytes, numbers and lines that change, and the same inside of what is packed or has checksums.

All is drawn from a ``random.Random``, so that a seed gives the same damage on every machine.
"""

import gzip
import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

ODD_NUMBERS = (
    *(b"-1", b"0", b"1", b"2", b"255", b"65536", b"2147483647", b"2147483648", b"4294967295", b"-2147483648"),
    *(b"9223372036854775807", b"18446744073709551616", b"1" + b"0" * 40, b"1e308", b"1e999", b"-1e999", b"5e-324"),
    *(b"nan", b"inf", b"-inf", b"0x10", b"1_0", b"", b"3.5", b"-0", b"1e5", b"NaN", b"1,5"),
)
ODD_BYTES = (
    *(b"\0", b"\xff", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80"),
    *(struct.pack("<f", math.nan), struct.pack("<f", math.inf), struct.pack("<d", math.nan), b"\xff" * 8),
    *(struct.pack("<d", 1e300), struct.pack("<q", -1), struct.pack("<q", 1 << 40), struct.pack(">I", 1 << 30)),
)
ODD_WORDS = (
    *(b"", b"\n", b"\r", b"\xef\xbb\xbf", b"\x1b[31m", b"'", b'"', b"{", b"[", b"]", b"}", b":", b"-", b"&a", b"*a"),
    *(b"!!binary ", b"..", b"/", b"\0", b"\xed\xa0\x80", "\u2028".encode(), b"%s", b"true", b"null", b"~", b"#", b","),
)
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 255, 2**31, -(2**31), 2**63, 10**30, 0.5, -0.0, 1e308, math.nan, math.inf),
    *("", "a", "\n", "\x1b[31m", "\ud800", "../..", "a" * 5000, "nan", "1", [], {}, [[]], [None], [0] * 4, [1e308] * 3),
    *({"a": 1}, {"": None}, [["a"]], list(range(300))),
)

# --- bytes ------------------------------------------------------------------------------------------------------------


def _span(content: bytes, rng: Random, longest: int = 64) -> tuple[int, int]:
    """Random piece; beginnings, where headers are, as often as all the rest."""
    end = len(content) if rng.random() < 0.5 else min(len(content), 512)
    start = rng.randrange(end + 1)
    return start, min(len(content), start + rng.randrange(1, longest))


def _put(content: bytes, start: int, end: int, piece: bytes) -> bytes:
    return content[:start] + piece + content[end:]


def _flip(content: bytes, rng: Random) -> bytes:
    start, _ = _span(content, rng)
    return _put(
        content, start, start + 1, bytes([(content[start] if start < len(content) else 0) ^ 1 << rng.randrange(8)])
    )


def _truncate(content: bytes, rng: Random) -> bytes:
    return content[: _span(content, rng)[0]]


def _insert(content: bytes, rng: Random) -> bytes:
    start, _ = _span(content, rng)
    return _put(content, start, start, rng.choice((rng.randbytes(rng.randrange(1, 20)), *ODD_WORDS)))


def _duplicate(content: bytes, rng: Random) -> bytes:
    start, end = _span(content, rng, 1024)
    return _put(content, end, end, content[start:end] * rng.choice((1, 1, 2, 50)))


def _remove(content: bytes, rng: Random) -> bytes:
    return _put(content, *_span(content, rng, 256), b"")


def _overwrite(content: bytes, rng: Random) -> bytes:
    start, piece = _span(content, rng)[0], rng.choice(ODD_BYTES)
    start -= start % rng.choice((1, 2, 4))
    return _put(content, start, start + len(piece), piece)


def _number(content: bytes, rng: Random) -> bytes:
    found = list(re.finditer(rb"-?\d+(\.\d+)?", content[:65536]))
    if not found:
        return _overwrite(content, rng)
    match = rng.choice(found[:40] if rng.random() < 0.5 else found)
    return _put(content, *match.span(), rng.choice(ODD_NUMBERS))


def _word(content: bytes, rng: Random) -> bytes:
    found = list(re.finditer(rb"[A-Za-z_]+", content[:65536]))
    if not found:
        return _insert(content, rng)
    match, other = rng.choice(found[:40] if rng.random() < 0.5 else found), rng.choice(found)
    return _put(content, *match.span(), rng.choice((other.group(), *ODD_WORDS)))


def _line(content: bytes, rng: Random) -> bytes:
    lines = content.split(b"\n")
    at = rng.randrange(min(len(lines), 60))
    lines[at : at + 1] = rng.choice(([], [lines[at]] * 2, [lines[-1]], [lines[at], rng.choice(lines)], [b""]))
    return b"\n".join(lines)


STEPS: tuple[Callable[[bytes, Random], bytes], ...] = (
    *(_flip, _flip, _truncate, _insert, _duplicate, _remove, _overwrite, _overwrite, _number, _number, _word, _line),
)


def damaged(content: bytes, rng: Random) -> bytes:
    """Content after one to four changes, inside of what is packed where it is known how."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = _inside(content, rng) if rng.random() < 0.6 else rng.choice(STEPS)(content, rng)
    return content


# --- inside of what is packed or has checksums ------------------------------------------------------------------------


def _inside(content: bytes, rng: Random) -> bytes:
    otherwise = _safetensors if content[8:9] == b"{" else _json
    change = next((change for start, change in INSIDES if content.startswith(start)), otherwise)
    try:
        return change(content, rng)
    except (ValueError, EOFError, OSError, zlib.error, struct.error, zipfile.BadZipFile, LookupError, RecursionError,
            NotImplementedError, RuntimeError):  # fmt: skip
        return rng.choice(STEPS)(content, rng)  # damaged before


def _zip(content: bytes, rng: Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(item.filename, archive.read(item)) for item in archive.infolist()]
    at = rng.randrange(len(members))
    name, data = members[at]
    members[at] = rng.choice(
        ((name, damaged(data, rng)),) * 4 + ((damaged(name.encode(), rng).decode("latin-1"), data),)
    )
    if rng.random() < 0.1:
        members.pop(rng.randrange(len(members)))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members:
            entry = zipfile.ZipInfo(name)  # which ends names at a zero
            if entry.filename not in archive.namelist():
                archive.writestr(entry, data)
    return packed.getvalue()


def _gzip(content: bytes, rng: Random) -> bytes:
    return gzip.compress(damaged(gzip.decompress(content), rng), mtime=0)


def _png(content: bytes, rng: Random) -> bytes:
    chunks, at = [], 8
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    index = rng.randrange(len(chunks))
    kind, data = chunks[index]
    inner = zlib.compress(damaged(zlib.decompress(data), rng)) if kind == b"IDAT" else damaged(data, rng)
    chunks[index : index + 1] = rng.choice(([(kind, inner)],) * 5 + ([], [(kind, data)] * 2))
    parts = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return content[:8] + b"".join(parts)


def _glb(content: bytes, rng: Random) -> bytes:
    (length,) = struct.unpack("<I", content[12:16])
    text = _json(content[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _safetensors(content: bytes, rng: Random) -> bytes:
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    facts = header.get("__metadata__") if isinstance(header, dict) else None
    own = facts.get("mereo") if isinstance(facts, dict) else None
    if isinstance(own, str) and rng.random() < 0.6:
        header["__metadata__"]["mereo"] = _json(own.encode(), rng).decode("utf-8", "replace")
    elif rng.random() < 0.5:
        header = changed_tree(header, rng)
    else:
        start = rng.randrange(8 + length, len(content))
        return _put(content, start, start + 4, rng.choice(ODD_BYTES)[:4])
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content[8 + length :]


def _json(content: bytes, rng: Random) -> bytes:
    return json.dumps(changed_tree(json.loads(content), rng)).encode()


INSIDES: tuple[tuple[bytes, Callable[[bytes, Random], bytes]], ...] = (
    *((b"PK\3\4", _zip), (b"\x1f\x8b", _gzip), (b"\x89PNG\r\n\x1a\n", _png), (b"glTF", _glb)),
)

# --- trees of JSON and YAML -------------------------------------------------------------------------------------------

Place = tuple[str | int, ...]


def places(tree: Any, at: Place = ()) -> Iterator[Place]:
    """Place of every value of a tree, that of the whole first."""
    yield at
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


def value_at(tree: Any, place: Place) -> Any:
    """Value at a place."""
    for key in place:
        tree = tree[key]
    return tree


def with_value(tree: Any, place: Place, value: Any) -> Any:
    """Tree with another value at a place; ``...`` takes it out."""
    if not place:
        return value
    copy = dict(tree) if isinstance(tree, dict) else list(tree)
    if len(place) == 1 and value is ...:
        del copy[place[0]]
    else:
        copy[place[0]] = with_value(tree[place[0]], place[1:], value)
    return copy


def changed_tree(tree: Any, rng: Random) -> Any:
    """Tree with one value taken out, odd, of another place, in a list, repeated, or under another key."""
    place = rng.choice(list(places(tree)))
    value = value_at(tree, place)
    if place and isinstance(place[-1], str) and rng.random() < 0.15:
        above = {k: v for k, v in value_at(tree, place[:-1]).items() if k != place[-1]}
        return with_value(tree, place[:-1], {**above, rng.choice(("", "a", "\n", f"{place[-1]}_")): value})
    several = value * 2 if isinstance(value, (list, str)) else [value, value]
    other = value_at(tree, rng.choice(list(places(tree))))
    new = rng.choice(
        (*ODD_VALUES, *(ODD_VALUES if rng.random() < 0.5 else ()), *(..., ..., [value], several, other) * 2)
    )
    return with_value(tree, place, None if new is ... and not place else new)
