"""Limits on what chunks of a ROS recording unpack to: rosbags compares with what they state when it has all in memory.

A chunk states its size; it is compared with the limit of all files before anything is unpacked, and the unpacking stops
one byte after it, where rosbags then finds another size than was stated.
"""

import bz2
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from mereo.io.size_limits import check_bytes, max_bytes


def bound_chunks() -> None:
    """Let rosbags unpack no chunk to more than it states, or than the limit; asked for again it changes nothing."""
    lz4: Any = import_module("lz4.frame").LZ4FrameDecompressor
    mcap: Any = import_module("rosbags.rosbag2.storage_mcap")
    mcap.DECOMPRESSORS.update({"lz4": partial(unpacked, lz4), "zstd": partial(unpacked, mcap.zstd.ZstdDecompressor)})
    bag: Any = import_module("rosbags.rosbag1.reader")
    bag.decompressors.update({"lz4": partial(_unpacked_any, lz4), "bz2": partial(_unpacked_any, bz2.BZ2Decompressor)})


def unpacked(engine: Callable[[], Any], data: bytes, size: int) -> bytes:
    """What a chunk unpacks to, but no more than one byte beyond the ``size`` that it states.

    Raises ``SizeError`` where that is over the limit, ``ValueError`` where the chunk is cut short.
    """
    check_bytes(CHUNK, size)
    found = b""
    while data and len(found) <= size:
        one = engine()  # packed data may be several streams, one after the other
        found += one.decompress(data, size + 1 - len(found))
        if len(found) <= size and not one.eof:
            raise ValueError(f"{CHUNK} is truncated")
        data = one.unused_data if one.eof else b""
    return found


def _unpacked_any(engine: Callable[[], Any], data: bytes) -> bytes:
    """The same for ROS 1, whose reader does not tell the stated size: at most the limit of all files."""
    found = unpacked(engine, data, max_bytes())
    check_bytes(CHUNK, len(found))
    return found


CHUNK = "a chunk of the recording"
