"""The laboratory shows what the scene and its camera say, and scores what the model makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from toy_scene import toy_scene

from mereo.evaluation.scoring import grid_scores
from mereo.geometry.transforms import transform_points
from mereo.models.weights import load_model
from mereo.scenes.parameters import parameters, random_state, set_value
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Workspace
from mereo.visualization.viewer.laboratory import CameraPlace, Laboratory


def test_the_camera_stands_where_its_place_says_and_sees_the_state() -> None:
    laboratory = Laboratory(toy_scene(axis=(0.0, 0.0, 1.0)), None)
    played = random_state(laboratory.scene, 2)
    place = CameraPlace(tilt_rad=0.5, azimuth_rad=1.2, distance=140.0)
    view = laboratory.look(played, place)
    world = view.mesh.transformed(view.T_world_camera)
    offset = view.T_world_camera[:3, 3] - world.bounds.mean(axis=0)
    assert np.linalg.norm(offset) == pytest.approx(140.0)
    assert np.arccos(offset[2] / 140.0) == pytest.approx(0.5)
    expected = laboratory.scene.deform(played.deformations).mesh
    for shown, wanted in zip(world.segments, expected.segments, strict=True):
        np.testing.assert_allclose(shown.vertices, wanted.vertices, atol=1e-9)
    # what was measured lies on the object, within the sensor's noise
    points = transform_points(view.T_world_camera, view.depth.to_points().points)
    low, high = expected.bounds
    assert ((points > low - 1.0) & (points < high + 1.0)).all()


def test_a_pose_is_what_the_workspace_draws() -> None:
    workspace, target = Workspace(any_roll=True, axis=(1.0, 2.0, 0.5)), np.array([1.0, 2.0, 3.0])
    drawn = workspace.sample(np.random.default_rng(3), target)
    rng = np.random.default_rng(3)
    cosine, azimuth = rng.uniform(np.cos(workspace.aperture_rad / 2), 1.0), rng.uniform(0.0, 2 * np.pi)
    distance, roll = rng.uniform(*workspace.distance), rng.uniform(0.0, 2 * np.pi)
    np.testing.assert_array_equal(workspace.pose(target, cosine, azimuth, distance, roll), drawn)


def test_pictures_do_not_flicker_and_follow_a_slider() -> None:
    laboratory = Laboratory(toy_scene(), None)
    played, place = random_state(laboratory.scene, 2), laboratory.first_place()
    first, again = (laboratory.look(played, place).depth.depth for _ in range(2))
    np.testing.assert_array_equal(first, again)
    moved = set_value(laboratory.scene, played, parameters(played)[-1], 0.5)
    assert (laboratory.look(moved, place).depth.depth != first).any()


def test_what_cannot_be_shown_is_said_in_one_sentence() -> None:
    laboratory = Laboratory(toy_scene(), None)
    played = random_state(laboratory.scene, 0)
    with pytest.raises(ValueError, match="the camera sees 0 points of the object; at least .* move the camera"):
        laboratory.look(played, CameraPlace(0.1, 0.0, 90_000.0))
    view = laboratory.look(played, laboratory.first_place())
    with pytest.raises(ValueError, match="there are no weights; .* name them with --weights"):
        laboratory.rebuild(view, 32, 20)
    with pytest.raises(ValueError, match="use the weights that belong to this object"):
        Laboratory(toy_scene(), load_model("rope"))


def test_a_trial_is_the_reconstruction_of_what_is_seen_and_its_score() -> None:
    model = replace(load_model("rope"), statistical_model=None)
    laboratory = Laboratory(load_scene("rope"), model)
    view = laboratory.look(random_state(laboratory.scene, 3), laboratory.first_place())
    trial = laboratory.rebuild(view, 24, 16)
    wanted = grid_scores(model, view.depth.to_points(), view.mesh, 16)
    assert (trial.scores.iou, trial.scores.miou) == (wanted.iou, wanted.miou)
    assert trial.scores.iou > 0.4
    assert trial.reconstruction.surfaces.names == laboratory.scene.rest.names
    low, high = view.mesh.bounds
    middle = trial.reconstruction.surfaces.segments[0].vertices.mean(axis=0)
    assert ((middle > low) & (middle < high)).all()  # in the camera frame, as the truth
