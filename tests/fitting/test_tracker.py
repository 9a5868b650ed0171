"""A tracked object without weights: its frames say that it is lost; what passes in front does not pull it."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.linalg import det, norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from mereo.api.result import Result
from mereo.cli.stream import Answering, Outcome, StreamFrame, SurfaceFolder, line
from mereo.fitting.config import FitConfig, TrackConfig
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.registration import answer_frame
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import search_hypotheses, search_modes
from mereo.fitting.registration.register import CloudToFit, Registrar
from mereo.fitting.search import rotations
from mereo.fitting.tracking import (
    BackgroundSearch,
    SynchronousExecutor,
    Track,
    TrackedFrame,
    Tracker,
    between,
    motion_precision,
)
from mereo.geometry.camera import SCANNER_TO_CAMERA, Camera, PointCloud
from mereo.geometry.mesh import SegmentedMesh, area_vectors, surface_points
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import inverse_rigid
from mereo.io.sensor_frame import SensorFrame
from mereo.models.weights import load_model
from mereo.reconstruction.observation import Observation, find_object, observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis import depth_sensor
from mereo.synthesis.clutter import Backdrop, Capsule, Surroundings, farthest
from mereo.synthesis.config import SENSORS
from mereo.synthesis.depth_sensor import SimulatedView, add_depth_noise, render_depth
from mereo.synthesis.recording import walk

CAMERA = Camera.from_fov(96, 96, 0.5)
PLACE = np.array([1.0, -2.0, 130.0])


def mesh_of(model: StatisticalModel, turn: int, share: float = 0.0) -> SegmentedMesh:
    """Segments before the camera, on the way from one state of the library to another."""
    z = ((1 - share) * model.library[3] + share * model.library[4]).astype(np.float64)
    R = rotations(97)[turn]
    posed = Posed(R, PLACE - R @ model.mean.mean(axis=0), z)
    return model.mesh(posed.place(model.material(z)))


def view(mesh: SegmentedMesh, seed: int = 0, occluders: tuple[Capsule, ...] = ()) -> SimulatedView:
    solids = Solids(mesh)
    rng = default_rng(seed)
    away = np.array([0.0, 0.0, 1.0])
    wall = Backdrop(away, farthest(solids, away) + 60.0)
    return depth_sensor.observe(solids, CAMERA, 0.02, SENSORS["paper"], rng, around=Surroundings(occluders, wall))


def bare(seen: SimulatedView) -> Observation:
    return observe(seen.image.to_points())


def whole(seen: SimulatedView) -> Observation:
    """All that was measured, with the object's mask."""
    image = seen.image
    return find_object(SensorFrame(Path("simulated"), image.to_points(), None, "camera", image, whole=seen.whole))


def vertices(mesh: SegmentedMesh) -> np.ndarray:
    return np.concatenate([segment.vertices for segment in mesh.segments])


def rms(answer: Answer, mesh: SegmentedMesh) -> float:
    return float(np.sqrt(((vertices(answer.surfaces) - vertices(mesh)) ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    """Registrar of a lobe with a core inside and a tip that lies on it, which bends."""
    return Registrar(None, load_model("tests/golden/lump.safetensors").statistical_model)


class HeldExecutor(Executor):
    """Executor that does its work when it is told to."""

    def __init__(self) -> None:
        self.held: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.held.append((Future(), lambda: fn(*args, **kwargs)))
        return self.held[-1][0]

    def work(self) -> None:
        """Do what was submitted last."""
        future, work = self.held[-1]
        future.set_result(work())


@pytest.fixture(scope="module")
def here(registrar: Registrar) -> SegmentedMesh:
    return mesh_of(registrar.model, 20)


@pytest.fixture(scope="module")
def there(registrar: Registrar) -> SegmentedMesh:
    """The same state, moved by its own length and turned."""
    found = mesh_of(registrar.model, 50)
    shift = np.array([22.0, 10.0, 60.0])
    return found.with_vertices([segment.vertices + shift for segment in found.segments])


@pytest.fixture(scope="module")
def frames(here: SegmentedMesh, there: SegmentedMesh) -> dict[str, Observation]:
    """The object here and there, nine tenths of it hidden, and another thing where it was."""
    shown = bare(view(here))
    points = shown.cloud.points
    hidden = points[points[:, 0] > np.quantile(points[:, 0], 0.9)]
    middle = points.mean(axis=0)
    along = np.array([25.0, 20.0, 0.0])
    rod = Capsule(middle - along, middle + along, 2.0)
    rays = CAMERA.directions().reshape(-1, 3)
    rows, hits = rod.first_hit(rays)
    thing = rays[rows] * hits.distance[:, None]
    return {
        "here": shown,
        "there": bare(view(there, 1)),
        "hidden": observe(PointCloud(hidden)),
        "thing": observe(PointCloud(thing)),
    }


Searches = list[Observation]


@lru_cache
def searched(registrar: Registrar, seen: Observation) -> Candidate:
    return search_hypotheses(seen, registrar, False, 1.0)


@pytest.fixture
def searches(registrar: Registrar, frames: dict[str, Observation], monkeypatch: pytest.MonkeyPatch) -> Searches:
    """Frames that were searched, each in truth only once; another thing is found nowhere."""
    asked: Searches = []

    def search(seen: Observation, *_: object) -> Candidate:
        asked.append(seen)
        is_thing = seen.cloud is frames["thing"].cloud
        return replace(searched(registrar, frames["here"]), modes=None) if is_thing else searched(registrar, seen)

    monkeypatch.setattr(answer_frame, "search_hypotheses", search)
    return asked


@pytest.fixture
def held() -> HeldExecutor:
    return HeldExecutor()


@pytest.fixture
def begun(
    registrar: Registrar, frames: dict[str, Observation], searches: Searches, held: HeldExecutor
) -> Iterator[Tracker]:
    """Tracker that has seen the object here in two frames."""
    with Tracker(registrar, executor=held) as tracker:
        answers = [tracker.follow(frames["here"], 0.03 * number, scene_unit=1.0) for number in range(2)]
        assert [one.tracking for one in answers] == ["found", "followed"] and searches == [frames["here"]]
        searches.clear()
        yield tracker


@pytest.mark.parametrize(
    "name, reason",
    [
        ("there", r"\d+ points of at least \d+ lie near where it was expected"),
        ("hidden", r"only \d+% as much of it as before can be seen"),
        ("thing", r"only \d+% of the points near where it was expected can be its own"),
    ],
)
def test_a_lost_object_is_told_in_the_same_frame_and_has_no_pose(
    begun: Tracker, held: HeldExecutor, frames: dict[str, Observation], name: str, reason: str
) -> None:
    answer = begun.follow(frames[name], 0.06, scene_unit=1.0)
    assert answer.tracking == "lost" and not answer.tracked
    assert answer.registration is None and answer.registered is None and answer.recognition.known is False
    sentence = rf"^the object is lost: {reason}; it is being searched for, so keep it in view, or start again with it$"
    with pytest.raises(ValueError, match=sentence):
        _ = answer.surfaces
    assert answer.hypothesis.keep.all() and answer.seen.cloud is frames[name].cloud
    result = Result.of(answer)
    assert "the object is lost" in repr(result) and "the object is lost" in result._repr_html_()
    assert repr(answer).endswith(": lost)") and len(held.held) == 1
    # in its old place it is followed at once, and nobody waits for the search any more
    assert begun.follow(frames["here"], 0.09, scene_unit=1.0).tracking == "followed"
    assert held.held[0][0].cancelled()


def test_it_is_searched_in_the_latest_lost_frame_one_at_a_time(
    begun: Tracker, held: HeldExecutor, frames: dict[str, Observation], searches: Searches, there: SegmentedMesh
) -> None:
    for number in range(3):
        assert begun.follow(frames["thing"], 0.1 + 0.03 * number, scene_unit=1.0).tracking == "lost"
    assert len(held.held) == 1 and not searches
    held.work()  # nothing is found, and the newest frame is searched
    assert begun.follow(frames["there"], 0.3, scene_unit=1.0).tracking == "lost"
    assert len(held.held) == 2
    held.work()
    assert searches == [frames["thing"], frames["there"]]
    found = begun.follow(frames["there"], 5.0, scene_unit=1.0)
    assert found.tracking == "found" and found.located_by == "search" and not found.tracked
    assert rms(found, there) < 0.7 and len(held.held) == 2
    assert begun.follow(frames["there"], 5.03, scene_unit=1.0).tracking == "followed"


def test_what_was_found_must_explain_the_newest_frame(
    begun: Tracker, held: HeldExecutor, frames: dict[str, Observation], here: SegmentedMesh
) -> None:
    assert begun.follow(frames["there"], 0.1, scene_unit=1.0).tracking == "lost"
    held.work()
    # it has gone back meanwhile: the old track explains it, and what was found there is forgotten
    back = begun.follow(frames["here"], 0.2, scene_unit=1.0)
    assert back.tracking == "followed" and rms(back, here) < 0.7
    assert begun.follow(frames["there"], 0.3, scene_unit=1.0).tracking == "lost"
    held.work()
    assert begun.follow(frames["thing"], 0.4, scene_unit=1.0).tracking == "lost" and len(held.held) == 3
    # later than any expectation lasts
    late = begun.follow(frames["here"], 9.0, scene_unit=1.0)
    assert late.tracking == "lost" and "it was last followed 8.8 s before" in str(late.recognition.reason)


def test_the_own_thread_blocks_no_frame_and_ends(
    registrar: Registrar, frames: dict[str, Observation], searches: Searches, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = threading.Event()
    goes_on = threading.Event()
    search = answer_frame.search_hypotheses

    def slow(seen: Observation, *rest: Any) -> Candidate:
        waiting.set()
        assert goes_on.wait(60)
        return search(seen, *rest)

    def threads() -> list[threading.Thread]:
        return [one for one in threading.enumerate() if one.name.startswith("mereo-search")]

    with Tracker(registrar) as tracker:
        tracker.follow(frames["here"], 0.0, scene_unit=1.0)
        assert not threads()
        monkeypatch.setattr(answer_frame, "search_hypotheses", slow)
        assert tracker.follow(frames["there"], 0.03, scene_unit=1.0).tracking == "lost" and waiting.wait(60)
        assert tracker.follow(frames["there"], 0.06, scene_unit=1.0).tracking == "lost" and len(threads()) == 1
        goes_on.set()
        running = tracker._search._running
        assert running is not None and running[0].time_s == 0.03 and running[1].result(60)
        assert tracker.follow(frames["there"], 0.09, scene_unit=1.0).tracking == "found"
        # given up while it goes on: its thread ends with it
        assert tracker.follow(frames["thing"], 0.12, scene_unit=1.0).tracking == "lost"
    for one in threads():
        one.join(60)
    assert not threads()


def test_faults_of_a_search_are_raised_and_unusable_frames_are_none(held: HeldExecutor) -> None:
    frame = TrackedFrame(observe(PointCloud(np.eye(3))), 0.0)
    search = BackgroundSearch(held.submit, held)
    for _ in range(2):  # one at a time
        search.start(frame)
    assert search.take() is None
    held.held[-1][0].set_exception(ValueError("3 points"))
    assert search.take() is None
    search.start(frame)
    held.held[-1][0].set_exception(OSError("broken"))
    with pytest.raises(OSError, match="broken"):
        search.take()
    assert len(held.held) == 2


def test_a_stream_says_that_an_object_is_lost(
    registrar: Registrar, frames: dict[str, Observation], searches: Searches, tmp_path: Path
) -> None:
    answering = Answering(None, registrar, 24, waits=True)
    folder = SurfaceFolder(tmp_path / "out", False)
    lines = []
    for number, name in enumerate(("here", "thing")):
        answer = answering(StreamFrame(name, 0.03 * number, partial(frames.get, name)))
        outcome = Outcome("frame", 0.0, answer, "", 0.0, 0.0, 0)
        lines.append(line(folder.written(outcome, "camera")))
    answering.close()
    assert [one["tracking"] for one in lines] == ["found", "lost"] and lines[1]["segments"] == {}
    assert det(lines[0]["pose"]) == pytest.approx(1) and lines[1]["pose"] is None  # no earlier pose
    assert lines[1]["reason"].startswith("the object is lost: only")
    # surfaces of the frame that was there by this name before it was lost are gone
    assert not list((tmp_path / "out").iterdir())


FRAMES, BEFORE, AFTER = 11, 3, 8


@pytest.fixture(scope="module")
def crossing(registrar: Registrar) -> list[tuple[SegmentedMesh, SimulatedView]]:
    """A tool comes from the side, hides half of an object that bends slowly, and leaves."""
    frames = []
    for number in range(FRAMES):
        mesh = mesh_of(registrar.model, 20, 0.3 * number / FRAMES)
        low = vertices(mesh).min(axis=0)
        high = vertices(mesh).max(axis=0)
        tool: tuple[Capsule, ...] = ()
        if BEFORE <= number < AFTER:
            share = np.sin(np.pi * (number - BEFORE + 0.5) / (AFTER - BEFORE))
            width = high[0] - low[0]
            z = 0.9 * low[2]
            x = 0.9 * (low[0] - width + (0.25 + 0.35 * share) * width)
            tool = (Capsule(np.array([x, -200.0, z]), np.array([x, 200.0, z]), 0.9 * width),)
        frames.append((mesh, view(mesh, number, tool)))
    return frames


@pytest.mark.parametrize("observed", [bare, whole])
def test_what_passes_in_front_does_not_pull_the_object(
    registrar: Registrar, crossing: list[tuple[SegmentedMesh, SimulatedView]], observed: Callable[..., Observation]
) -> None:
    shown = [int(one.image.valid.sum()) for _, one in crossing]
    assert min(shown[BEFORE:AFTER]) < 0.6 * shown[0]
    with Tracker(registrar, executor=SynchronousExecutor()) as tracker:
        answers = [tracker.follow(observed(one), i / 30, scene_unit=1.0) for i, (_, one) in enumerate(crossing)]
    assert [one.tracking for one in answers] == ["found", *["followed"] * (FRAMES - 1)]
    off = [rms(answer, mesh) for answer, (mesh, _) in zip(answers, crossing, strict=True)]
    before, during, after = (max(part) for part in (off[:BEFORE], off[BEFORE:AFTER], off[AFTER:]))
    assert max(before, during, after) < 0.6 and during < 1.2 * before


SEED, RATE_HZ = 740_000, 30.0


@pytest.fixture(scope="module")
def engine() -> Registrar:
    return Registrar.of(load_model("engine"), "modes")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("engine")


def seen(scene: Scene, mesh: SegmentedMesh, noise: float = 0.0, seed: int = 0) -> PointCloud:
    camera = Camera.from_fov(96, 96, scene.workspace.fov_rad)
    return add_depth_noise(render_depth(Solids(mesh), camera), noise, default_rng(seed)).to_points()


def states(scene: Scene, seed: int, count: int, change_s: float) -> list[SegmentedMesh]:
    meshes = [scene.deform(one.deformations).mesh for one in walk(scene, seed, np.arange(count) / RATE_HZ, change_s)]
    T = inverse_rigid(scene.workspace.sample(example_rng(seed, 0), meshes[0].bounds.mean(axis=0)))
    return [mesh.transformed(T) for mesh in meshes]


@pytest.fixture(scope="module")
def first(scene: Scene) -> SegmentedMesh:
    return states(scene, SEED, 1, 1.0)[0]


@pytest.fixture(scope="module")
def second(scene: Scene) -> SegmentedMesh:
    """Another state, seen from elsewhere."""
    return states(scene, SEED + 5, 1, 1.0)[0]


def apart(found: Answer, mesh: SegmentedMesh) -> float:
    return float(norm(vertices(found.surfaces) - vertices(mesh), axis=1).mean())


@pytest.mark.parametrize("unit", [pytest.param(1.0, marks=pytest.mark.slow), None])
def test_a_slow_sequence_is_tracked_as_its_frames_are_fitted(
    engine: Registrar, scene: Scene, unit: float | None
) -> None:
    meshes = states(scene, SEED + 1, 8, 0.5)
    size = 1.0 if unit else 2.5
    tracker = Tracker(engine)
    frames = [observe(PointCloud(size * seen(scene, mesh).points)) for mesh in meshes]
    found = [tracker.follow(frame, i / RATE_HZ, scene_unit=unit) for i, frame in enumerate(frames)]
    assert all(one.tracked for one in found[1:])
    assert norm(vertices(meshes[-1]) - vertices(meshes[0]), axis=1).max() > 0.5
    alone = Tracker(engine).follow(frames[-1], 0.0, scene_unit=unit)
    last = meshes[-1]
    truth = last.with_vertices([size * segment.vertices for segment in last.segments])
    assert apart(found[-1], truth) < apart(alone, truth) + 0.2 * size
    # the unit that was found is kept
    units = [one.registration.scene_unit for one in found if one.registration is not None]
    assert units == pytest.approx(8 * [size], rel=0.02) and np.ptp(units) < 0.01 * size


def test_an_object_that_jumps_or_goes_and_comes_again_is_found_in_its_own_frame(
    engine: Registrar, scene: Scene, first: SegmentedMesh, second: SegmentedMesh
) -> None:
    tracker = Tracker(engine, executor=SynchronousExecutor())
    tracker.follow(observe(seen(scene, first)), 0.0, scene_unit=1.0)
    few = observe(PointCloud(seen(scene, first).points[:3]))
    with pytest.raises(ValueError, match="points"):
        Tracker(engine).follow(few, 0.1, scene_unit=1.0)
    assert tracker.follow(few, 0.1, scene_unit=1.0).tracking == "lost"
    assert tracker.follow(observe(seen(scene, first)), 0.2, scene_unit=1.0).recognition.known is True
    merged = observe(seen(scene, first))
    vars(merged)["self_hidden"] = 0.3  # as if another view's points lay behind
    followed = tracker.follow(merged, 0.21, scene_unit=1.0)
    assert followed.tracked and followed.recognition.known == "unsure" and followed.recognition.reason == merged.doubt
    own = search_modes(CloudToFit(seen(scene, second).points, scene_unit=1.0), engine.model).registration
    # elsewhere: at once, and after more time than any expectation lasts
    for mesh, time_s in ((second, 0.23), (first, 5.0), (second, 10.0)):
        jumped, tracked = (
            tracker.follow(observe(seen(scene, mesh)), time_s + wait, scene_unit=1.0) for wait in (0, 0.1)
        )
        assert not jumped.tracked and tracked.tracked and apart(tracked, mesh) < apart(jumped, mesh) + 0.05 < 1.0
        if mesh is second:
            assert norm(jumped.registration.material - own.material, axis=1).max() < 0.5
    tracker.forget()
    assert not tracker.follow(observe(seen(scene, second)), 5.2, scene_unit=1.0).tracked


def test_points_away_from_the_expected_surface_are_strays(
    engine: Registrar, scene: Scene, first: SegmentedMesh
) -> None:
    cloud = seen(scene, first)
    tracker = Tracker(engine)
    tracker.follow(observe(cloud), 0.0, scene_unit=1.0)
    beside = observe(PointCloud(np.concatenate([cloud.points, 1.5 * cloud.points[:12]])))
    found = tracker.follow(beside, 0.03, scene_unit=1.0)
    assert found.tracked and found.hypothesis.dropped == 12 and not found.hypothesis.keep[-12:].any()
    assert_array_equal(found.seen.cloud.points, cloud.points)
    assert apart(found, first) < 0.2
    assert tracker.follow(beside, 0.06, keep_all=True).hypothesis.dropped == 0


def test_an_object_that_is_lost_at_once_is_searched(
    engine: Registrar, scene: Scene, first: SegmentedMesh, held: HeldExecutor
) -> None:
    tracker = Tracker(replace(engine, method="auto"), TrackConfig(most_ruled_out=-1.0), held)
    found = tracker.follow(observe(seen(scene, first)), 0.0, scene_unit=1.0)
    assert found.tracking == "lost" and found.registered is None and found.is_missing
    assert found.recognition.known is False and str(found.recognition.reason).startswith("the object is lost: nothing")
    running = tracker._search._running
    assert running is not None
    tracker.forget()
    assert running[1].cancelled()


def test_without_evidence_the_expected_state_is_the_answer(
    engine: Registrar, scene: Scene, first: SegmentedMesh
) -> None:
    config = TrackConfig()
    fitted = search_modes(CloudToFit(seen(scene, first).points, scene_unit=1.0), engine.model)
    track = Track.of(fitted, 0.0, config, FitConfig())
    count = POSE + track.problem.model.count
    velocity = 0.1 * default_rng(0).normal(size=count)
    moving = replace(track, velocity=velocity)
    state = moving.expected(0.5, config)
    # what noise alone may be does not count as motion
    assert_allclose(between(track.posed, state), 0.5 * velocity * (1 - (config.dead / moving.speed) ** 2), atol=1e-9)
    shift = np.concatenate([np.zeros(3), [1.0, -2.0, 2.0], np.zeros(count - 6)])
    assert replace(track, velocity=shift).speed == pytest.approx(3.0, rel=1e-6) and track.speed == 0.0
    slow = replace(track, velocity=velocity * config.dead / moving.speed)
    assert_allclose(between(track.posed, slow.expected(0.5, config)), 0.0, atol=1e-9)
    precision = motion_precision(moving, 0.5, config)
    off = state.moved(0.01 * default_rng(1).normal(size=count))
    back = off.moved(NormalEquations(precision, precision @ between(state, off)).step(0.0))
    assert_allclose(back.place(np.eye(3)), state.place(np.eye(3)), atol=1e-2)
    # what moves is less certain than what is still
    still = replace(moving, velocity=np.zeros(count), unsure=0.0)
    assert np.trace(motion_precision(still, 0.5, config)) > 10 * np.trace(precision)


@pytest.mark.slow
def test_frames_that_become_noisier_are_met_with_their_own_constants(
    engine: Registrar, scene: Scene, first: SegmentedMesh
) -> None:
    tracker = Tracker(engine, executor=SynchronousExecutor())
    tracker.follow(observe(seen(scene, first, 0.02)), 0.0, scene_unit=1.0)
    quiet = tracker._track.problem
    for number in range(1, 11):
        found = tracker.follow(observe(seen(scene, first, 0.5, number)), number / RATE_HZ, scene_unit=1.0)
        assert found.tracking != "lost"
    loud = tracker._track
    assert 0.2 < loud.problem.noise < 0.5 and loud.problem.cloud_sigma > 1.5 * quiet.cloud_sigma
    assert loud.problem.tolerance > quiet.tolerance and quiet.config == tracker.registrar.config
    for number in range(11, 21):
        tracker.follow(observe(seen(scene, first, 0.02, number)), number / RATE_HZ, scene_unit=1.0)
    assert tracker._track.problem.cloud_sigma == quiet.cloud_sigma


@pytest.mark.slow
def test_a_scanners_frames_are_answered_in_its_frame(engine: Registrar, scene: Scene, first: SegmentedMesh) -> None:
    cloud = PointCloud(seen(scene, first).points @ SCANNER_TO_CAMERA.T)
    tracker = Tracker(engine)
    for number in range(2):
        found = tracker.follow(observe(cloud, "scanner"), number / RATE_HZ, scene_unit=1.0)
    assert found.tracked
    assert np.median(Solids(found.surfaces).nearest(cloud.points).distance) < 0.2


def test_a_surface_that_no_camera_saw_is_followed(registrar: Registrar) -> None:
    tracker = Tracker(registrar)
    for number in range(3):
        mesh = mesh_of(registrar.model, 20, 0.05 * number)
        places, faces, _ = SegmentedMesh(mesh.segments[1:]).merged()  # without the core inside
        points, face = surface_points(places, faces, 2000)
        cloud = PointCloud.of(np.hstack([points, area_vectors(places, faces)[face]]))
        frame = find_object(SensorFrame(Path("a.ply"), cloud, None, "camera"))
        answer = tracker.follow(frame, number / RATE_HZ, scene_unit=1.0)
        assert frame.extent == "surface" and answer.tracked == (number > 0)
        assert answer.recognition.known is True and apart(answer, mesh) < 0.3
