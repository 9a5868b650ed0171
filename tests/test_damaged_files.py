"""Headers that lie, bytes that have changed, and files that unpack to far more than they are: one sentence each."""

import bz2
import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mereo.io.depth_formats import read_raw_depth
from mereo.io.label_volumes import read_label_volume
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import read_mask, read_point_cloud
from mereo.io.simulation_states import read_states
from mereo.io.size_limits import LIMIT_VARIABLE, max_bytes

POINTS = np.random.default_rng(0).normal(size=(57, 3)).astype(np.float32)
TEXT = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS.tolist()).encode()
DATA, TRIANGLE = POINTS.tobytes(), b"3 0 1 2\n"
ASCII, BINARY = "ascii", "binary_little_endian"


def ply(order: str, count: int, data: bytes, faces: int | None = None) -> bytes:
    head = f"ply\n{f'format {order} 1.0' if order else 'comment none'}\nelement vertex {count}\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    if faces is not None:
        head += f"element face {faces}\nproperty list uchar int vertex_indices\n"
    return f"{head}end_header\n".encode() + data


def pcd(count: int, layout: str, data: bytes, width: int | None = None) -> bytes:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nHEIGHT 1\n"
    return f"{head}WIDTH {count if width is None else width}\nPOINTS {count}\nDATA {layout}\n".encode() + data


def npy(*shape: int) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


def zipped(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def one_sentence(read: Callable[[Path], object], path: Path, content: bytes, expected: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        read(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


# --- headers that lie -------------------------------------------------------------------------------------------------

LYING_CLOUDS = {
    "fewer than none.ply": (ply(ASCII, -5, TEXT), "its header states -5 of element 'vertex'"),
    "none less one.ply": (ply(BINARY, -1, DATA), "its header states -1 of element 'vertex'"),
    "no format.ply": (ply("", 57, DATA), "its format is '', not one of ascii, binary_little_endian, binary_big"),
    "no such format.ply": (ply("binary_middle_endian", 57, DATA), "its format is 'binary_middle_endian'"),
    "more than there are.ply": (ply(BINARY, 10**12, DATA), "truncated: 57 of 1000000000000 points"),
    "fewer than none.pcd": (pcd(-5, "ascii", TEXT), "its header states -5 points"),
    "none less one.pcd": (pcd(-1, "binary", DATA), "its header states -1 points"),
    "two counts.pcd": (pcd(20, "binary", DATA, 57), "its header states 20 points and 57 x 1"),
    "too far back.pcd": (
        pcd(4, "binary_compressed", struct.pack("<II", 5, 48) + bytes([1, 65, 66, 32, 10])),
        "its compressed data are damaged",
    ),
    "cut short.pts": (b"58\n" + TEXT, "truncated: 57 of 58 points"),
    "huge.npy": (npy(10**15, 3) + DATA, r"an array of shape \[1000000000000000, 3\], which its \d+ bytes cannot hold"),
    "huge.npz": (zipped("points.npy", npy(10**15, 3) + DATA), r"array of shape \[1000000000000000, 3\]"),
}


@pytest.mark.parametrize("name", LYING_CLOUDS)
def test_a_cloud_whose_header_lies_is_refused(tmp_path: Path, name: str) -> None:
    one_sentence(read_point_cloud, tmp_path / name, *LYING_CLOUDS[name])


def glb(vertices: int, indices: int, view: bool = True) -> bytes:
    """A triangle, with these counts in its header; without a view its vertices are zeros."""
    positions = {"componentType": 5126, "type": "VEC3", "count": vertices} | ({"bufferView": 0} if view else {})
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [positions, {"componentType": 5125, "type": "SCALAR", "count": indices, "bufferView": 1}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 48}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = np.eye(3, dtype=np.float32).tobytes() + np.arange(3, dtype=np.uint32).tobytes()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


LYING_MESHES = {
    "fewer faces.ply": (ply(ASCII, 57, TEXT + TRIANGLE, 5), "truncated: 58 of 62 rows"),
    "fewer than none.ply": (ply(BINARY, -57, DATA, 1), "its header states -57 of element 'vertex'"),
    "fewer faces.off": (b"OFF\n3 5 0\n0 0 0\n1 0 0\n0 1 0\n" + TRIANGLE, "truncated: 1 of 5 faces"),
    "fewer than none.off": (b"OFF\n-3 1 0\n0 0 0\n" + TRIANGLE, "its header states -3 vertices"),
    "no end.stl": (
        b"solid a\nfacet normal 0 0 1\nouter loop\n"
        + b"".join(b"vertex %d %d 0\n" % place for place in ((0, 0), (1, 0), (0, 1)))
        + b"endloop\nendfacet\n",
        "it is truncated: it does not end in endsolid",
    ),
    "huge.stl": (bytes(80) + b"\xff" * 4 + bytes(100), "states 4294967295 triangles, and its 184 bytes hold 2"),
    "vertices.glb": (glb(10**10, 3), "truncated: 3 of 10000000000 elements"),
    "indices.glb": (glb(3, -3), "its header states -3 elements"),
    "fewer than none.glb": (glb(-1, 3), "its header states -1 elements"),
    "zeros.glb": (
        glb(3 * 10**8, 3, view=False),
        r"unpacks to 7\.2 GB; at most 4 GB are read: .* MEREO_MAX_FILE_GB=7\.2",
    ),
}


@pytest.mark.parametrize("name", LYING_MESHES)
def test_a_mesh_whose_header_lies_is_refused(tmp_path: Path, name: str) -> None:
    one_sentence(read_segmented_mesh, tmp_path / name, *LYING_MESHES[name])


def test_a_glb_that_does_not_lie_is_read(tmp_path: Path) -> None:
    (tmp_path / "honest.glb").write_bytes(glb(3, 3))
    assert len(read_segmented_mesh(tmp_path / "honest.glb").segments[0].faces) == 1


def nifti(*sizes: int) -> bytes:
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed: pip install 'mereo[medical]'")
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.uint8)
    block = bytearray(header.binaryblock)
    block[40:56] = struct.pack("<8h", 3, *sizes, 1, 1, 1, 1)
    block[108:112], block[344:348] = struct.pack("<f", 352), b"n+1\0"
    return bytes(block) + bytes(214)


def nrrd(sizes: str, encoding: str, data: bytes) -> bytes:
    pytest.importorskip("nrrd", reason="pynrrd is not installed: pip install 'mereo[medical]'")
    return f"NRRD0004\ntype: uchar\ndimension: 3\nsizes: {sizes}\nencoding: {encoding}\n\n".encode() + data


def test_a_volume_whose_header_lies_is_refused(tmp_path: Path) -> None:
    huge = r"unpacks to 246 GB; at most 4 GB are read"
    one_sentence(read_label_volume, tmp_path / "a.nii.gz", gzip.compress(nifti(32000, 32000, 30)), huge)
    one_sentence(read_label_volume, tmp_path / "b.nii", nifti(-5, 6, 7), "its header states the size -5 x 6 x 7")
    one_sentence(read_label_volume, tmp_path / "a.nrrd", nrrd("32000 32000 30", "raw", bytes(210)), huge)
    one_sentence(read_label_volume, tmp_path / "b.nrrd", nrrd("-5 -6 7", "raw", bytes(210)), "the size -5 x -6 x 7")


# --- files that unpack to far more than they are ----------------------------------------------------------------------


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "0.01")


@pytest.mark.usefixtures("small_limit")
def test_what_unpacks_to_too_much_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    zeros = bytes(24_000_000)
    packed = zipped("points.npy", npy(2_000_000, 3) + zeros)
    refused = r"unpacks to 0\.024 GB; at most 0\.01 GB are read: .* MEREO_MAX_FILE_GB=0\.1"
    tracemalloc.start()
    one_sentence(read_point_cloud, tmp_path / "a.npz", packed, refused)
    one_sentence(lambda path: read_states(path, ("a",)), tmp_path / "b.npz", packed, refused)
    pytest.importorskip("lxml", reason="lxml is not installed: pip install 'mereo[cad]'")
    one_sentence(read_segmented_mesh, tmp_path / "c.3mf", zipped("3D/3dmodel.model", zeros), refused)
    assert tracemalloc.get_traced_memory()[1] < 60_000_000
    tracemalloc.stop()


@pytest.mark.usefixtures("small_limit")
def test_a_depth_image_of_too_many_floats_is_refused(tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR comes with the extra sensors")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {"Z": np.ones((1500, 2000), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr unpacks to 0\.012 GB; at most 0\.01 GB are read"):
        read_raw_depth(tmp_path / "a.exr")


@pytest.mark.parametrize("encoding, pack", [("gzip", gzip.compress), ("bzip2", bz2.compress)])
def test_data_that_unpack_to_more_than_their_header_states(
    tmp_path: Path, encoding: str, pack: Callable[[bytes], bytes]
) -> None:
    for size in (24_000_000, 210):
        (tmp_path / "a.nrrd").write_bytes(content := nrrd("5 6 7", encoding, pack(bytes(size))))
        if size == 210:
            assert read_label_volume(tmp_path / "a.nrrd").labels.shape == (5, 6, 7)
        else:
            expected = "unpack to more than the 1680 bytes that its header states"
            one_sentence(read_label_volume, tmp_path / "a.nrrd", content, expected)


def test_the_limit_is_a_positive_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    for text in ("much", "-1", "0", "nan", "inf"):
        monkeypatch.setenv(LIMIT_VARIABLE, text)
        with pytest.raises(ValueError, match=f"^MEREO_MAX_FILE_GB is '{text}'; it must be a positive number of"):
            read_point_cloud(tmp_path / "a.npy")
    monkeypatch.setenv(LIMIT_VARIABLE, "12.5")
    assert max_bytes() == 12.5e9 and len(read_point_cloud(tmp_path / "a.npy").points) == 57


# --- images -----------------------------------------------------------------------------------------------------------


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(9))) + chunk(b"IEND", b"")


def test_no_flipped_bit_of_a_png_makes_another_image(tmp_path: Path) -> None:
    """Pillow alone returns other depths for some of them."""
    values = np.random.default_rng(0).integers(500, 900, (8, 8)).astype(np.uint16)
    path = tmp_path / "a.png"
    Image.fromarray(values).save(path)
    whole = path.read_bytes()
    for place in range(8, len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        try:
            found = read_raw_depth(path)
        except ValueError:
            continue
        np.testing.assert_array_equal(found, values)


def test_an_image_with_too_many_pixels_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for read in (read_raw_depth, read_mask):
        one_sentence(read, tmp_path / "a.png", png(30000, 30000), "more than 179 million pixels; no larger images")
        one_sentence(read, tmp_path / "b.png", png(10000, 10000), "cannot be read as a")
        monkeypatch.setenv(LIMIT_VARIABLE, "0.5")
        one_sentence(read, tmp_path / "c.png", png(10000, 10000), r"unpacks to 0\.8 GB; at most 0\.5 GB are read")
        monkeypatch.delenv(LIMIT_VARIABLE)
