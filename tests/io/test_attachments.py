"""Files that are carried: read, moved, and written in their own format again."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from shapes import ball, box

from mereo.geometry.subdivision import split_long_edges
from mereo.io.attachments import Positions, Surfaces, read_attachments, read_pose_table, write_attachment
from mereo.io.volume_files import file_space
from mereo.io.writers.glb import viewer_rotation
from mereo.scenes.files.template import write_scene_file
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SourceFrame

POINTS = default_rng(0).normal(size=(20, 3))


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "glb"])
def test_a_mesh_keeps_its_format_and_its_surface(tmp_path: Path, suffix: str) -> None:
    part = ball((3.0, 1.0, 2.0), 1.5, "vessel", level=2)
    exported = trimesh.Trimesh(part.vertices, part.faces).export(file_type=suffix)
    (tmp_path / f"vessel.{suffix}").write_bytes(exported if isinstance(exported, bytes) else exported.encode())
    (found,) = read_attachments([tmp_path / f"vessel.{suffix}"])
    assert isinstance(found.content, Surfaces) and found.name == f"vessel.{suffix}"
    moved = found.content.at(found.content.points + 1.0, None)
    path = tmp_path / "out" / found.name
    write_attachment(path, moved, 1.0, viewer_rotation("camera"), 0.001)
    (again,) = read_attachments([path])
    assert_allclose(np.sort(again.content.points, axis=0), np.sort(part.vertices + 1.0, axis=0), atol=1e-5)
    assert isinstance(again.content, Surfaces)
    again.content.mesh.check()


@pytest.mark.parametrize("suffix", ["ply", "xyz", "npy", "txt"])
def test_a_cloud_keeps_its_format_and_its_points(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud.{suffix}"
    write_attachment(path, Positions(POINTS), 1000.0, np.eye(3), 1.0)
    (found,) = read_attachments([path])
    assert isinstance(found.content, Positions)
    assert_allclose(found.content.points, 1000.0 * POINTS, rtol=1e-6)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_table_keeps_its_other_columns(tmp_path: Path, mark: str) -> None:
    rows = ["Z,note,X,y", '3,"a, b",1,2', "6,,4,5", "", "9,c,7,8"]
    text = "\n".join(rows) if mark == "," else "\n".join(rows).replace("a, b", "a b").replace(",", mark)
    table = read_pose_table(written(tmp_path / "t.csv", text))
    assert table.rotations is None
    assert_array_equal(table.points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    again = read_pose_table(written(tmp_path / "u.csv", table.at(table.points + 0.5, None).text(10.0)))
    assert_allclose(again.points, 10 * (table.points + 0.5))
    assert again.header == ("Z", "note", "X", "y")
    assert [row[1] for row in again.rows] == [row[1] for row in table.rows]


def test_poses_come_back_turned(tmp_path: Path) -> None:
    turns = Rotation.random(4, rng=default_rng(1))
    rows = ["grasp,x,y,z,qx,qy,qz,qw"]
    for index, (turn, point) in enumerate(zip(turns, POINTS, strict=False)):
        rows.append(",".join(map(str, [f"g{index}", *point, *turn.as_quat()])))
    about = Rotation.from_rotvec([0.2, 0.5, -1.0]).as_matrix()
    table = read_pose_table(written(tmp_path / "p.csv", "\n".join(rows)))
    assert table.rotations is not None
    assert_allclose(table.rotations, turns.as_matrix(), atol=1e-12)
    again = read_pose_table(written(tmp_path / "q.csv", table.at(table.points, about @ table.rotations).text()))
    assert again.rotations is not None
    assert_allclose(again.rotations, about @ turns.as_matrix(), atol=1e-9)
    assert_allclose(again.points, POINTS[:4], rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b,c\n1,2,3\n", "its columns are a, b, c; it needs x, y, z"),
        ("x,y,z,X\n1,2,3,4\n", "it has several columns 'x', of which one alone"),
        ("x,y,z\n", "it has a header and no row"),
        ("x,y,z\n1,2,3\n1,two,3\n", "line 3 has 'two' in the column y, which is no finite number"),
        ("x,y,z\n1,2,nan\n", "line 2 has 'nan' in the column z"),
        ("x,y,z\n1,2\n", "line 2 has 2 cells and the header 3"),
        ("x,y,z,qx,qy,qz\n1,2,3,0,0,0\n", "its columns are x, y, z, qx, qy, qz; it needs x, y, z, qx, qy, qz, qw"),
        ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n1,2,3,0,0,0,0\n", "line 3 has an orientation that is no rotation"),
        ("", "is empty"),
    ],
)
def test_a_table_that_cannot_be_used_says_why(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_pose_table(written(tmp_path / "t.csv", text))


def test_files_that_cannot_be_carried_say_why(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.stl does not exist"):
        read_attachments([tmp_path / "missing.stl"])
    with pytest.raises(ValueError, match=r"is empty \(0 bytes\)"):
        read_attachments([written(tmp_path / "empty.ply", "")])
    with pytest.raises(ValueError, match=r"has the suffix '.dae'; a file to carry is one of .stl, .ply"):
        read_attachments([written(tmp_path / "plan.dae", "x")])
    with pytest.raises(ValueError, match="cannot be read as a mesh"):
        read_attachments([written(tmp_path / "plan.stl", "no mesh at all")])
    (tmp_path / "sub").mkdir()
    twice = [written(folder / "a.csv", "x,y,z\n1,2,3\n") for folder in (tmp_path, tmp_path / "sub")]
    with pytest.raises(ValueError, match=r"two files to carry are called 'a.csv'"):
        read_attachments(twice)
    np.save(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    with pytest.raises(ValueError, match="has no positions, or NaN or infinite ones"):
        read_attachments([tmp_path / "nan.npy"])


def test_files_name_their_anatomical_space(tmp_path: Path) -> None:
    """As 3D Slicer does: in the header of binary and the first line of plain STL files, in comments of PLY and OBJ."""
    stl = ball((3.0, 1.0, 2.0), 1.5, level=1)
    plain = trimesh.Trimesh(stl.vertices, stl.faces)
    binary, ply = plain.export(file_type="stl"), plain.export(file_type="ply")
    files = {
        "a.stl": (b"3D Slicer output. SPACE=LPS".ljust(80, b"\0") + binary[80:], "LPS"),
        "b.stl": (plain.export(file_type="stl_ascii").replace("solid", "solid Slicer SPACE=RAS", 1).encode(), "RAS"),
        "c.ply": (ply.replace(b"comment", b"comment 3D Slicer output. SPACE=LPS\ncomment", 1), "LPS"),
        "d.obj": (b"# 3D Slicer output. SPACE=LPS\n" + plain.export(file_type="obj").encode(), "LPS"),
        "e.stl": (binary, None),
        "f.nii": (b"\0" * 400, "RAS"),
        "g.nrrd": (b"NRRD0004\nspace: left-posterior-superior\n\n", "RAS"),
        "h.nrrd": (b"NRRD0004\nspace: 3D-left-handed\n\n", None),
        "i.csv": (b"x,y,z\n1,2,3\n", None),
    }
    for name, (content, space) in files.items():
        (tmp_path / name).write_bytes(content)
        assert file_space(tmp_path / name) == space, name
    found = read_attachments([tmp_path / name for name in files if name[0] in "abcdei"])
    assert [each.space for each in found] == ["LPS", "RAS", "LPS", "LPS", None, None]
    (tmp_path / "a.stl").write_bytes(b"SPACE=LAS".ljust(80) + binary[80:])
    with pytest.raises(ValueError, match=r"a.stl is in the space LAS; a mesh is in LPS or RAS: export it in one"):
        file_space(tmp_path / "a.stl")
    scene = load_scene(write_scene_file([tmp_path / "d.obj"], tmp_path / "d.yaml"))
    assert scene.space == scene.source_frame.space == "LPS"
    assert SourceFrame.of_facts(scene.source_frame.facts()).space == "LPS"
    with pytest.raises(ValueError, match=r"d.obj is in LPS and .*b.stl in RAS, by what they state; the files of an"):
        load_scene(write_scene_file([tmp_path / "d.obj", tmp_path / "b.stl"], tmp_path / "two.yaml"))


def test_splitting_long_edges_keeps_the_surface() -> None:
    part = box((0, 0, 0), (8, 3, 1), "a")
    vertices, faces = split_long_edges(part.vertices, part.faces, 0.7, 100_000)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.edges_unique_length.max() <= 0.7 and mesh.is_watertight
    assert mesh.volume == pytest.approx(24.0) and mesh.area == pytest.approx(70.0)
    assert_array_equal(vertices[: len(part.vertices)], part.vertices)
    with pytest.raises(ValueError, match="would take 1,000 triangles or more to have no edge over 0.05; it"):
        split_long_edges(part.vertices, part.faces, 0.05, 1000)
