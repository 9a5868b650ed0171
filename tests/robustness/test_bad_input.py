"""What a user sees after a mistake: one line that says value, rule and cure, exit code 2, and nothing half-written."""

import os
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import untrained
from folder_contents import run_mereo
from numpy.random import default_rng
from scene_files import HEAD, write_mesh
from shapes import ball, box

from mereo import __main__ as command_line
from mereo.geometry.mesh import SegmentedMesh, check_segment
from mereo.io.atomic_files import atomic_file, check_new_directory, new_directory
from mereo.io.object_storage import claim


def refused(capsys: pytest.CaptureFixture, folder: Path, text: str, *arguments: object) -> None:
    """The command fails with one line that contains ``text`` and makes no output."""
    before = sorted(folder.rglob("*"))
    code = command_line.main([str(a) for a in arguments])
    message = capsys.readouterr().err.strip()
    assert code == 2, message
    assert message.startswith("mereo: error: ") and "\n" not in message, message
    assert text in message, message
    assert sorted(folder.rglob("*")) == before


def cloud(count: int = 200) -> np.ndarray:
    return default_rng(0).normal(loc=(0.0, 0.0, 20.0), size=(count, 3))


BAD_CLOUDS = {
    "missing": (None, "missing.npy"),
    "too few": (cloud(20), "has 20 points; a reconstruction needs at least 32"),
    "behind": (cloud() - [0.0, 0.0, 40.0], "behind the camera"),
    "one place": (
        np.ones((100, 3)),
        "the 100 points of missing.npy lie on a line or at one place; the object's surface must",
    ),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_bad_clouds(case: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    points, text = BAD_CLOUDS[case]
    path = tmp_path / "missing.npy"
    if points is not None:
        np.save(path, points)
    refused(capsys, tmp_path, text, "reconstruct", path, "--weights", "rope", "--output", tmp_path / "out")


@pytest.mark.parametrize("number", ["1e400", "1e300", "nan"])
def test_a_mesh_beyond_all_numbers(number: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    places = f"v 0 0 0\nv {number} 0 0\nv 0 1 0\nv 0 0 1\n"
    faces = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part.obj").write_text(places + faces)
    text = "part.obj cannot be read as a mesh (its part 'part' has vertices that are NaN, infinite or beyond 1e+12)"
    refused(capsys, tmp_path, text, "learn", tmp_path / "part.obj", "--output", tmp_path / "out")


def test_bad_segments_are_named_with_the_cure() -> None:
    whole = ball((0, 0, 0), 1.0, level=3)
    vertices, faces = whole.vertices, whole.faces
    cases = {
        r"segment 'ball' has 3 open edges; it must be closed: fill its holes": replace(whole, faces=faces[1:]),
        r"segment 'ball' has volume -.*it must be positive.*reverse them": replace(whole, faces=faces[:, ::-1]),
        r"edges whose faces disagree": replace(whole, faces=np.concatenate([faces[:1, ::-1], faces[1:]])),
        r"NaN or infinite vertices": replace(whole, vertices=np.where(vertices > 0.99, np.nan, vertices)),
        r"refers to vertex 700 of 642": replace(whole, faces=np.concatenate([faces, [[0, 1, 700]]])),
        r"has no faces": replace(whole, faces=faces[:0]),
    }
    check_segment(whole)
    for text, segment in cases.items():
        with pytest.raises(ValueError, match=text):
            check_segment(segment)


def test_segment_names_are_unique_and_few() -> None:
    part = ball((0, 0, 0), 1.0, level=1)
    many = tuple(replace(part, name=str(i)) for i in range(255))
    for parts, text in (((part, part), "'ball' is used twice"), ((), "0 segments"), (many, "at most 254")):
        with pytest.raises(ValueError, match=text):
            SegmentedMesh(parts)


def test_nothing_is_found_where_nothing_ever_was_in_training() -> None:
    """An untrained network says anything anywhere; outside its domain the answer is empty all the same."""
    wild = untrained(("a", "b"))
    code = wild.encode(cloud())
    places = code.normalizer.invert(default_rng(1).uniform(-4, 4, size=(3000, 3)))
    outside = (np.abs(code.normalizer.apply(places)) > 1.5).any(axis=1)
    said = wild.query(code, places).label
    answer = replace(wild, domain=((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))).query(code, places)
    assert (said[outside] > 0).any() and np.array_equal(answer.label[~outside], said[~outside])
    assert (answer.label[outside] == 0).all() and answer.probability[outside, 0].min() > 0.999


# --- what is no place for an output is refused, and before any work ---------------------------------------------------


NO_PLACES = {
    "": "the output '.' has no name of its own",
    "..": "the output '..' has no name of its own",
    "a\udcff": r"the output 'a\\udcff' has .* no UTF-8 text: choose another name",
    "a\0b": r"the output 'a\\x00b' has a zero byte",
    "link": "link is a link, which would be lost; an output is written in its own place: name that",
    "pipe/deep/out": "pipe is no folder, so out cannot be made in it: choose another --output",
    "pipe": "is a device or pipe; an output is a file or folder: choose another --output",
}


@pytest.mark.parametrize("name", NO_PLACES)
@pytest.mark.parametrize("make", [new_directory, atomic_file], ids=["folder", "file"])
def test_what_is_no_place_for_an_output_is_refused_before_the_work(
    make: Callable[..., AbstractContextManager[Path]], name: str, working_folder: Path
) -> None:
    Path("target").mkdir()
    Path("link").symlink_to("target")
    os.mkfifo("pipe")
    before = sorted(working_folder.rglob("*"))
    for force in (True, False):
        with pytest.raises(ValueError, match=NO_PLACES[name]), make(name, force=force):
            pytest.fail("the work was begun")
    assert sorted(working_folder.rglob("*")) == before


def test_a_run_may_lie_behind_a_link(tmp_path: Path) -> None:
    """Nothing is put in the place of a folder in which work is continued."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to("disk")
    assert claim(tmp_path / "run", "config.json", {"a": 1}, "a run") is None
    assert os.listdir(tmp_path / "disk") == ["config.json"] and (tmp_path / "run").is_symlink()
    os.mkfifo(tmp_path / "pipe")
    for path in (Path(""), Path(".."), tmp_path / "pipe"):
        with pytest.raises(ValueError, match="has no name|is a device"):
            claim(path, "config.json", {}, "a run")


def test_a_mount_point_is_no_place_for_a_new_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "ismount", lambda path: path == tmp_path)
    with pytest.raises(ValueError, match="is a mount point, which cannot be renamed: name a folder in it"):
        check_new_directory(tmp_path, force=True)


@pytest.mark.parametrize(
    "command",
    [
        "reconstruct cloud.npy --weights rope --output {}",
        "export rope --output {}",
        "evaluate rope --output {}",
        "generate rope --examples 2 --output {}",
        "train data --output {}",
        "align cloud.npy --scene rope --start start.json --output {}",
        "stream . --weights rope --surfaces {}",
        "scene preview rope --output {}",
        "bench --weights rope --output {}",
        "demo --output {}",
    ],
)
def test_every_command_refuses_a_pipe_first(command: str, working_folder: Path, capsys: pytest.CaptureFixture) -> None:
    os.mkfifo("pipe")
    assert command_line.main(command.format("pipe").split()) == 2
    assert "mereo: error: pipe is a device or pipe" in capsys.readouterr().err
    assert Path("pipe").is_fifo() and os.listdir() == ["pipe"]


@pytest.mark.parametrize(
    "command",
    [
        "reconstruct left.ply --weights rope --output {}",
        "scene export bar.yaml --output right.ply",
        "scene export bar.yaml --output linked.ply",
        "scene preview bar.yaml --output bar.yaml",
        "scene preview bar.yaml --output left.ply",
        "bench --weights weights.safetensors --output weights.safetensors",
    ],
)
def test_not_even_force_replaces_an_input(
    command: str, working_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """By whatever name: the mesh of a scene file, the file itself, an asset of a built-in scene, weights."""
    monkeypatch.setenv("MEREO_ASSETS", str(working_folder / "assets"))
    for name, low in (("left", 0), ("right", 20)):
        write_mesh(box((low, 0, 0), (low + 20, 10, 10), name), Path(f"{name}.ply"))
    Path("bar.yaml").write_text(HEAD.replace(".stl", ".ply"))
    os.link("right.ply", "linked.ply")
    Path("assets/bunny").mkdir(parents=True)
    for name in ("weights.safetensors", "assets/bunny/bunny.off"):
        Path(name).write_text("precious")
    before = {path: path.read_bytes() for path in working_folder.rglob("*") if path.is_file()}
    assert run_mereo(*command.format(working_folder).split(), "--force") == 2
    assert re.search("is read.*; it is not replaced.*: choose another", capsys.readouterr().err)
    assert {path: path.read_bytes() for path in working_folder.rglob("*") if path.is_file()} == before
