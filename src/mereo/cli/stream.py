"""``mereo stream``: a reconstruction of the latest frame, again and again, printed and written.

    folder, recording, camera, names -frames_of, watched_frames-> StreamFrame -stream, Answering-> Outcome
    Outcome -> a line of JSON, surfaces as a GLB file

A reading thread waits for frames; the caller's thread answers. Between them there is room for one frame: a newer one
takes the place of one that still waits, so that an answer is never older than the last computation and memory never
grows, however slow the machine is. A bad frame is reported and passed over.
"""

import io
import json
import os
import queue
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from mereo.cli.answers import StreamCommand
from mereo.cli.options import check_named, loaded_object
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor
from mereo.geometry.conventions import CloudAxes, Pair, Texts
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import owned_centroids
from mereo.geometry.transforms import Transform, Vector
from mereo.io.atomic_files import JsonObject, atomic_file, check_place, remove_abandoned, to_json
from mereo.io.config import InputConfig
from mereo.io.errors import is_foreseen, words_of
from mereo.io.readers import CLOUD_READERS, DEPTH_READERS
from mereo.io.realsense import camera_frames, is_camera, is_live, resized
from mereo.io.ros_recordings import RecordedFrame, is_recording
from mereo.io.sensor_frame import SensorFrame, message_frame, read_frame, read_messages
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.locating.following import Tracker
from mereo.locating.whole_frame import at_point
from mereo.models.trained import Trained
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation, find_object
from mereo.results.joints import measure_joints, segment_poses
from mereo.scenes.parameters import with_frame_joints
from mereo.synthesis.recording import CAMERA, FRAMES, is_recording_folder

STANDARD_INPUT = "-"
"""Source that means names of files on standard input."""

RECENT = 10_000
"""Answers whose latencies a summary is made of: a stream may run for weeks in the same memory."""


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """Frame of a sequence, decoded when it is answered.

    Attributes:
        name: for people: a file, a number.
        time_s: when it was recorded, from any zero.
        load: decodes it; called for frames that are answered only.
        joints: reads the values of joints that are known at its time; None where none are.
    """

    name: str
    time_s: float
    load: Callable[[], Any]
    joints: Callable[[], Any] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of a frame: its answer or error, and the time it took.

    Attributes:
        name, time_s: of the frame.
        result: the answer; None where it failed.
        error: one sentence; empty where it did not fail.
        latency_s: from the frame's arrival to its answer, waiting included.
        work_s: the decoding and answering in it.
        dropped: frames that were replaced by newer ones since the last outcome.
    """

    name: str
    time_s: float
    result: Any
    error: str
    latency_s: float
    work_s: float
    dropped: int


Arrived = tuple[StreamFrame, float, int]
"""Frame, when it came by ``time.perf_counter``, and how many gave way to newer ones before it."""


Frames = Iterator[StreamFrame | None]
"""A sequence, with a None where nothing new has come."""


def stream(
    frames: Iterable[StreamFrame | None],
    answer: Callable[[StreamFrame], Any],
    *,
    recorded_pace: bool = False,
    every_frame: bool = False,
) -> Iterator[Outcome]:
    """Answer the latest frame, again and again, until the sequence ends.

    Args:
        frames: the sequence; iterated in a thread of its own, which may wait for the camera. A None says that nothing
            new has come, and lets a thread that waits see that the stream has been left.
        answer: from a frame, which it decodes, to whatever is wanted.
        recorded_pace: frames arrive when their times say, counted from the first; else as fast as they are read.
        every_frame: none is dropped; the sequence waits for the answers, without a thread.

    Yields one outcome per answered or failed frame. Whatever goes wrong in one frame is its outcome's error; what goes
    wrong in the sequence itself is raised after the outcomes before it.
    """
    source = _paced(frames) if recorded_pace else iter(frames)
    each = ((frame, time.perf_counter(), 0) for frame in source if frame is not None)
    arriving = each if every_frame else _latest(source)
    with closing(arriving):
        for frame, arrived_s, dropped in arriving:
            start = time.perf_counter()
            result = None
            error = ""
            try:
                result = answer(frame)
            except Exception as problem:  # a damaged frame makes the libraries that parse it raise anything
                error = frame_error(problem, frame.name)
            now = time.perf_counter()
            yield Outcome(frame.name, frame.time_s, result, error, now - arrived_s, now - start, dropped)


def _paced(frames: Iterable[StreamFrame | None]) -> Frames:
    start = time.perf_counter()
    zero = None
    for frame in frames:
        if frame is not None:
            zero = frame.time_s if zero is None else zero
            time.sleep(max(0.0, frame.time_s - zero - (time.perf_counter() - start)))
        yield frame


def _latest(frames: Frames) -> Generator[Arrived, None, None]:
    """Frames that a thread brings, of those that came since the last one only the newest."""
    waiting: queue.Queue[Arrived | Exception | None] = queue.Queue(maxsize=1)
    is_left = threading.Event()
    reported = 0

    def bring() -> None:
        end: Exception | None = None
        dropped = 0
        try:
            for frame in frames:
                if is_left.is_set():
                    return
                if frame is not None:
                    with suppress(queue.Empty):
                        waiting.get_nowait()
                        dropped += 1
                    waiting.put((frame, time.perf_counter(), dropped))
        except Exception as problem:  # raised in the caller's thread, after the outcomes before it
            end = problem
        while not is_left.is_set():
            with suppress(queue.Full):  # the last frame is still taken
                waiting.put(end, timeout=0.1)
                return

    threading.Thread(target=bring, daemon=True, name="frames").start()
    try:
        while isinstance(taken := waiting.get(), tuple):
            frame, arrived_s, dropped = taken
            yield frame, arrived_s, dropped - reported
            reported = dropped
        if taken is not None:
            raise taken
    finally:
        is_left.set()


def frame_error(problem: Exception, name: str) -> str:
    """Sentence that says what is wrong with a frame; ``name`` is the frame's."""
    words = words_of(problem)
    return words if is_foreseen(problem) else f"{name} cannot be answered ({words}): record or write it again"


@dataclass
class Summary:
    """Numbers of a stream: what was answered, what failed, and what gave way to newer frames, up to now."""

    answered: int = 0
    failed: int = 0
    dropped: int = 0
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    start_s: float = field(default_factory=time.perf_counter)

    def add(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.dropped += outcome.dropped
        if outcome.error:
            self.failed += 1
        else:
            self.answered += 1
            self.latencies_s.append(outcome.latency_s)

    def __str__(self) -> str:
        rate_hz = self.answered / (time.perf_counter() - self.start_s)
        median, worst = np.quantile(self.latencies_s, [0.5, 0.99]) if self.latencies_s else (nan, nan)
        return (
            f"{self.answered} frames answered at {rate_hz:.1f} Hz, latency {1e3 * median:.0f} ms (median), "
            f"{1e3 * worst:.0f} ms (99 %); {self.dropped} dropped for newer ones, {self.failed} bad"
        )


# --- watched folders --------------------------------------------------------------------------------------------------

LOOK_S = 0.05
"""Seconds between two looks."""

PATIENCE_S = 10.0
"""Seconds after which a file that is still empty, or still changes, is handed over as it is."""


class WatchedFolder:
    """Files of a folder into which a camera's program writes, each handed over once for every time it was written.

    No system tells when a writer is done. A file counts as complete when it is not empty and has not changed between
    two looks. One that never comes to rest is handed over all the same after a while, so that whoever reads it says
    what is wrong with it; one that was handed over too early comes again when it has changed.

    Attributes:
        folder: the folder; what lies deeper is not seen.
        wanted: which of its files count.
    """

    def __init__(self, folder: Path, wanted: Callable[[Path], bool]) -> None:
        self.folder, self.wanted = folder, wanted
        # of each file time and size at the last look, since when it is waited for, and those when it was handed over
        self._seen = dict[Path, tuple[Pair, float, Pair | None]]()

    def look(self, now_s: float) -> list[Path]:
        """Files that are complete since the last look, the oldest first; ``now_s`` is the time by any clock.

        Raises ``OSError`` where the folder is gone.
        """
        before, self._seen, complete = self._seen, {}, dict[Path, Pair]()
        for file in list(self.folder.iterdir()):
            try:
                facts = file.stat() if self.wanted(file) else None
            except FileNotFoundError:  # removed or renamed meanwhile
                continue
            if facts is None:
                continue
            version = facts.st_mtime_ns, facts.st_size
            last, since_s, taken = before.get(file, (None, now_s, None))
            if version == taken:
                since_s = now_s
            elif (version == last and facts.st_size > 0) or now_s - since_s >= PATIENCE_S:
                complete[file] = taken = version
            self._seen[file] = version, since_s, taken
        return sorted(complete, key=lambda file: (complete[file][0], file.name))


# --- stream sources ---------------------------------------------------------------------------------------------------


def frames_of(
    source: str,
    reading: InputConfig,
    isolation: IsolationConfig,
    rate_hz: float = 30.0,
    align_color: bool = False,
    joints: str | None = None,
) -> Frames:
    """Frames of a source, in order; each is decoded when it is answered.

    A source is a folder of depth images or point clouds (in the order of their names, recorded at ``rate_hz``), a ROS
    recording, a RealSense camera (``camera_frames``, which also has ``align_color``), or ``-`` for names of files, one
    a line, as they are written. ``joints`` is the topic of a recording that has the joints' values of each frame.

    Raises ``FileNotFoundError``, or ``ValueError`` for a folder without frames, and what a camera raises.
    """
    if is_camera(source):
        images = camera_frames(source, reading, align_color)
        return (None if image is None else _of_message(image, source, reading, isolation) for image in images)
    if align_color:
        raise ValueError(f"--align-color is given for {source}; it is for RealSense cameras alone: leave it out")
    if source == STANDARD_INPUT:
        return _named(reading, isolation)
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a folder of frames or a ROS recording is needed, or -")
    if is_recording(path):
        return (_of_message(message, source, reading, isolation) for message in read_messages(path, reading, joints))
    if not path.is_dir():
        raise ValueError(f"{path} is a single file; for one frame use `mereo reconstruct`, here name its folder")
    return (
        StreamFrame(file.name, i / rate_hz, _loader(partial(read_frame, file, reading), isolation))
        for i, file in enumerate(frames_in(path, reading))
    )


def frames_in(folder: Path, reading: InputConfig) -> list[Path]:
    """Depth images and point clouds of a folder in the order of their names; ``ValueError`` where it has none."""
    files = sorted(file for file in folder.iterdir() if _is_frame(file, reading))
    if not files:
        raise ValueError(f"{folder} has no depth images or point clouds; a folder of frames is needed: check the path")
    return files


def watched_frames(source: str, reading: InputConfig, isolation: IsolationConfig) -> Frames:
    """Frames of a folder as their files arrive, without end; None where nothing new has come.

    Files that are there already come first. One that is written again is a new frame; see ``WatchedFolder`` on when a
    file is complete. Times count from the start.

    Raises ``FileNotFoundError``, or ``ValueError`` for what is no folder; ``OSError`` where it is removed meanwhile.
    """
    path = Path(source)
    if source != STANDARD_INPUT and not is_camera(source) and not path.exists():
        raise FileNotFoundError(f"{path} does not exist; a folder that can be watched is needed: make it first")
    if not path.is_dir() or is_recording(path):
        raise ValueError(f"{source} is no folder of frames; only such a folder can be watched: leave out --watch")
    folder = WatchedFolder(path, lambda file: _is_frame(file, reading))
    start = time.perf_counter()

    def arriving() -> Frames:
        while True:
            begun = time.perf_counter()
            for file in folder.look(begun):
                load = _loader(partial(read_frame, file, reading), isolation)
                yield StreamFrame(file.name, time.perf_counter() - start, load)
            yield None
            time.sleep(max(LOOK_S, time.perf_counter() - begun))  # at most half of the time in a folder of many files

    return arriving()


def _is_frame(file: Path, reading: InputConfig) -> bool:
    """Whether the name of a file is a frame's; hidden ones are those that a writer renames when they are complete."""
    known = file.suffix.lower() in CLOUD_READERS or file.suffix.lower() in DEPTH_READERS
    return known and not file.name.startswith(".") and file != reading.mask and file.is_file()


def _named(reading: InputConfig, isolation: IsolationConfig) -> Iterator[StreamFrame]:
    start = time.perf_counter()
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="surrogateescape")  # names are bytes: one that is no UTF-8 is still a file's
    for line in sys.stdin:
        if name := line.strip():
            load = _loader(partial(read_frame, name, reading), isolation)
            yield StreamFrame(name, time.perf_counter() - start, load)


def _of_message(message: RecordedFrame, source: str, reading: InputConfig, isolation: IsolationConfig) -> StreamFrame:
    read = partial(message_frame, message, Path(source), reading)
    return StreamFrame(message.name, message.time_s, _loader(read, isolation), message.joints)


def with_joint_files(frames: Iterable[StreamFrame | None], folder: Path) -> Frames:
    """Frames whose joints' values are in files of a folder, ``0000.yaml`` of the frame ``0000.png``."""
    return (frame and replace(frame, joints=partial(Path, folder, f"{Path(frame.name).stem}.yaml")) for frame in frames)


def _loader(read: Callable[[], SensorFrame], isolation: IsolationConfig) -> Callable[[], Any]:
    return lambda: find_object(read(), isolation)


# --- the command ------------------------------------------------------------------------------------------------------


def run(command: StreamCommand) -> None:
    """Print a line of JSON for each frame, and the summary at the end."""
    # read when torch is loaded; clouds of ever other sizes would fill it with products that do not come again
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "4")
    stream_reconstructions(command)


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
    if every_frame and is_live(source):
        raise ValueError(
            f"{source} is a camera, which waits for no answer: leave out --every-frame, or record it first"
        )
    folder = None if command.surfaces is None else SurfaceFolder(command.surfaces, command.force)
    joints = command.joints
    topic = None
    steady = None
    if joints is not None and is_recording(Path(source)) and not joints.exists():
        topic = str(joints)
    frames: Iterable[StreamFrame | None] = (
        watched_frames(source, reading, command.isolation)
        if command.watch
        else frames_of(source, reading, command.isolation, command.rate, command.align_color, topic)
    )
    if joints is not None and joints.is_dir():
        frames = with_joint_files(frames, joints)
    elif topic is None:
        steady = joints
    known = loaded_object(replace(command, joints=steady))
    answer = Answering(
        known.network,
        known.registrar(command.method, command.joints),
        command.resolution,
        command.isolation.keep_all,
        command.uncertainty,
        every_frame,
        command.radius,
    )
    # what a camera delivers, or is written to standard input or into a watched folder, arrives when it does
    pace = not (every_frame or command.watch or source == STANDARD_INPUT or is_live(source))
    summary = Summary()
    last_error = ""
    is_stopped = False
    broken_off: Exception | None = None
    with closing(answer):
        try:
            for answered in stream(frames, answer, recorded_pace=pace, every_frame=every_frame):
                outcome = answered if folder is None else folder.written(answered, reading.frame)
                summary.add(outcome)
                last_error = outcome.error or last_error
                print(json.dumps(to_json(line(outcome))), flush=True)
        except KeyboardInterrupt:
            is_stopped = True
            print("stopped", file=sys.stderr)
        except BrokenPipeError:  # nobody reads the answers any more
            raise
        except (ValueError, OSError) as problem:
            broken_off = problem
        print(summary, file=sys.stderr)
    if not summary.answered and broken_off is None and last_error:
        broken_off = ValueError(f"none of the {summary.failed} frames could be answered; the last one: {last_error}")
    elif not summary.answered and broken_off is None and not is_stopped:
        broken_off = ValueError(
            f"no frame came from {command.input}; a stream needs one: check that anything writes it"
        )
    if broken_off is not None:
        raise broken_off
    return summary


def line(outcome: Outcome) -> JsonObject:
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
        surfaces: of all segments; None where the object is lost.
        facts: what is printed: who answers (``method``), how it was tracked, the share of points that the registered
            model explains, whether the frame shows the object, ``pose`` and ``joints`` as of ``Result``, points that
            were dropped, and each segment's ``centroid`` and ``volume``, with its ``pose`` where the registered model
            answers, and the network's ``confidence`` where that does.
    """

    surfaces: SegmentedMesh | None
    facts: JsonObject

    @classmethod
    def of(cls, answer: Answer, uncertainty: bool = False, radius: bool = True) -> "FrameAnswer":
        """Facts of an answer, with the error ``radius`` of its surface; by ``uncertainty`` also those of segments."""
        registration, is_missing = answer.registration, answer.is_missing
        facts: JsonObject = {
            "method": None if is_missing else "network",
            "tracked": answer.tracked,
            "tracking": answer.tracking,
            "explained": None if registration is None else round(registration.explained, 4),
            "known": answer.recognition.known,
            "reason": answer.recognition.reason,
            "pose": None,
            "joints": {},
        }
        strays = answer.hypothesis.dropped
        segments = dict[str, JsonObject]()
        if is_missing:
            return cls(None, {**facts, "strays": strays, "segments": segments})
        mesh = answer.surfaces
        registered = answer.registered
        if registered is None:
            for segment in answer.reconstruction.segments:
                if segment.voxels:
                    segments[segment.name] = _facts(segment.centroid, float(segment.volume))
                    segments[segment.name]["confidence"] = round(float(segment.confidence), 3)
            return cls(mesh, {**facts, "strays": strays, "segments": segments})
        joints = {name: joint.facts() for name, joint in measure_joints(answer).items()}
        facts |= {"method": registered.method, "located_by": answer.located_by}
        facts |= {"pose": _rows(registered.pose()), "joints": joints}
        figures = zip(mesh.names, owned_centroids(mesh), mesh.owned_volumes, strict=True)
        poses = segment_poses(registered)
        for name, centroid, volume in figures:
            segments[name] = {**_facts(centroid, float(volume)), "pose": _rows(poses[name])}
        if (radius or uncertainty) and (sure := registered.uncertainty) is not None:
            facts["radius95"] = sure.summary(sure.outline)
            for each in sure.segments if uncertainty else ():
                sure_of = {"centroid_radius95": round(each.centroid_radius95, DIGITS), "volume95": each.volume95}
                segments[each.name] |= {**sure_of, "expected_iou": round(each.expected_iou, 3)}
        return cls(mesh, {**facts, "strays": strays, "segments": segments})


def _rows(pose: Transform) -> list[list[float]]:
    return [[round(value, DIGITS) for value in row] for row in pose.tolist()]


def _facts(centroid: Vector, volume: float) -> JsonObject:
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
        radius: bool = True,
    ) -> None:
        """Without a registrar the network alone answers each frame; one of both there must be.

        ``waits`` lets each frame of a lost object wait for its search, so that answers do not depend on their speed.
        """
        self.model, self.resolution, self.keep_all = model, resolution, keep_all
        self.uncertainty, self.radius = uncertainty, radius
        executor = SynchronousExecutor() if waits else None
        self.tracker = None if registrar is None else Tracker(registrar, executor=executor)
        self.scene = None if registrar is None else registrar.given
        self._size: Pair | None = None

    def __call__(self, frame: StreamFrame) -> FrameAnswer:
        """Answer to a frame; raises ``ValueError`` for unusable ones and other sizes, and where nothing is found."""
        seen: Observation = frame.load()
        if (image := seen.frame.whole) is not None:  # intrinsics that state no size would be those of any
            size = image.camera.width, image.camera.height
            self._size = self._size or size
            if size != self._size:
                raise ValueError(resized(frame.name, size, self._size))
        if self.tracker is None:
            answer = answer_frame(at_point(seen, None), self.model, None, keep_all=self.keep_all)
        else:
            scene = None if frame.joints is None else with_frame_joints(self.scene, frame.joints())
            answer = self.tracker.follow(seen, frame.time_s, keep_all=self.keep_all, scene=scene)
        return FrameAnswer.of(replace(answer, resolution=self.resolution), self.uncertainty, self.radius)

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
        self._frames: Texts = {}
        check_place(path, may_be_link=True)
        if path.exists() and not path.is_dir():
            raise FileExistsError(f"{path} is a file; surfaces are written into a folder: choose another --surfaces")
        remove_abandoned(path)
        if path.is_dir() and any(path.iterdir()) and not force:
            raise FileExistsError(
                f"{path} exists and is not empty; nothing in it is overwritten: choose another --surfaces or pass "
                "--force, which replaces the files of the same names"
            )

    def written(self, outcome: Outcome, axes: CloudAxes) -> Outcome:
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
