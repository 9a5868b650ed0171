"""Point clouds written as PLY and PCD by hand."""

import struct
from itertools import takewhile

import numpy as np
from numpy import ndarray


def save_ply(points: ndarray, order: str) -> bytes:
    """x, y, z with a colour in between, so that columns matter."""
    head = f"ply\nformat {order} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty uchar red\n"
    head += "property float y\nproperty float z\nend_header\n"
    if order == "ascii":
        return (head + "".join(f"{x!r} 7 {y!r} {z!r}\n" for x, y, z in points.tolist())).encode()
    end = "<" if "little" in order else ">"
    return head.encode() + b"".join(struct.pack(f"{end}fBff", x, 7, y, z) for x, y, z in points.tolist())


def save_pcd(points: ndarray, layout: str) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x _ y z\nSIZE 4 4 1 4 4\nTYPE U F U F F\nCOUNT 1 1 4 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {layout}\n"
    if layout == "ascii":
        return (head + "".join(f"9 {x!r} 0 0 0 0 {y!r} {z!r}\n" for x, y, z in points.tolist())).encode()
    if layout == "binary":
        return head.encode() + b"".join(struct.pack("<If4sff", 9, x, b"pad!", y, z) for x, y, z in points.tolist())
    x, y, z = (column.tobytes() for column in np.ascontiguousarray(points.T))
    data = b"\x09\0\0\0" * len(points) + x + b"pad!" * len(points) + y + z
    packed = lzf_compress(data)
    return head.encode() + struct.pack("<II", len(packed), len(data)) + packed


def lzf_compress(data: bytes) -> bytes:
    """Runs of four bytes that come again, 3 to 264 bytes long, and literals."""
    out = bytearray()
    at = 0
    while at < len(data):
        pairs = zip(data[at : at + 264], data[at - 4 : at + 260], strict=False) if at > 3 else ()
        length = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
        if length < 3:
            literals = data[at : at + 3]
            out += bytes([len(literals) - 1]) + literals
            at += len(literals)
            continue
        out += bytes([(length - 2) << 5, 3] if length < 9 else [7 << 5, length - 9, 3])
        at += length
    return bytes(out)
