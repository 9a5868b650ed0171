"""``mereo stream``: a reconstruction of the latest frame, again and again, printed and written.

StreamFrame -Answering-> FrameAnswer -> a line of JSON, surfaces as a GLB file
"""

import json
import re
import sys
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mereo.cli.answers import StreamCommand
from mereo.cli.options import check_named, loaded_object
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor, Tracker
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import owned_centroids
from mereo.io.atomic_files import atomic_file, check_place, remove_all_abandoned, to_json
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.trained import Trained
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.stream import (
    STANDARD_INPUT,
    Outcome,
    StreamFrame,
    Summary,
    frame_error,
    frames_of,
    stream,
    watched_frames,
)
from mereo.synthesis.recording import CAMERA, FRAMES, is_recording_folder


def stream_reconstructions(command: StreamCommand) -> Summary:
    """Print a line of JSON for each answered or bad frame, and the summary at the end or after Ctrl-C.

    Raises ``ValueError`` where not one frame could be answered, and what broke the sequence off, where something did;
    ``FileExistsError`` for a folder of surfaces with content, without ``force``.
    """
    check_named("stream", command.object, command.weights)
    source, reading, every_frame = command.input, command.reading, command.every_frame
    if source != STANDARD_INPUT and is_recording_folder(Path(source)):  # of ``mereo scene record``
        reading = replace(reading, intrinsics=reading.intrinsics or Path(source) / CAMERA)
        source = str(Path(source) / FRAMES)
    folder = None if command.surfaces is None else SurfaceFolder(command.surfaces, command.force)
    known = loaded_object(command.object, command.weights, None, command.units, command.inference)
    frames: Iterable[StreamFrame | None] = (
        watched_frames(source, reading, command.isolation)
        if command.watch
        else frames_of(source, reading, command.isolation, command.rate)
    )
    answer = Answering(
        known.network,
        known.registrar(command.method),
        command.resolution,
        command.isolation.keep_all,
        command.uncertainty,
        every_frame,
    )
    # what is written to standard input or into a watched folder arrives when it does
    pace = not every_frame and not command.watch and source != STANDARD_INPUT
    summary, last_error = Summary(), ""
    broken_off: Exception | None = None
    with closing(answer):
        try:
            for answered in stream(frames, answer, recorded_pace=pace, every_frame=every_frame):
                outcome = answered if folder is None else folder.written(answered, reading.frame)
                summary.add(outcome)
                last_error = outcome.error or last_error
                print(json.dumps(to_json(line(outcome))), flush=True)
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
        except BrokenPipeError:  # nobody reads the answers any more
            raise
        except (ValueError, OSError) as problem:
            broken_off = problem
        print(summary, file=sys.stderr)
    if not summary.answered and broken_off is None and last_error:
        broken_off = ValueError(f"none of the {summary.failed} frames could be answered; the last one: {last_error}")
    if broken_off is not None:
        raise broken_off
    return summary


def line(outcome: Outcome["FrameAnswer"]) -> dict[str, Any]:
    """JSON that is printed of one frame; lengths in the input's unit, times in milliseconds."""
    return {
        "frame": outcome.name,
        "time_s": outcome.time_s,
        "latency_ms": round(1e3 * outcome.latency_s, 1),
        "work_ms": round(1e3 * outcome.work_s, 1),
        "dropped": outcome.dropped,
        **({"error": outcome.error} if outcome.result is None else outcome.result.facts),
    }


# --- answers ----------------------------------------------------------------------------------------------------------

DIGITS = 6
"""Digits of a printed coordinate."""


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """Answer to a frame of a stream, in the input's frame and units.

    Attributes:
        surfaces: of all segments; None where the object is lost and no network answers.
        facts: what is printed: who answers (``method``), how it was tracked, the share of points that the registered
            model explains, whether the frame shows the object, points that were dropped, and each segment's
            ``centroid`` and ``volume``, with the network's ``confidence`` where the answer is the network's.
    """

    surfaces: SegmentedMesh | None
    facts: dict[str, Any]

    @classmethod
    def of(cls, answer: Answer, uncertainty: bool = False) -> "FrameAnswer":
        """Facts of an answer; with ``uncertainty`` also how sure the registered model is, where that is known."""
        registration, is_missing = answer.registration, answer.is_missing
        facts: dict[str, Any] = {
            "method": None if is_missing else "network",
            "tracked": answer.tracked,
            "tracking": answer.tracking,
            "explained": None if registration is None or is_missing else round(registration.explained, 4),
            "known": answer.recognition.known,
            "reason": answer.recognition.reason,
        }
        strays, segments = answer.hypothesis.dropped, dict[str, dict[str, Any]]()
        if is_missing:
            return cls(None, {**facts, "strays": strays, "segments": segments})
        mesh = answer.surfaces
        if registration is None or not answer.taken:
            for segment in answer.reconstruction.segments:
                if segment.voxels:
                    segments[segment.name] = _facts(segment.centroid, float(segment.volume))
                    segments[segment.name]["confidence"] = round(float(segment.confidence), 3)
            return cls(mesh, {**facts, "strays": strays, "segments": segments})
        facts |= {"method": registration.method, "located_by": answer.located_by}
        for name, centroid, volume in zip(mesh.names, owned_centroids(mesh), mesh.owned_volumes, strict=True):
            segments[name] = _facts(centroid, float(volume))
        if uncertainty and (sure := registration.uncertainty) is not None:
            for each in sure.segments:
                radius = round(each.centroid_radius95, DIGITS)
                segments[each.name] |= {"centroid_radius95": radius, "volume95": each.volume95}
            facts["radius95"] = sure.summary(sure.outline)
        return cls(mesh, {**facts, "strays": strays, "segments": segments})


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

    def __call__(self, frame: StreamFrame) -> FrameAnswer:
        """Answer to a frame; raises ``ValueError`` for unusable clouds, and where nothing is found."""
        seen: Observation = frame.load()
        if self.tracker is None:
            answer = answer_frame(seen, self.model, None, keep_all=self.keep_all)
        else:
            answer = self.tracker.follow(seen, frame.time_s, keep_all=self.keep_all)
        return FrameAnswer.of(replace(answer, resolution=self.resolution), self.uncertainty)

    def close(self) -> None:
        """End the search for a lost object, where one goes on."""
        if self.tracker is not None:
            self.tracker.close()


# --- surfaces ---------------------------------------------------------------------------------------------------------


class SurfaceFolder:
    """Folder for the surfaces of answered frames, one file each; what is in it is kept, unless ``force`` is given.

    Attributes:
        path: of the folder; it is made when the first surfaces are written.
        force: replace files that are there; nothing else in the folder is touched.
    """

    def __init__(self, path: Path, force: bool) -> None:
        self.path, self.force = path, force
        self._frames: dict[str, str] = {}
        check_place(path, may_be_link=True)
        if path.exists() and not path.is_dir():
            raise FileExistsError(f"{path} is a file; surfaces are written into a folder: choose another --surfaces")
        remove_all_abandoned(path)
        if path.is_dir() and any(path.iterdir()) and not force:
            raise FileExistsError(
                f"{path} exists and is not empty; nothing in it is overwritten: choose another --surfaces or pass "
                "--force, which replaces the files of the same names"
            )

    def written(self, outcome: Outcome[FrameAnswer], axes: CloudAxes) -> Outcome[FrameAnswer]:
        """Write the surfaces of an answered frame; where that fails, the outcome is a failed one.

        A frame that comes again replaces its own file; two frames never share one.
        """
        if outcome.result is None:
            return outcome
        name = re.sub(r"[^\w.-]+", "_", outcome.name)
        try:
            owner = self._frames.get(name)
            if outcome.result.surfaces is None:
                if owner == outcome.name:  # no surfaces of an earlier state
                    (self.path / f"{name}.glb").unlink(missing_ok=True)
                return outcome
            if owner not in (None, outcome.name):
                raise FileExistsError(f"{self.path / name}.glb holds the surfaces of {owner}: rename {outcome.name}")
            with atomic_file(self.path / f"{name}.glb", force=self.force or owner is not None) as partial:
                write_segments_glb(partial, outcome.result.surfaces, viewer_rotation(axes))
            self._frames[name] = outcome.name
        except Exception as problem:
            return replace(outcome, result=None, error=frame_error(problem, outcome.name))
        return outcome
