"""Parts as CAD programs write them: long faces bend with the object, overlaps are exact and say their cause."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from cad_objects import tongs, write_parts, write_pliers
from manifold3d import Manifold
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scene_files import write_bar, write_mesh
from shapes import ball, box

from mereo.deformation.maps import Rigid
from mereo.deformation.samplers import JointSampler, RandomMotion, cubic_cells
from mereo.deformation.warps import Squash
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import mesh_of, overlaps
from mereo.geometry.symmetry import describe_symmetries
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.scenes.files.build import TOLERANCE, refined
from mereo.scenes.files.check import STATE_TOLERANCE, check_scene
from mereo.scenes.files.joints import contacts
from mereo.scenes.files.template import flat_base, material_points, measure_motion, write_scene_file
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene file of the pliers, as ``mereo scene new`` writes it."""
    folder = tmp_path_factory.mktemp("pliers")
    return write_scene_file(write_pliers(folder), folder / "pliers.yaml", deformations="soft")


@pytest.fixture(scope="module")
def pliers(written: Path) -> Scene:
    return load_scene(written)


# --- faces ------------------------------------------------------------------------------------------------------------


def test_every_edge_follows_its_curve(pliers: Scene) -> None:
    rng = default_rng(0)
    away = []
    for index in range(4):  # the very states that edges are compared in
        maps = pliers.sample_deformations(example_rng(0, index))
        for segment, deform in zip(pliers.rest.segments, maps, strict=True):
            a, b = segment.vertices[segment.faces[:, 0]], segment.vertices[segment.faces[:, 1]]
            share = rng.uniform(0, 1, (len(a), 1))
            chord = (1 - share) * deform(a) + share * deform(b)
            away.append(norm(deform((1 - share) * a + share * b) - chord, axis=1).max())
    assert max(away) < 1.5 * TOLERANCE


def test_rigid_parts_and_fine_meshes_stay_as_they_are(tmp_path: Path, pliers: Scene) -> None:
    joint = "{type: joint, segments: [right], pivot: [120, 5, 5], axis: [1, 0, 0], angle: [-90, 90]}"
    scene = load_scene(write_bar(tmp_path, f"deformations:\n  - {joint}\n"))
    files = read_segmented_mesh(tmp_path / "left.stl", tmp_path / "right.stl")
    assert [len(s.faces) for s in scene.rest.segments] == [len(s.faces) for s in files.segments]
    again = refined(pliers.rest, pliers.sample_deformations)
    assert all(a is b for a, b in zip(again.segments, pliers.rest.segments, strict=True))


def test_neighbours_split_a_shared_edge_alike(pliers: Scene) -> None:
    """The bores' rims on the plane z = 0 are edges of both levers, and have the same vertices afterwards."""
    middle = pliers.T_scene_source[:3, 3]
    radius = 5 * pliers.T_scene_source[0, 0]
    rims = []
    for segment in pliers.rest.segments[:2]:
        away = segment.vertices - middle
        on_rim = (np.abs(np.hypot(*away.T[:2]) - radius) < 1e-6) & (np.abs(away[:, 2]) < 1e-9)
        rims.append(set(map(tuple, np.round(segment.vertices[on_rim], 9))))
        assert segment.edge_imbalance() == (0, 0) and segment.volume > 0
    assert rims[0] == rims[1] and len(rims[0]) >= 40


# --- overlaps ---------------------------------------------------------------------------------------------------------


def test_overlaps_of_solids_are_exact_and_those_of_other_meshes_measured_on_a_grid() -> None:
    for depth in (1e-4, 0.01, 0.5):  # a grid of 40 cells sees none of the first two
        mesh = SegmentedMesh((box((0, 0, 0), (1, 2, 3), "a"), box((1 - depth, 0, 0), (3, 2, 3), "b")))
        (found,) = overlaps(mesh, tolerance=0.0)
        assert (found.small, found.share) == ("a", pytest.approx(depth, rel=1e-9))
    whole = ball((0, 0, 0), 1.0, "a")
    holed = replace(whole, faces=whole.faces[3:], solid=False)
    (found,) = overlaps(SegmentedMesh((holed, ball((1, 0, 0), 1.0, "b"))))
    assert found.share == pytest.approx(5 / 16, abs=0.01)


def test_an_overlap_in_states_names_its_cause(written: Path, capsys: pytest.CaptureFixture) -> None:
    head = written.read_text().split("deformations:")[0]
    away = written.with_name("away.yaml")
    joint = "{{type: joint, segments: [{}], pivot: [{}, 0, 0], axis: [0, 0, 1], angle: [-{a}, {a}]}}"
    for block, cause in (
        (joint.format("lower", 0, a=20), None),
        (joint.format("lower", 60, a=20), "'1 joint of lower' moves one of the two alone: narrow its range, correct"),
        ("{type: squash, factor: [0.5, 0.5], axis: [1, 0, 0], segments: [pin]}", "leave out its `segments`, so that"),
    ):
        away.write_text(f"{head}deformations:\n  - {block}\n")
        if cause is None:
            check_scene(str(away))
        else:
            with pytest.raises(ValueError, match=r"has \d faults?, listed above: correct its deformations$"):
                check_scene(str(away), repair=True)
        printed = capsys.readouterr().out
        assert ("fault: in random states" in printed) == (cause is not None)
        assert (cause or "") in printed and "nothing to repair" not in printed


def test_parts_that_all_overlap_are_not_in_one_frame(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    files = [write_mesh(box((0, 0, 0), (20, 10, 10 + k)), tmp_path / f"{k}.stl") for k in range(3)]
    for count, faults in ((2, "1 fault,"), (3, "3 faults,")):  # random states count no pair again
        with pytest.raises(ValueError, match=f"has {faults} listed above: repair the meshes with --repair"):
            check_scene(str(write_scene_file(files[:count], tmp_path / f"of{count}.yaml")))
        printed = capsys.readouterr().out
        assert ("note: most pairs overlap" in printed) == (count == 3) and "overlap in 100.00%" in printed


# --- defaults ---------------------------------------------------------------------------------------------------------


def test_a_rigid_motion_is_none_and_a_stretch_is_its_own() -> None:
    mesh = SegmentedMesh((box((-1, -1, -1), (1, 1, 1)),))
    turn = Rigid(np.array([0.3, 0.2, 0.1]), np.array([5.0, 0, 0]), np.zeros(3))
    assert measure_motion(mesh, lambda rng: (turn,)).largest < 1e-12
    squash, (points, _) = Squash(np.zeros(3), np.array([0, 0, 1.0]), 1.1), material_points(mesh, 800)
    way = norm(squash(points) - points, axis=1) / 2
    found = measure_motion(mesh, lambda rng: (squash,))
    assert found.mean == pytest.approx(np.sqrt(np.mean(way**2)), rel=0.02)
    assert found.largest == pytest.approx(way.max(), rel=0.1)


def test_surface_points_lie_evenly_on_the_surface_and_cubes_fill_the_box_around_a_box() -> None:
    points, owner = material_points(SegmentedMesh((box((0, 0, 0), (8, 1, 1)), box((9, 0, 0), (10, 1, 1), "b"))), 4000)
    assert (owner == 1).mean() == pytest.approx(6 / 40, abs=0.001)
    first = points[owner == 0]
    ends = np.isclose(first[:, 0], 0) | np.isclose(first[:, 0], 8)
    assert ends.mean() == pytest.approx(2 / 34, abs=0.001) and first[:, 0].mean() == pytest.approx(4, abs=0.1)
    assert np.isclose(np.abs(first[~ends, 1:] - 0.5).max(axis=1), 0.5).all()
    bounds, cells = cubic_cells(np.array([[0.0, 0, 0], [10, 4, 1]]), 5.0)
    assert cells == (2, 1, 1)
    assert_allclose(bounds, [[0, -0.5, -2], [10, 4.5, 3]])


def test_the_picture_is_filled_and_nothing_is_cut(pliers: Scene) -> None:
    camera = Camera.from_fov(96, 96, pliers.workspace.fov_rad)
    near, far = pliers.workspace.distance
    assert far == pytest.approx(1.25 * near, abs=1)
    reach, inside = [], []
    for index in range(40):
        rng = example_rng(3, index)
        mesh = pliers.sample_state(rng).mesh
        pose = pliers.workspace.sample(rng, mesh.bounds.mean(axis=0))
        places = np.abs(camera.project(transform_points(inverse_rigid(pose), mesh.merged()[0])) - 48) / 48
        reach.append(places.max())
        inside.append((places < 1).all(axis=1).mean())
    assert max(reach) > 0.75 and min(inside) > 0.95 and np.mean(inside) > 0.998


def test_up_is_told_by_the_kind_of_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for suffix, axis in (("stl", [0, 0, 1]), ("obj", [0, 1, 0])):
        file = write_mesh(ball((0, 0, 0), 3.0, level=1), tmp_path / f"a.{suffix}")
        path = write_scene_file([file], tmp_path / f"{suffix}.yaml", aperture=140.0)
        assert f"axis: {axis}  # the middle of that cone" in path.read_text()
    narrow = load_scene(path).workspace
    assert np.rad2deg(narrow.aperture_rad) == pytest.approx(140) and not narrow.any_roll
    check_scene(str(path))
    printed = capsys.readouterr().out
    assert "up: y, the camera's `axis`" in printed
    assert re.search(r"motion: [45]\.\d% of the longest side in a typical state, ", printed)
    pixels = int(re.search(r"shows it in (\d+) of 9,216 pixels", printed)[1])  # type: ignore[index]
    assert pixels > 2500


def dome() -> Segment:
    """Ball of radius 1 that is cut flat at z = -0.3."""
    whole = ball((0, 0, 0), 1.0)
    return replace(whole, vertices=np.maximum(whole.vertices, (-np.inf, -np.inf, -0.3)))


def test_a_flat_base_is_found_in_any_position_and_of_a_box_the_side_that_is_down() -> None:
    for turns in ([0.0, 0.0, 0.0], [0.3, -0.5, 0.2]):
        turn = Rigid(np.array(turns), np.ones(3), np.ones(3))
        base = flat_base(SegmentedMesh((replace(dome(), vertices=turn(dome().vertices)),)), (0.0, 0.0, 1.0))
        start, end = turn(np.array([[0.0, 0, 0], [0, 0, -1]]))
        assert base is not None and base.normal @ (end - start) > 0.999
        # a disc of radius sqrt(1 - 0.3^2), and the cap of height 1.3 above it
        assert base.share == pytest.approx(0.91 / (0.91 + 2 * 1.3), abs=0.01)
    for up in ((0, 0, 1), (0, -1, 0)):
        base = flat_base(SegmentedMesh((box((0, 0, 0), (4, 3, 3)),)), up)
        assert base is not None and base.share == pytest.approx(12 / 66)
        assert_array_equal(base.normal, -np.array(up))


def test_what_is_round_or_falls_over_has_no_base() -> None:
    rod = trimesh.creation.cylinder(1, 12)
    pebble = trimesh.creation.icosphere(4).apply_scale([1, 0.7, 0.25])
    for shape in (trimesh.creation.torus(3, 1), rod, pebble):
        part = Segment("part", (0, 0, 0), np.array(shape.vertices), np.array(shape.faces))
        assert flat_base(SegmentedMesh((part,)), (0.0, 0.0, 1.0)) is None
    leaning = box((0, 0, 0), (1, 1, 2.5))
    leaning = replace(leaning, vertices=leaning.vertices + 0.32 * leaning.vertices[:, 2:] * [1, 0, 0])
    base = flat_base(SegmentedMesh((leaning,)), (0.0, 0.0, 1.0))
    assert base is not None and abs(base.normal[2]) < 0.5, "it lies on a side"


def test_a_base_is_named_where_the_camera_looks_from_below(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    file = write_mesh(dome(), tmp_path / "dome.obj")
    sentences = []
    path = write_scene_file([file], tmp_path / "dome.yaml", report=sentences.append)
    check_scene(str(path))
    _, sentence = sentences
    assert sentence in capsys.readouterr().out.splitlines()
    assert sentence == (
        "base: it can stand on a flat base (normal 0 0 -1, 26% of its hull): if it stays on a table, the camera never "
        "sees it from below; narrow it with `camera: {axis: [0, 0, 1], aperture: 180}`"
    )
    text = path.read_text().replace("aperture: 360", "aperture: 180")
    assert "axis: [0, 0, 1]  # the middle of that cone" in text  # although y is up in most OBJ files
    path.write_text(text)
    check_scene(str(path))
    assert "26% of its hull), and the camera never looks from below" in capsys.readouterr().out


# --- joints -----------------------------------------------------------------------------------------------------------


def test_a_word_says_how_the_object_moves(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    files = write_pliers(tmp_path)
    said = list[str]()
    scene = load_scene(write_scene_file(files, tmp_path / "auto.yaml", report=said.append))
    assert said[0] == "deformations: by its joints, for its parts touch like 2 hinges"
    hinge = "- type: joint  # turns on the round contact, radius 4.98, of pin and lower\n    segments: [lower]"
    assert hinge in (tmp_path / "auto.yaml").read_text()
    middle = scene.T_scene_source[:3, 3]
    for deform in scene.sample_deformations(default_rng(0))[:2]:  # the pin's axis stays
        assert norm((deform(middle[None]) - middle)[0, :2]) < 0.05 * scene.T_scene_source[0, 0]
    assert scene.definition != load_scene(write_scene_file(files, tmp_path / "s.yaml", deformations="stiff")).definition
    check_scene(str(tmp_path / "auto.yaml"))
    assert "fault" not in capsys.readouterr().out
    text = write_scene_file(files, tmp_path / "r.yaml", deformations="rigid").read_text()
    assert "\ndeformations: rigid\n#" in text
    rest = load_scene(tmp_path / "r.yaml")
    assert np.array_equal(rest.sample_state(default_rng(0)).mesh.merged()[0], rest.rest.merged()[0])
    bar = write_mesh(box((0, 0, 0), (40, 10, 10)), tmp_path / "bar.stl")
    write_scene_file([bar], tmp_path / "bar.yaml", report=said.append)
    assert "deformations: as a soft elastic solid, for no parts of it touch like a hinge" in said
    with pytest.raises(ValueError, match="no parts of it touch as in a joint: take soft, stiff or rigid"):
        write_scene_file([bar], tmp_path / "b.yaml", deformations="articulated")
    assert not (tmp_path / "b.yaml").exists()


def test_joints_are_narrowed_until_no_combination_collides(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = write_scene_file(write_parts(tmp_path, tongs()), tmp_path / "tongs.yaml")
    check_scene(str(path))
    assert "fault" not in capsys.readouterr().out
    reason = re.compile(r"angle: (\[.*\])  # narrowed from (\[-30, 30\]): beyond, joints collide together")
    assert len(reason.findall(path.read_text())) == 2
    scene = load_scene(path)
    draw = scene.sample_deformations
    assert isinstance(draw, RandomMotion)
    angles = [sampler.angle_rad for sampler, _ in draw.steps if isinstance(sampler, JointSampler)]
    for chosen in product(*angles):  # the corners of the box of the ranges
        steps = [
            (replace(sampler, angle_rad=(angle, angle)), members)  # type: ignore[type-var]
            for (sampler, members), angle in zip(draw.steps, chosen, strict=True)
        ]
        mesh = scene.deform(replace(draw, steps=tuple(steps))(default_rng(1))).mesh
        assert not overlaps(mesh, STATE_TOLERANCE)
    former = path.with_name("former.yaml")
    former.write_text(reason.sub(r"angle: \2", path.read_text()))
    with pytest.raises(ValueError, match=r"has 1 fault, listed above: correct its deformations$"):
        check_scene(str(former))
    assert "fault: in random states" in capsys.readouterr().out


def test_planes_cylinders_and_other_contacts() -> None:
    turn = Rigid(np.array([0.3, -0.5, 0.2]), np.zeros(3), np.zeros(3))
    shaft = Manifold.cylinder(6, 1, 1, 32)
    body = Manifold.cube((8, 4, 4), True) - shaft.translate((2, 0, -1))
    lid = Manifold.cube((2, 4, 1), True).translate((-2, 0, 2.5))
    pit = Manifold.cube((4, 4, 4), True).translate((-6, 0, 0)) - Manifold.sphere(1.5, 48).translate((-8, 0, 0))
    parts = (body, shaft.translate((2, 0, -1)), lid, pit, Manifold.sphere(1.5, 48).translate((-8, 0, 0)))
    meshes = [mesh_of(part) for part in parts]
    names = ("body", "shaft", "lid", "pit", "ball")
    mesh = SegmentedMesh(tuple(Segment(n, (0, 0, 0), turn(v), f) for n, (v, f) in zip(names, meshes, strict=True)))
    found = {frozenset((names[c.first], names[c.second])): c for c in contacts(mesh)}
    kinds = {"body shaft": "cylinder", "body lid": "plane", "body pit": "plane", "pit ball": "other"}
    assert {key: c.kind for key, c in found.items()} == {frozenset(key.split()): kind for key, kind in kinds.items()}
    round_one = found[frozenset(("body", "shaft"))]
    axis = turn(np.array([[0.0, 0, 1]]))[0]
    assert abs(round_one.axis @ axis) > 0.9999 and round_one.radius == pytest.approx(1, abs=0.02)
    away = round_one.point - turn(np.array([[2.0, 0, 0]]))[0]
    assert norm(away - (away @ axis) * axis) < 0.02
    assert abs(found[frozenset(("body", "lid"))].axis @ axis) > 0.9999


def test_a_check_names_parts_that_no_frame_tells_apart(written: Path, capsys: pytest.CaptureFixture) -> None:
    sentence = "the object looks the same turned by 180 degrees about x: no frame tells upper and lower apart"
    check_scene(str(written))
    assert f"symmetry: {sentence}" in capsys.readouterr().out.splitlines()
    model = scene_model(load_scene(written), 20)
    assert describe_symmetries(model.symmetries, model.rest.names) == [sentence]
