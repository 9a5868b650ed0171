"""`mereo scene new`: the file it writes loads as it is, fits the object, and explains every choice."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from label_cases import halves, write_nifti
from scene_files import write_mesh
from shapes import ball, box

import mereo.__main__ as command_line
from mereo.deformation.samplers import RandomMotion
from mereo.scenes.files import check
from mereo.scenes.files.template import identifier, write_scene_file
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES


def uncommented(text: str) -> str:
    """With every example switched on."""
    return re.sub(r"^#  ", "  ", text, flags=re.MULTILINE)


@pytest.mark.parametrize("longest", [30.0, 4000.0])
def test_the_file_loads_in_the_unit_that_is_likely(longest: float, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    files = [
        write_mesh(box((0, 0, 0), (longest / 2, 12, 10)), tmp_path / "parts" / "left part.stl"),
        write_mesh(box((longest / 2, 0, 0), (longest, 12, 10)), tmp_path / "parts" / "no.stl"),
    ]
    path = write_scene_file(files, tmp_path / "thing.yaml")
    scene = load_scene(path)
    assert (scene.name, scene.rest.names) == ("thing", ("left part", "no"))
    assert scene.unit_m is not None
    assert scene.unit_m * (scene.rest.bounds[1] - scene.rest.bounds[0]).max() == pytest.approx(longest / 1000)
    assert scene.workspace.all_around and scene.workspace.any_roll and scene.workspace.axis == (0.0, 0.0, 1.0)
    assert "file: parts/left part.stl" in path.read_text() and "name: 'no'" in path.read_text()


def test_every_example_in_the_comments_is_valid(tmp_path: Path) -> None:
    path = write_scene_file([write_mesh(ball((5, 5, 5), 30.0), tmp_path / "a.ply")], tmp_path / "a.yaml")
    path.write_text(uncommented(path.read_text()))
    scene = load_scene(path)
    assert isinstance(scene.sample_deformations, RandomMotion)
    assert len(scene.sample_deformations.steps) == 6
    scene.sample_state(np.random.default_rng(0)).mesh.check()


@pytest.mark.slow
def test_a_model_and_a_label_volume(tmp_path: Path) -> None:
    model = trimesh.Scene()
    for name, low in (("Body", 0.0), ("Lid #2", 1.0)):
        part = box((low, 0, 0), (low + 1, 1, 1))
        model.add_geometry(trimesh.Trimesh(part.vertices, part.faces), node_name=name, geom_name=name)
    model.export(tmp_path / "box.glb")
    path = write_scene_file([tmp_path / "box.glb"], tmp_path / "box.yaml")
    assert load_scene(path).rest.names == ("Body", "Lid #2")
    assert "units: m  # the rule of glTF" in path.read_text()
    volume = write_nifti(tmp_path / "ct.nii.gz", np.where(halves() == 7, 0, halves()))
    path = write_scene_file([volume], tmp_path / "ct.yaml")
    assert load_scene(path).rest.names == ("label_1", "label_2")


def test_nothing_is_overwritten_and_bad_input_is_explained(tmp_path: Path) -> None:
    file = write_mesh(ball((0, 0, 0), 3.0), tmp_path / "a.ply")
    (tmp_path / "sub").mkdir()
    same = write_mesh(ball((0, 0, 0), 3.0), tmp_path / "sub" / "a.stl")
    path = write_scene_file([file], tmp_path / "a.yaml")
    for files, output, error, message in (
        ([file], path, FileExistsError, "a.yaml exists; it is not overwritten"),
        ([file], tmp_path / "a.txt", ValueError, "a scene file is .yaml"),
        ([], None, ValueError, "no mesh is given"),
        ([file, same], tmp_path / "b.yaml", ValueError, "two files are called 'a'"),
        ([tmp_path / "none.stl"], tmp_path / "b.yaml", FileNotFoundError, "none.stl does not exist"),
        ([file, tmp_path / "ct.nii"], tmp_path / "b.yaml", ValueError, "a label volume among them"),
    ):
        with pytest.raises(error, match=message):
            write_scene_file(files, output)
    assert not (tmp_path / "b.yaml").exists()


AWKWARD = ("null", "1e-3", "a: b #c", "it's", "two\nlines\x7f")


def test_every_name_of_a_file_is_a_segment(tmp_path: Path) -> None:
    """Also one that YAML takes for another kind of value, or for several; what a name cannot have is replaced."""
    files = [write_mesh(box((10 * k, 0, 0), (10 * k + 9, 9, 9)), tmp_path / f"{k}.stl") for k in range(len(AWKWARD))]
    named = [file.rename(tmp_path / f"{name}.stl") for file, name in zip(files, AWKWARD, strict=True)]
    path = write_scene_file(named, tmp_path / "on.yaml")
    scene = load_scene(path)
    assert (scene.name, scene.rest.names) == ("on", (*AWKWARD[:-1], "two_lines_"))


def test_every_name_of_a_part_is_a_segment(tmp_path: Path) -> None:
    def write(*names: str) -> Path:
        model = trimesh.Scene()
        for low, name in enumerate(names):
            part = box((low, 0, 0), (low + 0.9, 1, 1))
            model.add_geometry(trimesh.Trimesh(part.vertices, part.faces), node_name=name, geom_name=name)
        model.export(tmp_path / "model.glb")
        return tmp_path / "model.glb"

    path = write_scene_file([write("Body/Lid\n2", "null", "3")], tmp_path / "a.yaml")
    assert load_scene(path).rest.names == ("Body_Lid_2", "null", "3")
    with pytest.raises(ValueError, match="two parts are called 'a_b'; segments are named after them: rename one"):
        write_scene_file([write("a/b", "a_b")], tmp_path / "b.yaml")
    assert not (tmp_path / "b.yaml").exists()


def test_a_file_name_that_no_text_holds_is_refused(tmp_path: Path) -> None:
    file = tmp_path / os.fsdecode(b"part\xff.stl")
    try:
        write_mesh(ball((0, 0, 0), 3.0, level=1), tmp_path / "a.stl").rename(file)
    except OSError:
        pytest.skip("this file system has names in UTF-8 only")
    with pytest.raises(ValueError, match="has a name that is not UTF-8; .*: rename it"):
        write_scene_file([file], tmp_path / "a.yaml")
    assert not (tmp_path / "a.yaml").exists()


def test_names_are_valid_and_new() -> None:
    assert identifier("My part (2)") == "My-part-2"
    assert identifier("...") == "object"
    assert identifier(SCENES[0]) == f"my-{SCENES[0]}"


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(check, "STATES", 3)
    write_mesh(ball((0, 0, 0), 30.0), tmp_path / "a.ply")
    monkeypatch.chdir(tmp_path)
    assert command_line.main(["scene", "new", "a.ply", "--units", "cm"]) == 0
    assert "units: cm  # as you said" in (tmp_path / "a.yaml").read_text()
    assert "wrote a.yaml" in capsys.readouterr().out
    assert command_line.main(["scene", "new", "a.ply", "--output", "b b.yaml", "--aperture", "90"]) == 0
    assert "aperture: 90 " in (tmp_path / "b b.yaml").read_text()
    assert "mereo scene check 'b b.yaml'" in capsys.readouterr().out
    assert command_line.main(["scene", "new", "a.ply", "--output", "c.yaml", "--aperture", "400"]) == 2
    assert "--aperture is 400" in capsys.readouterr().err and not (tmp_path / "c.yaml").exists()
    assert command_line.main(["scene", "check", "a.yaml"]) == 0
    assert "a: 1 segments, closed" in capsys.readouterr().out
    assert command_line.main(["scene", "preview", "a.yaml", "--output", "a.png"]) == 0
