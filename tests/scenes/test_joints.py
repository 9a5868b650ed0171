"""Joints that a library of states shows, and states that differ in one of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapes import box

from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.problem.segments import Joints
from mereo.geometry.mesh import SegmentedMesh
from mereo.scenes.random_states import build_model
from mereo.scenes.statistical_model import StatisticalModel

NONE = np.empty((0, 3)), np.empty(0, dtype=np.uint8)


@pytest.fixture(scope="module")
def arm() -> StatisticalModel:
    """Three boxes in a row; the second turns about z at x = 6, the third about x at x = 18."""
    rest = SegmentedMesh(tuple(box((12 * i - 6, -2, -3), (12 * i + 6, 2, 3), f"box_{i}", i) for i in range(3)))
    base, middle, hand = (segment.vertices.copy() for segment in rest.segments)
    states, rng = [], np.random.default_rng(0)
    for bend, turn in rng.uniform([-0.6, -np.pi], [0.6, np.pi], size=(300, 2)):
        about_z = Rotation.from_euler("z", bend)
        elbow = np.array([6.0, 0, 0])
        turned = Rotation.from_euler("x", turn).apply(hand)
        states.append(np.concatenate([base, *(about_z.apply(part - elbow) + elbow for part in (middle, turned))]))
    return build_model(rest, *NONE, np.stack(states).astype(np.float32))


def test_segments_that_touch_are_joined(arm: StatisticalModel) -> None:
    joined = {frozenset((fixed, hanging)) for fixed, hanging, _ in Joints.of(arm).branches}
    assert joined == {frozenset((0, 1)), frozenset((1, 2))}


def test_one_joint_moves_and_the_rest_stays(arm: StatisticalModel) -> None:
    """Among the states that are tried is a hand half a turn round on the arm as it is."""
    posed = Posed(Rotation.from_euler("y", 0.5).as_matrix(), np.array([0.0, 1.0, 90.0]), arm.library[0].astype(float))
    here = np.split(posed.place(arm.material(posed.z)), 3)
    moved = [np.split(other.place(arm.material(other.z)), 3) for other in Joints.of(arm).others(posed, 4)]
    assert len(moved) == 8
    axis = here[2].mean(axis=0) - here[1].mean(axis=0)
    half = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis))
    opposite = half.apply(here[2] - here[2].mean(axis=0)) + here[2].mean(axis=0)
    best = min(moved, key=lambda parts: float(np.linalg.norm(parts[2] - opposite, axis=1).max()))
    assert np.linalg.norm(best[2] - opposite, axis=1).max() < 1.5
    np.testing.assert_allclose(best[0], here[0], atol=0.3)
    np.testing.assert_allclose(best[1], here[1], atol=0.3)


def test_an_object_of_one_segment_has_no_joints() -> None:
    rest = SegmentedMesh((box((-6, -2, -3), (6, 2, 3), "box", 0),))
    states = rest.segments[0].vertices * np.random.default_rng(0).uniform(0.8, 1.2, size=(50, 1, 3))
    model = build_model(rest, *NONE, states.astype(np.float32))
    assert Joints.of(model).others(Posed(np.eye(3), np.zeros(3), np.zeros(model.count)), 4) == []
