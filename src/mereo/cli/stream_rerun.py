"""A stream as a Rerun recording: what was seen, found and doubted, and how long it took, on the frames' own time.

    Outcome -RerunLog.add-> entities of a recording, in a file that `rerun FILE.rrd` opens, or in a viewer

| entity | what |
|---|---|
| ``camera``, ``camera/depth`` | intrinsics and depth image in metres, where the frame is one |
| ``cloud``, ``strays`` | points that are taken for the object's, and the others; the input's frame and unit |
| ``object/NAME`` | mesh of each segment that was found, in its colour |
| ``answer/...``, ``points/...``, ``milliseconds/...`` | numbers of each frame (``series``) |
| ``log`` | doubt, errors, and when the object was found (``messages``) |
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from mereo.cli.stream_answers import FrameAnswer
from mereo.fitting.registration.recognition import NOT_ASKED
from mereo.geometry.camera import Camera, DepthImage
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import Segment, vertex_normals
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.writers.meshes import OUTER_OPACITY
from mereo.reconstruction.stream import Outcome

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
    beside = rrb.Vertical(
        rrb.Spatial2DView(origin="camera", name="depth image"),
        rrb.Tabs(*curves, active_tab=0),
        rrb.TextLogView(origin="log", name="log"),
    )
    # with the camera, which is far away, the view would begin with a small object
    space = rrb.Spatial3DView(origin="/", contents=["/cloud", "/strays", "/object/**"], name="object")
    return rrb.Blueprint(rrb.Horizontal(space, beside, column_shares=[3, 2]), collapse_panels=True)


class RerunLog:
    """Log of a stream's outcomes; each is at its frame's time, and at its number.

    Attributes:
        recording: what it is written to.
    """

    def __init__(self, recording: Any, axes: CloudAxes) -> None:
        """Log whose clouds have these axes."""
        self._rerun, self.recording = import_rerun(), recording
        self._number, self._found = 0, dict[str, Segment]()
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
            self._found.clear()
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
        segments = () if answer.surfaces is None else answer.surfaces.segments
        present = {segment.name: segment for segment in segments if len(segment.faces)}
        for name in self._found.keys() - present.keys():
            self._log(("object", name), self._rerun.Clear(recursive=True))
        self._found = {name: one for name, one in self._found.items() if name in present}
        for index, segment in enumerate(segments):
            if segment.name not in present:
                continue
            before = self._found.get(segment.name)
            lasting = {} if before is not None and np.array_equal(before.faces, segment.faces) else faces_of(segment)
            moving = {
                "vertex_positions": segment.vertices,
                "vertex_normals": vertex_normals(segment),
                **shading(answer, index),
            }
            self._log(("object", segment.name), self._rerun.Mesh3D.from_fields(**lasting, **moving))
            self._found[segment.name] = segment

    def _log(self, entity: str | tuple[str, ...], value: Any, static: bool = False) -> None:
        # names of segments may hold slashes and blanks: as a list they are one part of the path each
        self.recording.log(list(entity) if isinstance(entity, tuple) else entity, value, static=static, strict=True)


def faces_of(segment: Segment) -> dict[str, Any]:
    """Fields of a mesh that stay while it moves."""
    return {"triangle_indices": segment.faces.astype(np.uint32)}


def shading(answer: FrameAnswer, index: int) -> dict[str, Any]:
    """Fields of a segment's mesh that colour it; those by values at its vertices (``vertex_colors``) belong here."""
    assert answer.surfaces is not None
    opacity = 255 if answer.surfaces.opaque[index] else round(255 * OUTER_OPACITY)
    return {"albedo_factor": (*answer.surfaces.segments[index].color, opacity)}


def series(outcome: Outcome[FrameAnswer]) -> dict[str, float]:
    """Numbers of a frame, by the entity that shows them as a curve; milliseconds add up to the latency.

    What else is known of an answer by a number for each frame belongs here.
    """
    found = outcome.result
    facts: dict[str, float] = {"points/dropped_frames": outcome.dropped}
    parts = {"latency": outcome.latency_s, "waiting": outcome.latency_s - outcome.work_s}
    if found is None:
        parts["failing"] = outcome.work_s
    else:
        parts |= {"decoding": outcome.work_s - found.seconds, "answering": found.seconds}
        facts |= {"points/object": int(found.reading.keep.sum()), "points/strays": found.strays}
        facts["answer/tracked"] = float(found.tracked)
        if found.explained is not None:
            facts["answer/explained"] = found.explained
        if found.recognition is not NOT_ASKED:
            facts["answer/known"] = 0.5 if found.recognition.known == "unsure" else float(found.recognition.known)
        if found.radius95 is not None:
            facts |= {f"radius95/{name}": float(found.radius95[name]) for name in ("median", "max")}
    return facts | {f"milliseconds/{name}": 1e3 * seconds for name, seconds in parts.items()}


def messages(outcome: Outcome[FrameAnswer]) -> Iterator[tuple[str, str]]:
    """Sentences about a frame, with their severity (INFO, WARN, ERROR); the frame's name begins each."""
    found = outcome.result
    if found is None:
        yield "ERROR", f"{outcome.name}: {outcome.error}"
        return
    if found.recognition.told is not None and found.recognition is not NOT_ASKED:
        yield "WARN", f"{outcome.name}: {found.recognition.told}"
    if found.tracking == "found" and found.explained is not None:  # else a network alone is asked for every frame
        yield "INFO", f"{outcome.name}: the object was found; the answer is by {found.method}"
