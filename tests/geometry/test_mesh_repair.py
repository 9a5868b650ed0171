"""Faulty meshes: each fault is found, repaired, and said; what is sound stays, cavities included."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from overlapping import check_overlap
from scene_files import write_bar, write_mesh
from shapes import ball, box, knobbly_torus, segment

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import examine, likely_unit, overlaps
from mereo.geometry.mesh_repair import repaired, without_overlaps
from mereo.scenes.files import check
from mereo.scenes.files.build import MeshWarning
from mereo.scenes.files.check import check_scene
from mereo.scenes.registry import load_scene


def joined(*parts: Segment) -> Segment:
    vertices, faces, _ = SegmentedMesh(tuple(replace(p, name=str(i)) for i, p in enumerate(parts))).merged()
    return Segment("part", (1, 2, 3), vertices, faces)


def hollow() -> Segment:
    inner = ball((0, 0, 0), 1.0)
    return joined(ball((0, 0, 0), 2.0), replace(inner, faces=inner.faces[:, ::-1]))


def soup(part: Segment, noise: float) -> Segment:
    """Every face with vertices of its own, moved a little."""
    vertices = part.vertices[part.faces].reshape(-1, 3)
    rng = np.random.default_rng(0)
    return replace(
        part, vertices=vertices + noise * rng.normal(size=vertices.shape), faces=np.arange(len(vertices)).reshape(-1, 3)
    )


def half_turned(part: Segment) -> Segment:
    faces = part.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return replace(part, faces=faces)


@pytest.mark.parametrize("part", [ball((3, 0, 0), 2.0), knobbly_torus(1), hollow(), box((0, 0, 0), (1, 2, 3))])
def test_sound_meshes_are_left_alone(part: Segment) -> None:
    assert examine(part).sound
    fixed = repaired(part)
    assert fixed.segment is part and fixed.changes == ()


TORUS = knobbly_torus(1)


@pytest.mark.parametrize(
    ("faulty", "fault", "change", "volume"),
    [
        (replace(TORUS, faces=TORUS.faces[5:]), "open edges", "filled 1 hole with", TORUS.volume),
        (
            replace(TORUS, faces=np.delete(TORUS.faces, [0, 900], axis=0)),
            "6 open edges",
            "filled 2 holes",
            TORUS.volume,
        ),
        (replace(TORUS, faces=TORUS.faces[:, ::-1]), "100% of its surface facing inwards", "turned 1920", TORUS.volume),
        (half_turned(TORUS), "disagree in orientation", "turned 640 faces", TORUS.volume),
        (soup(TORUS, 1e-9), "open edges", "merged 4800 vertices", TORUS.volume),
        (soup(TORUS, 1e-5), "open edges", "merged 4800 vertices", TORUS.volume),
        (replace(TORUS, faces=np.concatenate([TORUS.faces, TORUS.faces[:7]])), "open edges", "dropped 7", TORUS.volume),
        (
            joined(
                TORUS,
                replace(
                    segment(trimesh.creation.icosahedron()),
                    vertices=np.eye(12, 3) * 0.01 + 4,
                    faces=np.array([[0, 1, 2]]),
                ),
            ),
            "3 open edges",
            "removed 1 fragments (1 faces)",
            TORUS.volume,
        ),
        (
            joined(ball((0, 0, 0), 2.0), ball((2, 0, 0), 2.0)),
            "intersects itself",
            "united 2 shells",
            2 * 4 / 3 * np.pi * 8 - 5 / 16 * 4 / 3 * np.pi * 8,
        ),
    ],
)
def test_each_fault_is_found_repaired_and_said(faulty: Segment, fault: str, change: str, volume: float) -> None:
    health = examine(faulty)
    assert any(fault in text for text in (*health.dirty, *health.hopeless)), health
    fixed = repaired(faulty)
    assert any(change in text for text in fixed.changes), fixed.changes
    assert examine(fixed.segment).sound
    SegmentedMesh((fixed.segment,)).check()
    assert fixed.segment.volume == pytest.approx(volume, rel=0.01)


def test_a_cavity_survives_the_repair_of_a_hole() -> None:
    part = hollow()
    fixed = repaired(replace(part, faces=part.faces[4:]))
    assert fixed.segment.volume == pytest.approx(part.volume, rel=0.01)


@pytest.mark.slow
def test_the_last_resort_is_a_new_surface_that_keeps_the_shape() -> None:
    # one surface that runs through itself: no hole to fill and no shell to unite
    part = ball((0, 0, 0), 2.0)
    x, y, z = part.vertices.T
    twisted = replace(part, vertices=np.stack([x, y * (1 - 1.2 * np.exp(-4 * (x - 1) ** 2)), z], axis=1))
    assert any("intersects itself" in text for text in examine(twisted).dirty) or examine(twisted).hopeless
    fixed = repaired(twisted)
    assert "new surface" in fixed.changes[-1]
    assert examine(fixed.segment).sound
    np.testing.assert_allclose(fixed.segment.bounds, twisted.bounds, atol=0.05)


def test_nothing_is_made_of_nothing() -> None:
    empty = Segment("part", (1, 2, 3), np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
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


def test_a_segment_within_another_becomes_its_cavity() -> None:
    mesh = SegmentedMesh((ball((0, 0, 0), 2.0, "outer"), ball((0, 0, 0), 1.0, "inner")))
    fixed, _ = without_overlaps(mesh)
    check_overlap(fixed)
    assert fixed.segments[0].volume == pytest.approx(4 / 3 * np.pi * 7, rel=0.01)


def test_likely_units() -> None:
    assert likely_unit(np.array([[0.0, 0, 0], [0.3, 0.1, 0.1]])) == "m"
    assert likely_unit(np.array([[0.0, 0, 0], [300, 100, 100]])) == "mm"


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_check_counts_faults_and_repair_leaves_the_users_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "STATES", 3)
    path = write_bar(tmp_path, "# kept here\nsize: 15\n")
    check_scene(str(path))
    assert "bar: 2 segments, closed, outward oriented, without overlap" in capsys.readouterr().out
    part = trimesh.load_mesh(tmp_path / "left.stl")
    part.apply_translation((3, 0, 0))
    write_mesh(Segment("left", (0, 0, 0), np.array(part.vertices), np.array(part.faces)[2:]), tmp_path / "left.stl")
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"bar.yaml has 3 faults, listed above: repair the meshes with --repair"):
        check_scene(str(path))
    printed = capsys.readouterr().out
    assert "fault: it has 6 open edges (holes)" in printed and "left and right overlap in 15" in printed
    check_scene(str(path), repair=True)
    printed = capsys.readouterr().out
    assert "repaired left: filled 1 hole" in printed and "cut out" in printed
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


def test_parts_of_a_model_get_files_of_their_own(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    parts = {
        "a": box((0, 0, 0), (2, 2, 2)),
        "core": box((2.5, 0.8, 0.8), (2.9, 1.2, 1.2)),
        "b b": box((1.5, 0, 0), (3.5, 2, 2)),
    }
    for name, part in parts.items():
        scene.add_geometry(trimesh.Trimesh(part.vertices, part.faces), node_name=name, geom_name=name)
    scene.export(tmp_path / "model.glb")
    path = tmp_path / "two.yaml"
    path.write_text(
        "name: two\nunits: m\nmodel: model.glb  # from CAD\n\nparts:\n"
        "  - name: a\n  - {name: core, nested_in: b b}\n  - {name: b b, color: [1, 2, 3]}\n\nsize: 12 # s\n"
    )
    check_scene(str(path), repair=True)
    data = yaml.safe_load((tmp_path / "two-repaired.yaml").read_text())
    assert list(data) == ["name", "units", "segments", "size"] and data["size"] == 12
    assert [block["file"] for block in data["segments"]] == ["a-repaired.ply", "core-repaired.ply", "b_b-repaired.ply"]
    rest = load_scene(tmp_path / "two-repaired.yaml").rest
    assert (rest.nested, rest.colors[2]) == ((("core", "b b"),), (1, 2, 3))
    check_overlap(rest)


def test_a_mesh_without_an_inside_is_reported_and_turned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_bar(tmp_path)
    part = trimesh.load_mesh(tmp_path / "left.stl")
    write_mesh(
        Segment("left", (0, 0, 0), np.array(part.vertices), np.array(part.faces)[:, ::-1]), tmp_path / "left.stl"
    )
    with pytest.raises(ValueError, match="has 1 fault, listed above"):
        check_scene(str(path))
    assert "left                     192 faces\n  fault: it has 100% of its surface facing" in capsys.readouterr().out
    check_scene(str(path), repair=True)
    assert "repaired left: turned 192 faces around" in capsys.readouterr().out
    files = [block["file"] for block in yaml.safe_load((tmp_path / "bar-repaired.yaml").read_text())["segments"]]
    assert files == ["left-repaired.ply", "right.stl"]


def test_only_yaml_files_are_repaired() -> None:
    with pytest.raises(ValueError, match="'rope' is none"):
        check_scene("rope", repair=True)
