"""Every format gives back the points that were written; every damaged file gets one sentence with its cure."""

import io
import json
import os
import struct
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from folder_contents import refusal
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from point_files import save_pcd, save_ply

from mereo.geometry.camera import Camera, PointCloud
from mereo.io.mesh_formats import MeshWarning, read_glb, read_segmented_mesh
from mereo.io.readers import InputWarning, is_depth_image, read_depth_image, read_mask, read_point_cloud

POINTS = default_rng(0).normal(size=(57, 3)).astype(np.float32) + np.float32(3)


def text(points: ndarray, separator: str, *, extra: str = "") -> str:
    return "".join(separator.join(repr(v) for v in row) + extra + "\n" for row in points.tolist())


CLOUDS = {
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
    "commas.csv": ("X;Y;Z\n" + text(POINTS, ";").replace(".", ",")).encode(),
    "spaced commas.txt": text(POINTS, " ").replace(".", ",").encode(),
    "tabs and commas.asc": ("x\ty\tz\tname\n" + text(POINTS, "\t", extra="\ta,b").replace(".", ",")).encode(),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_every_format_gives_back_the_points(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(CLOUDS[name])
    assert_array_equal(read_point_cloud(tmp_path / name).points, POINTS.astype(float))


def test_whole_numbers_between_commas_are_numbers(tmp_path: Path) -> None:
    """Millimetres with colours, and zeros among them, are no halves of numbers."""
    (tmp_path / "a.csv").write_text("x,y,z,r,g,b\n10,0,300,0,255,0\n-12,20,301,7,0,0\n")
    assert_array_equal(read_point_cloud(tmp_path / "a.csv").points, [[10, 0, 300], [-12, 20, 301]])


def test_arrays_in_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", POINTS)
    np.save(tmp_path / "organized.npy", POINTS[:56].reshape(7, 8, 3))
    np.savez(tmp_path / "named.npz", points=POINTS, other=POINTS[:2])
    np.savez(tmp_path / "only.npz", cloud=POINTS, matrix=np.eye(4))
    for name, count in (("flat.npy", 57), ("organized.npy", 56), ("named.npz", 57), ("only.npz", 57)):
        assert_array_equal(read_point_cloud(tmp_path / name).points, POINTS[:count])


def test_missing_points_are_refused_with_the_cure_or_dropped(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[3], points[5, 1], points[9] = nan, np.inf, 0
    for name, content in (("a.ply", save_ply(points, "binary_little_endian")), ("b.pcd", save_pcd(points, "binary"))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"3 of 57 points without a measurement.*--drop-invalid"):
            read_point_cloud(tmp_path / name)
        kept = np.delete(POINTS, [3, 5, 9], axis=0)
        assert_array_equal(read_point_cloud(tmp_path / name, drop_invalid=True).points, kept)


def npy(array: ndarray) -> bytes:
    np.save(file := io.BytesIO(), array)
    return file.getvalue()


PLY = save_ply(POINTS, "binary_little_endian")
PCD = save_pcd(POINTS, "binary")
PACKED = struct.pack("<II", 5, 80) + bytes([1, 65, 66, 32, 10])
BAD_CLOUDS = {
    "empty.ply": (b"", "is empty"),
    "no vertices.ply": (save_ply(POINTS[:0], "ascii"), "0 vertices"),
    "cut at a line.ply": (b"\n".join(CLOUDS["ascii.ply"].split(b"\n")[:-5]), "53 of 57|54 of 57"),
    "cut binary.pcd": (PCD[:-1], "truncated: 56 of 57"),
    "words.xyz": (b"once upon a time\nthere was a cloud\n", "no row of three numbers"),
    "a word among numbers.xyz": (b"1 2 3\n4 five 6\n", "cannot be read.*five"),
    "empty cell.csv": (b"1,2,3\n4,,6\n", "cannot be read"),
    "all commas.csv": (b"0,51,-0,95,0,35\n0,52,-0,09,0,36\n", "its first row is '0,51,-0,95,0,35', where commas are "),
    "titled commas.csv": (b"x,y,z\n1,51,-1,95,7,35\n", "commas are between numbers and seem to be in them: export it"),
    "really ply.pcd": (CLOUDS["ascii.ply"], "no PCD header"),
    "pickle.npy": (npy(np.array([{}], object)), "cannot be read"),
    "transposed.npy": (npy(POINTS.T), r"shape is \(3, 57\)"),
    "words.npy": (npy(np.array([["a", "b", "c"]])), "not a number"),
    "mesh.stl": (b"solid", "is a mesh, not what a camera has measured, .*: give the frame, and the mesh as the object"),
    "suffix.las": (b"LASF", "suffix '.las'.*convert"),
    "fewer than none.ply": (PLY.replace(b"vertex 57", b"vertex -5"), "its header states -5 of element 'vertex'"),
    "no such format.ply": (PLY.replace(b"little", b"middle"), "its format is 'binary_middle_endian'"),
    "more than there are.ply": (PLY.replace(b"57", b"1000000000000"), "PLY is unexpected length"),
    "fewer than none.pcd": (PCD.replace(b"POINTS 57", b"POINTS -5"), "its header states -5 points"),
    "two counts.pcd": (PCD.replace(b"POINTS 57", b"POINTS 20"), "its header states 20 points and 57 x 1"),
    "too far back.pcd": (
        PCD.partition(b"DATA")[0].replace(b"57", b"4") + b"DATA binary_compressed\n" + PACKED,
        "its compressed data are damaged",
    ),
    "cut short.pts": (CLOUDS["count.pts"].replace(b"57", b"58", 1), "truncated: 57 of 58 points"),
}


@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_a_bad_cloud_gets_one_sentence(tmp_path: Path, name: str) -> None:
    content, expected = BAD_CLOUDS[name]
    (tmp_path / name).write_bytes(content)
    with refused(tmp_path / name, expected):
        read_point_cloud(tmp_path / name)


@contextmanager
def refused(path: Path, expected: str) -> Iterator[None]:
    """Expect an error of one line that names the file and, after a colon, the cure."""
    with pytest.raises(ValueError, match=expected) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    assert ": " in message.replace(str(path), "")
    assert not isinstance(caught.value, UnicodeError)


def test_missing_files_and_directories(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist.*check the path"):
        read_mask(tmp_path / "nothing.png")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="is a directory"):
        read_point_cloud(tmp_path / "folder.ply")


def test_parts_of_an_obj_keep_their_order_names_and_closedness(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    lines = []
    offset = 1
    for name, shift in (("zebra", 0.0), ("ant", 3.0), ("middle part", 6.0)):
        lines += [f"v {x + shift} {y} {z}" for x, y, z in box.vertices]
        start = -8 if name == "ant" else offset  # those below 0 count from the latest vertex
        lines += [f"g {name}"] + [f"f {a + start}//1 {b + start}//2 {c + start}" for a, b, c in box.faces]
        offset += 8
    (tmp_path / "parts.obj").write_text("\n".join(lines))
    mesh = read_segmented_mesh(tmp_path / "parts.obj")
    mesh.check()
    assert mesh.names == ("zebra", "ant", "middle part")
    assert_allclose([s.volume for s in mesh.segments], 1.0)


def test_one_file_for_each_segment(tmp_path: Path) -> None:
    for name, suffix in (("b_ball", "ply"), ("a_box", "stl"), ("c_rod", "obj"), ("d_tube", "off")):
        trimesh.creation.icosphere(1).export(tmp_path / f"{name}.{suffix}")
    mesh = read_segmented_mesh(tmp_path)
    mesh.check()  # an STL file is triangles without connection until equal positions are merged
    assert mesh.names == ("a_box", "b_ball", "c_rod", "d_tube")
    assert len(set(mesh.colors)) == 4


def test_bad_meshes_get_one_sentence(tmp_path: Path) -> None:
    face, triangle = b"element face 5\nproperty list uchar int i\nend_header", b"3 0 1 2\n"
    for name, content, expected in (
        ("points.ply", CLOUDS["ascii.ply"], "no faces"),
        ("fewer faces.ply", CLOUDS["ascii.ply"].replace(b"end_header", face), "truncated: 57 of 62 rows"),
        ("fewer faces.off", b"OFF\n3 5 0\n0 0 0\n1 0 0\n0 1 0\n" + triangle, "truncated: 1 of 5 faces"),
        ("fewer than none.off", b"OFF\n-3 1 0\n0 0 0\n" + triangle, "its header states -3 vertices"),
        ("huge.stl", bytes(80) + b"\xff" * 4 + bytes(100), "cannot be read as a mesh"),
        ("broken.obj", b"v 0 0 0\nf 1 2 3\n", "refers to vertex 2 of 1"),
        ("zero.obj", b"v 0 0 0\nf 0 1 1\n", "refers to vertex 0 of 1"),
        ("two.obj", b"v 0 0 0\nv 1 2\n", "its line 2 is 'v 1 2'; a vertex or face has three entries or more"),
        ("edge.obj", b"v 0 0 0\n" * 3 + b"f 1 2\n", "its line 4 is 'f 1 2'; a vertex"),
        ("nan.obj", b"v 0 nan 0\n" * 3 + b"f 1 2 3\n", "its part 'nan' has vertices that are NaN, infinite or beyond"),
        ("point.obj", b"v 1 2 3\n" * 3 + b"f 1 2 3\n", "it has no faces of three different places"),
        ("broken.glb", b"glTF but not really", "cannot be read as a mesh"),
        ("drawing.step", b"ISO-10303-21;", "suffix '.step'"),
    ):
        (tmp_path / name).write_bytes(content)
        with refused(tmp_path / name, expected):
            read_segmented_mesh(tmp_path / name)


def write_glb(path: Path, arrays: list[ndarray], **tree: Any) -> Path:
    """GLB file of a tree whose accessor i is array i, in one buffer: its second chunk, unless the tree names others."""
    kinds = {"f4": 5126, "u2": 5123, "i2": 5122, "i1": 5120}
    content = b"".join(array.tobytes() for array in arrays)
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    views = [{"buffer": 0, "byteOffset": at, "byteLength": a.nbytes} for at, a in zip(starts, arrays, strict=False)]
    accessors = [
        {
            "bufferView": index,
            "componentType": kinds[a.dtype.str[1:]],
            "count": len(a),
            "normalized": a.dtype.kind == "i",
        }
        | {"type": "SCALAR" if a.ndim == 1 else f"VEC{a.shape[1]}"}
        for index, a in enumerate(arrays)
    ]
    common = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(tree["nodes"])))}]}
    common |= {"bufferViews": views, "buffers": [{"byteLength": len(content)}], "accessors": accessors}
    text = json.dumps(common | tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


BOX = trimesh.creation.box()
CORNERS = BOX.vertices.astype("<f4")
SIDES = BOX.faces.reshape(-1).astype("<u2")
SOLID = {"attributes": {"POSITION": 0}, "indices": 1}


def test_each_instance_and_node_of_a_glb_file_is_a_segment_in_its_place(tmp_path: Path) -> None:
    shifts = np.array([[0, 0, 0], [2, 0, 0], [0, 4, 0]], "<f4")
    turns = np.array([[0, 0, 0, 127], [0, 0, 127, 0], [0, 0, 0, 127]], "<i1")
    sizes = np.array([[1, 1, 1], [1, 2, 1], [1, 1, 3]], "<f4")
    places = {"attributes": {"TRANSLATION": 2, "ROTATION": 3, "SCALE": 4}}
    nodes = [
        {"name": "finger", "mesh": 0, "translation": [0, 0, 10], "extensions": {"EXT_mesh_gpu_instancing": places}},
        *({"name": "thumb", "mesh": 0, "translation": [9 * side, 0, 0]} for side in (1, -1)),
    ]
    arrays = [CORNERS, SIDES, shifts, turns, sizes]
    mesh = read_segmented_mesh(write_glb(tmp_path / "hand.glb", arrays, nodes=nodes, meshes=[{"primitives": [SOLID]}]))
    mesh.check()
    middles = {part.name: part.bounds.mean(axis=0).tolist() for part in mesh.segments}
    fingers = {f"finger_{number}": [x, y, 10] for number, (x, y, _) in enumerate(shifts.tolist(), 1)}
    assert middles == fingers | {"thumb": [9, 0, 0], "thumb_1": [-9, 0, 0]}
    assert_allclose([part.volume for part in mesh.segments], [1, 2, 3, 1, 1], rtol=1e-6)
    assert read_glb(tmp_path / "hand.glb").mesh.names == mesh.names


def test_materials_of_a_node_are_segments_where_each_is_closed(tmp_path: Path) -> None:
    halves = [{"attributes": {"POSITION": 0}, "indices": index, "material": index - 2} for index in (2, 3)]
    meshes = [{"primitives": halves}, {"primitives": [SOLID | {"material": 1}, SOLID]}]
    nodes = [{"name": "whole", "mesh": 0}, {"name": "pair", "mesh": 1, "translation": [5, 0, 0]}]
    arrays = [CORNERS, SIDES, SIDES[:15], SIDES[15:]]
    materials = [{"name": "red"}, {"name": "blue"}]
    path = write_glb(tmp_path / "two.glb", arrays, nodes=nodes, meshes=meshes, materials=materials)
    mesh = read_segmented_mesh(path)
    mesh.check()
    assert mesh.names == ("whole", "pair_blue", "pair_2")
    assert read_glb(path).mesh.names == ("whole_red", "whole_blue", "pair_blue", "pair_2")


def test_positions_as_shares_of_integers_and_sparse_ones_are_read_as_such(tmp_path: Path) -> None:
    shares = np.round(CORNERS * 2 * 32767).astype("<i2")
    node = {"name": "part", "mesh": 0, "scale": [0.5, 0.5, 0.5]}
    meshes = [{"primitives": [SOLID]}]
    mesh = read_segmented_mesh(write_glb(tmp_path / "a.glb", [shares, SIDES], nodes=[node], meshes=meshes))
    assert mesh.segments[0].volume == pytest.approx(1.0)
    moved = np.flatnonzero(CORNERS[:, 2] > 0).astype("<u2")
    arrays = [CORNERS, SIDES, moved, CORNERS[moved] + np.array([0, 0, 2], "<f4")]
    sparse = {"count": 4, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    changed = {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "sparse": sparse}
    indices = {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"}
    tree = {"nodes": [{"name": "part", "mesh": 0}], "meshes": meshes, "accessors": [changed, indices]}
    assert read_segmented_mesh(write_glb(tmp_path / "b.glb", arrays, **tree)).segments[0].volume == pytest.approx(3.0)


@pytest.mark.parametrize("extension", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_a_compressed_glb_file_is_refused_by_its_compression(extension: str, tmp_path: Path) -> None:
    tree = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [SOLID]}], "extensionsUsed": [extension]}
    path = write_glb(tmp_path / "a.glb", [CORNERS, SIDES], **tree)
    with refused(path, f"it is compressed by {extension}, which is not read: export"):
        read_segmented_mesh(path)


def test_a_mesh_opens_no_files_but_buffers_in_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "mesh"
    (folder / "below").mkdir(parents=True)
    content = CORNERS.tobytes() + SIDES.tobytes()
    for place in (tmp_path / "secret.bin", folder / "below" / "in here.bin"):
        place.write_bytes(content)
    (folder / "link.bin").symlink_to("../secret.bin")
    os.mkfifo(folder / "pipe.bin")
    look = {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}]}
    tree = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [SOLID | {"material": 0}]}], **look}
    tree |= {"images": [{"uri": "pipe.bin"}]}  # which would be waited for
    path = folder / "a.glb"
    good = {"buffers": [{"uri": "below/in%20here.bin", "byteLength": len(content)}]}
    assert read_segmented_mesh(write_glb(path, [CORNERS, SIDES], **tree, **good)).segments[0].volume == 1.0
    for uri in (
        "../secret.bin",
        str(tmp_path / "secret.bin"),
        "link.bin",
        "pipe.bin",
        "/dev/zero",
        "below",
        "none.bin",
    ):
        bad = {"buffers": [{"uri": uri, "byteLength": len(content)}]}
        with pytest.raises(ValueError, match=f"it names '{uri}', which is no regular file in its folder or below"):
            read_segmented_mesh(write_glb(path, [CORNERS, SIDES], **tree, **bad))
    text = BOX.export(file_type="ply", encoding="ascii")
    text = text.decode() if isinstance(text, bytes) else text
    (folder / "a.ply").write_text(text.replace("element vertex", "comment TextureFile pipe.bin\nelement vertex"))
    assert read_segmented_mesh(folder / "a.ply").segments[0].volume == 1.0
    assert len(read_point_cloud(folder / "a.ply").points) == 8
    (folder / "a.obj").write_text("mtllib pipe.bin\nmtllib /dev/zero\n" + BOX.export(file_type="obj"))
    assert read_segmented_mesh(folder / "a.obj").segments[0].volume == 1.0


def test_a_3mf_file_that_unpacks_to_more_than_the_limit_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("lxml", reason="lxml comes with the extra cad")
    BOX.export(tmp_path / "a.3mf")
    with zipfile.ZipFile(tmp_path / "a.3mf", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/zeros.bin", bytes(20_000_000))
    assert read_segmented_mesh(tmp_path / "a.3mf").segments[0].volume == 1.0
    monkeypatch.setenv("MEREO_MAX_FILE_GB", "0.02")
    monkeypatch.setattr(trimesh, "load_scene", None)
    with pytest.raises(ValueError, match="a.3mf takes more than 0.02 GB of memory to read: .* MEREO_MAX_FILE_GB=1"):
        read_segmented_mesh(tmp_path / "a.3mf")


def write_materials(path: Path, parts: list[tuple[str, ndarray]]) -> Path:
    """OBJ file of boxes' faces, of which each material has its own vertices."""
    lines = list[str]()
    for index, (material, faces) in enumerate(parts):
        lines += [*(f"v {x + 3 * index} {y} {z}" for x, y, z in BOX.vertices), f"usemtl {material}"]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 8 * index + 1]
    path.write_text("\n".join(lines))
    return path


def test_materials_of_an_obj_file_are_segments_where_closed_or_it_is_said(tmp_path: Path) -> None:
    mesh = read_segmented_mesh(write_materials(tmp_path / "a.obj", [("red", BOX.faces), ("blue", BOX.faces)]))
    mesh.check()
    assert mesh.names == ("red", "blue")
    path = write_materials(tmp_path / "b.obj", [("red", BOX.faces), ("blue", BOX.faces[1:])])
    with pytest.warns(MeshWarning, match="b.obj has 2 materials, which are no closed parts, but no objects") as caught:
        assert read_segmented_mesh(path).names == ("b",)
    assert len(caught) == 1


# --- depth images -----------------------------------------------------------------------------------------------------

CAMERA = Camera(8, 6, 10.0, 11.0, 4.0, 3.0)


def save_depth(path: Path, values: ndarray) -> Path:
    Image.fromarray(values).save(path)
    return path


def test_depth_is_value_over_scale_and_masked(tmp_path: Path) -> None:
    values = default_rng(1).integers(400, 60000, (6, 8)).astype(np.uint16)
    values[2, 3] = 0
    path = save_depth(tmp_path / "d.png", values)
    assert_array_equal(read_depth_image(path, CAMERA, 5000.0).depth, values / 5000.0)
    mask = np.zeros((6, 8), np.uint8)
    mask[1:4, 2:5] = 255
    masked = read_depth_image(path, CAMERA, 5000.0, save_depth(tmp_path / "m.png", mask))
    assert int(masked.valid.sum()) == 8
    assert_array_equal(masked.depth, np.where(mask > 0, values / 5000.0, 0))


def test_a_bad_depth_image_gets_one_sentence(tmp_path: Path) -> None:
    good = np.full((6, 8), 900, np.uint16)
    path = tmp_path / "d.png"
    for values, scale, expected in (
        (np.zeros((6, 8), np.uint16), 1000.0, "measures 0 pixels in the image"),
        (np.full((6, 8), 90, np.uint8), 1000.0, "mode L, not a 16-bit grey PNG"),
        (np.full((6, 9), 900, np.uint16), 1000.0, "9 x 6 pixels but the intrinsics say 8 x 6"),
        (good, 1.0, "median depth of .* is 900 m.*--depth-scale"),
        (good, 0.0, "depth scale is 0.0"),
    ):
        save_depth(path, values)
        with refusal(expected):
            read_depth_image(path, CAMERA, scale)
    noise = default_rng(0).integers(500, 1500, (60, 80)).astype(np.uint16)
    path.write_bytes(save_depth(path, noise).read_bytes()[:3000])
    with refused(path, "cannot be read as a depth image"):
        read_depth_image(path, CAMERA)
    save_depth(path, good)
    with pytest.raises(ValueError, match="measures 0 pixels inside the mask"):
        read_depth_image(path, CAMERA, 1000.0, save_depth(tmp_path / "m.png", np.zeros((6, 8), np.uint8)))
    with pytest.raises(ValueError, match="the mask .* is 5 x 4 pixels but the depth image is 8 x 6"):
        read_depth_image(path, CAMERA, 1000.0, save_depth(tmp_path / "m.png", np.ones((4, 5), np.uint8)))


def test_masks_of_all_kinds_agree(tmp_path: Path) -> None:
    truth = default_rng(2).random((5, 7)) > 0.5
    grey = Image.fromarray(truth.astype(np.uint8) * 9)
    for name, image in (
        ("grey", grey),
        ("deep", Image.fromarray(truth.astype(np.uint16) * 256)),
        ("bits", Image.fromarray(truth)),
        ("color", Image.merge("RGB", (Image.new("L", grey.size), grey, Image.new("L", grey.size)))),
        ("opaque", Image.merge("RGBA", (grey, grey, grey, Image.new("L", grey.size, 255)))),
    ):
        image.save(tmp_path / f"{name}.png")
        assert_array_equal(read_mask(tmp_path / f"{name}.png"), truth, err_msg=name)


def disk(*values: int) -> ndarray:
    """Nested disks of these values on an image of 0."""
    row, column = np.mgrid[:40, :60]
    radius = np.hypot(row - 20, column - 30)
    return np.select([radius < 18 - 5 * i for i in range(len(values))][::-1], values[::-1], 0).astype(np.uint8)


def test_soft_edges_are_taken_from_half_of_white_and_a_word_is_said(tmp_path: Path) -> None:
    truth = disk(255) > 0
    grey = Image.fromarray(disk(255))
    grey.save(tmp_path / "mask.jpg", quality=60)
    assert ((np.asarray(Image.open(tmp_path / "mask.jpg")) > 0) != truth).sum() > 50, "grey would count as object"
    grey.convert("RGB").resize((120, 80), Image.Resampling.BILINEAR).save(tmp_path / "resized.png")
    for name, why, factor in (("mask.jpg", r" \(a lossy format makes them\)", 1), ("resized.png", "", 2)):
        with pytest.warns(InputWarning, match=f"{name} has grey edges{why}; its pixels from half of white"):
            mask = read_mask(tmp_path / name)
        assert_array_equal(mask, np.kron(truth, np.ones((factor, factor))) > 0, err_msg=name)


def test_a_mask_of_ids_needs_the_objects(tmp_path: Path) -> None:
    ids = disk(1, 4, 3)
    path = tmp_path / "ids.png"
    save_depth(path, ids)
    palette = Image.fromarray(ids)
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0, 0, 0, 128])
    palette.save(tmp_path / "colors.png")
    save_depth(tmp_path / "deep.png", ids.astype(np.uint16))
    for name in ("ids.png", "colors.png", "deep.png"):
        with pytest.raises(
            ValueError, match=r"has the values 0, 1, 3, 4, which may be ids .* --mask-value 4 or others"
        ):
            read_mask(tmp_path / name)
        assert_array_equal(read_mask(tmp_path / name, values=(3,)), ids == 3)
        assert_array_equal(read_mask(tmp_path / name, values=(3, 4)), ids >= 3)
    with pytest.raises(
        ValueError, match=r"has the values 0, 1, 3, 4, and the object's are to be \[7\]; .*--mask-value"
    ):
        read_mask(path, values=(7,))
    palette.convert("RGB").save(tmp_path / "ids.jpg")
    with pytest.raises(ValueError, match="is in a lossy format, and the object's are to be"):
        read_mask(tmp_path / "ids.jpg", values=(3,))


def test_what_is_opaque_is_the_object(tmp_path: Path) -> None:
    truth = disk(255) > 0
    noise = default_rng(3).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    alpha = Image.fromarray(truth.astype(np.uint8) * 250)
    for name, image in (
        ("colors", Image.merge("RGBA", (*Image.fromarray(noise).split(), alpha))),
        ("grey", Image.merge("LA", (Image.fromarray(noise[..., 0]), alpha))),
    ):
        image.save(tmp_path / f"{name}.png")
        assert_array_equal(read_mask(tmp_path / f"{name}.png"), truth, err_msg=name)
    cut_out = Image.fromarray(np.where(truth, 7, 2).astype(np.uint8))
    cut_out.putpalette([9] * 30)
    cut_out.save(tmp_path / "palette.png", transparency=2)
    assert_array_equal(read_mask(tmp_path / "palette.png"), truth)


MILLIMETRES = default_rng(5).integers(400, 9000, (6, 8)).astype(np.uint16)
MILLIMETRES[2, 3] = 0
METRES = np.where(MILLIMETRES > 0, MILLIMETRES / np.float32(1000), nan).astype(np.float32)


@pytest.mark.parametrize("name", ["short.tif", "float.tiff", "big.tif", "short.npy", "double.npy"])
def test_every_format_gives_the_same_metres(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    values = {"short": MILLIMETRES, "big": MILLIMETRES.astype(">u2"), "double": METRES.astype(">f8")}
    stored = values.get(path.stem, METRES)
    np.save(path, stored) if path.suffix == ".npy" else save_depth(path, stored)
    depth = read_depth_image(path, CAMERA).depth
    assert_allclose(depth, MILLIMETRES / 1000, rtol=1e-6)
    assert depth[2, 3] == 0, "NaN and 0 both say that nothing was measured"


@pytest.mark.parametrize(
    "channels", [{"Z": 1.0}, {"ViewLayer.Depth.Z": 1.0, "R": 9.0, "G": 9.0, "B": 9.0}, {"odd": 1.0}]
)
def test_exr(tmp_path: Path, channels: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="OpenEXR comes with the extra sensors")
    stored = np.where(np.isnan(METRES), np.float32(1e10), METRES)  # what renderers write where there is nothing
    pixels = {name: np.ascontiguousarray(stored * np.float32(factor)) for name, factor in channels.items()}
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, pixels).write(str(tmp_path / "d.exr"))
    assert_allclose(read_depth_image(tmp_path / "d.exr", CAMERA).depth, MILLIMETRES / 1000, rtol=1e-6)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"d.exr needs OpenEXR, .*: pip install 'mereo\[sensors\]'"):
        read_depth_image(tmp_path / "d.exr", CAMERA)


def test_what_is_no_depth_image_is_said_so(tmp_path: Path) -> None:
    save_depth(tmp_path / "grey.tif", np.zeros((6, 8), np.uint8))
    page = Image.fromarray(MILLIMETRES)
    page.save(tmp_path / "pages.tif", save_all=True, append_images=[page])
    np.save(tmp_path / "words.npy", np.array([["a", "b"]]))
    (tmp_path / "photo.jpg").write_bytes(b"JFIF")
    for name, expected in (
        ("grey.tif", "mode L, not a grey TIFF of 16-bit or float values"),
        ("pages.tif", "2 pages instead of one"),
        ("words.npy", "not a number"),
        ("photo.jpg", "suffix '.jpg'; a depth image is one of .png, .tif, .tiff, .exr, .npy"),
    ):
        with refused(tmp_path / name, expected):
            read_depth_image(tmp_path / name, CAMERA)


def test_arrays_are_told_apart_by_their_shape(tmp_path: Path) -> None:
    cases = (((48, 64), True), ((100, 3), False), ((100, 2), False), ((100, 6), False), ((48, 64, 3), False))
    for shape, image in cases:
        np.save(tmp_path / "a.npy", np.ones(shape))
        assert is_depth_image(tmp_path / "a.npy") == image


def test_normals_of_a_ply_file_are_read_with_its_points(tmp_path: Path) -> None:
    normals = default_rng(1).normal(size=POINTS.shape)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    head = f"ply\nformat {{}} 1.0\nelement vertex {len(POINTS)}\n{names}end_header\n"
    rows = np.hstack([POINTS, normals]).astype("<f4")
    (tmp_path / "a.ply").write_bytes(head.format("ascii").encode() + text(rows, " ").encode())
    (tmp_path / "b.ply").write_bytes(head.format("binary_little_endian").encode() + rows.tobytes())
    for name in ("a.ply", "b.ply"):
        cloud = read_point_cloud(tmp_path / name)
        assert_array_equal(cloud.points, POINTS.astype(float))
        length = norm(normals, axis=1, keepdims=True)
        assert_allclose(cloud.normals, normals / length, atol=1e-6)
    rows[3], rows[5, 3] = 0.0, nan
    (tmp_path / "b.ply").write_bytes(head.format("binary_little_endian").encode() + rows.tobytes())
    cloud = read_point_cloud(tmp_path / "b.ply", drop_invalid=True)
    assert cloud.normals is not None and len(cloud.normals) == len(cloud) == 56 and np.isfinite(cloud.normals).all()
    with pytest.raises(ValueError, match="there are 1 normals and 56 points; each point needs one"):
        PointCloud(cloud.points, cloud.normals[:1])
