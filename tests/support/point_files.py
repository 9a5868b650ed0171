"""Point clouds written as PLY and PCD by hand."""

import struct

import numpy as np


def save_ply(points: np.ndarray, order: str) -> bytes:
    """x, y, z with a colour in between, so that columns matter."""
    head = f"ply\nformat {order} 1.0\nelement vertex {len(points)}\nproperty float x\nproperty uchar red\n"
    head += "property float y\nproperty float z\nend_header\n"
    if order == "ascii":
        return (head + "".join(f"{x!r} 7 {y!r} {z!r}\n" for x, y, z in points.tolist())).encode()
    end = "<" if "little" in order else ">"
    return head.encode() + b"".join(struct.pack(f"{end}fBff", x, 7, y, z) for x, y, z in points.tolist())


def save_pcd(points: np.ndarray, layout: str) -> bytes:
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
    """A slow, greedy encoder: the longest earlier match of at least three bytes, else literals."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend(bytes([len(run) - 1]) + run)
        literals.clear()

    while at < len(data):
        best, offset = 0, 0
        for back in range(1, min(at, 64) + 1):
            length = 0
            while at + length < len(data) and length < 264 and data[at + length] == data[at - back + length]:
                length += 1
            if length > best:
                best, offset = length, back
        if best < 3:
            literals.append(data[at])
            at += 1
            continue
        flush()
        long, high, low = best - 2, (offset - 1) >> 8, (offset - 1) & 255
        out.extend(bytes([(long << 5) | high, low]) if long < 7 else bytes([(7 << 5) | high, long - 7, low]))
        at += best
    flush()
    return bytes(out)
