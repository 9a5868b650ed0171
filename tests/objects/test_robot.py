"""The robot in random poses: rigid links that stay joined, within their limits, and pass through nothing."""

from itertools import pairwise

import numpy as np
import pytest
from solid_pairs import gap, overlapping_pairs

from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import State
from mereo_objects import _robot_parts as parts
from mereo_objects import robot

LINKS = ("base", "column", "upper_arm", "elbow", "forearm", "wrist", "hand")


@pytest.fixture(scope="module")
def states() -> list[State]:
    scene, rng = load_scene("robot"), np.random.default_rng(1)
    return [scene.sample_state(rng) for _ in range(40)]


def pose(*angles_deg: float) -> SegmentedMesh:
    """The arm at given angles, the gripper as at rest."""
    turns = robot.chain(np.deg2rad(np.array(angles_deg)))
    links = [robot.Compose(turns[:count][::-1]) for count in range(1, 7)]
    return robot.scene().deform((robot.Identity(), *links, links[-1], links[-1])).mesh


def test_neighbours_have_a_clearance() -> None:
    mesh = robot.rest_mesh()
    pairs = [*pairwise(LINKS), ("hand", "finger_left"), ("hand", "finger_right")]
    for pair in pairs:
        assert 0.1 < gap(mesh, *pair) < 0.3, pair


def test_no_two_parts_overlap(states: list[State]) -> None:
    for state in states:
        assert overlapping_pairs(state.mesh) == []
        assert state.mesh.bounds[0, 2] > -1e-9  # the floor


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_neighbours_pass_each_other_at_any_angle(index: int, share: float) -> None:
    joint = robot.JOINTS[index]
    angles = np.zeros(6)
    angles[index] = joint.lower_deg + share * (joint.upper_deg - joint.lower_deg)
    angles[5] = 45.0  # the hand's corners turned up
    mesh = pose(*angles)
    assert all(pair not in overlapping_pairs(mesh) for pair in pairwise(LINKS))


def test_neighbours_share_the_axis_of_their_joint(states: list[State]) -> None:
    for state in states:
        for joint, (before, after) in zip(robot.JOINTS, pairwise(state.deformations[:7]), strict=True):
            on_axis = np.array(joint.center) + np.outer([0.0, 3.0], joint.axis)
            assert np.allclose(before(on_axis), after(on_axis), atol=1e-9)


def test_fingers_open_alike_and_stay_on_their_guides(states: list[State]) -> None:
    tips = np.array([[36.0, 0.0, parts.FOREARM_HEIGHT]])
    openings = []
    for state in states:
        hand, left, right = state.deformations[6:]
        y_axis = hand(tips + np.array([[0.0, 1.0, 0.0]])) - hand(tips)
        slide = left(tips) - hand(tips)
        assert np.allclose(slide, hand(tips) - right(tips), atol=1e-9)
        along = float(slide[0] @ y_axis[0])
        assert np.allclose(slide, along * y_axis, atol=1e-9)
        openings.append(parts.JAW_OPENING + along)
    assert min(openings) >= robot.OPENING[0] and max(openings) <= robot.OPENING[1]
    assert np.ptp(openings) > 1.2


@pytest.mark.parametrize(
    "angles_deg, pair",
    [
        ((0, 75, 60, 0, 0, 0), ("base", "hand")),  # bent over forwards
        ((0, -35, 75, 0, 90, 0), ("column", "hand")),  # folded back
        ((0, 0, 70, 90, 100, 0), ("upper_arm", "hand")),  # turned sideways
    ],
)
def test_poses_in_which_parts_meet_are_refused(angles_deg: tuple[float, ...], pair: tuple[str, str]) -> None:
    assert pair in overlapping_pairs(pose(*angles_deg))
    assert not robot.is_clear(robot.chain(np.deg2rad(np.array(angles_deg))))
