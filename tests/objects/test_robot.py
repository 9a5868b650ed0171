"""The robot in random poses: rigid links that stay joined, within their limits, and pass through nothing."""

from itertools import pairwise

import numpy as np
import pytest
from solid_pairs import gap, overlapping_pairs

from mereo.deformation.maps import jacobian
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import State
from mereo.synthesis.depth_sensor import render_depth
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


def test_rest_pose_is_a_base_six_links_and_two_fingers() -> None:
    mesh = robot.rest_mesh()
    assert mesh.names == (*LINKS, "finger_left", "finger_right")
    assert len(set(mesh.colors)) == 9
    assert 3000 < sum(len(segment.faces) for segment in mesh.segments) < 15000
    left, right = mesh.segments[7:]
    assert np.isclose(left.volume, right.volume)


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


def test_every_part_moves_rigidly(states: list[State]) -> None:
    points = np.array([[0.0, 0.0, 0.0], [30.0, 5.0, 40.0], [-5.0, 8.0, 12.0]])
    for state in states[:5]:
        for deformation in state.deformations:
            matrix = jacobian(deformation, points)[1]
            assert np.allclose(matrix.transpose(0, 2, 1) @ matrix, np.eye(3), atol=1e-6)
            assert np.allclose(np.linalg.det(matrix), 1.0, atol=1e-6)


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


def test_states_vary(states: list[State]) -> None:
    hands = np.stack([state.mesh.segments[6].vertices.mean(axis=0) for state in states])
    assert hands.std(axis=0).min() > 5.0


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


def test_spheres_enclose_the_hand_and_its_camera() -> None:
    rows = [row for row in robot.REACHING if row.link == 6]
    vertices = np.concatenate([part.vertices for part in robot.rest_mesh().segments[6:]])
    outside = [np.linalg.norm(vertices[:, None] - row.centers(), axis=-1).min(axis=1) - row.radius for row in rows]
    assert np.min(outside, axis=0).max() < 0.0


@pytest.mark.parametrize("pitch_deg", [-100.0, 100.0])
def test_the_hand_passes_the_forearm_at_any_spin(pitch_deg: float) -> None:
    arm = Solids(SegmentedMesh(robot.rest_mesh().segments[3:5]))
    for spin_deg in range(0, 360, 30):
        hand = pose(0, 0, 0, 0, pitch_deg, spin_deg).segments[6]
        assert arm.nearest(hand.vertices).distance.min() > 1.0
        assert not arm.label(hand.vertices).any()


def test_views_tell_a_hand_from_one_turned_by_half(states: list[State]) -> None:
    scene, rng = load_scene("robot"), np.random.default_rng(3)
    camera = Camera.from_fov(96, 96, scene.workspace.fov_rad)
    half_turn = robot.Rigid(np.array([np.pi, 0.0, 0.0]), np.zeros(3), np.array(parts.WRIST))
    telling = []
    for state in states:
        hand, left, right = state.deformations[6:]
        # the left finger at rest, turned by half, lies where the right one is, and then moves as that does
        turned = [robot.Compose((half_turn, after)) for after in (hand, right, left)]
        other = scene.deform((*state.deformations[:6], *turned))
        T_camera_world = inverse_rigid(scene.workspace.sample(rng, state.mesh.bounds.mean(axis=0)))
        seen, confused = (render_depth(each.mesh.transformed(T_camera_world), camera).depth for each in (state, other))
        telling.append(int((np.abs(seen - confused) > 0.5).sum()))  # five times the noise
    assert np.quantile(telling, 0.1) > 15 and np.median(telling) > 30


def test_few_free_poses_are_refused() -> None:
    rng = np.random.default_rng(2)
    draws = [robot.sample_angles(rng) for _ in range(200)]
    assert 0.65 < np.mean([robot.is_clear(robot.chain(angles)) for angles in draws]) < 0.9
    assert robot.is_clear(robot.chain(np.zeros(6)))
