"""The statistical model of a scene's states, and the motion of any point with its material points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_scene import sample_deformations, toy_scene

from mereo.scenes.random_states import build_model, interior_nodes, sample_states, state_points
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel


def test_modes_reproduce_states_they_were_not_built_from(model: StatisticalModel) -> None:
    scene = toy_scene()
    for index in range(5):
        state = state_points(scene.sample_state(example_rng(7, index)), model.nodes, model.node_labels)
        T, z = model.project(state)
        found = model.material(z) @ T[:3, :3].T + T[:3, 3]
        assert np.linalg.norm(found - state, axis=1).max() < 0.15
        assert np.abs(z).max() < 5


def test_the_residue_is_that_of_held_out_states(model: StatisticalModel) -> None:
    assert 0 < model.residue < 0.01 * model.half


def test_the_pose_of_the_states_does_not_matter() -> None:
    scene, rng = toy_scene(), np.random.default_rng(0)
    nodes, labels = interior_nodes(scene.rest)
    states = sample_states(scene, nodes, labels, 60, 3)
    turned = np.stack([s @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3) * 50 for s in states])
    plain = build_model(scene.rest, nodes, labels, states)
    posed = build_model(scene.rest, nodes, labels, turned.astype(np.float32))
    assert plain.count == posed.count
    np.testing.assert_allclose(plain.mean, posed.mean, atol=0.02)
    np.testing.assert_allclose(plain.motion, posed.motion, rtol=0.02)


def test_one_state_is_no_model() -> None:
    scene = toy_scene()
    nodes, labels = interior_nodes(scene.rest)
    with pytest.raises(ValueError, match="asked of 1 states; it needs 2 or more: record more states"):
        build_model(scene.rest, nodes, labels, sample_states(scene, nodes, labels, 1, 3))


def test_inside_points_follow_the_scene(model: StatisticalModel) -> None:
    scene = toy_scene()
    deformations = sample_deformations(example_rng(7, 1))
    points = np.random.default_rng(1).uniform([-17, -5, -4], [-7, 5, 4], size=(300, 3))
    labels = np.ones(300, dtype=np.uint8)
    material = state_points(scene.deform(deformations), model.nodes, model.node_labels)
    error = np.linalg.norm(model.weights(points, labels)(material) - deformations[0](points), axis=1)
    assert error.max() < 0.1
