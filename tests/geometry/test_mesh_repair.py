"""Faulty meshes: each fault is found, repaired, and said; what is left is labelled by the winding number."""

import re
from dataclasses import replace
from math import nan
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
import yaml
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from overlapping import check_overlap
from scene_files import write_bar, write_mesh
from shapes import ball, box, knobbly_torus, one, segment, write_model

from mereo.geometry import mesh_check, mesh_repair
from mereo.geometry.mesh import Segment, SegmentedMesh, connected
from mereo.geometry.mesh_check import examine, mesh_of, overlaps, solid_of
from mereo.geometry.mesh_repair import close_holes, farthest, open_edges, repaired, without_overlaps
from mereo.geometry.solids import Solids, label_grid, signed_distance_and_direction
from mereo.io.mesh_formats import MeshWarning, read_object_mesh
from mereo.scenes.files import check
from mereo.scenes.files.check import check_scene
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import synthesize


def joined(*parts: Segment) -> Segment:
    vertices, faces, _ = SegmentedMesh(tuple(replace(p, name=str(i)) for i, p in enumerate(parts))).merged()
    return Segment("part", (1, 2, 3), vertices, faces)


def turned(part: Segment) -> Segment:
    return replace(part, faces=part.faces[:, ::-1])


def soup(part: Segment, noise: float) -> Segment:
    vertices = part.vertices[part.faces].reshape(-1, 3)
    vertices += noise * default_rng(0).normal(size=vertices.shape)
    return replace(part, vertices=vertices, faces=np.arange(len(vertices)).reshape(-1, 3))


def half_turned(part: Segment) -> Segment:
    faces = part.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return replace(part, faces=faces)


HOLLOW = joined(ball((0, 0, 0), 2.0), turned(ball((0, 0, 0), 1.0)))


@pytest.mark.parametrize("part", [ball((3, 0, 0), 2.0), knobbly_torus(1), HOLLOW, box((0, 0, 0), (1, 2, 3))])
def test_sound_meshes_are_left_alone(part: Segment) -> None:
    assert examine(part).sound
    fixed = repaired(part)
    assert fixed.segment is part and fixed.changes == ()


TORUS = knobbly_torus(1)
FLECK = Segment("fleck", (0, 0, 0), np.eye(3) * 0.01 + 4, np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("faulty", "fault", "change", "volume"),
    [
        (replace(TORUS, faces=TORUS.faces[5:]), "open edges", "filled 1 hole with", TORUS.volume),
        (turned(TORUS), "100% of its surface facing inwards", "turned 1920", TORUS.volume),
        (half_turned(TORUS), "disagree in orientation", "turned 640 faces", TORUS.volume),
        (soup(TORUS, 1e-5), "open edges", "merged 4800 vertices", TORUS.volume),
        (replace(TORUS, faces=TORUS.faces[[*range(1920), 0, 5]]), "more than two faces", "dropped 2", TORUS.volume),
        (joined(TORUS, FLECK), "3 open edges", "% of its surface), 0.01 long, near [4.0", TORUS.volume),
        (
            joined(ball((0, 0, 0), 2.0), ball((2, 0, 0), 2.0)),
            "intersects itself",
            "united 2 shells",
            (2 - 5 / 16) * 4 / 3 * np.pi * 8,
        ),
    ],
)
def test_each_fault_is_found_repaired_and_said(faulty: Segment, fault: str, change: str, volume: float) -> None:
    health = examine(faulty)
    assert any(fault in text for text in (*health.dirty, *health.hopeless)), health
    fixed = repaired(faulty)
    assert any(change in text for text in fixed.changes) and "new surface" not in fixed.changes[-1], fixed.changes
    assert examine(fixed.segment).sound
    SegmentedMesh((fixed.segment,)).check()
    assert fixed.segment.volume == pytest.approx(volume, rel=0.01)


def horned(radius: float, horns: int) -> Segment:
    shell = ball((0, 0, 0), 1.0)
    whole = solid_of(shell.vertices, shell.faces)
    arm = manifold3d.Manifold.cylinder(3.2, 0.3, 0.3, 24).rotate((0, 90, 0)).translate((0.9, 0, 0))
    whole += arm.refine_to_length(0.15)
    for degrees in (0, 40)[:horns]:
        horn = manifold3d.Manifold.cylinder(0.7, radius, radius, 12).rotate((0, -90, 0)).translate((-0.9, 0, 0))
        whole += horn.rotate((0, 0, degrees))
    vertices, faces = mesh_of(whole)
    x, y, z = vertices.T
    angle, out = (x - 1.2) / 0.6, 0.6 - y
    bent = np.stack([1.2 + out * np.sin(angle), 0.6 - out * np.cos(angle), z], axis=1)
    vertices = np.where(x[:, None] > 1.2, bent, vertices)
    below = np.argsort(vertices[faces].mean(axis=1)[:, 2])
    return Segment("part", (1, 2, 3), vertices, faces[below[3:]])


def test_thin_horns_stay_where_a_new_surface_is_made() -> None:
    part = horned(0.01, 2)
    cell = float(np.ptp(part.vertices, axis=0).max()) / 128
    assert cell > 0.02, "the horns are thinner than a cell"
    fixed = repaired(part, "mm")
    made = fixed.changes[-1]
    assert "new surface" in made and "in thin places those below" in made and "also lost" not in made
    assert examine(fixed.segment).sound
    assert len(solid_of(fixed.segment.vertices, fixed.segment.faces).decompose()) == 1
    assert_allclose(fixed.segment.bounds, part.bounds, atol=cell)
    assert farthest(fixed.kept, fixed.segment)[0][0] < 1.1 * cell
    label = Solids(one(fixed.segment)).label
    for angle in np.radians([180, 220]):  # each is there along all of its length, and no thicker than it was
        middle = np.linspace(1.05, 1.55, 40)[:, None] * [np.cos(angle), np.sin(angle), 0]
        assert label(middle).all() and not label(middle + np.array([0, 0, 0.016])).any()


def test_what_is_too_thin_for_the_finest_cells_is_said() -> None:
    fixed = repaired(horned(1e-5, 1), "mm")
    lost = (
        r"also lost is (.*) % of the surface, which lies near \[-1.6, 0, 0\] mm, 0.6 mm from it, too thin or inside out"
    )
    assert (share := re.search(lost, fixed.changes[-1])) and float(share[1]) < 1e-3, fixed.changes[-1]
    (distance, place), _ = farthest(fixed.kept, fixed.segment)
    assert distance == pytest.approx(0.6, abs=0.02)
    assert_allclose(place, [-1.6, 0, 0], atol=1e-4)
    assert max(way for way, _ in farthest(fixed.segment, fixed.kept)) < 0.1


def test_all_faults_of_a_segment_are_named_at_once() -> None:
    crossing = joined(ball((0, 0, 0), 2.0), ball((2, 0, 0), 2.0), ball((9, 0, 0), 0.05, level=1))
    vertices = np.concatenate([crossing.vertices, [[nan, 0, 0]]])
    faces = crossing.faces.copy()
    faces[[10, 400]] = faces[[10, 400], ::-1]
    first = faces[0]
    wing = [first[0], first[1], int(crossing.faces[-1, 0])]  # on an edge of the ball, which has two faces already
    extra = [wing, [5, 5, 9], [7, 8, len(vertices) - 1], [0, 1, 99_999]]
    health = examine(Segment("part", (1, 2, 3), vertices, np.concatenate([faces[:-1], extra])), "mm")
    assert [text.split(", near")[0].split(" (")[0] for text in (*health.hopeless, *health.dirty)] == [
        "has NaN or infinite vertices",
        f"has a face that refers to vertex 99999 of {len(vertices)}",
        "has 1 degenerate face with one vertex twice",
        "has 5 open edges",
        "has 1 edge with more than two faces",
        "has 6 edges at which faces disagree in orientation",
        "intersects itself",
    ]
    assert any("1 fragment" in note and "near [9, 0, 0] mm" in note for note in health.notes), health.notes


def test_a_vessel_that_faces_inwards_is_kept_and_noted() -> None:
    tube = mesh_of(manifold3d.Manifold.cylinder(9.0, 0.005, 0.005, 8).translate((0, 0, 11)))
    vessel = turned(Segment("vessel", (0, 0, 0), *tube))
    crossing = joined(ball((0, 0, 0), 10.0), ball((3, 0, 0), 9.0), vessel)
    assert any("% of its surface facing inwards, near [-0.0" in note for note in examine(crossing).notes)
    fixed = repaired(crossing)
    assert fixed.changes == ("united 3 shells that overlap, of which 1 outside the others faced inwards",)
    assert (
        fixed.segment.bounds[1, 2] == 20 and len(solid_of(fixed.segment.vertices, fixed.segment.faces).decompose()) == 2
    )


def test_what_a_cut_drops_is_said_with_its_share() -> None:
    crumb = ball((9, 0, 0), 0.02, level=1)
    mesh, changes = without_overlaps(SegmentedMesh((box((1, 0, 0), (3, 2, 2)), joined(ball((0, 0, 0), 2.0), crumb))))
    (change,) = changes["part"]
    assert (share := re.fullmatch("cut out 'box' and dropped 1 fleck, (.*) % of it", change)), change
    assert float(share[1]) == pytest.approx(100 * crumb.volume / mesh.segments[1].volume, rel=0.1)


@pytest.mark.parametrize("axes", [np.array([[1, 2, 3]]), np.array([[1, 2, 3], [3, -1, 2]])])
def test_a_line_or_plane_in_any_direction_is_no_solid(axes: ndarray) -> None:
    places = default_rng(0).random((12, len(axes))) @ axes
    for vertices in (places, places.astype(np.float32).astype(float)):
        health = examine(Segment("part", (1, 2, 3), vertices, np.arange(12).reshape(4, 3)))
        assert health.hopeless == ("is flat, without any volume",) and not health.mendable


def test_holes_are_closed_as_one_by_one() -> None:
    part = replace(TORUS, faces=np.delete(TORUS.faces, default_rng(0).integers(0, 1920, 60), axis=0))
    vertices, faces = part.vertices, part.faces
    rim = open_edges(vertices, faces)
    group = connected(rim, len(vertices))
    for number in np.unique(group[rim[:, 0]]):
        loop = rim[group[rim[:, 0]] == number]
        faces = np.concatenate([faces, [[b, a, len(vertices)] for a, b in loop]])
        vertices = np.concatenate([vertices, vertices[loop[:, :1]].mean(axis=0)])
    assert len(vertices) > len(part.vertices) + 20
    closed = close_holes(part.vertices, part.faces)
    assert_array_equal(closed[0], vertices)
    assert_array_equal(closed[1], faces)


def test_closed_triangles_enclose_nothing_and_no_repair_makes_a_solid_of_loose_ones() -> None:
    rng = default_rng(0)
    places = (rng.random((40, 1, 3)) + 0.05 * rng.random((40, 3, 3))).reshape(-1, 3)
    loose = Segment("loose", (1, 2, 3), places, np.arange(120).reshape(-1, 3))
    assert examine(loose).hopeless == ("is an open surface (120 open edges) that encloses no volume",)
    doubled = replace(loose, faces=np.concatenate([loose.faces, loose.faces[:, ::-1]]))
    assert "encloses no volume" in examine(doubled).hopeless
    with pytest.raises(ValueError, match="'loose' has no surface that could be repaired: export it again"):
        repaired(loose)


def test_a_solid_of_many_faces_is_simplified_and_how_far_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_repair, "MOST_FACES", 10_000)
    part = ball((5, 0, 0), 1.0, level=5)
    fewer, way = mesh_repair.simplified(part)
    SegmentedMesh((fewer,)).check()
    assert len(fewer.faces) <= 10_000 and 0 < way < 0.002 and fewer.volume == pytest.approx(part.volume, rel=1e-2)
    for other in (TORUS, replace(part, faces=part.faces[1:])):  # of few faces, and no solid
        assert mesh_repair.simplified(other) == (other, 0.0)
    path = write_mesh(part, tmp_path / "ball.stl")
    with pytest.warns(MeshWarning, match=r"ball.stl has 20,480 faces in 'ball'; it is taken with .*,.*, at most 0.00"):
        mesh = read_object_mesh(path)
    (tmp_path / "more").mkdir()
    assert read_object_mesh(tmp_path / "more" / ".." / "ball.stl") is mesh
    write_mesh(ball((5, 0, 0), 1.0, level=2), path)
    assert len(read_object_mesh(path).segments[0].faces) == 320


def test_what_is_no_solid_may_have_fewer_faces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_check, "MOST_DIRTY", 100)
    path = write_bar(tmp_path)
    part = trimesh.load_mesh(tmp_path / "left.stl")
    write_mesh(Segment("left", (0, 0, 0), part.vertices, part.faces[1:]), tmp_path / "left.stl")
    with pytest.raises(
        ValueError, match=r"'left' has 3 open edges \(.*\) and 191 faces, of which .* may have 100: repair"
    ):
        load_scene(path)


def test_nothing_is_made_of_nothing() -> None:
    empty = Segment("part", (1, 2, 3), np.full((3, 3), nan), np.array([[0, 1, 2]]))
    assert examine(empty).hopeless
    with pytest.raises(ValueError, match="'part' has no surface that could be repaired"):
        repaired(empty)


def test_overlaps_are_cut_from_the_larger_segment() -> None:
    small, large = ball((2, 0, 0), 1.0, "small"), ball((0, 0, 0), 2.0, "large")
    mesh = SegmentedMesh((large, small))
    (found,) = overlaps(mesh)
    assert (found.small, found.large) == ("small", "large") and 0.3 < found.share < 0.5
    fixed, changes = without_overlaps(mesh)
    check_overlap(fixed)
    assert changes == {"large": ["cut out 'small'"]}
    assert fixed.segments[1] is small
    assert fixed.segments[0].volume == pytest.approx(large.volume - found.share * small.volume, rel=0.01)
    nested = SegmentedMesh((small, large), (("small", "large"),))
    fixed, changes = without_overlaps(nested)
    check_overlap(fixed)
    assert list(changes) == ["small"] and fixed.segments[1] is large
    cubes = [box((i, 0, 0), (i + 1, 1, 1), f"cube_{i}", i) for i in range(3)]  # which touch
    assert overlaps(SegmentedMesh((*cubes, ball((0, 9, 0), 1.0)))) == ()


@pytest.mark.slow
def test_check_counts_faults_and_repair_leaves_the_users_files(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "STATES", 3)
    path = write_bar(tmp_path, "# kept here\nsize: 15\n")
    check_scene(str(path))
    assert "bar: 2 segments, closed, outward oriented, without overlap" in capsys.readouterr().out
    part = trimesh.load_mesh(tmp_path / "left.stl")
    part.apply_translation((3, 0, 0))
    write_mesh(Segment("left", (0, 0, 0), np.array(part.vertices), np.array(part.faces)[2:]), tmp_path / "left.stl")
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"bar.yaml has 2 faults, listed above: repair the meshes with --repair"):
        check_scene(str(path))
    printed = capsys.readouterr().out
    assert "fault: it has 6 open edges (1 hole, near [103, 2.08, 9.17] mm)" in printed
    assert "left and right overlap in 15" in printed
    check_scene(str(path), repair=True)
    printed = capsys.readouterr().out
    assert "repaired left: filled 1 hole" in printed and "cut out" in printed
    assert "longest side 20 mm before, 17 now; the old surface reaches at most 3 mm out of the new one (near" in printed
    assert {file: file.read_bytes() for file in before} == before
    fixed = (tmp_path / "bar-repaired.yaml").read_text()
    assert fixed.startswith("# bar.yaml with repaired meshes, written by `mereo scene check bar.yaml --repair`.\n")
    assert "kept here" not in fixed and "left-repaired.ply" in fixed
    scene = load_scene(tmp_path / "bar-repaired.yaml")
    scene.rest.check()
    with pytest.warns(MeshWarning, match="6 open edges"):
        assert scene.definition == load_scene(path).definition  # all but the meshes is what it was
    with pytest.raises(FileExistsError, match="bar-repaired.yaml exists; it is not overwritten"):
        check_scene(str(path), repair=True)


def test_parts_of_a_model_get_files_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    parts = {
        "a": box((0, 0, 0), (2, 2, 2)),
        "core": box((2.5, 0.8, 0.8), (2.9, 1.2, 1.2)),
        "b b": box((1.5, 0, 0), (3.5, 2, 2)),
    }
    write_model(tmp_path / "model.glb", parts)
    path = tmp_path / "two.yaml"
    path.write_text(
        "name: two\nunits: m\nmodel: model.glb  # from CAD\n\nparts:\n"
        "  - name: a\n  - {name: core, nested_in: b b}\n  - {name: b b, color: [1, 2, 3]}\n\nsize: 12 # s\n"
    )
    check_scene(str(path), repair=True)
    assert "reaches at most 0.5 m out of the new one (near [" in capsys.readouterr().out
    data = yaml.safe_load((tmp_path / "two-repaired.yaml").read_text())
    assert list(data) == ["name", "units", "segments", "size"] and data["size"] == 12
    assert [block["file"] for block in data["segments"]] == ["a-repaired.ply", "core-repaired.ply", "b_b-repaired.ply"]
    rest = load_scene(tmp_path / "two-repaired.yaml").rest
    assert (rest.nested, rest.colors[2]) == ((("core", "b b"),), (1, 2, 3))
    check_overlap(rest)


WHOLE = ball((0, 0, 0), 2.0, level=3)


def nodes(*axes: ndarray) -> ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def holed() -> Segment:
    """Without the three faces nearest to +x; far from there it is the whole ball."""
    order = np.argsort(-WHOLE.vertices[WHOLE.faces].mean(axis=1)[:, 0])
    return replace(WHOLE, faces=np.delete(WHOLE.faces, order[:3], axis=0), solid=False)


def crossing() -> Segment:
    """Two balls in one mesh, each closed, that share a lens."""
    return replace(joined(WHOLE, ball((1.5, 0, 0), 2.0, level=3)), solid=False)


def truth(points: ndarray, part: Segment) -> ndarray:
    centers = [(0, 0, 0), (1.5, 0, 0)][: 1 + (len(part.vertices) > len(WHOLE.vertices))]
    return np.min([norm(points - center, axis=-1) for center in centers], axis=0) - 2.0


@pytest.mark.parametrize("part", [holed(), crossing()], ids=["hole", "self-intersection"])
def test_points_and_grids_are_labelled_as_of_the_solid(part: Segment) -> None:
    axis = np.linspace(-2.7, 3.7, 33)
    points = default_rng(0).uniform(-3, 4, size=(4000, 3))
    found = Solids(one(part)).label(points), label_grid(one(part), axis, axis, axis)
    for labels, places in zip(found, (points, nodes(axis, axis, axis)), strict=True):
        clear = (np.abs(truth(places, part)) > 0.06) & (norm(places - [2, 0, 0], axis=-1) > 0.6)
        assert_array_equal(labels[clear] == 1, truth(places, part)[clear] < 0)


def test_the_mark_travels_and_relaxes_the_check_only_for_marked_segments() -> None:
    mesh = SegmentedMesh((holed(),)).transformed(np.eye(4))
    mesh.check()
    with pytest.raises(ValueError, match="open edges; it must be closed"):
        SegmentedMesh((replace(mesh.segments[0], solid=True),)).check()
    with pytest.raises(ValueError, match="NaN"):
        SegmentedMesh((replace(mesh.segments[0], vertices=WHOLE.vertices * nan),)).check()


def test_a_scene_with_a_hole_warns_and_makes_examples(tmp_path: Path) -> None:
    write_mesh(holed(), tmp_path / "ball.ply")
    write_mesh(box((2.5, -2, -2), (5, 2, 2)), tmp_path / "box.ply")
    path = tmp_path / "holed.yaml"
    path.write_text(
        "name: holed\nunits: m\nsegments:\n  - {name: ball, file: ball.ply}\n  - {name: box, file: box.ply}\n"
    )
    with pytest.warns(MeshWarning, match=r"'ball' has 7 open edges \(1 hole, near .*; the winding number") as caught:
        scene = load_scene(path)
    assert len(caught) == 1
    assert [segment.solid for segment in scene.rest.segments] == [False, True] and len(set(scene.rest.colors)) == 2
    settings = GenerateConfig(points=64, sampling=SamplingConfig(per_segment=32))
    queries = synthesize(scene, settings, example_rng(0, 0)).queries
    assert (queries.labels == 1).sum() >= 16 and np.isfinite(queries.distances).all()


def convex_polyhedron(seed: int) -> tuple[Segment, ndarray, ndarray]:
    """A random convex hull with the outward unit normals and offsets of its faces' planes."""
    mesh = trimesh.convex.convex_hull(default_rng(seed).normal(size=(60, 3)))
    normal = np.array(mesh.face_normals)
    return segment(mesh), normal, np.einsum("ij,ij->i", normal, mesh.triangles[:, 0])


@pytest.mark.parametrize("seed", range(3))
def test_depth_in_a_convex_solid_is_the_distance_to_the_nearest_face_plane(seed: int) -> None:
    part, normal, offset = convex_polyhedron(seed)
    solids = Solids(one(part))
    points = default_rng(seed).uniform(-1, 1, size=(4000, 3))
    height = points @ normal.T - offset
    points, height = points[height.max(axis=1) < 0], height[height.max(axis=1) < 0]
    distance, direction = signed_distance_and_direction(solids, points, solids.label(points))
    assert np.allclose(distance, height.max(axis=1), atol=1e-9)
    assert np.allclose(direction, normal[height.argmax(axis=1)], atol=1e-6)


def test_outside_a_box_distance_and_direction_have_closed_forms() -> None:
    solids = Solids(one(box((-1, -2, -3), (1, 2, 3))))
    points = default_rng(0).uniform(-6, 6, size=(5000, 3))
    outside = np.maximum(np.abs(points) - [1, 2, 3], 0.0)
    points = points[(outside > 0).any(axis=1)]
    foot = np.clip(points, [-1, -2, -3], [1, 2, 3])
    distance, direction = signed_distance_and_direction(solids, points, solids.label(points))
    expected = norm(points - foot, axis=1)
    assert np.allclose(distance, expected, atol=1e-9)
    assert np.allclose(direction, (foot - points) / expected[:, None], atol=1e-6)


def test_a_point_on_the_surface_takes_the_outward_normal() -> None:
    solids = Solids(one(box((0, 0, 0), (2, 2, 2))))
    points = np.array([[2.0, 0.7, 0.4], [0.3, 0.0, 1.1]])
    distance, direction = signed_distance_and_direction(solids, points, np.zeros(2, np.uint8))
    assert np.allclose(distance, 0) and np.allclose(direction, [[1, 0, 0], [0, -1, 0]])


def test_nearest_over_all_segments_is_the_least_of_each_segments_distance() -> None:
    solids = Solids(SegmentedMesh((knobbly_torus(1), ball((0, 0, 6), 1.5, color=1), box((4, 4, 4), (5, 6, 7)))))
    points = default_rng(3).uniform(-8, 8, size=(2000, 3))
    each = np.stack([solids.segment_distance(index, points) for index in range(3)])
    found = solids.nearest(points)
    assert np.allclose(found.distance, each.min(axis=0))
    assert np.array_equal(found.owner, each.argmin(axis=0))
    assert np.allclose(norm(found.point - points, axis=1), found.distance)


@pytest.mark.parametrize("unit, shift", [(1.0, 0.0), (1e-5, 0.0), (1.0, 3000.0)])
@pytest.mark.parametrize("seed", range(2))
def test_labels_are_right_beyond_a_billionth_of_the_longest_side(seed: int, unit: float, shift: float) -> None:
    """As ``Solids.label`` states it, for points this close to faces, edges and corners, of small things too."""
    part, normal, offset = convex_polyhedron(seed)
    side = float(np.ptp(part.vertices, axis=0).max())
    rng = default_rng(seed)
    face = rng.integers(len(part.faces), size=40_000)
    corners = part.vertices[part.faces[face]]
    points = np.einsum("ni,nij->nj", rng.dirichlet((0.3, 0.3, 0.3), len(face)), corners)
    points += (rng.choice([-1, 1], len(face)) * side * 10 ** rng.uniform(-12, -3, len(face)))[:, None] * normal[face]
    height = (points @ normal.T - offset).max(axis=1)
    moved = replace(part, vertices=unit * part.vertices + shift)
    wrong = (Solids(one(moved)).label(unit * points + shift) == 1) != (height < 0)
    assert np.abs(height[wrong]).max(initial=0.0) < 1e-9 * side


def test_the_first_segment_owns_an_overlap() -> None:
    mesh = SegmentedMesh((box((0, 0, 0), (2, 2, 2), "first"), box((1, 0, 0), (3, 2, 2), "second", 1)))
    points = np.array([[0.5, 1, 1], [1.5, 1, 1], [2.5, 1, 1], [3.5, 1, 1]])
    assert Solids(mesh).label(points).tolist() == [1, 1, 2, 0]
    assert label_grid(mesh, points[:, 0], points[:1, 1], points[:1, 2]).ravel().tolist() == [1, 1, 2, 0]


@pytest.mark.parametrize("seed", range(2))
def test_a_label_grid_is_the_labels_of_its_nodes(seed: int) -> None:
    mesh = SegmentedMesh((knobbly_torus(seed), knobbly_torus(seed + 9, "other", 1), ball((0, 0, 0), 1.0, color=2)))
    low, high = mesh.bounds
    around = default_rng(seed).uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (40, 3))
    axes = np.sort(around, axis=0).T
    labels = Solids(mesh).label(nodes(*axes).reshape(-1, 3)).reshape(40, 40, 40)
    assert np.array_equal(label_grid(mesh, *axes), labels)
    assert set(np.unique(labels)) == {0, 1, 2, 3}


@pytest.mark.parametrize("seed", range(12))
def test_columns_through_vertices_and_edges_leave_no_crack(seed: int) -> None:
    """Integer vertices on integer columns: every tie there is, in any numbering, is decided as beside it."""
    rng = default_rng(seed)
    mesh = trimesh.convex.convex_hull(rng.integers(0, 7, size=(14, 3)))
    number = rng.permutation(len(mesh.vertices))
    vertices = np.empty((len(number), 3))
    vertices[number] = np.round(mesh.vertices)
    part = Segment("hull", (1, 2, 3), vertices, number[mesh.faces])
    part = part if part.volume > 0 else turned(part)
    axis = np.arange(-1.0, 9.0)
    z = axis + np.sqrt(0.1)  # no node on a face
    labels = label_grid(one(part), axis, axis, z)
    assert np.array_equal(labels, label_grid(one(part), axis + 1e-5, axis + 1e-8, z))
    assert labels.any()
