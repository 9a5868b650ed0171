"""An object followed from frame to frame: each fit starts where the last ended, and asks network or search when lost.

    Observation, time -Tracker.follow-> Answer (tracked from the last state, or of the frame by itself)

What can be seen of a lost object is that the model explains fewer of the frame's points than it did. Then, and at
first, the frame is fitted by itself, as `mereo reconstruct` does, and the better of both is gone on with.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mereo.fitting.config import FitConfig, FoundBy
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import answer_of, find, in_found_unit
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.recognition import recognize
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking.config import TrackConfig
from mereo.fitting.tracking.next_fit import Track, gated, next_fit
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.transforms import transform_points
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import EncodedFrame
from mereo.reconstruction.strays import Reading


class Tracker:
    """Follows one object through a sequence of frames; not safe for use by several threads at once.

    Attributes:
        registrar: of the object; its ``method`` says whether a registration that does not explain its frame is taken.
            Draws and rest model are not asked: they take longer than the time between two frames.
        config: constants.
    """

    def __init__(self, registrar: Registrar, config: TrackConfig = TrackConfig()) -> None:  # noqa: B008 (frozen)
        # a frame that nobody understands comes 30 times a second while the object is away
        self.registrar = registrar.at_once
        self.config = config
        self.forget()

    def forget(self) -> None:
        """Start anew: the next frame is fitted by itself."""
        self._track: Track | None = None
        self._T_camera_input, self._axes = np.eye(4), "camera"
        self._best = 0.0
        self._found_by: FoundBy = "network"

    def follow(
        self, seen: Observation, time_s: float, *, scene_unit: float | None = None, keep_all: bool = False
    ) -> Answer:
        """Answer to the next frame.

        Args:
            seen: the object in the frame, any density, in one unit throughout the sequence.
            time_s: of the frame, from any zero; what is expected of the object depends on the time since the last one.
            scene_unit: length of a scene unit in the frame's unit, where it is known for certain.
            keep_all: take every point for the object's.

        Raises ``ValueError`` for unusable clouds and, unless the registrar's method is "auto", where a frame that is
        fitted by itself finds too little. The track is kept: the object may come again.
        """
        started = time.perf_counter()
        tracked = self._tracked(seen, time_s, keep_all)
        if tracked is not None and self._believed(tracked):
            return self._gone_on(seen, tracked, started)
        found, likelier = find(seen, self.registrar.network, self.registrar, keep_all, scene_unit)
        must_register = self.registrar.method != "auto" or self.registrar.network is None
        if found.modes is None and tracked is None and must_register:
            assert found.error is not None
            raise found.error
        own = None if found.modes is None else _Tracked.of_frame(found, time_s, self.config, self.registrar.config)
        if (
            tracked is not None
            and self._takes(tracked)
            and (own is None or own.score <= tracked.score + self.config.margin)
        ):
            return self._gone_on(seen, tracked, started, restart=True)
        return self._begun(seen, found, own, likelier, started)

    def _tracked(self, seen: Observation, time_s: float, keep_all: bool) -> "_Tracked | None":
        """The frame fitted from the last state; None without one that leads here."""
        track, config = self._track, self.config
        if track is None or seen.frame.axes != self._axes or not 0 <= time_s - track.time_s <= config.longest_s:
            return None
        points = transform_points(self._T_camera_input, seen.cloud.points)
        keep = np.ones(len(points), dtype=bool) if keep_all else gated(track, points, time_s, config)
        if keep.sum() < MIN_POINTS:
            return None
        lines = seen.lines.transformed(self._T_camera_input)
        fitted, after = next_fit(track, points[keep], points[~keep], time_s, config, lines)
        return _Tracked(fitted, after, Reading(seen.cloud, keep))

    def _believed(self, tracked: "_Tracked") -> bool:
        """Whether the frame need not be fitted by itself."""
        if not (tracked.registration.accepted or self.registrar.asks_network or self.registrar.method == "modes"):
            return False  # a search's answer is taken in any case, as nobody else has one
        return self._takes(tracked) and tracked.score >= self._best - self.config.drop

    def _takes(self, candidate: "_Tracked") -> bool:
        return self.registrar.takes(candidate.registration)

    def _gone_on(self, seen: Observation, tracked: "_Tracked", started: float, restart: bool = False) -> Answer:
        """Answer that the last frame's state led to."""
        self._track = tracked.track
        self._best = tracked.score if restart else max(self._best, tracked.score)
        model = self.registrar.network
        stated = self.registrar.stated_scene_unit(seen.frame.unit_m)
        calibration = None if model is None else model.calibration
        recognition = recognize(tracked.registration, calibration, stated_scene_unit=stated)
        seen = in_found_unit(seen, self.registrar, tracked.registration, recognition)
        return Answer(
            seen=seen.read_as(tracked.hypothesis),
            model=model,
            registrar=self.registrar,
            hypothesis=tracked.hypothesis,
            T_camera_input=self._T_camera_input,
            registration=tracked.registration,
            taken=True,
            recognition=recognition,
            found_by=self._found_by,
            seconds=time.perf_counter() - started,
        )

    def _begun(
        self, seen: Observation, found: Candidate, own: "_Tracked | None", likelier: EncodedFrame, started: float
    ) -> Answer:
        """Answer of a frame by itself; the track begins with it, or ends where it is not believed."""
        registration = None if own is None else own.registration
        answer = answer_of(seen, self.registrar.network, self.registrar, found, likelier, registration)
        self._track = own.track if own is not None and answer.taken else None
        self._T_camera_input, self._axes = found.encoded.T_camera_input, seen.frame.axes
        self._best, self._found_by = 0.0 if own is None else own.score, found.found_by
        return replace(answer, seconds=time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class _Tracked:
    """Fit that may be a frame's answer, the track that goes on from it, and the points that it is of."""

    fitted: ModesFit
    track: Track
    hypothesis: Reading

    @classmethod
    def of_frame(cls, found: Candidate, time_s: float, config: TrackConfig, clean: FitConfig) -> "_Tracked":
        """Candidate of a frame that was fitted by itself."""
        assert found.modes is not None
        fitted = replace(found.modes, rest=None)
        return cls(fitted, Track.of(fitted, time_s, config, clean), found.hypothesis)

    @cached_property
    def registration(self) -> Registration:
        return self.fitted.registration()

    @property
    def score(self) -> float:
        """Share of all points of the frame that are explained."""
        return self.registration.explained * float(self.hypothesis.keep.mean())
