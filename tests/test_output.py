"""Outputs appear whole or not at all, and what is written is what comes back."""

import errno
import json
import os
import stat
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mereo.camera import Camera
from mereo.files import read_camera, read_segmented_mesh
from mereo.mesh import Segment, SegmentedMesh
from mereo.output import atomic_file, new_directory, write_camera, write_json, write_labels_npz, write_segments_glb

INTERRUPTIONS = [ValueError("no"), KeyboardInterrupt(), SystemExit(1)]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}


def test_a_file_appears_at_the_end_with_ordinary_permissions(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.txt"
    with atomic_file(path) as partial:
        assert partial.suffix == ".txt"
        assert partial.parent == path.parent
        partial.write_text("whole")
        assert not path.exists()
    assert contents(tmp_path / "deep" / "er") == {"a.txt": b"whole"}
    plain = tmp_path / "plain"
    plain.write_text("")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


@pytest.mark.parametrize("interruption", INTERRUPTIONS, ids=lambda e: type(e).__name__)
def test_an_interruption_leaves_everything_as_it_was(tmp_path: Path, interruption: BaseException) -> None:
    (tmp_path / "old.txt").write_text("old")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "x").write_text("old")
    before = contents(tmp_path)
    for path in (tmp_path / "old.txt", tmp_path / "new" / "deep" / "a.txt"):
        with pytest.raises(type(interruption)), atomic_file(path) as partial:
            partial.write_text("half")
            raise interruption
    for path in (tmp_path / "old", tmp_path / "fresh" / "deep"):
        with pytest.raises(type(interruption)), new_directory(path, force=True) as partial:
            (partial / "sub").mkdir()
            (partial / "sub" / "half").write_text("half")
            raise interruption
    assert contents(tmp_path) == before


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    for place in (atomic_file(tmp_path / "a.bin"), new_directory(tmp_path / "d")):
        with pytest.raises(OSError, match=r"disk is full while writing .*free space") as caught, place as partial:
            (partial / "f" if partial.is_dir() else partial).write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert caught.value.errno == errno.ENOSPC
        assert "\n" not in str(caught.value)
    assert contents(tmp_path) == {}


def test_a_really_full_disk(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    with pytest.raises(OSError, match="disk is full"), atomic_file(tmp_path / "a") as partial:
        partial.symlink_to("/dev/full")
        partial.write_bytes(b"x" * 100_000)
    assert contents(tmp_path) == {}


def test_existing_outputs_are_kept_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    (tmp_path / "d").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "d" / "x").write_text("old")
    with (
        pytest.raises(FileExistsError, match=r"exists; it is not overwritten: .*--force"),
        atomic_file(tmp_path / "a", force=False),
    ):
        pass
    with (
        pytest.raises(FileExistsError, match=r"not empty; it is not overwritten: .*--force"),
        new_directory(tmp_path / "d"),
    ):
        pass
    with pytest.raises(FileExistsError, match="is a file; a directory"), new_directory(tmp_path / "a", force=True):
        pass
    with pytest.raises(FileExistsError, match="is a directory; a file"), atomic_file(tmp_path / "d"):
        pass
    for name in ("d", "empty"):
        with new_directory(tmp_path / name, force=name == "d") as partial:
            (partial / "y").write_text("new")
    assert contents(tmp_path) == {"a": b"old", "d": b"", "d/y": b"new", "empty": b"", "empty/y": b"new"}


def test_json_knows_arrays_and_has_no_nan(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json", {"a": np.arange(3), "b": (np.float32(0.5), float("nan")), "c": Path("x"), "é": True}
    )
    loaded = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert loaded == {"a": [0, 1, 2], "b": [0.5, None], "c": "x", "é": True}


def test_intrinsics_come_back_exactly(tmp_path: Path) -> None:
    camera = Camera(96, 64, 101.123456789, 99.1, 48.25, 31.5)
    write_camera(tmp_path / "c.json", camera)
    assert read_camera(tmp_path / "c.json") == camera


def test_labels_come_back(tmp_path: Path) -> None:
    labels = np.random.default_rng(0).integers(0, 4, (5, 6, 7)).astype(np.uint8)
    origin, spacing = np.array([0.1, -2.0, 3.0]), np.array([0.5, 0.25, 1.0])
    write_labels_npz(tmp_path / "l.npz", labels, origin, spacing, ("head", "left ear", "Körper"))
    with np.load(tmp_path / "l.npz", allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["labels"], labels)
        np.testing.assert_array_equal(loaded["origin"], origin)
        np.testing.assert_array_equal(loaded["spacing"], spacing)
        assert loaded["names"].tolist() == ["head", "left ear", "Körper"]
    with pytest.raises(ValueError, match="label 3 has no name among 2"):
        write_labels_npz(tmp_path / "l.npz", labels, origin, spacing, ("a", "b"))


def segments() -> SegmentedMesh:
    """Names and colours that exporters tend to change: spaces, accents, dark colours; one segment without faces."""
    ball, box = trimesh.creation.icosphere(2, radius=0.1), trimesh.creation.box((0.1, 0.2, 0.3))
    lost = Segment("lost", (9, 9, 9), np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    return SegmentedMesh(
        (
            Segment("zebra head", (86, 180, 233), ball.vertices + np.array([0, 0, 0.7]), np.array(ball.faces)),
            lost,
            Segment("Öhrchen", (3, 7, 255), box.vertices + np.array([0.3, 0, 0.7]), np.array(box.faces)),
        )
    )


def test_a_glb_gives_back_names_colours_and_vertices(tmp_path: Path) -> None:
    mesh = segments()
    write_segments_glb(tmp_path / "s.glb", mesh)
    back = read_segmented_mesh(tmp_path / "s.glb")
    assert back.names == ("zebra head", "Öhrchen")
    assert back.colors == ((86, 180, 233), (3, 7, 255))
    for found, written in zip(back.segments, (mesh.segments[0], mesh.segments[2]), strict=True):
        np.testing.assert_allclose(found.vertices, written.vertices, atol=1e-7)
        np.testing.assert_array_equal(found.faces, written.faces)


def test_other_programs_see_the_glb_y_up_in_metres(tmp_path: Path) -> None:
    mesh = segments()
    write_segments_glb(tmp_path / "s.glb", mesh, unit_m=0.001)
    scene = trimesh.load_scene(tmp_path / "s.glb", process=False)
    node, key = scene.graph["zebra head"]
    np.testing.assert_allclose(node, np.diag([0.001, -0.001, -0.001, 1.0]))
    # glTF factors are linear light: viewers turn them back into the segment's sRGB colour
    linear = np.asarray(scene.geometry[key].visual.material.baseColorFactor[:3]) / 255.0
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * srgb, (86, 180, 233), atol=1.5)
    assert scene.geometry[key].visual.material.doubleSided


def test_the_glb_is_valid_gltf(tmp_path: Path) -> None:
    write_segments_glb(tmp_path / "s.glb", segments(), np.eye(3))
    data = (tmp_path / "s.glb").read_bytes()
    assert data[:4] == b"glTF"
    assert int.from_bytes(data[8:12], "little") == len(data)
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    assert length % 4 == 0
    assert document["scenes"] == [{"nodes": [0]}]
    assert document["nodes"][0]["matrix"] == np.eye(4).ravel().tolist()
    assert sum(view["byteLength"] for view in document["bufferViews"]) == document["buffers"][0]["byteLength"]
    assert document["accessors"][0]["count"] == 162
    np.testing.assert_allclose(document["accessors"][0]["max"], [0.1, 0.1, 0.8], atol=1e-6)


def test_a_glb_without_surfaces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="all segments are without faces"):
        write_segments_glb(tmp_path / "s.glb", SegmentedMesh((segments().segments[1],)))
    assert contents(tmp_path) == {}
