"""Every built-in scene in many random states: closed, positive, apart, in view, and invertible."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mereo.camera import Camera
from mereo.config import GenerateConfig
from mereo.deformation import invert
from mereo.frame import inverse_rigid, transform_points
from mereo.rendering import render_depth
from mereo.scene import SCENES, Scene, Workspace, load_scene, look_at
from mereo.solid import Solids, check_overlap, label_grid

STATES = 12
APART = ("robot", "engine", "lizard", "shapes")
"""Scenes of separate parts, with air between what slides, hinges or moves by itself: no vertex is shared."""

_LIVER = ("liver/lapgym_liver_visual.stl", "liver/lapgym_gallbladder_visual.stl")
NEEDED_ASSETS = {
    "bunny": ("bunny/bunny.off",),
    "skull": ("skull/sofa_skull_and_teeth_coarse.obj",),
    "liver": _LIVER,
    "tumor": _LIVER,
    "liver-simulated": _LIVER,
    "human": (
        "human/makehuman_base.obj",
        "human/makehuman_default.mhskel",
        "human/makehuman_default_weights.mhw",
    ),
}


@pytest.fixture(scope="module", params=SCENES)
def scene(request: pytest.FixtureRequest, require_asset: Callable[[str], Path]) -> Scene:
    for name in NEEDED_ASSETS.get(request.param, ()):
        require_asset(name)
    return load_scene(request.param)


def test_rest_pose_is_sound(scene: Scene) -> None:
    scene.rest.check()
    check_overlap(scene.rest)
    extent = scene.rest.bounds[1] - scene.rest.bounds[0]
    assert len(scene.rest.segments) >= 2
    # a sheet is flat at rest: its thickness, the shortest side, says nothing about its size
    shortest = extent[:2].min() / 2 if scene.name == "sheet" else extent.min()
    assert 5.0 < shortest < 30.0


def test_random_states_stay_closed_positive_and_apart(scene: Scene) -> None:
    rng = np.random.default_rng(1)
    for _ in range(STATES):
        mesh = scene.sample_state(rng).mesh
        mesh.check()
        for segment, rest in zip(mesh.segments, scene.rest.segments, strict=True):
            # soft matter keeps its volume roughly; a strongly bent ear gains on its outer side; a tumour's size varies
            least, most = (0.4, 2.2) if segment.name == "tumor" else (0.7, 1.6)
            assert least < segment.volume / rest.volume < most, segment.name
    check_overlap(mesh, tolerance=0.02)


def test_jacobian_is_positive_throughout_each_segment(scene: Scene) -> None:
    rng = np.random.default_rng(2)
    inner = [interior_points(scene, index, rng) for index in range(len(scene.rest.segments))]
    step = 1e-4
    for _ in range(STATES):
        for deformation, points in zip(scene.sample_deformations(rng), inner, strict=True):
            columns = [deformation(points + step * e) - deformation(points - step * e) for e in np.eye(3)]
            determinant = np.linalg.det(np.stack(columns, axis=-1) / (2 * step))
            assert determinant.min() > 0.05


def interior_points(scene: Scene, index: int, rng: np.random.Generator) -> np.ndarray:
    segment = scene.rest.segments[index]
    draws = rng.uniform(*segment.bounds, size=(4000, 3))
    inside = draws[Solids(scene.rest).inside(index, draws)][:300]
    return np.concatenate([inside, segment.vertices])


def test_deformations_can_be_undone(scene: Scene) -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        for index, deformation in enumerate(scene.sample_deformations(rng)):
            rest = interior_points(scene, index, rng)[:200]
            guess = rest + rng.normal(scale=0.3, size=rest.shape)
            found, converged = invert(deformation, deformation(rest), guess)
            assert converged.mean() > 0.99
            assert np.abs(found - rest)[converged].max() < 1e-2


def test_touching_segments_keep_touching(scene: Scene) -> None:
    """Vertices that two segments share at rest stay together: to half of the camera's noise, 0.1 units."""
    segments = scene.rest.segments
    state = scene.sample_state(np.random.default_rng(4))
    shared = 0
    for a in range(len(segments)):
        for b in range(a + 1, len(segments)):
            gap = np.linalg.norm(segments[a].vertices[:, None] - segments[b].vertices[None], axis=-1)
            i, j = np.nonzero(gap < 1e-5)
            shared += len(i)
            moved = state.mesh.segments[a].vertices[i] - state.mesh.segments[b].vertices[j]
            assert np.abs(moved).max(initial=0.0) < 0.05
    assert (shared == 0) if scene.name in APART else (shared > 50)


def test_the_whole_object_is_in_view_of_every_camera(scene: Scene) -> None:
    rng = np.random.default_rng(5)
    size = GenerateConfig().image_size
    camera = Camera.from_fov(size, size, scene.workspace.fov_rad)
    for _ in range(50):
        state = scene.sample_state(rng)
        T_world_camera = scene.workspace.sample(rng, state.mesh.bounds.mean(axis=0))
        mesh = state.mesh.transformed(inverse_rigid(T_world_camera))
        pixels = camera.project(np.concatenate([segment.vertices for segment in mesh.segments]))
        assert pixels.min() > 0 and pixels.max() < size
        assert render_depth(mesh, camera).valid.sum() >= 32


def test_label_grid_adds_up_to_the_volumes(scene: Scene) -> None:
    low, high = scene.rest.bounds
    axes = [np.linspace(low[k] - 1, high[k] + 1, 120) for k in range(3)]
    grid = label_grid(scene.rest, *axes)
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    for index, volume in enumerate(scene.rest.owned_volumes):
        assert abs((grid == index + 1).sum() * cell / volume - 1) < 0.06


def test_workspace_is_a_cone_of_the_stated_aperture_and_distance() -> None:
    rng = np.random.default_rng(6)
    workspace, target = Workspace(axis=(0.0, 1.0, 0.0)), np.array([3.0, -2.0, 1.0])
    poses = [workspace.sample(rng, target) for _ in range(2000)]
    offset = np.stack([pose[:3, 3] - target for pose in poses])
    distance = np.linalg.norm(offset, axis=1)
    cosine = offset[:, 1] / distance
    assert distance.min() >= 100 and distance.max() <= 200 and abs(distance.mean() - 150) < 3
    # uniform over the cap: the cosine is uniform between that of 70 degrees and 1
    assert cosine.min() >= np.cos(np.deg2rad(70)) - 1e-9
    assert abs(cosine.mean() - (1 + np.cos(np.deg2rad(70))) / 2) < 0.02
    for pose in poses[:50]:
        in_camera = transform_points(inverse_rigid(pose), target[None])[0]
        assert np.allclose(in_camera[:2], 0, atol=1e-9) and in_camera[2] > 0  # aimed at the target
        assert abs(pose[1, 0]) < 1e-9  # level horizon: the image's x axis is perpendicular to `axis`


def test_whole_sphere_with_any_roll_prefers_no_direction() -> None:
    rng = np.random.default_rng(7)
    workspace = Workspace(aperture_rad=2 * np.pi, any_roll=True)
    poses = np.stack([workspace.sample(rng, np.zeros(3)) for _ in range(3000)])
    for column in range(3):  # x, y and z axes of the camera are each uniform on the sphere
        assert np.abs(poses[:, :3, column].mean(axis=0)).max() < 0.06
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1.0)


def test_look_at_straight_along_up_is_still_a_rotation() -> None:
    pose = look_at(np.array([0.0, 0.0, 10.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.isclose(np.linalg.det(pose[:3, :3]), 1.0)
    assert np.allclose(pose[:3, 2], [0, 0, -1])


def test_unknown_scene_is_named() -> None:
    with pytest.raises(ValueError, match=f"scene 'hare' is unknown; it must be one of {', '.join(SCENES)}"):
        load_scene("hare")
