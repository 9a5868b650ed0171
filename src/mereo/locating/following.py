"""Follow an object through whole depth images, in which everything else is seen as well.

frame, time -locate_object, the first time and where it is lost-> part of the frame -Tracker.follow-> Answer
"""

from dataclasses import replace
from typing import Any

from mereo.fitting import tracking
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import Track, TrackedFrame
from mereo.locating.whole_frame import NEAR, at_point, is_whole, locate_object, part_of, pixels_near
from mereo.reconstruction.observation import Observation


class Tracker(tracking.Tracker):
    """Tracker that takes whole frames as well: of these it follows the pixels near where the object is expected."""

    def locate(self, frame: TrackedFrame, registrar: Registrar) -> tuple[Observation, Candidate]:
        """What of a frame is taken for the object, where a whole frame has it; raises as ``find`` does."""
        if is_whole(frame.seen, registrar):
            return locate_object(frame.seen, registrar, frame.keep_all, frame.scene_unit)
        return super().locate(frame, registrar)

    def follow(self, seen: Observation, *arguments: Any, **named: Any) -> Answer:
        """Answer the next frame, as ``tracking.Tracker``; a point is where the object is in the first one."""
        seen = replace(seen, point=None) if self._has_begun else at_point(seen, self.registrar)
        return super().follow(seen, *arguments, **named)

    def _tracked(self, track: Track | None, frame: TrackedFrame, longest_s: float) -> Any:
        whole = frame.seen.frame.whole
        if track is not None and whole is not None and is_whole(frame.seen, self.registrar):
            model = track.problem.model
            posed = track.expected(frame.time_s, self.config)
            mesh = model.mesh(track.unit * posed.place(model.material(posed.z)))
            mask = pixels_near(whole, mesh, NEAR * model.half * track.unit)
            frame = replace(frame, seen=part_of(frame.seen, mask))
        return super()._tracked(track, frame, longest_s)
