"""Meshes that are no solids: the winding number labels them as the solid that they stand for, from check to dataset."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_files import write_mesh
from shapes import ball, box

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.solids import Solids, label_grid
from mereo.scenes.files.build import MeshWarning
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.examples import synthesize

WHOLE = ball((0, 0, 0), 2.0, level=3)


def holed() -> Segment:
    """Without the three faces nearest to +x; far from there it is the whole ball."""
    order = np.argsort(-WHOLE.vertices[WHOLE.faces].mean(axis=1)[:, 0])
    return replace(WHOLE, faces=np.delete(WHOLE.faces, order[:3], axis=0), solid=False)


def crossing() -> Segment:
    """Two balls in one mesh, each closed, that share a lens."""
    other = ball((1.5, 0, 0), 2.0, level=3)
    faces = np.concatenate([WHOLE.faces, other.faces + len(WHOLE.vertices)])
    return Segment("ball", (1, 2, 3), np.concatenate([WHOLE.vertices, other.vertices]), faces, solid=False)


def truth(points: np.ndarray, part: Segment) -> np.ndarray:
    centers = [(0, 0, 0), (1.5, 0, 0)][: 1 + (len(part.vertices) > len(WHOLE.vertices))]
    return np.min([np.linalg.norm(points - center, axis=-1) for center in centers], axis=0) - 2.0


@pytest.mark.parametrize("part", [holed(), crossing()], ids=["hole", "self-intersection"])
def test_points_and_grids_are_labelled_as_of_the_solid(part: Segment) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 4, size=(4000, 3))
    clear = (np.abs(truth(points, part)) > 0.06) & (np.linalg.norm(points - [2, 0, 0], axis=1) > 0.6)
    inside = Solids(SegmentedMesh((part,))).label(points) == 1
    np.testing.assert_array_equal(inside[clear], truth(points, part)[clear] < 0)
    axis = np.linspace(-2.7, 3.7, 33)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    clear = (np.abs(truth(nodes, part)) > 0.06) & (np.linalg.norm(nodes - [2, 0, 0], axis=-1) > 0.6)
    grid = label_grid(SegmentedMesh((part,)), axis, axis, axis) == 1
    np.testing.assert_array_equal(grid[clear], truth(nodes, part)[clear] < 0)


def test_the_mark_travels_and_relaxes_the_check_only_for_marked_segments() -> None:
    mesh = SegmentedMesh((holed(),)).transformed(np.eye(4))
    mesh.check()
    with pytest.raises(ValueError, match="open edges; it must be closed"):
        SegmentedMesh((replace(mesh.segments[0], solid=True),)).check()
    with pytest.raises(ValueError, match="NaN"):
        SegmentedMesh((replace(mesh.segments[0], vertices=WHOLE.vertices * np.nan),)).check()


def test_a_scene_with_a_hole_warns_and_makes_examples(tmp_path: Path) -> None:
    write_mesh(holed(), tmp_path / "ball.ply")
    write_mesh(box((2.5, -2, -2), (5, 2, 2)), tmp_path / "box.ply")
    path = tmp_path / "holed.yaml"
    path.write_text(
        "name: holed\nunits: m\nsegments:\n  - {name: ball, file: ball.ply}\n  - {name: box, file: box.ply}\n"
    )
    with pytest.warns(
        MeshWarning, match=r"'ball' has 7 open edges \(1 hole, near .*; the winding number .*--repair"
    ) as caught:
        scene = load_scene(path)
    assert len(caught) == 1
    assert [segment.solid for segment in scene.rest.segments] == [False, True]
    settings = GenerateConfig(points=64, sampling=SamplingConfig(per_segment=32))
    queries = synthesize(scene, settings, example_rng(0, 0)).queries
    assert (queries.labels == 1).sum() >= 16 and np.isfinite(queries.distances).all()
