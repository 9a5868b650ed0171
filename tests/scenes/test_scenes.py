"""Every built-in scene in many random states: closed, positive, apart, in view, and invertible."""

import re
from itertools import combinations

import numpy as np
import pytest
from numpy import ndarray
from numpy.linalg import det, norm
from numpy.random import Generator, default_rng
from overlapping import check_overlap
from scipy.spatial import ConvexHull, cKDTree
from solid_pairs import crowded

from mereo.deformation.maps import invert, jacobian_determinant
from mereo.geometry.camera import Camera
from mereo.geometry.conventions import MIN_POINTS, Range
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid, is_rigid, look_at, transform_points
from mereo.scenes.parameters import parameters, random_state, set_value
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import SCENES, AssetUnavailable, Scene, State, Workspace
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.depth_sensor import render_depth

STATES, MANY_STATES, CAMERAS = 12, 200, 50

APART = ("robot", "engine", "lizard", "shapes")
"""Scenes of separate parts, with air between what slides, hinges or moves by itself: no vertex is shared."""

NOISE = 0.1
"""Of the camera's depth, standard deviation in units."""

PRESSED = {
    "bunny": {"ear_left", "ear_right", "head"},
    "human": {"torso", "thigh_left", "thigh_right", "shin_left", "shin_right"},
}
"""Segments that may press into each other a little: the ears' roots are side by side and bend alone; at groin and knee
flat triangles cut across the crease between neighbours."""

REAL_M = {"bunny": 0.156, "liver": 0.202, "tumor": 0.202, "liver-simulated": 0.202, "skull": 0.236, "human": 1.68}
LENGTHS_M = REAL_M | {"rope": 0.74, "robot": 0.482, "engine": 0.519, "lizard": 0.716, "shapes": 0.256, "sheet": 0.59}
"""Longest side of the rest pose's box."""


@pytest.fixture(scope="module", params=SCENES)
def scene(request: pytest.FixtureRequest) -> Scene:
    try:
        return load_scene(request.param)
    except AssetUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def states(scene: Scene) -> list[State]:
    rng = default_rng(1)
    return [scene.sample_state(rng) for _ in range(STATES)]


def interior_points(scene: Scene, rng: Generator, count: int = 300) -> list[ndarray]:
    solids = Solids(scene.rest)
    points = []
    for index, segment in enumerate(scene.rest.segments):
        draws = rng.uniform(*segment.bounds, size=(4000, 3))
        points.append(draws[solids.inside(index, draws)][:count])
    return points


def smallest_determinant(state: State, points: list[ndarray]) -> float:
    """Over points of all segments, the segments that one map moves together."""
    groups = {}
    for deformation, part in zip(state.deformations, points, strict=True):
        groups.setdefault(id(deformation), []).append(part)
    maps = {id(deformation): deformation for deformation in state.deformations}
    return min(jacobian_determinant(maps[key], np.concatenate(parts)).min() for key, parts in groups.items())


def assert_in_view(scene: Scene, mesh: SegmentedMesh, rng: Generator) -> None:
    """Whole, from random cameras; the corners of the convex hull decide, as all of it is in front of them."""
    vertices = np.concatenate([segment.vertices for segment in mesh.segments])
    size = GenerateConfig().image_size
    hull = vertices[ConvexHull(vertices).vertices]
    camera = Camera.from_fov(size, size, scene.workspace.fov_rad)
    poses = np.stack([scene.workspace.sample(rng, mesh.bounds.mean(axis=0)) for _ in range(CAMERAS)])
    seen = np.einsum("cji,cnj->cni", poses[:, :3, :3], hull - poses[:, None, :3, 3]).reshape(-1, 3)
    pixels = camera.project(seen)
    assert seen[:, 2].min() > 0 and pixels.min() > 0 and pixels.max() < size


def test_rest_pose_is_sound_and_of_its_stated_size(scene: Scene) -> None:
    scene.rest.check()
    check_overlap(scene.rest)
    assert not crowded(scene.rest, NOISE / 2)
    extent = scene.rest.bounds[1] - scene.rest.bounds[0]
    assert len(scene.rest.segments) >= 2
    # a sheet is flat at rest: its thickness, the shortest side, says nothing about its size
    shortest = extent[:2].min() / 2 if scene.name == "sheet" else extent.min()
    assert 5.0 < shortest < 30.0
    assert scene.unit_m is not None and LENGTHS_M[scene.name] == pytest.approx(extent.max() * scene.unit_m, rel=0.02)


def test_deformations_can_be_undone(scene: Scene, states: list[State]) -> None:
    rng = default_rng(3)
    inner = interior_points(scene, rng, 150)
    for state in states[:4]:
        for rest, deformation in zip(inner, state.deformations, strict=True):
            guess = rest + rng.normal(scale=0.3, size=rest.shape)
            found, converged = invert(deformation, deformation(rest), guess)
            assert converged.mean() > 0.99
            assert np.abs(found - rest)[converged].max() < 1e-2


def test_touching_segments_keep_touching(scene: Scene, states: list[State]) -> None:
    """Vertices that two segments share at rest stay together: to half of the camera's noise."""
    trees = [cKDTree(segment.vertices) for segment in scene.rest.segments]
    shared = 0
    for a, b in combinations(range(len(trees)), 2):
        if {scene.rest.names[a], scene.rest.names[b]} == {"ear_left", "ear_right"}:
            continue  # they touch by chance, and each bends alone
        pairs = [(i, j) for i, near in enumerate(trees[a].query_ball_tree(trees[b], 1e-5)) for j in near]
        shared += len(pairs)
        i, j = np.array(pairs, np.int64).reshape(-1, 2).T
        for state in states:
            moved = state.mesh.segments[a].vertices[i] - state.mesh.segments[b].vertices[j]
            assert np.abs(moved).max(initial=0.0) < NOISE / 2
    assert (shared == 0) if scene.name in APART else (shared > 50)


@pytest.mark.parametrize(
    ("count", "volumes"), [(STATES, (0.65, 1.6)), pytest.param(MANY_STATES, (0.4, 2.0), marks=pytest.mark.slow)]
)
def test_random_states_are_sound_apart_smooth_and_in_view(scene: Scene, count: int, volumes: Range) -> None:
    rng = default_rng(8)
    size = GenerateConfig().image_size
    inner = interior_points(scene, rng, 100)
    vertices = [rng.permutation(segment.vertices)[:300] for segment in scene.rest.segments]
    points = [np.concatenate(pair) for pair in zip(inner, vertices, strict=True)]
    for index in range(count):
        state = scene.sample_state(rng)
        mesh = state.mesh
        mesh.check()
        for segment, rest in zip(mesh.segments, scene.rest.segments, strict=True):
            # soft matter keeps its volume roughly; a strongly bent ear gains on its outer side; a tumour's size varies
            least, most = (0.4, 2.2) if segment.name == "tumor" else volumes
            assert least < segment.volume / rest.volume < most, segment.name
        # nothing is inside anything unless declared nested, nor passes through itself, by more than twice the noise
        assert crowded(mesh, 2 * NOISE, slice(index % 4, None, 4)) <= PRESSED.get(scene.name, set())
        assert smallest_determinant(state, points) > 0.05
        assert_in_view(scene, mesh, rng)
        if index % 4 == 0:
            check_overlap(mesh, tolerance=0.02)
            T_camera_world = inverse_rigid(scene.workspace.sample(rng, mesh.bounds.mean(axis=0)))
            camera = Camera.from_fov(size, size, scene.workspace.fov_rad)
            assert render_depth(mesh.transformed(T_camera_world), camera).valid.sum() >= MIN_POINTS


def test_workspace_is_a_cone_of_the_stated_aperture_and_distance() -> None:
    rng = default_rng(6)
    workspace = Workspace(axis=(0.0, 1.0, 0.0))
    target = np.array([3.0, -2.0, 1.0])
    poses = [workspace.sample(rng, target) for _ in range(1500)]
    offset = np.stack([pose[:3, 3] - target for pose in poses])
    distance = norm(offset, axis=1)
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
    rng = default_rng(7)
    workspace = Workspace(aperture_rad=2 * np.pi, any_roll=True)
    poses = np.stack([workspace.sample(rng, np.zeros(3)) for _ in range(3000)])
    for column in range(3):  # x, y and z axes of the camera are each uniform on the sphere
        assert np.abs(poses[:, :3, column].mean(axis=0)).max() < 0.06
    assert np.allclose(det(poses[:, :3, :3]), 1.0)
    pose = look_at(np.array([0.0, 0.0, 10.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert is_rigid(pose) and np.allclose(pose[:3, 2], [0, 0, -1]), "straight along up"


@pytest.mark.parametrize("seed", [0, 3])
def test_every_number_that_a_scene_draws_has_a_name_of_its_own(scene: Scene, seed: int) -> None:
    played = random_state(scene, seed)
    assert [call.key for call in played.calls if not call.name.name] == [], "the scene does not say what it draws"
    found = parameters(played)
    names = [(f.group, f.name) for f in found]
    assert found and len(set(names)) == len(names)
    assert all(re.fullmatch(r"[a-z0-9][\w ,/.]*[\w]", name) and "_" not in name for _, name in names), names
    # the same sliders keep their names when one of them moves
    moved = {f.key: f.name for f in parameters(set_value(scene, played, found[0], found[0].value))}
    assert moved == {f.key: f.name for f in found}


def test_nobody_changes_the_rest_pose_or_a_state_in_place(scene: Scene) -> None:
    for segment in (*scene.rest.segments, *scene.sample_state(default_rng(0)).mesh.segments):
        with pytest.raises(ValueError, match="read-only"):
            segment.vertices += 1.0
        with pytest.raises(ValueError, match="read-only"):
            segment.faces[:] = 0
