"""Symmetries of segmented objects, against solids whose symmetries are known."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.metrics import with_segments_exchanged
from mereo.geometry.symmetry import describe_symmetries, find_symmetries
from mereo.geometry.transforms import rigid, transform_points

POSE = rigid(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([5.0, -3.0, 8.0]))


def posed(*parts: trimesh.Trimesh, pose: np.ndarray = POSE, nested: tuple[tuple[str, str], ...] = ()) -> SegmentedMesh:
    segments = [
        Segment("abc"[i], (1, 2, 3), transform_points(pose, np.asarray(part.vertices)), np.asarray(part.faces))
        for i, part in enumerate(parts)
    ]
    return SegmentedMesh(tuple(segments), nested)


def moved(part: trimesh.Trimesh, x: float, y: float = 0.0, z: float = 0.0) -> trimesh.Trimesh:
    part = part.copy()
    part.apply_translation((x, y, z))
    return part


CUBOID, BALL = trimesh.creation.box((20, 30, 50)), trimesh.creation.icosphere(radius=20, subdivisions=4)


@pytest.mark.parametrize(
    ("part", "count"),
    [
        (CUBOID, 3),
        (trimesh.creation.box((20, 20, 50)), 7),
        (trimesh.creation.cylinder(15, 50, sections=6), 11),
        (trimesh.creation.cylinder(10, 50, sections=64), 2),  # about its axis, and over end
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
    assert (
        "the object looks the same turned by 180 degrees about z: no frame tells left and right apart"
        in describe_symmetries(find_symmetries(halves, 0.3), ("left", "right"))
    )


def test_segments_that_change_places_are_told_from_those_that_land_on_none() -> None:
    halves = find_symmetries(posed(moved(CUBOID, -10), moved(CUBOID, 10)), 0.3)
    assert {symmetry.lands_on for symmetry in halves} == {(0, 1), (1, 0)}
    assert {symmetry.swaps for symmetry in halves if symmetry.lands_on == (1, 0)} == {True}
    core = trimesh.creation.icosphere(radius=5)
    beam = trimesh.creation.box((20, 4, 4))  # it would survive a half turn
    (bottle,) = find_symmetries(
        posed(beam, trimesh.creation.cone(15, 60, sections=64).apply_translation((0, 0, -20))), 0.3
    )
    assert bottle.angle is None and bottle.lands_on == (None, 1)
    (hidden,) = find_symmetries(posed(moved(core, 8), BALL, nested=(("a", "b"),)), 0.3)
    assert hidden.lands_on == (None, 1)
    assert not hidden.swaps
    assert hidden.describe(("tumour", "ball")).endswith("in any way: no frame tells where tumour is")


def test_a_small_part_on_the_surface_breaks_the_symmetry() -> None:
    knob = trimesh.creation.icosphere(radius=2)
    assert find_symmetries(posed(CUBOID, moved(knob, 12, 3)), 0.3) == ()
    assert len(find_symmetries(posed(CUBOID, moved(knob, 2, 3)), 0.3)) == 3, "what is inside is not seen"


def test_a_tolerance_must_be_above_zero() -> None:
    with pytest.raises(ValueError, match="the tolerance is 0; it must be above 0"):
        find_symmetries(posed(CUBOID), 0.0)


def test_scores_up_to_symmetry_take_the_exchange_that_fits_best() -> None:
    right = np.array([[90, 1, 0, 0], [2, 30, 0, 0], [0, 0, 40, 1], [0, 0, 0, 9]])
    exchanged = right[[0, 2, 1, 3]]  # the answer has taken one part for the other
    for confusion in (right, exchanged):
        np.testing.assert_array_equal(with_segments_exchanged(confusion, [(1, 0, 2)]), right)
    np.testing.assert_array_equal(with_segments_exchanged(exchanged, []), exchanged)
