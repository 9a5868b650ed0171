"""States beside one: their directions, played without the scene's own test, and with one joint moved."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from shapes import box
from toy_scene import rest_mesh

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Deformation
from mereo.fitting.draws.playback import Drawn, DrawnStates
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.segments import Joints
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import unit_rows
from mereo.scenes.random_states import build_model, scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene, Workspace
from mereo.scenes.statistical_model import StatisticalModel


@dataclass(frozen=True, eq=False)
class Moved:
    by: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return points + self.by


def sample_moves(rng: Generator) -> tuple[Deformation, ...]:
    """Moves by a direction, by rows and a rest that are directions, and by normal numbers that are none."""
    toward, wave = named(rng, "toward").normal(size=(1, 3)), named(rng, "waves").normal(size=(4, 3))
    sides, shares = unit_rows(wave[:2]), wave[2:] / norm(wave[2:])
    amounts = named(rng, "amounts").normal(size=3)
    return tuple(Moved(2 * unit_rows(toward)[0] + sides[i % 2] + 3 * shares[i % 2] + amounts) for i in range(4))


def test_what_is_a_direction_is_seen_by_what_its_length_moves() -> None:
    scene = Scene("moves", rest_mesh(), sample_moves, Workspace())
    states = DrawnStates.of(scene, scene_model(scene, 30, 1000), 4, 1000)
    rows = {place[1].name: [row.tolist() for row in rows] for place, rows in states.directions.items()}
    assert rows == {"toward": [[0, 1, 2]], "waves": [[0, 1, 2], [3, 4, 5], [6, 7, 8, 9, 10, 11]], "amounts": []}
    drawn, plain = states.drawn(1001), Drawn.of(scene, 1001)
    assert_allclose([norm(drawn.z[row]) ** 2 for row in drawn.directions], [1, 1, 1, 2.5])
    assert_allclose(drawn.z[-3:], plain.z[-3:])
    before, after = (states.played.moved(plain.deformations(scene, z) or ()) for z in (plain.z, drawn.z))
    assert_allclose(after, before, atol=1e-6)


REFUSES = {"human": 7, "robot": 3, "rope": 1, "sheet": 5}
"""A seed of each scene beside whose state are some that it refuses."""


@pytest.mark.parametrize("name", [*REFUSES, "lizard"])
def test_a_scene_that_tests_its_states_plays_their_neighbours_without(name: str) -> None:
    scene = load_scene(name)
    drawn, rng, refused = Drawn.of(scene, REFUSES.get(name, 7)), default_rng(0), 0
    points = [segment.vertices[::50] for segment in scene.rest.segments]
    for _ in range(15):
        z = np.where(drawn.smooth, drawn.z + 3.0 * rng.normal(size=len(drawn.z)), drawn.z)
        tested, untested = drawn.deformations(scene, z), drawn.deformations(scene, z, checked=False)
        if tested is None:
            refused += untested is not None
            continue
        assert untested is not None
        for one, other, places in zip(tested, untested, points, strict=True):
            assert np.array_equal(one(places), other(places))
    assert (refused > 0) == (name in REFUSES)


@pytest.mark.parametrize(("name", "calls"), [("robot", {(1,) * 7}), ("rope", {(1, 8, 8, 1), (1,) * 6})])
def test_draws_of_refused_attempts_are_not_part_of_a_state(name: str, calls: set[tuple[int, ...]]) -> None:
    scene = load_scene(name)
    assert {Drawn.of(scene, seed).sizes for seed in range(10)} <= calls


# --- joints -----------------------------------------------------------------------------------------------------------


NONE = np.empty((0, 3)), np.empty(0, dtype=np.uint8)


@pytest.fixture(scope="module")
def arm() -> StatisticalModel:
    """Three boxes in a row; the second turns about z at x = 6, the third about x at x = 18."""
    rest = SegmentedMesh(tuple(box((12 * i - 6, -2, -3), (12 * i + 6, 2, 3), f"box_{i}", i) for i in range(3)))
    base, middle, hand = (segment.vertices.copy() for segment in rest.segments)
    states, rng = [], default_rng(0)
    for bend, turn in rng.uniform([-0.6, -np.pi], [0.6, np.pi], size=(300, 2)):
        about_z = Rotation.from_euler("z", bend)
        elbow = np.array([6.0, 0, 0])
        turned = Rotation.from_euler("x", turn).apply(hand)
        states.append(np.concatenate([base, *(about_z.apply(part - elbow) + elbow for part in (middle, turned))]))
    return build_model(rest, *NONE, np.stack(states).astype(np.float32))


def test_one_joint_of_segments_that_touch_moves_and_the_rest_stays(arm: StatisticalModel) -> None:
    joined = {frozenset((fixed, hanging)) for fixed, hanging, _ in Joints.of(arm).branches}
    assert joined == {frozenset((0, 1)), frozenset((1, 2))}
    posed = Posed(Rotation.from_euler("y", 0.5).as_matrix(), np.array([0.0, 1.0, 90.0]), arm.library[0].astype(float))
    here = np.split(posed.place(arm.material(posed.z)), 3)
    moved = [np.split(other.place(arm.material(other.z)), 3) for other in Joints.of(arm).others(posed, 4)]
    assert len(moved) == 8
    axis = here[2].mean(axis=0) - here[1].mean(axis=0)
    half = Rotation.from_rotvec(np.pi * axis / norm(axis))
    opposite = half.apply(here[2] - here[2].mean(axis=0)) + here[2].mean(axis=0)
    best = min(moved, key=lambda parts: float(norm(parts[2] - opposite, axis=1).max()))
    assert norm(best[2] - opposite, axis=1).max() < 1.5
    assert_allclose(best[0], here[0], atol=0.3)
    assert_allclose(best[1], here[1], atol=0.3)


def test_an_object_of_one_segment_has_no_joints() -> None:
    rest = SegmentedMesh((box((-6, -2, -3), (6, 2, 3), "box", 0),))
    states = rest.segments[0].vertices * default_rng(0).uniform(0.8, 1.2, size=(50, 1, 3))
    model = build_model(rest, *NONE, states.astype(np.float32))
    assert Joints.of(model).others(Posed(np.eye(3), np.zeros(3), np.zeros(model.count)), 4) == []
