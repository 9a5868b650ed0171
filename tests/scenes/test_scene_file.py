"""Scene files: what a file says is what the scene is, errors name lines, and new ones explain every choice."""

import os
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh
from folder_contents import run_mereo
from label_cases import halves, write_nifti
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from overlapping import check_overlap
from scene_code import CODE, EVERYTHING
from scene_files import HEAD, write_bar, write_mesh
from shapes import ball, box, write_model

from mereo.deformation.maps import jacobian_determinant
from mereo.deformation.samplers import RandomMotion
from mereo.geometry.conventions import Names, WholeNumbers
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.scenes.files import build, check
from mereo.scenes.files.deformation_blocks import AnyDeformation, CameraBlock, SceneFile
from mereo.scenes.files.template import (
    UNPLACED,
    default_deformations,
    identifier,
    measure_motion,
    random_motion,
    write_scene_file,
)
from mereo.scenes.parameters import parameters, random_state
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES


def test_the_scene_has_the_files_segments_in_scene_units(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path, "size: 15\ncamera: {field_of_view: 30, distance: [90, 95], roll: true}\n"))
    assert (scene.name, scene.rest.names) == ("bar", ("left", "right"))
    assert scene.rest.colors == (PALETTE[0], (1, 2, 3))
    assert_allclose(scene.rest.bounds, [[-30, -7.5, -7.5], [30, 7.5, 7.5]], atol=1e-4)
    assert scene.unit_m == pytest.approx(0.010 / 15)
    assert scene.workspace.fov_rad == pytest.approx(np.deg2rad(30))
    assert (scene.workspace.distance, scene.workspace.any_roll) == ((90.0, 95.0), True)
    scene.rest.check()


@pytest.mark.parametrize("sides", [(20, 10, 10), (20, 4, 1)])
def test_segments_that_do_not_touch_bend_as_much_as_they_should_in_a_box_of_rubber(sides: WholeNumbers) -> None:
    apart = SegmentedMesh((box((0, 0, 0), sides, "left", 0), box((30, 0, 0), np.add(sides, [30, 0, 0]), "right", 1)))
    blocks = default_deformations(apart)
    assert [block.type for block in blocks] == ["bend", "lattice", "lattice"]
    assert measure_motion(apart, random_motion(apart, blocks, UNPLACED)).mean == pytest.approx(0.05, rel=0.1)


def test_a_scene_that_is_loaded_again_is_not_refined_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its content: not by its path, and other deformations are another scene."""
    refined = build.refined
    calls = []
    monkeypatch.setattr(build, "refined", lambda *scene: (calls.append(1), refined(*scene))[1])
    build._kept.cache_clear()
    scenes = []
    for folder, text in (("a", ""), ("b", ""), ("c", "deformations:\n  - {type: squash, factor: [0.5, 2.0]}\n")):
        (tmp_path / folder).mkdir()
        scenes.append(load_scene(write_bar(tmp_path / folder, text)))
    assert len(calls) == 2
    meshes = [scene.rest.merged()[0] for scene in scenes]
    assert_array_equal(meshes[0], meshes[1])
    assert meshes[2].shape != meshes[0].shape


def test_every_deformation_keeps_space_from_folding(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path, EVERYTHING))
    rng = default_rng(3)
    assert isinstance(scene.sample_deformations, RandomMotion) and len(scene.sample_deformations.steps) == 8
    moved = 0.0
    for _ in range(40):
        for segment, deformation in zip(scene.rest.segments, scene.sample_deformations(rng), strict=True):
            vertices = rng.choice(segment.vertices, 200)
            weights = rng.dirichlet([1, 1], size=len(vertices))
            inner = weights[:, :1] * vertices + weights[:, 1:] * segment.bounds.mean(axis=0)
            assert jacobian_determinant(deformation, np.concatenate([inner, vertices])).min() > 0
            moved = max(moved, float(np.abs(deformation(inner) - inner).max()))
    assert moved > 10


def test_sliders_are_named_after_the_files_deformations(tmp_path: Path) -> None:
    names = [
        (f.group, f.name, f.unit) for f in parameters(random_state(load_scene(write_bar(tmp_path, EVERYTHING)), 0))
    ]
    groups = ("1 joint of right", "2 lattice", "3 waves", "4 squash", "5 twist", "6 taper", "7 bend", "8 push")
    assert tuple(dict.fromkeys(group for group, *_ in names)) == groups and len(set(names)) == len(names)
    joint = [(name, unit) for group, name, unit in names if group.startswith("1")]
    assert joint == [("angle", "°"), ("slide", ""), ("shift x", ""), ("shift y", ""), ("shift z", "")]


def test_a_joint_turns_about_the_place_that_the_file_names(tmp_path: Path) -> None:
    joint = "- {type: joint, segments: [right], pivot: [120, 5, 0], axis: [0, 0, 2], angle: [90, 90]}"
    scene = load_scene(write_bar(tmp_path, f"deformations:\n  {joint}\n"))
    left, right = scene.sample_deformations(default_rng(0))
    pivot = np.array([[0.0, 0.0, -10.0]])  # 120, 5, 0 in scene units: the box is centred at 120, 5, 5 and doubled
    assert_allclose(right(pivot), pivot, atol=1e-4)
    assert_allclose(right(pivot + np.array([10, 0, 0])), pivot + np.array([0, 10, 0]), atol=1e-4)
    assert_array_equal(left(pivot + 1), pivot + 1)


def test_segments_with_the_same_deformations_stay_in_contact(tmp_path: Path) -> None:
    tail = "deformations:\n  - {type: waves, wavelength: [20, 60], strength: 0.8}\n  - {type: lattice}\n"
    scene = load_scene(write_bar(tmp_path, tail))
    given = len(trimesh.load_mesh(tmp_path / "left.stl").vertices)  # others divide long edges, to each side its own
    touching = [np.isclose(s.vertices[:, 0], 0) & (np.arange(len(s.vertices)) < given) for s in scene.rest.segments]
    before = [s.vertices[rows] for s, rows in zip(scene.rest.segments, touching, strict=True)]
    mesh = scene.sample_state(default_rng(0)).mesh
    faces = [moved.vertices[rows] for moved, rows in zip(mesh.segments, touching, strict=True)]
    order = [np.lexsort(np.round(points, 5).T) for points in before]
    assert len(order[0]) > 20
    assert_allclose(faces[0][order[0]], faces[1][order[1]], atol=1e-9)
    check_overlap(mesh)


def test_parts_of_a_model_are_renamed_joined_and_left_out(tmp_path: Path) -> None:
    path = tmp_path / "box.yaml"
    parts = {"Lid": box((0, 0, 2), (2, 2, 3)), "Body": box((0, 0, 0), (2, 2, 2))}
    write_model(tmp_path / "box.glb", {**parts, "Bolt": ball((9, 9, 9), 1)})
    head = "name: box\nunits: m\nmodel: box.glb\nparts:\n"
    path.write_text(f"{head}  - {{name: Body, nested_in: all}}\n  - {{name: all, parts: [Lid, Body]}}\n")
    rest = load_scene(path).rest
    assert (rest.names, rest.nested) == (("Body", "all"), (("Body", "all"),))
    # scaled to a shortest side of 20: the union of lid and body, which touch, is 2 x 2 x 3 metres
    assert [segment.volume for segment in rest.segments] == pytest.approx([8000, 12000])
    path.write_text(f"{head}  - name: Bold\n")
    with pytest.raises(ValueError, match=r"box.yaml:5: the model has no part 'Bold': did you mean 'Bolt'\?"):
        load_scene(path)


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "line", "parts"),
    [
        ("units: mm\n", "", 1, ("`units` is missing", "add a line `units: ...`")),
        ("units: mm", "unitz: mm", 2, ("`unitz` means nothing here", "did you mean 'units'?")),
        ("units: mm", "units: furlong", 2, ("'furlong'", "mm, cm, m, in")),
        ("left.stl", '""', 5, ("`file` is ''; it must have at least 1 character",)),
        (
            "size: 20",
            "size: 1e-12",
            9,
            ("`size` is 1e-12", "4e-12 scene units long; 1 is the least", "raise it to 0.25"),
        ),
        ("size: 20", "size: 20\ncamera: {roll: 180}", 10, ("`roll` is 180; it must be true", "any angle, or false")),
        ("type: lattice", "{type: elastic, cells: 64}", 11, ("100,000 is the most, for minutes: make it", "or fewer")),
        ("name: bar", "name: rope", 1, ("built-in scene", "choose another name")),
        ("name: bar", "name: a b", 1, ("'a b'", "letters, digits")),
        ("left.stl", "lift.stl", 5, ("lift.stl does not exist", "check the path")),
        ("[1, 2, 3]", "[1, 2, 300]", 8, ("300", "less than or equal to 255")),
        ("    color", "    nested_in: lefd\n    color", 8, ("'lefd'", "did you mean 'left'?")),
        ("    color", "    nested_in: left\n    color", 3, ("put 'right' first",)),
        ("size: 20", "size: 20\nsize: 10", 10, ("`size` is given twice", "remove one")),
        ("size: 20", "size: 20\nmodel: a.glb", 1, ("segments and model", "exactly one")),
        ("size: 20", "size: 20\nparts: [{name: a}]", 1, ("parts", "belongs to model")),
        ("size: 20", "size: 20\ncamera: {distance: [30, 200]}", 10, ("`distance` starts at 30", "outside the object")),
        ("type: lattice", "type: latice", 11, ("'latice'", "did you mean 'lattice'?")),
        ("type: lattice", "strength: 0.1", 11, ("`type` is missing", "bend", "waves")),
        ("type: lattice", "type: lattice\n    segments: [rigth]", 12, ("'rigth'", "did you mean 'right'?")),
        ("type: lattice", "type: lattice\n    spacing: 1", 12, ("`spacing` is 1", "make it 2 or more")),
        ("angle: [0, 100]", "angle: [100, 0]", 16, ("[least, most]",)),
        ("angle: [0, 100]", "angle: [0, 300]", 16, ("reaches 300 degrees", "folds over beyond", "bend less")),
        ("type: lattice", "{type: push, distance: [0, 5], tip: 1, reach: 6}", 11, ("reach must be above 10.8",)),
    ],
)
def test_errors_name_line_value_and_cure(old: str, new: str, line: int, parts: Names, tmp_path: Path) -> None:
    tail = "size: 20\ndeformations:\n  - type: lattice\n  - type: bend\n    origin: [100, 5, 5]\n    axis: [1, 0, 0]\n"
    head = HEAD + tail + "    length: 40\n    angle: [0, 100]\n"
    load_scene(write_bar(tmp_path, head=head))
    assert head.count(old) == 1
    path = write_bar(tmp_path, head=head.replace(old, new))
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load_scene(path)
    text = str(caught.value)
    assert text.startswith(f"{path}:{line}: ")
    assert all(part in text for part in parts), text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("deformations: &d [*d]\n", "is nested too deeply; a scene file has lists in blocks"),
        ("a: &a {<<: *a}\n", "is nested too deeply"),
        (
            "a0: &a0 [1,1,1,1,1,1,1,1,1]\n"
            + "".join(f"a{i}: &a{i} [{','.join(9 * [f'*a{i - 1}'])}]\n" for i in range(1, 30)),
            "values; at most 100000 can be read: use fewer aliases",
        ),
        ("deformations: " + "[" * 3000 + "]" * 3000, "is nested too deeply"),
        ("deformations: " + "[" * 90 + "]" * 90, "...; it must be a block of keys"),
        ("# much\n" * 100_000, "has 700,000 bytes; a scene file has at most 500,000"),
        ("", "`key: value`"),
        ("just words", "`key: value`"),
        ("- a\n- b\n", "`key: value`"),
        ("a: [1", "not YAML"),
        ("\x00", "not YAML"),
        ("source: 2001-99-99\n", "this is not YAML in UTF-8 (month must be in 1..12): correct it, or put it in quotes"),
        ("size: !!bool 3\n", "this is not YAML in UTF-8 ('3'): correct it"),
    ],
)
def test_documents_without_an_end_and_what_is_no_mapping_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(ValueError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)
    assert len(str(caught.value)) < 500


# --- Python -----------------------------------------------------------------------------------------------------------


def test_a_scene_from_a_python_file(tmp_path: Path) -> None:
    file = write_mesh(ball((0, 0, 0), 10.0), tmp_path / "ball.ply")
    path = tmp_path / "mine.py"
    path.write_text(CODE.format(name="mine", file=str(file)))
    scene = load_scene(path)
    assert (scene.name, scene.rest.names, scene.definition) == ("mine", ("ball",), path.read_text())
    for wrong, message in (
        (CODE.format(name=SCENES[0], file=str(file)), "built-in scene"),
        ("def scene():\n    return 3\n", "returns a int"),
        ("scene = (\n", "SyntaxError"),
        ("x = 1\n", "must run and define a function scene"),
    ):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=message):
            load_scene(path)
    for missing in ("none.py", "none.yaml"):
        with pytest.raises(FileNotFoundError, match=f"{missing} does not exist"):
            load_scene(tmp_path / missing)


def test_every_key_is_documented_with_its_default() -> None:
    rows = (Path(__file__).parents[2] / "docs" / "scene-file.md").read_text("utf-8").splitlines()
    kinds = {f"`{get_args(block.model_fields['type'].annotation)[0]}`": block for block in get_args(AnyDeformation)}
    for kind, block in [("", SceneFile), ("", CameraBlock), *kinds.items()]:
        for key in block.model_fields.keys() - ({"type", "segments"} if kind else ()):
            start = rf"\| .*{kind}.* \| `{key}` \|" if kind else rf"\| `{key}` \|"
            row = next(row for row in rows if re.match(start, row))
            default = block.model_fields[key].default
            assert type(default) not in (int, float) or f"| {default:g} |" in row


# --- new files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("longest", [30.0, 4000.0])
def test_the_file_loads_in_the_unit_that_is_likely(longest: float, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    boxes = box((0, 0, 0), (longest / 2, 12, 10)), box((longest / 2, 0, 0), (longest, 12, 10))
    names = "left part", "no"
    files = [write_mesh(part, tmp_path / f"parts/{name}.stl") for part, name in zip(boxes, names, strict=True)]
    path = write_scene_file(files, tmp_path / "thing.yaml")
    scene = load_scene(path)
    assert (scene.name, scene.rest.names) == ("thing", names) and scene.unit_m is not None
    assert scene.unit_m * np.ptp(scene.rest.bounds, axis=0).max() == pytest.approx(longest / 1000)
    assert scene.workspace.all_around and scene.workspace.any_roll and scene.workspace.axis == (0.0, 0.0, 1.0)
    assert "file: parts/left part.stl" in path.read_text() and "name: 'no'" in path.read_text()


def test_every_example_in_the_comments_is_valid(tmp_path: Path) -> None:
    path = write_scene_file([write_mesh(ball((5, 5, 5), 30.0), tmp_path / "a.ply")], tmp_path / "a.yaml")
    path.write_text(re.sub(r"^#  ", "  ", path.read_text(), flags=re.MULTILINE))
    scene = load_scene(path)
    assert isinstance(scene.sample_deformations, RandomMotion) and len(scene.sample_deformations.steps) == 6
    scene.sample_state(default_rng(0)).mesh.check()


@pytest.mark.slow
def test_a_label_volume_gives_its_labels(tmp_path: Path) -> None:
    volume = write_nifti(tmp_path / "ct.nii.gz", np.where(halves() == 7, 0, halves()))
    assert load_scene(write_scene_file([volume], tmp_path / "ct.yaml")).rest.names == ("label_1", "label_2")


def test_nothing_is_overwritten_and_bad_input_is_explained(tmp_path: Path) -> None:
    file = write_mesh(ball((0, 0, 0), 3.0), tmp_path / "a.ply")
    (tmp_path / "sub").mkdir()
    same, strange = tmp_path / "sub/a.stl", tmp_path / os.fsdecode(b"part\xff.stl")
    for place in (same, strange):
        write_mesh(ball((0, 0, 0), 3.0, level=1), tmp_path / "b.stl").rename(place)
    path = write_scene_file([file], tmp_path / "a.yaml")
    for files, output, error, message in (
        ([file], path, FileExistsError, "a.yaml exists; it is not overwritten"),
        ([file], tmp_path / "a.txt", ValueError, "a scene file is .yaml"),
        ([], None, ValueError, "no mesh is given"),
        ([file, same], tmp_path / "b.yaml", ValueError, "two files are called 'a'"),
        ([tmp_path / "none.stl"], tmp_path / "b.yaml", FileNotFoundError, "none.stl does not exist"),
        (
            [file, tmp_path / "ct.nii"],
            tmp_path / "b.yaml",
            ValueError,
            "ct.nii is a label volume and .*a.ply is none; an object",
        ),
        ([strange], tmp_path / "b.yaml", ValueError, "has a name that is not UTF-8; .*: rename it"),
    ):
        with pytest.raises(error, match=message):
            write_scene_file(files, output)
    assert not (tmp_path / "b.yaml").exists()


def test_every_name_of_a_file_is_a_segment_and_of_an_object_valid_and_new(tmp_path: Path) -> None:
    names = ("null", "1e-3", "a: b #c", "it's", "two\nlines\x7f")
    files = [write_mesh(box((10 * k, 0, 0), (10 * k + 9, 9, 9)), tmp_path / f"{k}.stl") for k in range(len(names))]
    named = [file.rename(tmp_path / f"{name}.stl") for file, name in zip(files, names, strict=True)]
    scene = load_scene(write_scene_file(named, tmp_path / "on.yaml"))
    assert (scene.name, scene.rest.names) == ("on", (*names[:-1], "two_lines_"))
    objects = ("My part (2)", "...", SCENES[0])
    assert [identifier(name) for name in objects] == ["My-part-2", "object", f"my-{SCENES[0]}"]


def test_every_name_of_a_part_is_a_segment(tmp_path: Path) -> None:
    def write(*names: str) -> Path:
        parts = {name: box((low, 0, 0), (low + 0.9, 1, 1)) for low, name in enumerate(names)}
        return write_model(tmp_path / "model.glb", parts)

    path = write_scene_file([write("Body/Lid\n2", "null", "Lid #2")], tmp_path / "a.yaml")
    assert load_scene(path).rest.names == ("Body_Lid_2", "null", "Lid #2")
    assert "units: m  # the rule of glTF" in path.read_text()
    with pytest.raises(ValueError, match="two parts are called 'a_b'; segments are named after them: rename one"):
        write_scene_file([write("a/b", "a_b")], tmp_path / "b.yaml")
    assert not (tmp_path / "b.yaml").exists()


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(check, "STATES", 3)
    write_mesh(ball((0, 0, 0), 30.0), tmp_path / "a.ply")
    monkeypatch.chdir(tmp_path)
    assert run_mereo("scene", "new", "a.ply", "--units", "cm") == 0
    assert "units: cm  # as you said" in (tmp_path / "a.yaml").read_text()
    assert "wrote a.yaml" in capsys.readouterr().out
    assert run_mereo("scene", "new", "a.ply", "--output", "b b.yaml", "--aperture", "90") == 0
    assert "aperture: 90 " in (tmp_path / "b b.yaml").read_text()
    assert "mereo scene check 'b b.yaml'" in capsys.readouterr().out
    assert run_mereo("scene", "new", "a.ply", "--output", "c.yaml", "--aperture", "400") == 2
    assert "--aperture is 400" in capsys.readouterr().err and not (tmp_path / "c.yaml").exists()
    assert run_mereo("scene", "check", "a.yaml") == 0
    assert "a: 1 segments, closed" in capsys.readouterr().out
    assert run_mereo("scene", "preview", "a.yaml", "--output", "a.png") == 0
