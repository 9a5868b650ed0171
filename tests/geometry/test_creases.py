"""Flat faces keep their creases in what viewers show; smooth surfaces stay smooth and as small as they were."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.geometry.subdivision import split_at_creases
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.writers.glb import write_segments_glb

RED, BLUE = (213, 94, 0), (86, 180, 233)


def segment_of(mesh: trimesh.Trimesh, name: str = "part", shift: float = 0.0) -> Segment:
    vertices = np.array(mesh.vertices, dtype=np.float64) + np.array([shift, 0.0, 0.0])
    return Segment(name, RED if name == "part" else BLUE, vertices, np.array(mesh.faces))


def box() -> Segment:
    return segment_of(trimesh.creation.box((1.0, 2.0, 3.0)))


def ball() -> Segment:
    return segment_of(trimesh.creation.icosphere(3), "ball", 4.0)


def cylinder(sides: int) -> Segment:
    return segment_of(trimesh.creation.cylinder(1.0, 2.0, sections=sides))


def check(segment: Segment) -> Segment:
    """Split segment, after a check that it is the same surface, with old vertices first."""
    split, source = split_at_creases(segment)
    np.testing.assert_array_equal(split.vertices, segment.vertices[source])
    np.testing.assert_array_equal(source[split.faces], segment.faces)
    np.testing.assert_array_equal(source[: len(segment.vertices)], np.arange(len(segment.vertices)))
    assert set(source[split.faces].ravel()) == set(np.unique(split.faces)) & set(range(len(segment.vertices)))
    return split


def test_a_box_has_three_normals_at_each_corner() -> None:
    split = check(box())
    assert len(split.vertices) == 24
    normals = vertex_normals(split)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    faces = split.vertices[split.faces]
    own = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[split.faces], np.repeat(own[:, None], 3, axis=1), atol=1e-12)


@pytest.mark.parametrize("sides, times", [(12, 2), (24, 2), (8, 3)])
def test_a_cylinder_is_smooth_around_and_has_rims(sides: int, times: int) -> None:
    """Twelve sides meet at exactly 30 degrees, which is no crease; eight at 45, which is one."""
    split = check(cylinder(sides))
    assert len(split.vertices) == times * 2 * sides + 2
    round_it = np.abs(vertex_normals(split)[:, 2]) < 0.5
    assert round_it.sum() == (times - 1) * 2 * sides
    np.testing.assert_allclose(vertex_normals(split)[~round_it, 2], np.sign(split.vertices[~round_it, 2]), atol=1e-9)


def test_faces_without_area_and_edges_of_many_faces_are_no_trouble() -> None:
    one = box()
    thin = np.concatenate([one.faces, [[0, 1, 1], [0, 0, 0]]])
    assert len(split_at_creases(Segment("thin", RED, one.vertices, thin))[0].vertices) == 24
    shared = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [1, 0, 5]])
    fan = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    check(Segment("fan", RED, fan, shared))
    none = Segment("none", RED, np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    assert split_at_creases(none)[0] is none


def test_a_glb_has_creases_and_merges_to_the_same_surface(tmp_path: Path) -> None:
    mesh = SegmentedMesh((box(), ball()))
    write_segments_glb(tmp_path / "s.glb", mesh, np.eye(3))
    read = trimesh.load_scene(tmp_path / "s.glb", process=False).geometry
    assert [len(read[name].vertices) for name in mesh.names] == [24, len(ball().vertices)]
    assert np.sort(np.abs(read["part"].vertex_normals), axis=1) == pytest.approx(np.tile([0, 0, 1], (24, 1)))
    for segment in read_segmented_mesh(tmp_path / "s.glb").segments:
        assert segment.edge_imbalance() == (0, 0)
