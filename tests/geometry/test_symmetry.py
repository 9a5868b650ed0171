"""Symmetries of segmented objects, against solids whose symmetries are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy import ndarray
from numpy.linalg import det
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from shapes import segment
from trimesh.creation import box, cylinder, icosphere

from mereo.geometry.mesh import Nested, SegmentedMesh
from mereo.geometry.metrics import with_segments_exchanged
from mereo.geometry.symmetry import describe_symmetries, find_symmetries
from mereo.geometry.transforms import fit_rigid, rigid, transform_points

POSE = rigid(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([5.0, -3.0, 8.0]))


def posed(*parts: trimesh.Trimesh, pose: ndarray = POSE, nested: Nested = ()) -> SegmentedMesh:
    segments = (replace(segment(part), name="abc"[i]) for i, part in enumerate(parts))
    return SegmentedMesh(tuple(segments), nested).transformed(pose)


def moved(part: trimesh.Trimesh, x: float, y: float = 0.0, z: float = 0.0) -> trimesh.Trimesh:
    return part.copy().apply_translation((x, y, z))


CUBOID = box((20, 30, 50))
BALL = icosphere(radius=20, subdivisions=4)


@pytest.mark.parametrize(
    ("part", "count"),
    [
        (CUBOID, 3),
        (box((20, 20, 50)), 7),
        (cylinder(15, 50, sections=6), 11),
        (cylinder(10, 50, sections=64), 2),  # about its axis, and over end
        (trimesh.creation.cone(10, 50, sections=64), 1),
        (BALL, 1),
    ],
)
def test_the_turns_of_known_solids_are_found(part: trimesh.Trimesh, count: int) -> None:
    mesh = posed(part)
    symmetries = find_symmetries(mesh, 0.3)
    assert len(symmetries) == count
    vertices = mesh.segments[0].vertices
    for symmetry in symmetries:
        turned = trimesh.Trimesh(transform_points(symmetry.turn, vertices), mesh.segments[0].faces)
        assert trimesh.proximity.closest_point(turned, vertices)[1].max() < 0.3
        assert symmetry.lands_on == (0,)


def test_an_axis_is_named_in_the_frame_of_the_object() -> None:
    (sentence,) = describe_symmetries(find_symmetries(posed(moved(BALL, 1), pose=np.eye(4)), 0.3), ("ball",))
    assert sentence == "the object looks the same turned in any way, each segment on itself"
    halves = posed(moved(CUBOID, -10), moved(CUBOID, 10), pose=np.eye(4))
    sentence = "the object looks the same turned by 180 degrees about z: no frame tells left and right apart"
    assert sentence in describe_symmetries(find_symmetries(halves, 0.3), ("left", "right"))


def test_segments_that_change_places_are_told_from_those_that_land_on_none() -> None:
    halves = find_symmetries(posed(moved(CUBOID, -10), moved(CUBOID, 10)), 0.3)
    assert {(symmetry.lands_on, symmetry.swaps) for symmetry in halves} == {((0, 1), False), ((1, 0), True)}
    core = icosphere(radius=5)
    beam = box((20, 4, 4))  # it would survive a half turn
    (bottle,) = find_symmetries(posed(beam, moved(trimesh.creation.cone(15, 60, sections=64), 0, 0, -20)), 0.3)
    assert bottle.angle is None and bottle.lands_on == (None, 1)
    (hidden,) = find_symmetries(posed(moved(core, 8), BALL, nested=(("a", "b"),)), 0.3)
    assert hidden.lands_on == (None, 1) and not hidden.swaps
    assert hidden.describe(("tumour", "ball")).endswith("in any way: no frame tells where tumour is")


def test_a_small_part_on_the_surface_breaks_the_symmetry() -> None:
    knob = icosphere(radius=2)
    assert find_symmetries(posed(CUBOID, moved(knob, 12, 3)), 0.3) == ()
    assert len(find_symmetries(posed(CUBOID, moved(knob, 2, 3)), 0.3)) == 3, "what is inside is not seen"
    with pytest.raises(ValueError, match="the tolerance is 0; it must be above 0"):
        find_symmetries(posed(CUBOID), 0.0)


def test_scores_up_to_symmetry_take_the_exchange_that_fits_best() -> None:
    right = np.array([[90, 1, 0, 0], [2, 30, 0, 0], [0, 0, 40, 1], [0, 0, 0, 9]])
    exchanged = right[[0, 2, 1, 3]]  # the answer has taken one part for the other
    for confusion in (right, exchanged):
        assert_array_equal(with_segments_exchanged(confusion, [(1, 0, 2)]), right)
    assert_array_equal(with_segments_exchanged(exchanged, []), exchanged)


def test_a_fit_of_moved_points_is_the_motion() -> None:
    rng = default_rng(3)
    for count in (3, 4, 50):
        motion = rigid(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * 100)
        source = rng.normal(size=(count, 3)) * [1, 5, 0.0 if count == 4 else 0.1]  # four of them in a plane
        found = fit_rigid(source, transform_points(motion, source))
        assert_allclose(found, motion, atol=1e-9)


def test_a_fit_of_noisy_pairs_is_the_one_of_scipy_and_nothing_near_it_is_better() -> None:
    rng = default_rng(3)
    source = rng.normal(size=(20, 3))
    target = rng.normal(size=(20, 3))
    weights = rng.random(20)
    found = fit_rigid(source, target, weights)
    middle, aim = (np.average(points, axis=0, weights=weights) for points in (source, target))
    expected = Rotation.align_vectors(target - aim, source - middle, weights=weights)[0].as_matrix()
    assert_allclose(found, rigid(expected, aim - expected @ middle), atol=1e-9)

    def error(motion: ndarray) -> float:
        return float(weights @ np.sum((transform_points(motion, source) - target) ** 2, axis=1))

    for _ in range(50):
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        assert error(rigid(turn, rng.normal(size=3) * 0.01) @ found) > error(found)


def test_a_fit_of_points_whose_products_are_infinite_ends() -> None:
    points = np.diag([1e300, 1.0, 1.0])
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="so far apart that their products are"):
        fit_rigid(points, points)


def test_mirrored_points_are_turned_not_mirrored() -> None:
    source = default_rng(3).normal(size=(30, 3))
    rotation = fit_rigid(source, source * [-1, 1, 1])[:3, :3]
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert det(rotation) == pytest.approx(1.0)
