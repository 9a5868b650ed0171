"""What ``mereo stream`` says of a frame: of the registered model that is followed, or of the network's surfaces."""

import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FoundBy, Tracking
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import NOT_ASKED, Recognition
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor, Tracker
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import owned_centroids
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.pipeline import Reconstruction

DIGITS = 6
"""Digits of a printed coordinate."""


class Seen(NamedTuple):
    """Content of a frame, and when it was recorded, in seconds from any zero."""

    observation: Observation
    time_s: float


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """Answer to a frame of a stream, in the input's frame and units.

    Attributes:
        surfaces: of all segments; None where the object is lost and no network answers.
        segments: facts of each that was found, by its name: ``centroid``, ``volume``, and the network's ``confidence``
            where the answer is the network's.
        reading: the frame's points, and which of them are taken for the object's.
        method: "modes" of the registered model, or "network"; None without surfaces.
        tracking: whether the object was found anew, followed from the last frame, or is lost.
        explained: share of the observed points that the registered model explains; None without one.
        recognition: whether the frame shows the object, in a state that was learned.
        radius95: median and greatest radius of 95 % of the surface, input unit, and whether they are calibrated; None
            where it was not asked for, or not known.
        observation: what was answered.
        seconds: of the answer alone, without decoding the frame.
        found_by: who found the object when it began to be followed; None where the answer is the network's own.
    """

    surfaces: SegmentedMesh | None
    segments: dict[str, Any]
    reading: Reading
    method: str | None
    tracking: Tracking
    explained: float | None
    recognition: Recognition = NOT_ASKED
    radius95: dict[str, float | bool] | None = None
    observation: Observation | None = None
    seconds: float = 0.0
    found_by: FoundBy | None = None

    @property
    def tracked(self) -> bool:
        """Whether the last frame's state led to it, so that neither network nor search was asked."""
        return self.tracking == "followed"

    @property
    def strays(self) -> int:
        """Number of points that were dropped."""
        return self.reading.dropped

    @classmethod
    def of_network(
        cls,
        found: Reconstruction,
        explained: float | None = None,
        recognition: Recognition = NOT_ASKED,
        tracking: Tracking = "found",
    ) -> "FrameAnswer":
        """Answer that is the network's; ``explained`` is of a registration that was not taken."""
        segments = {
            segment.name: {
                **_facts(segment.centroid, float(segment.volume)),
                "confidence": round(float(segment.confidence), 3),
            }
            for segment in found.segments
            if segment.voxels
        }
        return cls(found.surfaces, segments, found.reading, "network", tracking, explained, recognition)

    @classmethod
    def of_registration(cls, found: Answer, uncertainty: bool = False) -> "FrameAnswer":
        """Answer that is the registered model; with ``uncertainty`` it says how sure that is."""
        assert found.registration is not None
        mesh, registration = found.surfaces, found.registration
        centroids, volumes = owned_centroids(mesh), mesh.owned_volumes
        segments = {
            name: _facts(centroid, float(volume))
            for name, centroid, volume in zip(mesh.names, centroids, volumes, strict=True)
        }
        explained, sure = round(registration.explained, 4), registration.uncertainty if uncertainty else None
        for one in () if sure is None else sure.segments:
            segments[one.name] |= {"centroid_radius95": round(one.centroid_radius95, DIGITS), "volume95": one.volume95}
        radius95 = None if sure is None else sure.summary(sure.outline)
        method, known = registration.method, found.recognition
        followed = cls(mesh, segments, found.hypothesis, method, found.tracking, explained, known, radius95)
        return replace(followed, found_by=found.found_by)


def _facts(centroid: Float[np.ndarray, "3"], volume: float) -> dict[str, Any]:
    return {"centroid": [round(float(value), DIGITS) for value in centroid], "volume": volume}


class Answering:
    """Answers frames one after the other, following the object where there is a registrar."""

    def __init__(
        self,
        model: Trained | None,
        registrar: Registrar | None,
        resolution: int,
        keep_all: bool = False,
        uncertainty: bool = False,
        waits: bool = False,
    ) -> None:
        """Answering with a network, a registrar or both; without a registrar the network alone answers each frame.

        ``waits`` lets each frame of a lost object wait for its search, so that answers do not depend on their speed.
        """
        self.model, self.resolution, self.keep_all, self.uncertainty = model, resolution, keep_all, uncertainty
        executor = SynchronousExecutor() if waits else None
        self.tracker = None if registrar is None else Tracker(registrar, executor=executor)

    def __call__(self, seen: Seen) -> FrameAnswer:
        """Answer to a frame; raises ``ValueError`` for unusable clouds, and where nothing is found."""
        started = time.perf_counter()
        answer = self._answer(seen)
        return replace(answer, observation=seen.observation, seconds=time.perf_counter() - started)

    def _answer(self, seen: Seen) -> FrameAnswer:
        if self.tracker is None:
            found = answer_frame(seen.observation, self.model, None, keep_all=self.keep_all)
        else:
            found = self.tracker.follow(seen.observation, seen.time_s, keep_all=self.keep_all)
        if found.taken:
            return FrameAnswer.of_registration(found, self.uncertainty)
        explained = None if found.registration is None else round(found.registration.explained, 4)
        if found.is_missing:
            return FrameAnswer(None, {}, found.hypothesis, None, found.tracking, None, found.recognition)
        surfaces = replace(found, resolution=self.resolution).reconstruction
        return FrameAnswer.of_network(surfaces, explained, found.recognition, found.tracking)

    def close(self) -> None:
        """End the search for a lost object, where one goes on."""
        if self.tracker is not None:
            self.tracker.close()
