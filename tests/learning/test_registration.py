"""Segments are placed on a scan one by one: known poses come back, and what the scan does not say is not made up."""

import numpy as np
import pytest
from align_cases import object_at_rest, perturbed, pose_error, scan_of, true_poses
from shapes import ball

from mereo.geometry.mesh import SegmentedMesh
from mereo_learning.icp import Matches, Registration, Scan, exposed, icp, moved
from mereo_learning.placement import Placement, Start, _check, place

pytest.importorskip("small_gicp", reason="the extra align is not installed")

NOISE = 0.02


def middles() -> list[np.ndarray]:
    return [segment.bounds.mean(axis=0) for segment in object_at_rest().segments]


def start() -> Start:
    """The object off by 12 degrees and 4 units of its 44; the arm, which is bent, has a rough pose of its own."""
    poses = true_poses()
    whole = perturbed(poses[0], np.array([19.0, 6.0, 4.0]), 12, 4, seed=1)
    return Start(
        np.stack([whole, perturbed(poses[1], middles()[1], 10, 2, seed=2), whole]), np.array([0, 1, 0], bool), ""
    )


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return scan_of(moved(object_at_rest(), true_poses()), NOISE)


@pytest.fixture(scope="module")
def placement(points: np.ndarray) -> Placement:
    return place(object_at_rest(), points, start())


def test_each_segment_comes_to_its_own_true_pose_and_a_hidden_one_goes_with_its_neighbour(placement: Placement) -> None:
    """To a few times the noise, although base and arm are bent against each other; with one pose they would not."""
    for index in (0, 1):
        segment = placement.segments[index]
        shift, turn_deg = pose_error(segment.T_scan_segment, true_poses()[index], middles()[index])
        assert shift < 0.03 and turn_deg < 0.1
        assert segment.placed_by == "scan"
        assert segment.median < 2 * NOISE and segment.p95 < 5 * NOISE and segment.points > 500
    base, arm, peg = placement.segments
    assert (base.held, arm.held) == (0, 1), "three sides of the base are seen, two of the arm: it might slide"
    assert pose_error(base.T_scan_segment, true_poses()[1], middles()[1])[0] > 2
    assert placement.explained > 0.98
    assert arm.shift == pytest.approx(2, abs=0.05) and arm.turn_deg == pytest.approx(10, abs=0.2)
    assert peg.points == 0 and not peg.seen and peg.placed_by == "with base"
    np.testing.assert_array_equal(peg.T_scan_segment, base.T_scan_segment)
    assert np.isnan(peg.median)


@pytest.mark.slow
def test_a_held_segment_is_left_to_its_neighbour_or_start(points: np.ndarray) -> None:
    rest, rough = object_at_rest(), start()
    own = place(rest, points, rough, hold=["arm"]).segments[1]
    assert own.placed_by == "start"
    np.testing.assert_array_equal(own.T_scan_segment, rough.poses[1])
    with pytest.raises(ValueError, match="no segment 'leg' to hold; the segments are base, arm, peg"):
        place(rest, points, rough, hold=["leg"])


@pytest.mark.slow
def test_as_one_moves_all_by_one_motion(points: np.ndarray) -> None:
    """What is rigid keeps its shape, whatever the scan says of its parts."""
    rest = SegmentedMesh((object_at_rest().segments[0], object_at_rest().segments[2]))
    mine = scan_of(moved(rest, true_poses()[[0, 2]]), NOISE)
    rough = Start(start().poses[[0, 2]], np.zeros(2, bool), "")
    base, peg = place(rest, mine, rough, is_rigid=True).segments
    assert base.placed_by == peg.placed_by == "object"
    np.testing.assert_array_equal(base.T_scan_segment, peg.T_scan_segment)
    assert pose_error(base.T_scan_segment, true_poses()[0], middles()[0])[0] < 0.05


def test_a_scan_of_something_else_or_far_from_the_start_is_refused(points: np.ndarray) -> None:
    """Three points in five belong to a wall behind the object."""
    few = points[::4]
    wall = np.random.default_rng(0).uniform([-60, -60, 170], [60, 60, 171], size=(len(few) * 3 // 2, 3))
    with pytest.raises(ValueError, match="4.% of the scan's points|[0-3].% of the scan's points lie within"):
        place(object_at_rest(), np.concatenate([few, wall]), start())
    with pytest.raises(ValueError, match="the scan has 1 points that are .* apart; at least 40 are needed"):
        place(object_at_rest(), points[:1], start())
    away = start().poses.copy()
    away[:, 1, 3] += 60
    with pytest.raises(ValueError, match="segment 'base' moved by .* from its start, but at most|of the scan's points"):
        place(object_at_rest(), points, Start(away, np.zeros(3, bool), ""))


def test_a_segment_that_ran_away_is_refused() -> None:
    before, after = true_poses(), true_poses()
    after[2, :3, 3] += 4.0  # the peg is 5.6 long
    matches, scan = Matches(np.zeros(1, int), np.zeros(1), 1.0), Scan(np.zeros((1, 3)), np.zeros(3), 44.0, 1.0)
    with pytest.raises(ValueError, match="segment 'peg' moved by 6.93 .* at most 5.59, .* --hold peg"):
        _check(object_at_rest(), before, Registration(after, np.ones(3, bool), np.zeros(3, int), matches), scan)
    after[2, :3, 3] -= 2.0
    _check(object_at_rest(), before, Registration(after, np.ones(3, bool), np.zeros(3, int), matches), scan)


def test_a_ball_is_shifted_but_not_turned() -> None:
    """Its three turns are free: half of a ball, moved by a known shift, gives the shift and no turn."""
    sphere = ball((0, 0, 50), 6.0, "ball", level=4)
    shift = np.array([0.4, -0.3, 0.2])
    way = np.random.default_rng(0).normal(size=(3000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    half = np.array([0.0, 0.0, 50.0]) + 6.0 * way * [1, 1, -1] + shift
    motion, held = icp(half[half[:, 2] < 50.2], SegmentedMesh((sphere,)), 1.0, 0.05, hold=True)
    assert held == 3
    np.testing.assert_allclose(motion[:3, 3] + motion[:3, :3] @ [0, 0, 50] - [0, 0, 50], shift, atol=0.02)
    np.testing.assert_allclose(motion[:3, :3], np.eye(3), atol=2e-3)


def test_faces_in_contact_cannot_be_seen() -> None:
    """Of two boxes that touch, exactly the two faces between them go; of a nested one, all."""
    from shapes import box

    left, right = box((0, 0, 0), (1, 1, 1), "left"), box((1, 0, 0), (2, 1, 1), "right", 1)
    shown = exposed(SegmentedMesh((left, right)))
    assert [len(segment.faces) for segment in shown.segments] == [10, 10]
    assert not (shown.segments[0].vertices[shown.segments[0].faces][..., 0] == 1).all(axis=1).any()
    inner, outer = box((1, 1, 1), (2, 2, 2), "inner"), box((0, 0, 0), (3, 3, 3), "outer", 1)
    shown = exposed(SegmentedMesh((inner, outer), (("inner", "outer"),)))
    assert [len(segment.faces) for segment in shown.segments] == [0, 12]
