"""An object that is followed: what is still stays, what jumps is found again, and slow ones are as if fitted alone."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mereo.fitting.config import FitConfig, TrackConfig
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking import Track, Tracker, between, motion_precision
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth
from mereo.synthesis.recording import walk

SEED, RATE_HZ = 740_000, 30.0


@pytest.fixture(scope="module")
def network() -> Model:
    return load_model("engine")


@pytest.fixture(scope="module")
def registrar(network: Model) -> Registrar:
    return Registrar.of(network, "modes")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("engine")


def seen(scene: Scene, mesh: SegmentedMesh, noise: float = 0.0, seed: int = 0) -> PointCloud:
    camera = Camera.from_fov(96, 96, scene.workspace.fov_rad)
    return add_depth_noise(render_depth(Solids(mesh), camera), noise, np.random.default_rng(seed)).to_points()


def states(scene: Scene, seed: int, count: int, change_s: float) -> list[SegmentedMesh]:
    meshes = [scene.deform(one.deformations).mesh for one in walk(scene, seed, np.arange(count) / RATE_HZ, change_s)]
    T = inverse_rigid(scene.workspace.sample(example_rng(seed, 0), meshes[0].bounds.mean(axis=0)))
    return [mesh.transformed(T) for mesh in meshes]


@pytest.fixture(scope="module")
def here(scene: Scene) -> SegmentedMesh:
    return states(scene, SEED, 1, 1.0)[0]


@pytest.fixture(scope="module")
def there(scene: Scene) -> SegmentedMesh:
    """Another state, seen from elsewhere."""
    return states(scene, SEED + 5, 1, 1.0)[0]


def vertices(mesh: SegmentedMesh) -> np.ndarray:
    return np.concatenate([segment.vertices for segment in mesh.segments])


def apart(found: Answer, mesh: SegmentedMesh) -> float:
    return float(np.linalg.norm(vertices(found.surfaces) - vertices(mesh), axis=1).mean())


def test_a_jump_is_found_again_in_its_own_frame(
    registrar: Registrar, scene: Scene, here: SegmentedMesh, there: SegmentedMesh
) -> None:
    tracker = Tracker(registrar)
    for number in range(2):
        tracker.follow(observe(seen(scene, here)), number / RATE_HZ, scene_unit=1.0)
    found = [tracker.follow(observe(seen(scene, there)), number / RATE_HZ, scene_unit=1.0) for number in (2, 3)]
    assert [one.tracked for one in found] == [False, True]
    assert found[0].registration is not None
    own = registrar.fit_modes(CloudToFit(seen(scene, there).points, scene_unit=1.0)).registration()
    np.testing.assert_allclose(found[0].registration.material, own.material, atol=1e-9)
    assert apart(found[1], there) < apart(found[0], there) + 0.05


@pytest.mark.parametrize("unit", [pytest.param(1.0, marks=pytest.mark.slow), None])
def test_a_slow_sequence_is_tracked_as_its_frames_are_fitted(
    registrar: Registrar, scene: Scene, unit: float | None
) -> None:
    meshes, size = states(scene, SEED + 1, 8, 0.5), 1.0 if unit else 2.5
    tracker, frames = Tracker(registrar), [observe(PointCloud(size * seen(scene, mesh).points)) for mesh in meshes]
    found = [tracker.follow(frame, i / RATE_HZ, scene_unit=unit) for i, frame in enumerate(frames)]
    assert all(one.tracked for one in found[1:])
    assert np.linalg.norm(vertices(meshes[-1]) - vertices(meshes[0]), axis=1).max() > 0.5
    alone = Tracker(registrar).follow(frames[-1], 0.0, scene_unit=unit)
    assert apart(found[-1], alone.surfaces) < 0.2 * size
    # the unit that was found is kept
    units = [one.registration.scene_unit for one in found if one.registration is not None]
    assert units == pytest.approx(8 * [size], rel=0.02) and np.ptp(units) < 0.01 * size


def test_an_object_that_goes_and_comes_again_is_found(
    registrar: Registrar, scene: Scene, here: SegmentedMesh, there: SegmentedMesh
) -> None:
    tracker = Tracker(registrar)
    tracker.follow(observe(seen(scene, here)), 0.0, scene_unit=1.0)
    with pytest.raises(ValueError, match="points"):
        tracker.follow(observe(PointCloud(seen(scene, here).points[:3])), 0.1, scene_unit=1.0)
    assert tracker.follow(observe(seen(scene, here)), 0.2, scene_unit=1.0).tracked
    # elsewhere, and after more time than any expectation lasts
    found = tracker.follow(observe(seen(scene, there)), 5.0, scene_unit=1.0)
    assert not found.tracked and apart(found, there) < 1.0
    assert tracker.follow(observe(seen(scene, there)), 5.1, scene_unit=1.0).tracked
    tracker.forget()
    assert not tracker.follow(observe(seen(scene, there)), 5.2, scene_unit=1.0).tracked


def test_points_away_from_the_expected_surface_are_strays(
    registrar: Registrar, scene: Scene, here: SegmentedMesh
) -> None:
    cloud, tracker = seen(scene, here), Tracker(registrar)
    tracker.follow(observe(cloud), 0.0, scene_unit=1.0)
    beside = observe(PointCloud(np.concatenate([cloud.points, 1.5 * cloud.points[:12]])))
    found = tracker.follow(beside, 0.03, scene_unit=1.0)
    assert found.tracked and found.hypothesis.dropped == 12 and not found.hypothesis.keep[-12:].any()
    np.testing.assert_array_equal(found.seen.cloud.points, cloud.points)
    assert apart(found, here) < 0.2
    assert tracker.follow(beside, 0.06, keep_all=True).hypothesis.dropped == 0


class Unbelieving(Registrar):
    """Registrar for which no registration explains its frame."""

    def takes(self, registration: Registration) -> bool:
        return False


class Waiting(Executor):
    """Executor that never comes to its work."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        return Future()


def test_a_lost_object_with_weights_is_searched_and_has_the_networks_surfaces(
    network: Model, registrar: Registrar, scene: Scene, here: SegmentedMesh
) -> None:
    tracker = Tracker(Unbelieving(network, registrar.model, "auto"), executor=Waiting())
    found = tracker.follow(observe(seen(scene, here)), 0.0, scene_unit=1.0)
    assert found.tracking == "lost" and found.registered is None and not found.is_missing
    assert found.recognition.known is False and str(found.recognition.reason).startswith("the object is lost: nothing")
    running = tracker._search._running
    assert running is not None and len(replace(found, resolution=24).surfaces.segments) == len(network.names)
    tracker.forget()
    assert running[1].cancelled()


def some_state(count: int, seed: int) -> Posed:
    rng = np.random.default_rng(seed)
    turn = Posed(np.eye(3), np.zeros(3), np.zeros(count)).moved(np.r_[rng.normal(size=3), np.zeros(4 + count)])
    return Posed(turn.rotation, 50 * rng.normal(size=3), rng.normal(size=count), 0.1)


def test_the_step_between_states_leads_from_one_to_the_other() -> None:
    first, second = some_state(5, 0), some_state(5, 1)
    led = first.moved(between(first, second))
    np.testing.assert_allclose(led.rotation, second.rotation, atol=1e-12)
    np.testing.assert_allclose(led.translation, second.translation)
    np.testing.assert_allclose(led.z, second.z)
    assert led.log_scale == pytest.approx(second.log_scale)


def test_without_evidence_the_expected_state_is_the_answer(
    registrar: Registrar, scene: Scene, here: SegmentedMesh
) -> None:
    config = TrackConfig()
    track = Track.of(
        registrar.fit_modes(CloudToFit(seen(scene, here).points, scene_unit=1.0)), 0.0, config, FitConfig()
    )
    count = POSE + track.problem.model.count
    velocity = 0.1 * np.random.default_rng(0).normal(size=count)
    moving = replace(track, velocity=velocity)
    state = moving.expected(0.5, config)
    # what noise alone may be does not count as motion
    np.testing.assert_allclose(
        between(track.posed, state), 0.5 * velocity * (1 - (config.dead / moving.speed) ** 2), atol=1e-9
    )
    shift = np.concatenate([np.zeros(3), [1.0, -2.0, 2.0], np.zeros(count - 6)])
    assert replace(track, velocity=shift).speed == pytest.approx(3.0, rel=1e-6) and track.speed == 0.0
    slow = replace(track, velocity=velocity * config.dead / moving.speed)
    np.testing.assert_allclose(between(track.posed, slow.expected(0.5, config)), 0.0, atol=1e-9)
    assert replace(track, velocity=velocity).expected(0.5, replace(config, motion="pose")) is track.posed
    precision = motion_precision(moving, 0.5, config)
    off = state.moved(0.01 * np.random.default_rng(1).normal(size=count))
    back = off.moved(NormalEquations(precision, precision @ between(state, off)).step(0.0))
    np.testing.assert_allclose(back.place(np.eye(3)), state.place(np.eye(3)), atol=1e-2)
    # what moves is less certain than what is still
    still = replace(moving, velocity=np.zeros(count), unsure=0.0)
    assert np.trace(motion_precision(still, 0.5, config)) > 10 * np.trace(precision)


@pytest.mark.slow
def test_frames_that_become_noisier_are_met_with_their_own_constants(
    registrar: Registrar, scene: Scene, here: SegmentedMesh
) -> None:
    tracker = Tracker(registrar)
    tracker.follow(observe(seen(scene, here, 0.02)), 0.0, scene_unit=1.0)
    assert tracker._track is not None
    quiet = tracker._track.problem.config
    for number in range(1, 11):
        found = tracker.follow(observe(seen(scene, here, 0.5, number)), number / RATE_HZ, scene_unit=1.0)
        assert found.tracked or number == 1
    loud = tracker._track
    assert 0.2 < loud.noise < 0.5 and loud.problem.config.cloud_sigma > 1.5 * quiet.cloud_sigma
    assert loud.problem.config.tolerance > quiet.tolerance and quiet == tracker.registrar.config
    for number in range(11, 21):
        tracker.follow(observe(seen(scene, here, 0.02, number)), number / RATE_HZ, scene_unit=1.0)
    assert tracker._track.problem.config == quiet


@pytest.mark.slow
def test_a_scanners_frames_are_answered_in_its_frame(registrar: Registrar, scene: Scene, here: SegmentedMesh) -> None:
    cloud, tracker = PointCloud(seen(scene, here).points @ SCANNER_TO_CAMERA.T), Tracker(registrar)
    for number in range(2):
        found = tracker.follow(observe(cloud, "scanner"), number / RATE_HZ, scene_unit=1.0)
    assert found.tracked
    assert np.median(Solids(found.surfaces).nearest(cloud.points).distance) < 0.2
