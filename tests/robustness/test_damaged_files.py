"""Headers that lie, bytes that have changed, and files that unpack to far more than they are: one sentence each."""

import gzip
import io
import os
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fuzz import zipped
from PIL import Image
from point_files import save_pcd, save_ply

from mereo.io.errors import LIMIT_VARIABLE, PAGES, max_bytes
from mereo.io.intrinsics import read_intrinsics
from mereo.io.mesh_formats import read_glb, read_segmented_mesh
from mereo.io.readers import read_point_cloud, read_raw_depth
from mereo.io.ros_recordings import recorded_frames
from mereo.io.sensor_frame import read_frame
from mereo.io.simulation_states import read_states
from mereo.io.volume_files import read_label_volume
from mereo.models.weights import load_model
from mereo.scenes.registry import load_scene

POINTS = np.random.default_rng(0).normal(size=(57, 3)).astype(np.float32)
TEXT = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS.tolist()).encode()
PLY, PCD = save_ply(POINTS, "binary_little_endian"), save_pcd(POINTS, "binary")
TRIANGLE = b"3 0 1 2\n"


def npy(*shape: int) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


def one_sentence(read: Callable[[Path], object], path: Path, content: bytes, expected: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        read(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


LYING_CLOUDS = {
    "fewer than none.ply": (PLY.replace(b"vertex 57", b"vertex -5"), "its header states -5 of element 'vertex'"),
    "no such format.ply": (PLY.replace(b"little", b"middle"), "its format is 'binary_middle_endian'"),
    "more than there are.ply": (PLY.replace(b"57", b"1000000000000"), "PLY is unexpected length"),
    "fewer than none.pcd": (PCD.replace(b"POINTS 57", b"POINTS -5"), "its header states -5 points"),
    "two counts.pcd": (PCD.replace(b"POINTS 57", b"POINTS 20"), "its header states 20 points and 57 x 1"),
    "too far back.pcd": (
        PCD.partition(b"DATA")[0].replace(b"57", b"4")
        + b"DATA binary_compressed\n"
        + struct.pack("<II", 5, 80)
        + bytes([1, 65, 66, 32, 10]),
        "its compressed data are damaged",
    ),
    "cut short.pts": (b"58\n" + TEXT, "truncated: 57 of 58 points"),
    "huge.npz": (zipped({"points.npy": npy(10**15, 3) + PLY}), "takes more than 8 GB of memory to read"),
}


@pytest.mark.parametrize("name", LYING_CLOUDS)
def test_a_cloud_whose_header_lies_is_refused(tmp_path: Path, name: str) -> None:
    one_sentence(read_point_cloud, tmp_path / name, *LYING_CLOUDS[name])


LYING_MESHES = {
    "fewer faces.ply": (
        save_ply(POINTS, "ascii").replace(b"end_header", b"element face 5\nproperty list uchar int i\nend_header"),
        "truncated: 57 of 62 rows",
    ),
    "fewer faces.off": (b"OFF\n3 5 0\n0 0 0\n1 0 0\n0 1 0\n" + TRIANGLE, "truncated: 1 of 5 faces"),
    "fewer than none.off": (b"OFF\n-3 1 0\n0 0 0\n" + TRIANGLE, "its header states -3 vertices"),
    "huge.stl": (bytes(80) + b"\xff" * 4 + bytes(100), "cannot be read as a mesh"),
}


@pytest.mark.parametrize("name", LYING_MESHES)
def test_a_mesh_whose_header_lies_is_refused(tmp_path: Path, name: str) -> None:
    one_sentence(read_segmented_mesh, tmp_path / name, *LYING_MESHES[name])


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
    huge = "takes more than 8 GB of memory to read|cannot be read as a label volume"
    one_sentence(read_label_volume, tmp_path / "a.nii.gz", gzip.compress(nifti(32000, 32000, 30)), huge)
    one_sentence(read_label_volume, tmp_path / "b.nii", nifti(-5, 6, 7), "its header states the size -5 x 6 x 7")
    one_sentence(read_label_volume, tmp_path / "a.nrrd", nrrd("32000 32000 30", "raw", bytes(210)), huge)
    one_sentence(read_label_volume, tmp_path / "b.nrrd", nrrd("-5 -6 7", "raw", bytes(210)), "the size -5 x -6 x 7")


BOMBS: dict[str, Callable[[Path], object]] = {"a.npz": read_point_cloud, "a.nrrd": read_label_volume}
"""Files of about a megabyte that unpack to one gigabyte."""


@pytest.mark.skipif(not PAGES.exists(), reason="only Linux holds a process to a limit")
@pytest.mark.parametrize("name", BOMBS)
def test_what_takes_too_much_memory_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, zeros = tmp_path / name, bytes(1_000_000_000)
    if name == "a.npz":
        path.write_bytes(zipped({"points.npy": npy(len(zeros) // 12, 3) + zeros}))
    else:
        path.write_bytes(nrrd("1000 1000 1000", "gzip", gzip.compress(zeros, 1)))
    before = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setenv(LIMIT_VARIABLE, "0.7")
    with pytest.raises(ValueError, match=r"takes more than 0\.7 GB of memory to read") as caught:
        BOMBS[name](path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_a_recording_is_unpacked_in_limited_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One chunk, without an index, as a bomb would come."""
    mcap = pytest.importorskip("rosbags.rosbag2.storage_mcap", reason="rosbags is missing: mereo[sensors]")

    def sized(content: bytes) -> bytes:
        return len(content).to_bytes(8, "little") + content

    size = 1_000_000_000
    chunk = bytes(16) + size.to_bytes(8, "little") + bytes(4) + (4).to_bytes(4, "little") + b"zstd"
    content = b"\x89MCAP0\r\n\x01" + sized((4).to_bytes(4, "little") + b"ros2" + bytes(4))
    content += b"\x06" + sized(chunk + sized(mcap.zstd.compress(bytes(size))))
    (tmp_path / "a.mcap").write_bytes(content + b"\x02" + sized(bytes(20)) + b"\x89MCAP0\r\n")
    monkeypatch.setenv(LIMIT_VARIABLE, "0.7")
    with pytest.raises(ValueError, match=r"a\.mcap (takes more than 0\.7 GB of memory|cannot be read)"):
        next(recorded_frames(tmp_path / "a.mcap"))


def test_a_pipe_or_device_that_is_named_like_a_file_is_refused_at_once(tmp_path: Path) -> None:
    """Nobody writes to this pipe: whoever opened it would wait for ever."""
    readers: dict[str, Callable[[Path], object]] = {
        ".ply": read_frame,
        ".npy": read_frame,
        ".bag": read_frame,
        ".obj": read_segmented_mesh,
        ".glb": read_glb,
        ".png": read_raw_depth,
        ".nrrd": read_label_volume,
        ".json": read_intrinsics,
        ".npz": lambda p: read_states(p, ("a",)),
        ".yaml": load_scene,
        ".safetensors": lambda p: load_model(str(p)),
    }
    for suffix, read in readers.items():
        os.mkfifo(path := tmp_path / f"a{suffix}")
        with pytest.raises((ValueError, FileNotFoundError), match=f"a{suffix}"):
            read(path)


def test_the_limit_is_a_positive_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    for text in ("much", "-1", "0", "nan", "inf"):
        monkeypatch.setenv(LIMIT_VARIABLE, text)
        with pytest.raises(ValueError, match=f"^MEREO_MAX_FILE_GB is '{text}'; it must be a positive number of"):
            read_point_cloud(tmp_path / "a.npy")
    monkeypatch.setenv(LIMIT_VARIABLE, "12.5")
    assert max_bytes() == 12.5e9 and len(read_point_cloud(tmp_path / "a.npy").points) == 57


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
