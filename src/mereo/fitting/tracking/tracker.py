"""An object followed from frame to frame: each fit starts where the last one ended, and asks the network when lost.

    cloud, time -Tracker.follow-> Followed (registration, or what the network made of the frame)

What can be seen of a lost object is that the model explains fewer of the frame's points than it did. Then, and at
first, the frame is fitted by itself, as `mereo reconstruct` does, and the better of both is gone on with.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from mereo.fitting.config import FitChoice, FitConfig
from mereo.fitting.registration.fit import ModesFit
from mereo.fitting.registration.readings import FittedFrame, fitted_frame
from mereo.fitting.registration.recognition import NOT_ASKED, Recognition, recognize, recognized
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.tracking.config import TrackConfig
from mereo.fitting.tracking.next_fit import Track, gated, next_fit
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import MIN_POINTS, CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.models.model import Model
from mereo.reconstruction.strays import Reading, as_cloud


@dataclass(frozen=True, eq=False)
class Followed:
    """Answer to one frame of a sequence.

    Attributes:
        registration: of the object's model, by its modes, camera frame and input unit; None where none was found.
        taken: whether it is the answer; otherwise that is the network's, from ``asked``.
        asked: what the network made of the frame; None where the last state led to the answer.
        reading: the frame, and which of its points are taken for the object's.
        T_camera_input: from the input's frame to the camera frame.
        seconds: of the whole answer.
        refusal: why no registration was found.
        recognition: whether the frame shows the object, in a state that was learned.
    """

    registration: Registration | None
    taken: bool
    asked: FittedFrame | None
    reading: Reading
    T_camera_input: Float[np.ndarray, "4 4"]
    seconds: float
    refusal: str | None = None
    recognition: Recognition = NOT_ASKED

    def __repr__(self) -> str:
        told = "no registration" if self.registration is None else self.registration.told
        return f"Followed({told}, {'tracked' if self.tracked else 'network asked'}; {1e3 * self.seconds:.0f} ms)"

    @property
    def tracked(self) -> bool:
        """Whether the answer was reached from the last state, not from what the network says."""
        return self.asked is None

    @cached_property
    def surfaces(self) -> SegmentedMesh:
        """The segments of the registered model in the input's frame and unit; ``ValueError`` where none is taken."""
        if self.registration is None or not self.taken:
            raise ValueError("the frame has no registration that explains it: ask the network, mereo.reconstruct")
        return self.registration.mesh.transformed(inverse_rigid(self.T_camera_input))


class Tracker:
    """Follows one object through a sequence of frames; not safe for use by several threads at once.

    Attributes:
        registrar: of the object; its ``choice`` says whether a registration that does not explain its frame is taken.
            Draws and rest model are not asked: they take longer than the time between two frames.
        config: constants.
    """

    def __init__(self, registrar: Registrar, config: TrackConfig = TrackConfig()) -> None:  # noqa: B008 (frozen)
        # a frame that nobody understands comes 30 times a second while the object is away
        self.registrar = registrar.at_once
        self.config = config
        self.forget()

    @classmethod
    def of(cls, network: Model, choice: FitChoice = "auto") -> "Tracker":
        """Tracker of the object that weights were trained on; raises as ``Registrar.of`` does."""
        return cls(Registrar.of(network, choice))

    def forget(self) -> None:
        """Start anew: the next frame is fitted by itself."""
        self._track: Track | None = None
        self._T_camera_input, self._axes = np.eye(4), "camera"
        self._best = 0.0

    def follow(
        self,
        cloud: PointCloud | ArrayLike,
        time_s: float,
        axes: CloudAxes = "camera",
        *,
        scene_unit: float | None = None,
        stated_unit: float | None = None,
        keep_all: bool = False,
        unit_assumed: bool = False,
    ) -> Followed:
        """Answer to the next frame.

        Args:
            cloud: points on the object, any density, in one unit throughout the sequence.
            time_s: of the frame, from any zero; what is expected of the object depends on the time since the last one.
            axes: of the cloud.
            scene_unit: length of a scene unit in the cloud's unit, where it is known.
            stated_unit: the same as the input states it (``Registrar.stated_unit``).
            keep_all: drop no strays.
            unit_assumed: ``stated_unit`` is only assumed, see ``mereo.fitting.registration.answer.answer``.

        Raises ``ValueError`` for unusable clouds and, unless the registrar's choice is "auto", where a frame that is
        fitted by itself finds too little. The track is kept: the object may come again.
        """
        started = time.perf_counter()
        compared = None if unit_assumed else stated_unit
        seen = as_cloud(cloud if isinstance(cloud, PointCloud) else np.asarray(cloud, dtype=np.float64))
        tracked = self._tracked(seen, time_s, axes, keep_all)
        if tracked is not None and self._believed(tracked):
            return self._gone_on(tracked, started, compared)
        asked = fitted_frame(seen, self.registrar.network, self.registrar, axes, scene_unit, stated_unit, keep_all)
        if asked.modes is None and tracked is None and self.registrar.choice != "auto":
            assert asked.error is not None
            raise asked.error
        own = None if asked.modes is None else _Candidate.of_frame(asked, time_s, self.config, self.registrar.config)
        if (
            tracked is not None
            and self._takes(tracked)
            and (own is None or own.score <= tracked.score + self.config.margin)
        ):
            return self._gone_on(tracked, started, compared, restart=True)
        return self._begun(asked, own, axes, started, compared)

    def _tracked(self, seen: PointCloud, time_s: float, axes: CloudAxes, keep_all: bool) -> "_Candidate | None":
        """The frame fitted from the last state; None without one that leads here."""
        track, config = self._track, self.config
        if track is None or axes != self._axes or not 0 <= time_s - track.time_s <= config.longest_s:
            return None
        points = transform_points(self._T_camera_input, seen.points)
        keep = np.ones(len(points), dtype=bool) if keep_all else gated(track, points, time_s, config)
        if keep.sum() < MIN_POINTS:
            return None
        fitted, after = next_fit(track, points[keep], points[~keep], time_s, config)
        return _Candidate(fitted, after, Reading(seen, keep))

    def _believed(self, tracked: "_Candidate") -> bool:
        """Whether the network need not be asked."""
        return self._takes(tracked) and tracked.score >= self._best - self.config.drop

    def _takes(self, candidate: "_Candidate") -> bool:
        return self.registrar.takes(candidate.registration)

    def _gone_on(
        self, tracked: "_Candidate", started: float, stated_unit: float | None, restart: bool = False
    ) -> Followed:
        self._track = tracked.track
        self._best = tracked.score if restart else max(self._best, tracked.score)
        known = recognize(tracked.registration, self.registrar.network.calibration, stated_unit=stated_unit)
        seconds = time.perf_counter() - started
        T_camera_input = self._T_camera_input
        return Followed(tracked.registration, True, None, tracked.reading, T_camera_input, seconds, recognition=known)

    def _begun(
        self,
        asked: FittedFrame,
        own: "_Candidate | None",
        axes: CloudAxes,
        started: float,
        stated_unit: float | None,
    ) -> Followed:
        """Answer of a frame by itself; the track begins with it, or ends where it is not believed."""
        taken = own is not None and self._takes(own)
        self._track = own.track if own is not None and taken else None
        self._T_camera_input, self._axes = asked.seen.T_camera_input, axes
        self._best = 0.0 if own is None else own.score
        registration = None if own is None else own.registration
        reading = asked.reading if taken else asked.unaided.reading
        refusal = None if asked.error is None else str(asked.error)
        known = recognized(asked, registration, self.registrar.network, stated_unit)
        seconds = time.perf_counter() - started
        return Followed(registration, taken, asked, reading, asked.seen.T_camera_input, seconds, refusal, known)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Fit that may be a frame's answer, the track that goes on from it, and the points that it is of."""

    fitted: ModesFit
    track: Track
    reading: Reading

    @classmethod
    def of_frame(cls, asked: FittedFrame, time_s: float, config: TrackConfig, clean: FitConfig) -> "_Candidate":
        """Candidate of a frame that was fitted by itself."""
        assert asked.modes is not None
        fitted = replace(asked.modes, rest=None)
        return cls(fitted, Track.of(fitted, time_s, config, clean), asked.reading)

    @cached_property
    def registration(self) -> Registration:
        return self.fitted.registration()

    @property
    def score(self) -> float:
        """Share of all points of the frame that are explained."""
        return self.registration.explained * float(self.reading.keep.mean())
