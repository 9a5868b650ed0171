"""Every format gives back the points that were written; every damaged file gets one sentence with its cure."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from point_files import save_pcd, save_ply

from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.readers import read_mask, read_point_cloud

POINTS = np.random.default_rng(0).normal(size=(57, 3)).astype(np.float32) + np.float32(3)


def text(points: np.ndarray, separator: str, *, extra: str = "") -> str:
    return "".join(separator.join(repr(v) for v in row) + extra + "\n" for row in points.tolist())


CLOUDS: dict[str, bytes] = {
    "ascii.ply": save_ply(POINTS, "ascii"),
    "little.ply": save_ply(POINTS, "binary_little_endian"),
    "big.ply": save_ply(POINTS, "binary_big_endian"),
    "ascii.pcd": save_pcd(POINTS, "ascii"),
    "binary.pcd": save_pcd(POINTS, "binary"),
    "compressed.pcd": save_pcd(POINTS, "binary_compressed"),
    "plain.xyz": text(POINTS, " ").encode(),
    "colored.XYZ": ("# made by hand\n" + text(POINTS, "\t", extra="\t255\t0\t0")).encode(),
    "count.pts": (f"{len(POINTS)}\n" + text(POINTS, " ")).encode(),
    "titled.csv": ("\ufeffx,y,z,name\n" + text(POINTS, ",", extra=",dot")).encode(),
    "shuffled.csv": ('"id","z","x","y"\n' + text(np.column_stack([np.ones(57), POINTS[:, [2, 0, 1]]]), ",")).encode(),
    "commented.txt": ("# id x y z\n" + text(np.column_stack([np.ones(57), POINTS]), " ")).encode(),
    "german.csv": text(POINTS, "; ").encode(),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_every_format_gives_back_the_points(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(CLOUDS[name])
    np.testing.assert_array_equal(read_point_cloud(tmp_path / name).points, POINTS.astype(np.float64))


def test_arrays_in_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", POINTS)
    np.save(tmp_path / "organized.npy", POINTS[:56].reshape(7, 8, 3))
    np.savez(tmp_path / "named.npz", points=POINTS, other=POINTS[:2])
    np.savez(tmp_path / "only.npz", cloud=POINTS, matrix=np.eye(4))
    for name, count in (("flat.npy", 57), ("organized.npy", 56), ("named.npz", 57), ("only.npz", 57)):
        np.testing.assert_array_equal(read_point_cloud(tmp_path / name).points, POINTS[:count])


def test_missing_points_are_refused_with_the_cure_or_dropped(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[3], points[5, 1], points[9] = np.nan, np.inf, 0
    for name, content in (("a.ply", save_ply(points, "binary_little_endian")), ("b.pcd", save_pcd(points, "binary"))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"3 of 57 points without a measurement.*--drop-invalid"):
            read_point_cloud(tmp_path / name)
        kept = np.delete(POINTS, [3, 5, 9], axis=0)
        np.testing.assert_array_equal(read_point_cloud(tmp_path / name, drop_invalid=True).points, kept)


def numpy_bytes(path: Path, array: np.ndarray) -> bytes:
    np.save(path / "scratch.npy", array)
    return (path / "scratch.npy").read_bytes()


BAD_CLOUDS: dict[str, tuple[str, Callable[[Path], bytes], str]] = {
    "empty file": ("a.ply", lambda _: b"", "is empty"),
    "no vertices": ("a.ply", lambda _: save_ply(POINTS[:0], "ascii"), "0 vertices"),
    "cut binary ply": ("a.ply", lambda _: save_ply(POINTS, "binary_big_endian")[:-40], "cannot be read"),
    "cut at a line": ("a.ply", lambda _: b"\n".join(save_ply(POINTS, "ascii").split(b"\n")[:-5]), "53 of 57|54 of 57"),
    "cut binary pcd": ("a.pcd", lambda _: save_pcd(POINTS, "binary")[:-1], "truncated: 56 of 57"),
    "cut compressed pcd": ("a.pcd", lambda _: save_pcd(POINTS, "binary_compressed")[:-9], "cannot be read"),
    "words": ("a.xyz", lambda _: b"once upon a time\nthere was a cloud\n", "no row of three numbers"),
    "a word among numbers": ("a.xyz", lambda _: b"1 2 3\n4 five 6\n", "cannot be read.*five"),
    "empty cell": ("a.csv", lambda _: b"1,2,3\n4,,6\n", "cannot be read"),
    "ply called pcd": ("a.pcd", lambda _: save_ply(POINTS, "ascii"), "no PCD header"),
    "pickle": ("a.npy", lambda p: numpy_bytes(p, np.array([{}], dtype=object)), "cannot be read"),
    "transposed": ("a.npy", lambda p: numpy_bytes(p, POINTS.T), r"shape is \(3, 57\)"),
    "words in an array": ("a.npy", lambda p: numpy_bytes(p, np.array([["a", "b", "c"]])), "not a number"),
    "suffix": ("a.las", lambda _: b"LASF", "suffix '.las'.*convert"),
    "all NaN": ("a.npy", lambda p: numpy_bytes(p, np.full((4, 3), np.nan)), "all 4 points"),
    "no rows": ("a.npy", lambda p: numpy_bytes(p, np.empty((0, 3))), "0 points"),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_a_bad_cloud_gets_one_sentence(tmp_path: Path, case: str) -> None:
    name, make, expected = BAD_CLOUDS[case]
    (tmp_path / name).write_bytes(make(tmp_path))
    with pytest.raises(ValueError, match=expected) as caught:
        read_point_cloud(tmp_path / name)
    assert_sentence(caught.value, tmp_path / name)


def assert_sentence(error: Exception, path: Path) -> None:
    """One line that names the file and, after a colon, the cure."""
    message = str(error)
    assert "\n" not in message
    assert str(path) in message
    assert ": " in message.replace(str(path), "")
    assert not isinstance(error, UnicodeError)


def test_missing_files_and_directories(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist.*check the path"):
        read_mask(tmp_path / "nothing.png")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="is a directory"):
        read_point_cloud(tmp_path / "folder.ply")


def test_parts_of_an_obj_keep_their_order_names_and_closedness(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    lines, offset = [], 1
    for name, shift in (("zebra", 0.0), ("ant", 3.0), ("middle part", 6.0)):
        lines += [f"v {x + shift} {y} {z}" for x, y, z in box.vertices]
        lines += [f"g {name}"] + [f"f {a + offset}//1 {b + offset}//2 {c + offset}" for a, b, c in box.faces]
        offset += 8
    (tmp_path / "parts.obj").write_text("\n".join(lines))
    mesh = read_segmented_mesh(tmp_path / "parts.obj")
    mesh.check()
    assert mesh.names == ("zebra", "ant", "middle part")
    np.testing.assert_allclose([s.volume for s in mesh.segments], 1.0)


def test_one_file_for_each_segment(tmp_path: Path) -> None:
    for name, suffix in (("b_ball", "ply"), ("a_box", "stl"), ("c_rod", "obj"), ("d_tube", "off")):
        trimesh.creation.icosphere(1).export(tmp_path / f"{name}.{suffix}")
    mesh = read_segmented_mesh(tmp_path)
    mesh.check()  # an STL file is triangles without connection until equal positions are merged
    assert mesh.names == ("a_box", "b_ball", "c_rod", "d_tube")
    assert len(set(mesh.colors)) == 4


def test_bad_meshes_get_one_sentence(tmp_path: Path) -> None:
    for name, content, expected in (
        ("points.ply", save_ply(POINTS, "ascii"), "no faces"),
        ("broken.obj", b"v 0 0 0\nf 1 2 3\n", "refers to vertex 2 of 1"),
        ("broken.glb", b"glTF but not really", "cannot be read as a mesh"),
        ("drawing.step", b"ISO-10303-21;", "suffix '.step'"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=expected) as caught:
            read_segmented_mesh(tmp_path / name)
        assert_sentence(caught.value, tmp_path / name)
