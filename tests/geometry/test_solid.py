"""Inside, distance and label grids against closed forms, half spaces, symbolic shifts, and each other."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from shapes import ball, box, knobbly_torus, one, segment

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.mesh_check import overlaps
from mereo.geometry.solids import Solids, label_grid, signed_distance_and_direction


def convex_polyhedron(seed: int) -> tuple[Segment, np.ndarray, np.ndarray]:
    """A random convex hull with the outward unit normals and offsets of its faces' planes."""
    mesh = trimesh.convex.convex_hull(np.random.default_rng(seed).normal(size=(60, 3)))
    part = segment(mesh)
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return part, normal, np.einsum("ij,ij->i", normal, a)


def axes_around(mesh: SegmentedMesh, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    low, high = mesh.bounds
    reach = 0.1 * (high - low)
    return [np.sort(rng.uniform(low[k] - reach[k], high[k] + reach[k], count)) for k in range(3)]


def nodes(axes: list[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(3))
def test_depth_in_a_convex_solid_is_the_distance_to_the_nearest_face_plane(seed: int) -> None:
    part, normal, offset = convex_polyhedron(seed)
    solids = Solids(one(part))
    points = np.random.default_rng(seed).uniform(-1, 1, size=(4000, 3))
    height = points @ normal.T - offset
    points, height = points[height.max(axis=1) < 0], height[height.max(axis=1) < 0]
    distance, direction = signed_distance_and_direction(solids, points, solids.label(points))
    assert np.allclose(distance, height.max(axis=1), atol=1e-9)
    assert np.allclose(direction, normal[height.argmax(axis=1)], atol=1e-6)


def test_outside_a_box_distance_and_direction_have_closed_forms() -> None:
    solids = Solids(one(box((-1, -2, -3), (1, 2, 3))))
    points = np.random.default_rng(0).uniform(-6, 6, size=(5000, 3))
    outside = np.maximum(np.abs(points) - [1, 2, 3], 0.0)
    points = points[(outside > 0).any(axis=1)]
    foot = np.clip(points, [-1, -2, -3], [1, 2, 3])
    distance, direction = signed_distance_and_direction(solids, points, solids.label(points))
    expected = np.linalg.norm(points - foot, axis=1)
    assert np.allclose(distance, expected, atol=1e-9)
    assert np.allclose(direction, (foot - points) / expected[:, None], atol=1e-6)


def test_a_point_on_the_surface_takes_the_outward_normal() -> None:
    solids = Solids(one(box((0, 0, 0), (2, 2, 2))))
    points = np.array([[2.0, 0.7, 0.4], [0.3, 0.0, 1.1]])
    distance, direction = signed_distance_and_direction(solids, points, np.zeros(2, dtype=np.uint8))
    assert np.allclose(distance, 0) and np.allclose(direction, [[1, 0, 0], [0, -1, 0]])


def test_nearest_over_all_segments_is_the_least_of_each_segments_distance() -> None:
    solids = Solids(SegmentedMesh((knobbly_torus(1), ball((0, 0, 6), 1.5, color=1), box((4, 4, 4), (5, 6, 7)))))
    points = np.random.default_rng(3).uniform(-8, 8, size=(2000, 3))
    each = np.stack([solids.segment_distance(index, points) for index in range(3)])
    found = solids.nearest(points)
    assert np.allclose(found.distance, each.min(axis=0))
    assert np.array_equal(found.owner, each.argmin(axis=0))
    assert np.allclose(np.linalg.norm(found.point - points, axis=1), found.distance)


@pytest.mark.parametrize("shift", [0.0, 3000.0])
@pytest.mark.parametrize("seed", range(2))
def test_labels_are_right_beyond_two_millionths_of_the_longest_side(seed: int, shift: float) -> None:
    """As ``Solids.label`` states it, for points this close to faces, edges and corners; nearly all within 1e-7."""
    part, normal, offset = convex_polyhedron(seed)
    side, rng = float(np.ptp(part.vertices, axis=0).max()), np.random.default_rng(seed)
    face = rng.integers(len(part.faces), size=40_000)
    corners = part.vertices[part.faces[face]]
    points = np.einsum("ni,nij->nj", rng.dirichlet((0.3, 0.3, 0.3), len(face)), corners)
    points += (rng.choice([-1, 1], len(face)) * side * 10 ** rng.uniform(-8, -3, len(face)))[:, None] * normal[face]
    height = (points @ normal.T - offset).max(axis=1)
    moved = replace(part, vertices=part.vertices + shift)
    wrong = (Solids(one(moved)).label(points + shift) == 1) != (height < 0)
    assert np.abs(height[wrong]).max() < 2e-6 * side
    assert (np.abs(height[wrong]) > 1e-7 * side).mean() < 0.05


def test_the_first_segment_owns_an_overlap() -> None:
    mesh = SegmentedMesh((box((0, 0, 0), (2, 2, 2), "first"), box((1, 0, 0), (3, 2, 2), "second", 1)))
    points = np.array([[0.5, 1, 1], [1.5, 1, 1], [2.5, 1, 1], [3.5, 1, 1]])
    assert Solids(mesh).label(points).tolist() == [1, 1, 2, 0]
    assert label_grid(mesh, points[:, 0], points[:1, 1], points[:1, 2]).ravel().tolist() == [1, 1, 2, 0]


@pytest.mark.parametrize("seed", range(4))
def test_a_label_grid_is_the_labels_of_its_nodes(seed: int) -> None:
    mesh = SegmentedMesh((knobbly_torus(seed), knobbly_torus(seed + 9, "other", 1), ball((0, 0, 0), 1.0, color=2)))
    axes = axes_around(mesh, 40, np.random.default_rng(seed))
    labels = Solids(mesh).label(nodes(axes)).reshape(40, 40, 40)
    assert np.array_equal(label_grid(mesh, *axes), labels)
    assert set(np.unique(labels)) == {0, 1, 2, 3}


@pytest.mark.parametrize("seed", range(12))
def test_columns_through_vertices_and_edges_leave_no_crack(seed: int) -> None:
    """Integer vertices on integer columns: every tie there is, in any numbering, is decided as beside it."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.convex.convex_hull(rng.integers(0, 7, size=(14, 3)))
    number = rng.permutation(len(mesh.vertices))
    vertices = np.empty((len(number), 3))
    vertices[number] = np.round(mesh.vertices)
    part = Segment("hull", (1, 2, 3), vertices, number[mesh.faces])
    part = part if part.volume > 0 else Segment("hull", (1, 2, 3), vertices, number[mesh.faces[:, ::-1]])
    axis = np.arange(-1.0, 9.0)
    z = axis + np.sqrt(0.1)  # no node on a face
    labels = label_grid(one(part), axis, axis, z)
    assert np.array_equal(labels, label_grid(one(part), axis + 1e-5, axis + 1e-8, z))
    assert labels.any()


def test_touching_and_distant_segments_do_not_overlap() -> None:
    cubes = [box((i, 0, 0), (i + 1, 1, 1), f"cube_{i}", i) for i in range(3)]
    assert overlaps(SegmentedMesh((*cubes, ball((0, 9, 0), 1.0)))) == ()
