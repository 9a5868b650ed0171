"""Surfaces: closed forms, and coarse to fine against the dense grid."""

import numpy as np
import pytest
from analytic import Distance, ball, half, logits_of, plate, union
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import map_coordinates

from mereo.geometry.marching_cubes import zero_surface
from mereo.geometry.mesh import PALETTE, Segment
from mereo.reconstruction.isosurfaces import Extraction, Field, _grid, extract, extract_whole, locate

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def run(field: Field, segments: int = 1, resolution: int = 40, box: ndarray = BOX, **options: bool) -> Extraction:
    return extract(field, box, resolution, ("left", "right")[:segments], PALETTE[:segments], **options)


def euler_number(segment: Segment) -> int:
    edges = np.unique(np.sort(segment.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return len(np.unique(segment.faces)) - len(edges) + len(segment.faces)


def small_balls(seed: int) -> Distance:
    """Twelve balls of radius 0.6 to 3 voxels; a coarse cell has 4."""
    rng = default_rng(seed)
    voxel = 2 / 40
    return union(*(ball(tuple(rng.uniform(-0.8, 0.8, 3)), rng.uniform(0.6, 3.0) * voxel) for _ in range(12)))


FIELDS = {
    "one ball": (logits_of(ball((0.03, -0.02, 0.05), 0.7)), 1),
    "touching balls": (logits_of(ball((-0.41, 0.0, 0.0), 0.4), ball((0.39, 0.0, 0.0), 0.4)), 2),
    "halves": (logits_of(half(ball((0.0, 0.0, 0.0), 0.7), -1.0), half(ball((0.0, 0.0, 0.0), 0.7), 1.0)), 2),
    "thin plate": (logits_of(plate((1.0, 0.3, 0.2), 0.11, 0.06)), 1),
    "thin tilted plate": (logits_of(plate((1.0, 1.0, 1.0), 0.11, 0.06)), 1),
    "two thin plates": (logits_of(plate((0.2, 1.0, 0.1), 0.0, 0.06), plate((0.2, 1.0, 0.1), 0.06, 0.06)), 2),
    "ball smaller than a cell": (logits_of(ball((0.11, 0.12, 0.08), 0.06)), 1),
    **{f"small balls {seed}": (logits_of(small_balls(seed)), 1) for seed in range(4)},
    "small balls of two labels": (logits_of(small_balls(20), small_balls(21)), 2),
}


@pytest.mark.parametrize("name", FIELDS)
def test_coarse_to_fine_is_the_dense_grid(name: str) -> None:
    field, segments = FIELDS[name]
    fine, dense = run(field, segments), run(field, segments, dense=True)
    assert (fine.grid.labels == dense.grid.labels).all()
    assert dense.grid.labels.any() and dense.evaluated == dense.grid.labels.size
    for a, b in zip(fine.surfaces.segments, dense.surfaces.segments, strict=True):
        assert_array_equal(a.vertices, b.vertices)
        assert_array_equal(a.faces, b.faces)


def test_a_surface_once_met_is_followed_to_its_end() -> None:
    """A wire of one voxel's radius leaves a ball; saturated logits give the coarse lattice no slope to notice it by."""
    turn = np.linspace(0.0, 5.0, 400)
    wire = union(*(ball((0.62 * np.cos(t), 0.62 * np.sin(t), -0.3 + 0.2 * t), 0.06) for t in turn[::4]))
    plain = logits_of(union(ball((0.62, 0.0, -0.3), 0.2), wire))
    field = lambda points: 8.0 * np.sign(plain(points))  # noqa: E731
    fine, dense = run(field), run(field, dense=True)
    assert_array_equal(fine.grid.labels, dense.grid.labels)
    assert fine.grid.labels[:, :, -7:].any(), "the wire reaches up"


def test_a_ball_is_a_closed_surface_of_euler_number_2_for_which_few_points_are_asked() -> None:
    found = run(logits_of(ball((0.03, -0.02, 0.05), 0.7)), resolution=64)
    segment = found.surfaces.segments[0]
    assert segment.edge_imbalance() == (0, 0)
    assert euler_number(segment) == 2
    assert segment.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=2e-3)
    radius = norm(segment.vertices - [0.03, -0.02, 0.05], axis=1)
    assert np.abs(radius - 0.7).max() < 0.05 * 2 / 64, "a twentieth of a voxel"
    assert run(logits_of(ball((0.0, 0.0, 0.0), 0.6)), resolution=128).evaluated < 0.08 * 129**3


def test_neighbours_share_their_interface_and_volumes_add_up() -> None:
    whole = ball((0.0, 0.0, 0.0), 0.7)
    box = BOX + 0.013  # no node on the interface
    found = run(logits_of(half(whole, -1.0), half(whole, 1.0)), 2, 48, box)
    left, right = found.surfaces.segments
    together = run(logits_of(whole), 1, 48, box).surfaces.segments[0]
    voxel = 2 / 48
    walls = []
    for segment in (left, right):
        assert segment.edge_imbalance() == (0, 0) and euler_number(segment) == 2
        on_wall = (np.abs(segment.vertices[:, 0]) < 1e-5) & (norm(segment.vertices, axis=1) < 0.7 - 2 * voxel)
        walls.append(np.unique(segment.vertices[on_wall].round(5), axis=0))
    assert len(walls[0]) > 200
    assert_allclose(walls[0], walls[1], atol=2e-5 * voxel + 1e-9)
    assert left.volume + right.volume == pytest.approx(together.volume, rel=3e-3)  # gaps below a voxel along the rim


@pytest.mark.parametrize("seed", range(3))
def test_a_field_and_its_negative_have_one_surface_with_its_faces_turned(seed: int) -> None:
    """Also where opposite corners of a cell's side are alike, as on most sides of noise."""
    field = np.pad(default_rng(seed).normal(size=(12, 13, 14)), 1, constant_values=-1.0)
    vertices, faces = zero_surface(field)
    again, turned = zero_surface(-field)
    assert_array_equal(vertices, again)
    first, second = ({tuple(np.roll(face, -face.argmin())) for face in each} for each in (faces, turned[:, ::-1]))
    assert first == second
    surface = Segment("noise", PALETTE[0], vertices, faces)
    assert surface.edge_imbalance() == (0, 0) and surface.volume > 0, "closed, outward"
    assert_allclose(map_coordinates(field, vertices.T, order=1), 0.0, atol=1e-12)


def test_a_segment_that_fills_the_box_is_closed_half_a_voxel_outside() -> None:
    found = run(logits_of(ball((0.0, 0.0, 0.0), 9.0)), resolution=20)
    segment = found.surfaces.segments[0]
    assert found.grid.touched_sides().all()
    assert segment.edge_imbalance() == (0, 0)
    assert_allclose(segment.bounds, [[-1.05] * 3, [1.05] * 3], rtol=1e-6)
    assert 0.99 * 2.1**3 < segment.volume < 2.1**3


def test_voxels_are_cubes_and_the_resolution_is_that_of_the_longest_side() -> None:
    box = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.55]])
    grid = run(logits_of(ball((0.5, 1.0, 0.3), 0.2)), resolution=20, box=box).grid
    assert grid.labels.shape == (11, 21, 7)
    assert_allclose(grid.spacing, 0.1)
    assert_allclose(grid.positions(np.array([[10, 20, 0]])), [[1.0, 2.0, 0.0]])


def test_locate_grows_until_the_object_is_inside() -> None:
    field = logits_of(ball((2.5, 0.0, 0.0), 2.0))
    box = locate(field, BOX)
    assert (box[0] < [0.5, -2.0, -2.0]).all() and (box[1] > [4.499, 2.0, 2.0]).all()
    assert (box[1] - box[0]).max() < 6.0, "not much more than the ball"
    with pytest.raises(ValueError, match="finds no segment near the cloud.*check the weights"):
        locate(logits_of(lambda p: np.ones(len(p))), BOX)
    whole = extract_whole(logits_of(ball((0.5, 0.0, 0.0), 0.8)), BOX, 24, ("a",), PALETTE[:1])
    assert not whole.grid.touched_sides().any()
    assert whole.surfaces.segments[0].volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)


@pytest.mark.parametrize(
    "box, resolution, text",
    [
        (BOX, 3, "the resolution is 3; at least 4"),
        (BOX[::-1], 32, "all must be positive"),
        (BOX * np.nan, 32, "all must be positive and finite"),
        (BOX, 1000, "resolution 1000 makes a grid of 1001 x 1001 x 1001 nodes"),
    ],
)
def test_impossible_grids(box: ndarray, resolution: int, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        _grid(box, resolution)
