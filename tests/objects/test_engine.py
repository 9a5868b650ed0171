"""The engine at many crank angles: the linkage closes, valves follow their cams, nothing meets anything."""

import numpy as np
import pytest
from solid_pairs import overlapping_pairs

from mereo.deformation.maps import Deformation, jacobian_determinant
from mereo_objects import _engine_parts as parts
from mereo_objects import engine

ANGLES_RAD = np.linspace(0.0, engine.CYCLE_RAD, 19)[:-1] + 0.11
NAMES = engine.rest_mesh().names


def motions(crank_rad: float) -> dict[str, Deformation]:
    return dict(zip(NAMES, engine.deformations_at(crank_rad), strict=True))


def moved(deformation: Deformation, *point: float) -> np.ndarray:
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
    order = np.argsort(engine.FIRING_RAD) + 1
    assert order.tolist() == [1, 3, 4, 2]
    for number, firing in enumerate(engine.FIRING_RAD, start=1):
        index = NAMES.index(f"piston_{number}")
        top = [engine.rest_mesh().segments[index].vertices]
        heights = [
            engine.deformations_at(firing + offset)[index](top[0])[:, 2].max() for offset in (-0.3, 0.0, 0.3, np.pi)
        ]
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
        anywhere = np.random.default_rng(1).uniform([-25, -5, 15], [25, 5, 35], size=(500, 3))
        assert np.allclose(jacobian_determinant(motion, anywhere), 1.0, atol=1e-4)
