"""``mereo stream``: a reconstruction of the latest frame, again and again, printed and written.

    Observation, time -Answering-> FrameAnswer -> a line of JSON, surfaces as GLB files, a Rerun recording

| entity of a recording | what |
|---|---|
| ``camera``, ``camera/depth`` | intrinsics and depth image in metres, where the frame is one |
| ``cloud``, ``strays`` | points that are taken for the object's, and the others; the input's frame and unit |
| ``object/NAME`` | mesh of each segment that was found, in its colour |
| ``answer/...``, ``points/...``, ``milliseconds/...`` | numbers of each frame (``series``) |
| ``log`` | doubt, errors, and when the object was found (``messages``) |
"""

import json
import re
import socket
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import Float

from mereo.cli.answers import StreamCommand
from mereo.cli.options import check_named, loaded_object
from mereo.fitting.config import LocatedBy, Tracking
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import NOT_EVALUATED, Recognition
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor, Tracker
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import Segment, SegmentedMesh, vertex_normals
from mereo.geometry.solids import owned_centroids
from mereo.io.atomic_files import atomic_file, check_file_place, check_place, remove_abandoned, to_json
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.io.writers.meshes import OUTER_OPACITY
from mereo.models.trained import Trained
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.stream import (
    STANDARD_INPUT,
    Counter,
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
    ``FileExistsError`` for a folder of surfaces with content or a recording that is there, without ``force``; and as
    ``RerunTarget`` does.
    """
    check_named("stream", command.object, command.weights)
    source, reading, every_frame = command.input, command.reading, command.every_frame
    if source != STANDARD_INPUT and is_recording_folder(Path(source)):  # of ``mereo scene record``
        reading = replace(reading, intrinsics=reading.intrinsics or Path(source) / CAMERA)
        source = str(Path(source) / FRAMES)
    folder = None if command.surfaces is None else SurfaceFolder(command.surfaces, command.force)
    target = None if command.rerun is None else RerunTarget(command.rerun, command.force)
    known = loaded_object(command.object, command.weights, None, command.units, command.inference)
    frames: Iterable[StreamFrame[Observation] | None] = (
        watched_frames(source, reading, command.isolation)
        if command.watch
        else frames_of(source, reading, command.isolation, command.rate)
    )
    timed = (None if frame is None else _timed(frame) for frame in frames)
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
    outcomes: Iterator[Outcome[FrameAnswer]] = stream(timed, answer, recorded_pace=pace, every_frame=every_frame)
    opened = nullcontext() if target is None else target.opened(Path(source).name, reading.frame)
    with closing(answer), opened as log:
        broken_off, summary = answer_all(outcomes, folder, log, reading.frame)
        if not summary.answered and broken_off is not None:
            raise broken_off  # nothing is recorded
    if broken_off is not None:
        raise broken_off
    return summary


def answer_all(
    outcomes: Iterable[Outcome["FrameAnswer"]],
    folder: "SurfaceFolder | None",
    log: "RerunLog | None",
    axes: CloudAxes,
) -> tuple[Exception | None, Summary]:
    """Print and write outcomes until they end or Ctrl-C: what went wrong with all of them, the summary."""
    counter, last_error = Counter(), ""
    broken_off: Exception | None = None
    try:
        for answered in outcomes:
            outcome = answered if folder is None else folder.written(answered, axes)
            counter.add(outcome)
            last_error = outcome.error or last_error
            if log is not None:
                log.add(outcome)
            print(json.dumps(to_json(line(outcome))), flush=True)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    except BrokenPipeError:  # nobody reads the answers any more
        raise
    except (ValueError, OSError) as problem:
        broken_off = problem
    summary = counter.summary()
    print(summary, file=sys.stderr)
    if not summary.answered and broken_off is None and last_error:
        broken_off = ValueError(f"none of the {summary.failed} frames could be answered; the last one: {last_error}")
    return broken_off, summary


def line(outcome: Outcome["FrameAnswer"]) -> dict[str, Any]:
    """JSON that is printed of one frame; lengths in the input's unit, times in milliseconds."""
    facts: dict[str, Any] = {
        "frame": outcome.name,
        "time_s": outcome.time_s,
        "latency_ms": round(1e3 * outcome.latency_s, 1),
        "work_ms": round(1e3 * outcome.work_s, 1),
        "dropped": outcome.dropped,
    }
    answer = outcome.result
    if answer is None:
        return {**facts, "error": outcome.error}
    facts |= {
        "method": answer.method,
        "tracked": answer.tracked,
        "tracking": answer.tracking,
        "explained": answer.explained,
        "known": answer.recognition.known,
        "reason": answer.recognition.reason,
    }
    optional = {"located_by": answer.located_by, "radius95": answer.radius95}
    facts |= {name: value for name, value in optional.items() if value is not None}
    return {**facts, "strays": answer.strays, "segments": answer.segments}


# --- answers ----------------------------------------------------------------------------------------------------------

DIGITS = 6
"""Digits of a printed coordinate."""


class Seen(NamedTuple):
    """Content of a frame, and when it was recorded, in seconds from any zero."""

    observation: Observation
    time_s: float


def _timed(frame: StreamFrame[Observation]) -> StreamFrame[Seen]:
    """The frame, whose content says when it was recorded."""
    return StreamFrame(frame.name, frame.time_s, lambda: Seen(frame.load(), frame.time_s))


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
        explained: share of the observed points that the registered model explains, also of one that was not taken;
            None without one.
        recognition: whether the frame shows the object, in a state that was learned.
        radius95: median and greatest radius of 95 % of the surface, input unit, and whether they are calibrated; None
            where it was not asked for, or not known.
        observation: what was answered.
        seconds: of the answer alone, without decoding the frame.
        located_by: who found the object when it began to be followed; None where the answer is the network's own.
    """

    surfaces: SegmentedMesh | None
    segments: dict[str, Any]
    reading: Reading
    method: str | None
    tracking: Tracking
    explained: float | None
    recognition: Recognition = NOT_EVALUATED
    radius95: dict[str, float | bool] | None = None
    observation: Observation | None = None
    seconds: float = 0.0
    located_by: LocatedBy | None = None

    @property
    def tracked(self) -> bool:
        """Whether the last frame's state led to it, so that neither network nor search was asked."""
        return self.tracking == "followed"

    @property
    def strays(self) -> int:
        """Number of points that were dropped."""
        return self.reading.dropped

    @classmethod
    def of(cls, answer: Answer, uncertainty: bool = False) -> "FrameAnswer":
        """Facts of an answer; with ``uncertainty`` also how sure the registered model is."""
        registration = answer.registration
        explained = None if registration is None else round(registration.explained, 4)
        facts = cls(None, {}, answer.hypothesis, None, answer.tracking, explained, answer.recognition)
        if answer.is_missing:
            return replace(facts, explained=None)
        if registration is None or not answer.taken:
            network = answer.reconstruction
            segments = {
                segment.name: {
                    **_facts(segment.centroid, float(segment.volume)),
                    "confidence": round(float(segment.confidence), 3),
                }
                for segment in network.segments
                if segment.voxels
            }
            return replace(facts, surfaces=network.surfaces, segments=segments, method="network")
        mesh, sure = answer.surfaces, registration.uncertainty if uncertainty else None
        segments = {
            name: _facts(centroid, float(volume))
            for name, centroid, volume in zip(mesh.names, owned_centroids(mesh), mesh.owned_volumes, strict=True)
        }
        for each in () if sure is None else sure.segments:
            radius = round(each.centroid_radius95, DIGITS)
            segments[each.name] |= {"centroid_radius95": radius, "volume95": each.volume95}
        radius95 = None if sure is None else sure.summary(sure.outline)
        return replace(
            facts,
            surfaces=mesh,
            segments=segments,
            method=registration.method,
            radius95=radius95,
            located_by=answer.located_by,
        )


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
        if self.tracker is None:
            answer = answer_frame(seen.observation, self.model, None, keep_all=self.keep_all)
        else:
            answer = self.tracker.follow(seen.observation, seen.time_s, keep_all=self.keep_all)
        facts = FrameAnswer.of(replace(answer, resolution=self.resolution), self.uncertainty)
        return replace(facts, observation=seen.observation, seconds=time.perf_counter() - started)

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
        remove_abandoned(path)
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


# --- Rerun ------------------------------------------------------------------------------------------------------------

SUFFIX, SCHEMES, PORT = ".rrd", ("rerun", "rerun+http", "rerun+https"), 9876
"""Ending of a recording's file; schemes of a viewer's address, and the port that a viewer listens on by default."""

REACH_S, FLUSH_S = 2.0, 60.0
"""Time in which a viewer must take a connection, and one in which what was logged must have reached file or viewer."""

DATED_S = 1e8
"""Seconds, three years, from which on a frame's time is one since 1970, as in ROS recordings, and shown as a date."""

CURVES = ("answer", "milliseconds", "points", "radius95")
"""Roots of the entities of ``series``: each is a view of its own, as their numbers have other units."""

CLOUD_COLOR, STRAY_COLOR, POINT_PX = (200, 200, 200), (230, 60, 60), 1.5


def import_rerun() -> Any:
    """Module of Rerun's SDK; raises ``ImportError`` with a sentence on how to get it."""
    try:
        import rerun
    except ImportError:
        raise ImportError(
            "the Rerun SDK, which --rerun needs, is not installed: run pip install 'mereo[rerun]'"
        ) from None
    return rerun


class RerunTarget:
    """Destination of a recording: a new file, or the address of a viewer that is open.

    Attributes:
        text: as it was given: ``stream.rrd``, or ``rerun+http://127.0.0.1:9876/proxy``.
        force: replace a file that is there.
    """

    def __init__(self, text: str, force: bool = False) -> None:
        """Check a destination before any work; what is read is never replaced, as no frame is an .rrd file.

        Raises ``ImportError`` without the SDK, ``ValueError`` for what is neither, ``FileExistsError`` for a file that
        is there, without ``force``, and ``OSError`` for a viewer that does not answer.
        """
        self.text, self.force = text, force
        import_rerun()
        if self.is_address:
            self._check_viewer()
        elif Path(text).suffix.lower() == SUFFIX:
            check_file_place(text, force=force)
        else:
            raise ValueError(
                f"{text} is no place for a Rerun recording: name a file that ends in {SUFFIX}, or the address of an "
                f"open viewer, rerun+http://127.0.0.1:{PORT}/proxy"
            )

    @property
    def is_address(self) -> bool:
        """Whether it is a viewer."""
        return urlsplit(self.text).scheme in SCHEMES and "://" in self.text

    @contextmanager
    def opened(self, name: str, axes: CloudAxes) -> Iterator["RerunLog"]:
        """Log of a stream; its file appears when the block succeeds.

        Args:
            name: of the recording, for people.
            axes: of the clouds.

        Raises ``OSError`` where what was logged cannot be written or sent.
        """
        if self.is_address:
            with _recording(name) as recording:
                recording.connect_grpc(self.text, default_blueprint=blueprint())
                yield RerunLog(recording, axes)
        else:
            with atomic_file(self.text, force=self.force) as partial, _recording(name) as recording:
                recording.save(partial, default_blueprint=blueprint())
                yield RerunLog(recording, axes)

    def _check_viewer(self) -> None:
        """Raise ``OSError`` where nobody listens: the SDK would wait for ever."""
        address = urlsplit(self.text)
        try:
            socket.create_connection((address.hostname or "", address.port or PORT), REACH_S).close()
        except (OSError, ValueError) as problem:
            raise OSError(
                f"no Rerun viewer can be reached at {self.text} ({problem}): start one (rerun --bind 127.0.0.1), or "
                f"name a file that ends in {SUFFIX}"
            ) from None


@contextmanager
def _recording(name: str) -> Iterator[Any]:
    """Recording that is complete where the block ends, however it does."""
    rerun = import_rerun()
    recording = rerun.RecordingStream("mereo")
    try:
        yield recording
        recording.send_recording_name(name)
        try:
            recording.flush(timeout_sec=FLUSH_S)
        except RuntimeError as problem:
            raise OSError(f"the Rerun recording could not be completed ({problem}): is there room for it?") from None
    finally:
        recording.disconnect()


def blueprint() -> Any:
    """Arrangement of the viewer: the object beside depth image, curves and messages."""
    import_rerun()
    import rerun.blueprint as rrb

    curves = [rrb.TimeSeriesView(origin=origin, name=origin) for origin in CURVES]
    panels = rrb.Vertical(
        rrb.Spatial2DView(origin="camera", name="depth image"),
        rrb.Tabs(*curves, active_tab=0),
        rrb.TextLogView(origin="log", name="log"),
    )
    # with the camera, which is far away, the view would begin with a small object
    space = rrb.Spatial3DView(origin="/", contents=["/cloud", "/strays", "/object/**"], name="object")
    return rrb.Blueprint(rrb.Horizontal(space, panels, column_shares=[3, 2]), collapse_panels=True)


class RerunLog:
    """Log of a stream's outcomes; each is at its frame's time, and at its number.

    Attributes:
        recording: what it is written to.
    """

    def __init__(self, recording: Any, axes: CloudAxes) -> None:
        """Log whose clouds have these axes."""
        self._rerun, self.recording = import_rerun(), recording
        self._number, self._segments = 0, dict[str, Segment]()
        self._camera: Camera | None = None
        coordinates = self._rerun.ViewCoordinates
        self._log("/", coordinates.RDF if axes == "camera" else coordinates.RIGHT_HAND_Y_UP, static=True)

    def add(self, outcome: Outcome[FrameAnswer]) -> None:
        """Log an answered or failed frame; of a failed one nothing is shown but its error."""
        kind = "duration" if abs(outcome.time_s) < DATED_S else "timestamp"
        self.recording.set_time("frame_time", **{kind: outcome.time_s})
        self.recording.set_time("frame", sequence=self._number)
        self._number += 1
        for name, value in series(outcome).items():
            self._log(name, self._rerun.Scalars(value))
        for level, text in messages(outcome):
            self._log("log", self._rerun.TextLog(text, level=level))
        if outcome.result is None:
            for entity in ("camera/depth", "cloud", "strays", "object"):
                self._log(entity, self._rerun.Clear(recursive=True))
            self._segments.clear()
        else:
            self._add_frame(outcome.result)
            self._add_object(outcome.result)

    def _add_frame(self, answer: FrameAnswer) -> None:
        points, keep = answer.reading.whole.points, answer.reading.keep
        for entity, rows, color in (("cloud", keep, CLOUD_COLOR), ("strays", ~keep, STRAY_COLOR)):
            radius = self._rerun.Radius.ui_points(POINT_PX)
            self._log(entity, self._rerun.Points3D(points[rows], colors=color, radii=radius))
        if answer.observation is not None and (depth := answer.observation.frame.depth) is not None:
            self._add_depth(depth)

    def _add_depth(self, image: DepthImage) -> None:
        if image.camera != self._camera:
            self._camera = image.camera
            self._log("camera", self._pinhole(image.camera))
        seen = image.depth[image.depth > 0]
        span = (seen.min(), seen.max()) if len(seen) else None  # of the colours: 0 is no measurement
        self._log("camera/depth", self._rerun.DepthImage(image.depth.astype(np.float32), meter=1.0, depth_range=span))

    def _pinhole(self, camera: Camera) -> Any:
        # Rerun's pixels have their centres at +0.5 as well
        return self._rerun.Pinhole(
            focal_length=(camera.focal_x_px, camera.focal_y_px),
            principal_point=(camera.center_x_px, camera.center_y_px),
            resolution=(camera.width, camera.height),
            camera_xyz=self._rerun.ViewCoordinates.RDF,
        )

    def _add_object(self, answer: FrameAnswer) -> None:
        """Meshes of the segments; faces and colours only where they have changed, which those of a model never do."""
        mesh = answer.surfaces
        parts = () if mesh is None else zip(mesh.segments, mesh.opaque, strict=True)
        present = {segment.name: (segment, is_opaque) for segment, is_opaque in parts if len(segment.faces)}
        for name in self._segments.keys() - present.keys():
            self._log(("object", name), self._rerun.Clear(recursive=True))
            del self._segments[name]
        for name, (segment, is_opaque) in present.items():
            fields = {
                "vertex_positions": segment.vertices,
                "vertex_normals": vertex_normals(segment),
                "albedo_factor": (*segment.color, 255 if is_opaque else round(255 * OUTER_OPACITY)),
            }
            before = self._segments.get(name)
            if before is None or not np.array_equal(before.faces, segment.faces):
                fields["triangle_indices"] = segment.faces.astype(np.uint32)
            self._log(("object", name), self._rerun.Mesh3D.from_fields(**fields))
            self._segments[name] = segment

    def _log(self, entity: str | tuple[str, ...], value: Any, static: bool = False) -> None:
        # names of segments may hold slashes and blanks: as a list they are one part of the path each
        self.recording.log(list(entity) if isinstance(entity, tuple) else entity, value, static=static, strict=True)


def series(outcome: Outcome[FrameAnswer]) -> dict[str, float]:
    """Numbers of a frame, by the entity that shows them as a curve; milliseconds add up to the latency.

    What else is known of an answer by a number for each frame belongs here.
    """
    answer = outcome.result
    facts: dict[str, float] = {"points/dropped_frames": outcome.dropped}
    parts = {"latency": outcome.latency_s, "waiting": outcome.latency_s - outcome.work_s}
    if answer is None:
        parts["failing"] = outcome.work_s
    else:
        parts |= {"decoding": outcome.work_s - answer.seconds, "answering": answer.seconds}
        facts |= {"points/object": int(answer.reading.keep.sum()), "points/strays": answer.strays}
        facts["answer/tracked"] = float(answer.tracked)
        if answer.explained is not None:
            facts["answer/explained"] = answer.explained
        if answer.recognition is not NOT_EVALUATED:
            facts["answer/known"] = 0.5 if answer.recognition.known == "unsure" else float(answer.recognition.known)
        if answer.radius95 is not None:
            facts |= {f"radius95/{name}": float(answer.radius95[name]) for name in ("median", "max")}
    return facts | {f"milliseconds/{name}": 1e3 * seconds for name, seconds in parts.items()}


def messages(outcome: Outcome[FrameAnswer]) -> Iterator[tuple[str, str]]:
    """Sentences about a frame, with their severity (INFO, WARN, ERROR); the frame's name begins each."""
    answer = outcome.result
    if answer is None:
        yield "ERROR", f"{outcome.name}: {outcome.error}"
        return
    if answer.recognition.description is not None and answer.recognition is not NOT_EVALUATED:
        yield "WARN", f"{outcome.name}: {answer.recognition.description}"
    if answer.tracking == "found" and answer.explained is not None:  # else a network alone is asked for every frame
        yield "INFO", f"{outcome.name}: the object was found; the answer is by {answer.method}"
