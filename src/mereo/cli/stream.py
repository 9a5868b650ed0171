"""``mereo stream``: a reconstruction of the latest frame, again and again."""

import json
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from mereo.cli.options import MeshUnits, check_named, loaded_object
from mereo.cli.stream_answers import Answering, FrameAnswer, Seen
from mereo.cli.stream_rerun import RerunLog, RerunTarget
from mereo.fitting.config import StreamMethod
from mereo.geometry.conventions import CloudAxes
from mereo.io.atomic_files import atomic_file, check_place, remove_all_abandoned, to_json
from mereo.io.config import InputConfig
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.config import InferenceConfig
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import Observation
from mereo.reconstruction.stream import Counter, Outcome, StreamFrame, Summary, frame_error, stream
from mereo.reconstruction.stream_sources import STANDARD_INPUT, frames_of, watched_frames
from mereo.synthesis.recording import CAMERA, FRAMES, is_recording_folder


def stream_reconstructions(
    source: str,
    weights: str | None = None,
    *,
    looked_for: tuple[str, ...] = (),
    units: MeshUnits = None,
    resolution: int = 48,
    rate_hz: float = 30.0,
    every_frame: bool = False,
    watch: bool = False,
    surfaces: Path | None = None,
    rerun: str | None = None,
    force: bool = False,
    reading: InputConfig | None = None,
    isolation: IsolationConfig | None = None,
    inference: InferenceConfig | None = None,
    method: StreamMethod = "auto",
    uncertainty: bool = False,
) -> Summary:
    """Print a line of JSON for each answered or bad frame, and the summary at the end or after Ctrl-C.

    Where the object's model is registered, it is followed from frame to frame (``fitting.tracking``). ``surfaces`` is a
    folder without content, or with ``force`` one in which files of the same name are replaced. ``rerun`` is a new
    recording's file or a viewer's address (``RerunTarget``). ``uncertainty`` says how sure each answer is that is the
    registered model. What is looked for is named as in ``FrameJob``.

    Raises ``ValueError`` where not one frame could be answered, and what broke the sequence off, where something did;
    ``FileExistsError`` for a folder of surfaces with content or a recording that is there, without ``force``; and as
    ``RerunTarget`` does.
    """
    check_named("stream", looked_for, weights)
    source, reading = frames_of_recording(source, reading or InputConfig())
    folder = None if surfaces is None else SurfaceFolder(surfaces, force)
    target = None if rerun is None else RerunTarget(rerun, force)
    isolation = isolation or IsolationConfig()
    known = loaded_object(looked_for, weights, None, units, inference or InferenceConfig())
    frames: Iterable[StreamFrame[Observation] | None] = (
        watched_frames(source, reading, isolation) if watch else frames_of(source, reading, isolation, rate_hz)
    )
    answer = Answering(known.network, known.registrar(method), resolution, isolation.keep_all, uncertainty, every_frame)
    # what is written to standard input or into a watched folder arrives when it does
    pace = not every_frame and not watch and source != STANDARD_INPUT
    timed = (None if frame is None else with_time(frame) for frame in frames)
    outcomes: Iterator[Outcome[FrameAnswer]] = stream(timed, answer, recorded_pace=pace, every_frame=every_frame)
    opened = nullcontext() if target is None else target.opened(Path(source).name, reading.frame)
    with closing(answer), opened as log:
        broken_off, last_error, summary = answer_all(outcomes, folder, log, reading.frame)
        if not summary.answered and broken_off is None and last_error:
            broken_off = ValueError(
                f"none of the {summary.failed} frames could be answered; the last one: {last_error}"
            )
        if not summary.answered and broken_off is not None:
            raise broken_off  # nothing is recorded
    if broken_off is not None:
        raise broken_off
    return summary


def answer_all(
    outcomes: Iterable[Outcome[FrameAnswer]], folder: "SurfaceFolder | None", log: RerunLog | None, axes: CloudAxes
) -> tuple[Exception | None, str, Summary]:
    """Print and write outcomes until they end or Ctrl-C: what broke them off, the last frame's error, the summary."""
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
    return broken_off, last_error, summary


def frames_of_recording(source: str, reading: InputConfig) -> tuple[str, InputConfig]:
    """Folder of the frames and their camera, where the source is a folder of ``mereo scene record``; else as given."""
    if source == STANDARD_INPUT or not is_recording_folder(Path(source)):
        return source, reading
    folder = Path(source)
    return str(folder / FRAMES), replace(reading, intrinsics=reading.intrinsics or folder / CAMERA)


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


def line(outcome: Outcome[FrameAnswer]) -> dict[str, Any]:
    """JSON that is printed of one frame; lengths in the input's unit, times in milliseconds."""
    facts: dict[str, Any] = {
        "frame": outcome.name,
        "time_s": outcome.time_s,
        "latency_ms": round(1e3 * outcome.latency_s, 1),
        "work_ms": round(1e3 * outcome.work_s, 1),
        "dropped": outcome.dropped,
    }
    if outcome.result is None:
        return {**facts, "error": outcome.error}
    found = outcome.result
    where: dict[str, Any] = {
        "method": found.method,
        "tracked": found.tracked,
        "tracking": found.tracking,
        "explained": found.explained,
    }
    where |= {"known": found.recognition.known, "reason": found.recognition.reason}
    if found.found_by is not None:
        where["found_by"] = found.found_by
    if found.radius95 is not None:
        where["radius95"] = found.radius95
    return {**facts, **where, "strays": found.strays, "segments": found.segments}


def with_time(frame: StreamFrame[Observation]) -> StreamFrame[Seen]:
    """The frame, whose content says when it was recorded."""

    def load() -> Seen:
        return Seen(frame.load(), frame.time_s)

    return StreamFrame(frame.name, frame.time_s, load)
