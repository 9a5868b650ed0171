"""Follow an object from frame to frame: each fit starts where the last ended; a search finds a lost object.

    Observation, time -Tracker.follow-> Answer (found, followed or lost)

An object is lost where few points lie near where it was expected, the model explains fewer of them than it must, or the
frame rules out much of it. Then the answer says so, and a search goes on in the background; its state, fitted to the
newest frame, begins a new track. The first frame waits for its search.
"""

import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mereo.fitting.config import FitConfig, LocatedBy, TrackConfig, Tracking
from mereo.fitting.problem.gauss_newton import DAMPING, POSE, NormalEquations, Posed, in_space
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.problem.residuals import Prior, are_near
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import answer_of, find, in_registered_unit
from mereo.fitting.registration.recognition import Recognition, recognize
from mereo.fitting.registration.register import CloudToFit, ModesFit, Registrar
from mereo.fitting.search import WHOLE
from mereo.geometry.brief import counted
from mereo.geometry.camera import SightKind
from mereo.geometry.conventions import MIN_POINTS
from mereo.io.bounds import Number, PositiveOrUnknown, check_bounds
from mereo.io.cores import limit_blas_threads
from mereo.models.calibration import Calibration
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

# --- one frame's fit from the state of the frame before ---------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Track:
    """State of an object at a time, from which the next frame is fitted.

    Attributes:
        problem: of that frame: the model, and the frames' noise, smoothed.
        unit: length of a scene unit in the clouds' unit.
        posed: the state, scene units, without a scale.
        velocity: of the parameters, in the order of ``gauss_newton``, a second.
        unsure: how far the velocity may be off because little is known yet, scene units per second.
        other_lines: kind of the lines of sight of which a frame says nothing, as it was when the track began.
        area: greatest area of the object that was seen (``area`` of the evidence).
    """

    problem: Problem
    unit: float
    posed: Posed
    time_s: float
    velocity: Float[np.ndarray, " p"]
    unsure: float
    other_lines: SightKind
    area: float
    calibration: Calibration | None = None

    @classmethod
    def of(cls, fitted: ModesFit, time_s: float, config: TrackConfig, constants: FitConfig) -> "Track":
        """Track that begins with a frame's own fit, with these ``constants``."""
        posed, scale = without_scale(fitted.posed)
        base, model = fitted.problem, fitted.problem.model
        scale_std = config.scale_std if base.is_scale_open else KNOWN_SCALE_STD
        return cls(
            problem=base.changed(network=None, scale_std=scale_std, config=constants).with_noise(
                base.left_noise(fitted.surface)
            ),
            unit=fitted.unit * scale,
            posed=posed,
            time_s=time_s,
            velocity=np.zeros(POSE + model.count),
            unsure=config.first_speed,
            other_lines=base.evidence.other_lines,
            area=base.evidence.area,
            calibration=fitted.calibration,
        )

    def in_model(self, model: StatisticalModel) -> "Track":
        """The same state, with the velocity of its pose alone, by another model of the same material points."""
        T, z = model.project(self.problem.model.material(self.posed.z))
        return replace(
            self,
            problem=replace(self.problem, model=model),
            posed=Posed(self.posed.rotation @ T[:3, :3], self.posed.place(T[:3, 3:].T)[0], z, 0.0),
            velocity=np.pad(self.velocity[:POSE], (0, model.count)),
        )

    def expected(self, time_s: float, config: TrackConfig) -> Posed:
        """State that is expected at a time."""
        # James and Stein's estimate of a mean, positive part: small motion may be noise alone, large motion is not
        counted = max(1.0 - (config.dead / max(self.speed, 1e-9)) ** 2, 0.0)
        return self.posed.moved(counted * self.velocity * (time_s - self.time_s))

    @cached_property
    def squared(self) -> Float[np.ndarray, "p p"]:
        """Mean square of a material point's way, as a form of the parameters' step."""
        model = self.problem.model
        position = self.posed.place(model.positions(self.posed.z[None], model.sparse)[0])
        jacobian = in_space(self.posed, position, model.tangent(self.posed.z, model.sparse)).astype(np.float64)
        form: Float[np.ndarray, "p p"] = jacobian.T @ jacobian / len(model.sparse)
        return form

    @property
    def speed(self) -> float:
        """Speed that the object seems to have: root mean square of its points, scene units per second."""
        return float(np.sqrt(self.velocity @ self.squared @ self.velocity))


def without_scale(posed: Posed) -> tuple[Posed, float]:
    """Return a state in the unit that its scale makes of the scene's, and that scale."""
    scale = float(np.exp(posed.log_scale))
    return replace(posed, translation=posed.translation / scale, log_scale=0.0), scale


def gated(track: Track, points: Float[np.ndarray, "n 3"], time_s: float, config: TrackConfig) -> Bool[np.ndarray, " n"]:
    """Mark the points, in the cloud's unit, near the expected surface; others are outliers, or the object is lost."""
    samples = track.problem.samples.every(2)
    position = samples.posed(track.expected(time_s, config)).position
    most = config.gate * track.problem.model.half + samples.spacing
    return np.isfinite(cKDTree(position).query(points / track.unit, distance_upper_bound=most)[0])


def next_fit(
    track: Track,
    cloud: CloudToFit,
    time_s: float,
    config: TrackConfig,
) -> tuple[ModesFit, Track]:
    """Fit the modes to a frame, and return the fit with the track that ends with it.

    Where the lines of sight of ``cloud`` leave it open, the object is seen whole or in part as it was when the track
    began; where it was seen whole and the frame rules that out by more than ``WHOLE``, it is fitted as seen in part
    too, and the better fit is taken.
    """
    started = time.perf_counter()
    lines = cloud.lines
    with limit_blas_threads():
        start = track.expected(time_s, config)
        precision = motion_precision(track, max(time_s - track.time_s, 0.0), config)

        def fit(other_lines: SightKind) -> ModesFit:
            like = replace(cloud, lines=replace(lines, other_lines=other_lines))
            evidence = like.evidence(track.unit, config.observed_samples, config.points)
            problem = track.problem.changed(evidence=evidence)
            posed = descend(problem, start, precision, config)
            return ModesFit(problem, track.unit, posed, 0.0, calibration=track.calibration)

        fitted = fit(lines.other_lines or track.other_lines)
        if lines.other_lines is None and fitted.problem.silhouette_misfit(fitted.surface) > WHOLE:
            partial = fit("unknown")
            whole_misfit, misfit = (end.problem.misfit(end.posed, end.surface).total for end in (fitted, partial))
            fitted = partial if misfit + WHOLE < whole_misfit else fitted
    fitted = replace(fitted, seconds=time.perf_counter() - started)
    return fitted, followed(track, fitted, time_s, config)


def followed(track: Track, fitted: ModesFit, time_s: float, config: TrackConfig) -> Track:
    """Track with a further frame."""
    posed, scale = without_scale(fitted.posed)
    passed = max(time_s - track.time_s, 1e-3)
    before = track.problem.noise
    left = fitted.problem.left_noise(fitted.surface)
    return replace(
        track,
        problem=fitted.problem.with_noise(before + config.smoothing * (left - before)),
        unit=track.unit * scale,
        posed=posed,
        time_s=time_s,
        velocity=track.velocity + config.smoothing * (between(track.posed, posed) / passed - track.velocity),
        unsure=track.unsure * (1 - config.smoothing),
        area=max(track.area, fitted.problem.evidence.area),
    )


def between(first: Posed, second: Posed) -> Float[np.ndarray, " p"]:
    """Step of the parameters from one state to another: ``first.moved(step)`` is ``second``."""
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    scale = [second.log_scale - first.log_scale]
    return np.concatenate([turn, second.translation - first.translation, scale, second.z - first.z])


def motion_precision(track: Track, passed_s: float, config: TrackConfig) -> Float[np.ndarray, "p p"]:
    """Precision of the parameters' step from the expected state: a point is there up to its speeds times the time."""
    speed = config.speed + max(config.gain * max(track.speed - config.dead, 0.0), track.unsure)
    # noisy frames weigh less, and a moving object must not lag behind for that
    coarser = track.problem.cloud_sigma / track.problem.config.cloud_sigma
    sigma = coarser * (speed * passed_s + config.least)
    precision: Float[np.ndarray, "p p"] = track.squared * (config.motion_weight / sigma**2)
    return precision


def descend(problem: Problem, start: Posed, precision: Float[np.ndarray, "p p"], config: TrackConfig) -> Posed:
    """State that explains cloud, silhouette and prior from nearby, and lies near ``start``, which is expected."""
    half = problem.model.half
    prior = Prior.near(problem.model, start.z) if are_near(problem.model) else Prior.whole(problem.model)
    posed = start
    steps = config.steps + config.exact_steps
    for step in range(steps):
        sigma = max(config.first_sigma * half * config.cooling**step, problem.cloud_sigma)
        expected = NormalEquations(precision, precision @ between(start, posed))
        normal = problem.known(posed, prior, 0.0).plus(expected)
        normal = problem.seen(normal, posed, sigma, exact=step >= config.steps)
        posed = posed.moved(normal.step(DAMPING))
    return posed


# --- search in the background -----------------------------------------------------------------------------------------

# TrackedFrame -BackgroundSearch.start-> (seconds later) -BackgroundSearch.take-> Candidate
#
# NumPy lets go of the interpreter in most of a search, so a thread is enough.


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Frame of a sequence, with what is known of it: the arguments of ``Tracker.follow``."""

    seen: Observation
    time_s: Number
    scene_unit: PositiveOrUnknown = None
    keep_all: bool = False
    scene: Scene | None = None

    def __post_init__(self) -> None:
        check_bounds(self)


class SynchronousExecutor(Executor):
    """Executor that does the work at once, in the caller's thread: for recordings, and for tests."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work, and return what has come of it."""
        future = Future[Any]()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as problem:  # as an executor does
            future.set_exception(problem)
        return future


class BackgroundSearch:
    """Searches of one object, one at a time; used by one thread.

    Attributes:
        find: what finds the object in a frame.
        executor: what does the searches, the caller's to end; None for a thread of its own, which starts when the
            first search does and ends with ``close``.
    """

    def __init__(self, find: Callable[[TrackedFrame], Candidate], executor: Executor | None = None) -> None:
        self.find = find
        self.executor = executor
        self._thread = ThreadPoolExecutor(1, "mereo-search")
        self._running: tuple[TrackedFrame, Future[Candidate]] | None = None

    def start(self, frame: TrackedFrame) -> None:
        """Search a frame, unless one is being searched, or was and has not been taken."""
        if self._running is None:
            self._running = frame, (self.executor or self._thread).submit(self.find, frame)

    def take(self) -> tuple[TrackedFrame, Candidate] | None:
        """The searched frame and its best candidate, which may not explain it; None where there is none, or not yet.

        Raises what a search does, but for the ``ValueError`` of an unusable frame.
        """
        if self._running is None or not self._running[1].done():
            return None
        (frame, ended), self._running = self._running, None
        with suppress(ValueError):
            return frame, ended.result()
        return None

    def drop(self) -> None:
        """Forget the frame that is being searched."""
        if self._running is not None:
            self._running[1].cancel()
            self._running = None

    def close(self, wait: bool) -> None:
        """Forget it, and let its thread end with the search, which ``wait`` waits for; the next has another thread."""
        self.drop()
        self._thread.shutdown(wait, cancel_futures=True)
        self._thread = ThreadPoolExecutor(1, "mereo-search")


# --- the tracker ------------------------------------------------------------------------------------------------------


class Tracker:
    """Follows one object through a sequence of frames; not safe for use by several threads at once.

    Draws and rest model are not fitted: they take longer than the time between two frames.
    """

    def __init__(
        self,
        registrar: Registrar,
        config: TrackConfig = TrackConfig(),  # noqa: B008 (frozen)
        executor: Executor | None = None,
    ) -> None:
        """Follow an object.

        Args:
            registrar: of the object.
            config: constants.
            executor: what searches for a lost object (``BackgroundSearch``); None for a thread of its own.
        """
        self.registrar = registrar
        self.config = config
        self._search = BackgroundSearch(lambda frame: self.locate(frame, registrar.narrowed(frame.scene))[1], executor)
        self.forget()

    def __enter__(self) -> "Tracker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def locate(self, frame: TrackedFrame, registrar: Registrar) -> tuple[Observation, Candidate]:
        """What of a frame is taken for the object, and its best candidate; raises as ``find`` does."""
        return frame.seen, find(frame.seen, registrar.network, registrar, frame.keep_all, frame.scene_unit)

    def forget(self) -> None:
        """Forget the track: the next frame is fitted by itself; a search that goes on is given up."""
        self._search.close(wait=False)
        self._track: Track | None = None
        self._T_camera_input, self._axes = np.eye(4), "camera"
        self._located_by: LocatedBy = "search"
        self._has_begun = False

    def close(self) -> None:
        """Give up the search that goes on, if one does, and wait until its thread has ended."""
        self._search.close(wait=True)

    def follow(
        self,
        seen: Observation,
        time_s: float,
        *,
        scene_unit: float | None = None,
        keep_all: bool = False,
        scene: Scene | None = None,
    ) -> Answer:
        """Answer the next frame.

        Args:
            seen: the object in the frame, any density, in one unit throughout the sequence.
            time_s: of the frame, from any zero; what is expected of the object depends on the time since the last one.
            scene_unit: length of a scene unit in the frame's unit, where it is known for certain.
            keep_all: take every point for the object's.
            scene: the object's with the joints that are known in this frame (``with_joints``); None without any.

        The first frame is waited for, however long a search takes. Raises ``ValueError`` where that is unusable or
        shows too little; of later frames the object is then lost, and the track is kept.
        """
        started = time.perf_counter()
        frame = TrackedFrame(seen, time_s, scene_unit, keep_all, scene)
        tracked, why = self._tracked(self._track, frame, self.config.longest_s)
        if tracked is not None and not why:
            return self._gone_on(frame, tracked, started)
        if not self._has_begun and (alone := self._by_itself(frame, started)) is not None:
            return alone
        again = self._searched(frame)
        if again is None:
            self._search.start(frame)
            again = self._searched(frame)  # some executors have done it now
        if again is not None:
            return self._gone_on(frame, again, started, "found")
        return self._lost(frame, why, started)

    def _tracked(self, track: Track | None, frame: TrackedFrame, longest_s: float) -> "tuple[_Tracked | None, str]":
        """Fit the frame from an earlier state, and what speaks against that; None without one that leads to it."""
        seen, time_s = frame.seen, frame.time_s
        if track is None or seen.frame.axes != self._axes:
            return None, "nothing explains what is seen"
        passed_s = time_s - track.time_s
        if not 0 <= passed_s <= longest_s:
            return None, f"it was last followed {passed_s:.1f} s before"
        model = self.registrar.narrowed(frame.scene).states
        if model is not track.problem.model:  # values of other joints are known
            track = track.in_model(model)
        cloud = seen.cloud.transformed(self._T_camera_input)
        points = cloud.points
        keep = np.ones(len(points), dtype=bool) if frame.keep_all else gated(track, points, time_s, self.config)
        if keep.sum() < MIN_POINTS:
            return None, f"{counted(int(keep.sum()), 'point')} of at least {MIN_POINTS} lie near where it was expected"
        lines = seen.lines.transformed(self._T_camera_input)
        kept = cloud.rows(keep)
        near = CloudToFit(kept.points, lines=lines.with_unknown(points[~keep]), normals=kept.normals)

        def fit(config: TrackConfig) -> _Tracked:
            fitted, after = next_fit(track, near, time_s, config)
            return _Tracked(fitted, after, Reading(seen.cloud, keep))

        tracked = fit(self.config)
        if not tracked.fitted.registration.accepted:  # it may have moved far
            tracked = max(tracked, fit(self.config.patient), key=lambda fit_: fit_.score)
        return tracked, self._doubt(tracked)

    def _searched(self, frame: TrackedFrame) -> "_Tracked | None":
        """Fit the frame from the state that a search has found in an earlier one; None where that explains none."""
        earlier, candidate = self._search.take() or (frame, None)
        if candidate is None or candidate.modes is None:
            return None
        before = self._T_camera_input, self._axes
        self._T_camera_input, self._axes = candidate.encoded.T_camera_input, earlier.seen.frame.axes
        begun = _Tracked.of_frame(candidate, earlier.time_s, self.config, self.registrar.config)
        area = 0.0 if self._track is None else self._track.area
        tracked, why = self._tracked(replace(begun.track, area=max(area, begun.track.area)), frame, np.inf)
        if tracked is not None and not why:
            self._located_by = "search"
            return tracked
        self._T_camera_input, self._axes = before
        return None

    def _by_itself(self, frame: TrackedFrame, started: float) -> Answer | None:
        """Answer a frame by itself, which begins a track; None where nothing explains it."""
        registrar = self.registrar.narrowed(frame.scene)
        config = self.config
        seen, candidate = self.locate(frame, registrar)
        self._has_begun = True
        if candidate.modes is None:
            return None
        alone = _Tracked.of_frame(candidate, frame.time_s, config, self.registrar.config)
        if self._doubt(alone):
            return None
        self._track, self._located_by = alone.track, candidate.located_by
        self._T_camera_input, self._axes = candidate.encoded.T_camera_input, seen.frame.axes
        answer = answer_of(seen, registrar.network, registrar, candidate, alone.fitted.registration)
        return replace(answer, seconds=time.perf_counter() - started)

    def _doubt(self, tracked: "_Tracked") -> str:
        """What speaks against a fit, by the frame alone, in a clause; "" where nothing does."""
        registration, config = tracked.fitted.registration, self.config
        if tracked.area < config.least_area:
            return f"only {tracked.area:.0%} as much of it as before can be seen"
        if not registration.accepted:
            return f"only {registration.explained:.0%} of the points near where it was expected can be its own"
        if registration.ruled_out is not None and registration.ruled_out > config.most_ruled_out:
            return f"{registration.ruled_out:.0%} of it would lie where the frame shows none of it"
        return ""

    def _gone_on(
        self, frame: TrackedFrame, tracked: "_Tracked", started: float, tracking: Tracking = "followed"
    ) -> Answer:
        """Answer a frame by a fit that an earlier frame's state led to."""
        self._track = tracked.track
        self._search.drop()
        model = self.registrar.network
        stated = self.registrar.stated_scene_unit(frame.seen.frame.unit_m)
        recognition = recognize(tracked.fitted.registration, stated, has_weights=model is not None)
        recognition = recognition.doubted(frame.seen.doubt)
        seen = in_registered_unit(frame.seen, self.registrar, tracked.fitted.registration, recognition)
        return Answer(
            seen=seen.read_as(tracked.hypothesis),
            model=model,
            registrar=self.registrar.in_scene(frame.scene),
            hypothesis=tracked.hypothesis,
            T_camera_input=self._T_camera_input,
            registration=tracked.fitted.registration,
            recognition=recognition,
            located_by=self._located_by,
            tracking=tracking,
            seconds=time.perf_counter() - started,
        )

    def _lost(self, frame: TrackedFrame, why: str, started: float) -> Answer:
        """Answer a frame in which the object is lost, without surfaces."""
        reason = f"the object is lost: {why}; it is being searched for, so keep it in view, or start again with it"
        return Answer(
            seen=frame.seen,
            model=None,
            registrar=self.registrar,
            hypothesis=Reading.of_all(frame.seen.cloud),
            T_camera_input=self._T_camera_input,
            recognition=Recognition(False, reason, has_weights=self.registrar.network is not None),
            located_by="search",
            tracking="lost",
            seconds=time.perf_counter() - started,
        )


@dataclass(frozen=True, eq=False)
class _Tracked:
    """Fit that may be a frame's answer, the track that goes on from it, and the points that it is of."""

    fitted: ModesFit
    track: Track
    hypothesis: Reading

    @classmethod
    def of_frame(cls, candidate: Candidate, time_s: float, config: TrackConfig, constants: FitConfig) -> "_Tracked":
        """Candidate of a frame that was fitted by itself."""
        assert candidate.modes is not None
        fitted = replace(candidate.modes, rest=None)
        return cls(fitted, Track.of(fitted, time_s, config, constants), candidate.hypothesis)

    @property
    def score(self) -> float:
        """Share of all points of the frame that are explained."""
        return self.fitted.registration.explained * float(self.hypothesis.keep.mean())

    @cached_property
    def area(self) -> float:
        """Area of the object that was seen, as a share of the greatest ever."""
        return self.fitted.problem.evidence.area / self.track.area
