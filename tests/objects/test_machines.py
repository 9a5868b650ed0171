"""Engine, robot and lizard: linkages close, links stay joined, nothing meets anything, and what would is refused."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from manifold3d import Manifold
from numpy import ndarray
from numpy.random import Generator, default_rng
from solid_pairs import gap, overlapping_pairs

from mereo.deformation.maps import Deformation, jacobian_determinant
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import State
from mereo_objects import _engine_parts as parts
from mereo_objects import _robot_parts, engine, lizard, robot
from mereo_objects._hinges import Hinged, follow
from mereo_objects._lizard_parts import SPINE, leg, spine_links

ANGLES_RAD = np.linspace(0.0, engine.CYCLE_RAD, 19)[:-1] + 0.11
NAMES = engine.rest_mesh().names


def motions(crank_rad: float) -> dict[str, Deformation]:
    return dict(zip(NAMES, engine.deformations_at(crank_rad), strict=True))


def moved(deformation: Deformation, *point: float) -> ndarray:
    return deformation(np.array([point]))[0]


@pytest.mark.parametrize("crank_rad", ANGLES_RAD)
def test_no_two_parts_overlap_at_any_angle(crank_rad: float) -> None:
    assert overlapping_pairs(engine.scene().deform(engine.deformations_at(crank_rad)).mesh) == []


def test_rods_join_crank_pins_and_piston_pins() -> None:
    for crank_rad in ANGLES_RAD:
        motion = motions(crank_rad)
        for number, (x, throw) in enumerate(zip(parts.CYLINDERS, parts.THROWS, strict=True), start=1):
            crank_pin = (x, 0.0, throw * parts.CRANK_RADIUS)
            piston_pin = (x, 0.0, throw * parts.CRANK_RADIUS + parts.ROD_LENGTH)
            rod, piston = motion[f"rod_{number}"], motion[f"piston_{number}"]
            assert np.allclose(moved(rod, *crank_pin), moved(motion["crankshaft"], *crank_pin))
            assert np.allclose(moved(rod, *piston_pin), moved(piston, *piston_pin))
            assert np.allclose(moved(piston, *piston_pin)[:2], [x, 0.0])  # in its cylinder


def test_pistons_are_on_top_when_their_cylinder_fires_in_the_order_1_3_4_2() -> None:
    assert np.argsort(engine.FIRING_RAD).tolist() == [0, 2, 3, 1]
    for number, firing in enumerate(engine.FIRING_RAD, start=1):
        piston = engine.rest_mesh().segments[NAMES.index(f"piston_{number}")]
        moves = (motions(firing + offset)[piston.name] for offset in (-0.3, 0.0, 0.3, np.pi))
        heights = [move(piston.vertices)[:, 2].max() for move in moves]
        assert np.argmax(heights) == 1 and np.isclose(heights[1] - heights[3], 2 * parts.CRANK_RADIUS)
        valves = slice(2 * number - 2, 2 * number)
        assert (engine.valve_lifts(firing)[valves] == 0).all()  # closed while it burns
        assert (engine.valve_lifts(firing + 2 * np.pi)[valves] > 0).all()  # both ajar half a cycle later


def test_exhaust_opens_before_intake_and_each_once_a_cycle() -> None:
    crank = np.linspace(0.0, engine.CYCLE_RAD, 720, endpoint=False)
    intake, exhaust = np.array([engine.valve_lifts(angle)[:2] for angle in crank]).T
    assert np.isclose(np.rad2deg(crank[intake.argmax()]), 470, atol=1.1)
    assert np.isclose(np.rad2deg(crank[exhaust.argmax()]), 250, atol=1.1)
    for lift in (intake, exhaust):
        assert np.isclose(lift.max(), parts.LIFT, rtol=1e-3) and lift.min() == 0
        assert np.isclose((lift > 0).mean(), 300 / 720, atol=0.01)


def test_valves_move_only_along_their_stems_and_each_by_its_own_lift() -> None:
    x, radius, _ = engine.valve_places()
    widest = np.maximum(radius, parts.TAPPET_RADIUS)
    for crank_rad in ANGLES_RAD:
        motion = motions(crank_rad)["valves"]
        drop = engine.valve_lifts(0.0) - engine.valve_lifts(crank_rad)
        for at, reach, expected in zip(x, widest, drop, strict=True):
            points = np.array([[at - reach, 0.0, 22.0], [at, 0.5, 25.0], [at + reach, 0.0, 28.0]])
            assert np.allclose(motion(points) - points, [0.0, 0.0, expected])
        anywhere = default_rng(1).uniform([-25, -5, 15], [25, 5, 35], size=(500, 3))
        assert np.allclose(jacobian_determinant(motion, anywhere), 1.0, atol=1e-4)


# --- robot ------------------------------------------------------------------------------------------------------------


LINKS = ("base", "column", "upper_arm", "elbow", "forearm", "wrist", "hand")


@pytest.fixture(scope="module")
def states() -> list[State]:
    scene = load_scene("robot")
    rng = default_rng(1)
    return [scene.sample_state(rng) for _ in range(40)]


def pose(*angles_deg: float) -> SegmentedMesh:
    shares = {joint.name: joint.share(angle) for joint, angle in zip(robot.JOINTS, np.deg2rad(angles_deg), strict=True)}
    motion = robot.motion()
    shares["fingers apart"] = motion.joints["fingers apart"][0].share(0.0)
    return robot.scene().deform(motion.at(shares)).mesh


def test_neighbours_have_a_clearance() -> None:
    for pair in (*pairwise(LINKS), ("hand", "finger_left"), ("hand", "finger_right")):
        assert 0.1 < gap(robot.rest_mesh(), *pair) < 0.3, pair


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_neighbours_pass_each_other_at_any_angle(index: int, share: float) -> None:
    joint = robot.JOINTS[index]
    angles = np.zeros(6)
    angles[index] = np.rad2deg(joint.limits[0] + share * (joint.limits[1] - joint.limits[0]))
    angles[5] = 45.0  # the hand's corners turned up
    mesh = pose(*angles)
    assert all(pair not in overlapping_pairs(mesh) for pair in pairwise(LINKS))


def test_neighbours_share_the_axis_of_their_joint_above_the_floor(states: list[State]) -> None:
    for state in states:
        assert state.mesh.bounds[0, 2] > -1e-9
        for joint, (before, after) in zip(robot.JOINTS, pairwise(state.deformations[:7]), strict=True):
            on_axis = joint.pivot + np.outer([0.0, 3.0], joint.axis)
            assert np.allclose(before(on_axis), after(on_axis), atol=1e-9)


def test_fingers_open_alike_and_stay_on_their_guides(states: list[State]) -> None:
    tips = np.array([[36.0, 0.0, _robot_parts.FOREARM_HEIGHT]])
    openings = []
    for state in states:
        hand, left, right = state.deformations[6:]
        y_axis = hand(tips + np.array([[0.0, 1.0, 0.0]])) - hand(tips)
        slide = left(tips) - hand(tips)
        assert np.allclose(slide, hand(tips) - right(tips), atol=1e-9)
        along = float(slide[0] @ y_axis[0])
        assert np.allclose(slide, along * y_axis, atol=1e-9)
        openings.append(_robot_parts.JAW_OPENING + along)
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
    turns = (joint.at(joint.share(angle)) for joint, angle in zip(robot.JOINTS, np.deg2rad(angles_deg), strict=True))
    assert not robot.is_clear(tuple(turns))


# --- lizard -----------------------------------------------------------------------------------------------------------


def extreme_pose(rng: Generator) -> tuple[ndarray, dict[str, ndarray]]:
    limits = np.column_stack([np.full((len(SPINE), 2), lizard.SPINE_PLAY_RAD), lizard.SPINE_LIMIT_RAD])
    swing = np.array([[lizard.LEG_PLAY_RAD] * 2 + [limit] for limit in (lizard.SWING_RAD, lizard.FOOT_RAD)])
    legs = {name: rng.choice([-1.0, 1.0], size=(2, 3)) * swing for name in lizard.LEGS}
    return rng.choice([-1.0, 1.0], size=limits.shape) * limits, legs


def neighbours(spine: ndarray, legs: dict[str, ndarray]) -> Iterator[tuple[Manifold, Manifold, ndarray, ndarray]]:
    """Every two links that share a knuckle, with their motions: the socket's first."""
    links = spine_links()
    motions = lizard.spine_motions(spine)
    yield from zip(links[:-1], links[1:], motions[:-1], motions[1:], strict=True)
    for name, (plan, side, carrier) in lizard.LEGS.items():
        upper, foot = lizard._leg_motions(name, motions, legs[name])
        parts = leg(plan, side)
        yield links[carrier], parts.upper, motions[carrier], upper
        yield parts.upper, parts.foot, upper, foot


def test_links_keep_clear_of_each_other_at_the_limits() -> None:
    rng = default_rng(1)
    for _ in range(3):
        for socket, knob, before, after in neighbours(*extreme_pose(rng)):
            common = socket.transform(before[:3]) ^ knob.transform(after[:3])
            assert common.volume() < 1e-4 * knob.volume()


def test_a_chain_of_knuckles_moves_every_link_rigidly() -> None:
    vectors, _ = extreme_pose(default_rng(2))
    chain = Hinged(SPINE, vectors)
    motion = np.eye(4)
    for number, link in enumerate(spine_links()):
        if number > 0:
            motion = follow(motion, SPINE[number - 1], vectors[number - 1])
        points = np.array(link.to_mesh().vert_properties[:, :3], float)
        assert np.allclose(chain(points), points @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)


def test_a_tail_curled_into_a_leg_is_refused() -> None:
    rest = np.stack([np.eye(4)] * (len(SPINE) + 1))
    legs = {name: np.stack([np.eye(4)] * 2) for name in lizard.LEGS}
    assert lizard.is_clear(rest, legs)
    tight = np.column_stack([np.zeros((len(SPINE), 2)), np.linspace(0.0, 0.8, len(SPINE))])  # beyond the limits
    motions = lizard.spine_motions(tight)
    carried = {name: np.stack([motions[carrier]] * 2) for name, (_, _, carrier) in lizard.LEGS.items()}
    assert not lizard.is_clear(motions, carried)
