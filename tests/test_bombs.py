"""Recordings and 3MF files that unpack to far more than they are, refused before memory is taken."""

import bz2
import tracemalloc
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.recording_limits import bound_chunks, unpacked
from mereo.io.ros_recordings import recorded_frames
from mereo.io.size_limits import LIMIT_VARIABLE, SizeError

BOMB = bytes(30_000_000)


@pytest.fixture(scope="module")
def engines() -> dict[str, tuple[Callable[[bytes], bytes], Callable[[], Any]]]:
    """Packer and maker of the unpacker, by name."""
    mcap = pytest.importorskip(
        "rosbags.rosbag2.storage_mcap", reason="rosbags is missing: pip install 'mereo[sensors]'"
    )
    lz4 = import_module("lz4.frame")
    return {
        "bz2": (bz2.compress, bz2.BZ2Decompressor),
        "lz4": (lz4.compress, lz4.LZ4FrameDecompressor),
        "zstd": (mcap.zstd.compress, mcap.zstd.ZstdDecompressor),
    }


@pytest.mark.parametrize("name", ["bz2", "lz4", "zstd"])
def test_a_chunk_unpacks_to_what_it_states_and_no_more(name: str, engines: Any, monkeypatch: Any) -> None:
    pack, engine = engines[name]
    text = np.random.default_rng(0).bytes(50_000)
    assert unpacked(engine, pack(text), len(text)) == text
    assert unpacked(engine, pack(text) + pack(text), 2 * len(text)) == 2 * text
    with pytest.raises(ValueError, match="chunk of the recording is truncated"):
        unpacked(engine, pack(text)[:-9_000], len(text))
    packed = pack(BOMB)
    tracemalloc.start()
    assert len(unpacked(engine, packed, 1000)) == 1001  # it lied: rosbags then finds another size
    monkeypatch.setenv(LIMIT_VARIABLE, "0.01")
    with pytest.raises(SizeError, match=r"a chunk of the recording unpacks to 0\.03 GB; at most 0\.01 GB are read"):
        unpacked(engine, packed, len(BOMB))
    assert tracemalloc.get_traced_memory()[1] < 3_000_000
    tracemalloc.stop()


def test_a_recording_that_unpacks_to_too_much_is_one_sentence(
    tmp_path: Path, engines: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One chunk, without an index, as a bomb would come."""

    def sized(content: bytes) -> bytes:
        return len(content).to_bytes(8, "little") + content

    def chunk(stated: int) -> bytes:
        name = (4).to_bytes(4, "little") + b"zstd"
        return b"\x06" + sized(
            bytes(16) + stated.to_bytes(8, "little") + bytes(4) + name + sized(engines["zstd"][0](BOMB))
        )

    head = b"\x89MCAP0\r\n\x01" + sized((4).to_bytes(4, "little") + b"ros2" + bytes(4))
    tail = b"\x02" + sized(bytes(20)) + b"\x89MCAP0\r\n"
    path = tmp_path / "a.mcap"
    monkeypatch.setenv(LIMIT_VARIABLE, "0.01")
    path.write_bytes(head + chunk(len(BOMB)) + tail)
    with pytest.raises(SizeError, match=r"a chunk of the recording unpacks to 0\.03 GB; at most 0\.01 GB are read"):
        next(recorded_frames(path))
    path.write_bytes(head + chunk(100) + tail)
    with pytest.raises(ValueError, match="Chunk size mismatch: expected 100 bytes, got 101"):
        next(recorded_frames(path))


def test_chunks_of_ros_1_are_bounded_too(engines: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bound_chunks()
    unpack = import_module("rosbags.rosbag1.reader").decompressors["bz2"]
    assert unpack(bz2.compress(b"abc")) == b"abc"
    monkeypatch.setenv(LIMIT_VARIABLE, "0.01")
    with pytest.raises(SizeError, match="a chunk of the recording unpacks to"):
        unpack(bz2.compress(BOMB))


def test_a_model_of_much_xml_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tree of it takes many times its bytes."""
    pytest.importorskip("lxml", reason="lxml is not installed: pip install 'mereo[cad]'")
    with zipfile.ZipFile(tmp_path / "a.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", b"<model>" + b"<a/>" * 250_000 + b"</model>")
    monkeypatch.setenv(LIMIT_VARIABLE, "0.01")
    with pytest.raises(SizeError, match=r"a\.3mf unpacks to 0\.022 GB; at most 0\.01 GB are read"):
        read_segmented_mesh(tmp_path / "a.3mf")
