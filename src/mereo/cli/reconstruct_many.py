"""``mereo reconstruct`` for several frames and folders of them: one model, a folder of results for each frame."""

import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mereo.cli import outcome as command
from mereo.cli.reconstruct import FrameJob, outcome_of, reconstruct_file
from mereo.cli.reconstruct_tasks import answer_in_tasks
from mereo.cli.reconstruct_told import KNOWN, Told
from mereo.io.atomic_files import check_place
from mereo.io.config import InputConfig
from mereo.io.output_folders import MARKER
from mereo.io.progress import duration
from mereo.io.ros_recordings import is_recording
from mereo.reconstruction.observation import FrameWarning
from mereo.reconstruction.stream import frame_error
from mereo.reconstruction.stream_sources import frames_in
from mereo.workers.config import Cluster


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one frame.

    Attributes:
        path: its file.
        folder: of its results.
        told: what it is in a table; None for a frame that could not be answered.
    """

    path: Path
    folder: Path
    told: Told | None


def reconstruct_inputs(
    inputs: Sequence[Path], output: Path, job: FrameJob, cluster: Cluster | None = None
) -> command.Outcome:
    """Reconstruct one frame into ``output``, or several, or folders of them, into ``output``/NAME each.

    Several are tasks of ``cluster``, where one is given; ``ValueError`` for a single one then.

    Raises as ``reconstruct_file`` does for one frame; for several as ``reconstruct_frames``.
    """
    if not inputs:
        raise ValueError("no input is given; name a frame, several, or a folder of them: mereo reconstruct FRAME ...")
    if len(inputs) == 1 and not is_folder_of_frames(inputs[0]):
        if cluster is not None:
            raise ValueError("--ray is for several frames, each of which is a task: name more, or leave it out")
        return outcome_of(reconstruct_file(inputs[0], output, job), output)
    found = reconstruct_frames(list_frames(inputs, job.reading), output, job, cluster)
    frames = [{"output": str(one.folder), **one.told.summary} for one in found if one.told is not None]
    unknown = any(one.told is not None and one.told.known == KNOWN[False] for one in found)
    return command.Outcome({"output": str(output), "frames": frames}, command.NOT_RECOGNIZED if unknown else 0)


def is_folder_of_frames(path: Path) -> bool:
    """Whether a path is a folder of frames, and not the folder that a ROS 2 recording is."""
    return path.is_dir() and not is_recording(path)


def list_frames(inputs: Sequence[Path], reading: InputConfig) -> list[Path]:
    """Files of inputs and of the folders among them, each once; ``ValueError`` for a folder without frames."""
    files = [file for path in inputs for file in (frames_in(path, reading) if is_folder_of_frames(path) else [path])]
    return list({file.resolve(): file for file in files}.values())


def folder_names(files: Sequence[Path]) -> list[str]:
    """Name of each frame's folder of results: its file's without the suffix, with as much more as tells all apart.

    Raises ``ValueError`` where no name does, because files of one name lie in folders of one name.
    """
    kinds: tuple[Callable[[Path], str], ...] = (
        lambda file: file.stem,
        lambda file: file.name,
        lambda file: f"{file.resolve().parent.name}-{file.name}",
    )
    for kind in kinds:
        names = [kind(file) for file in files]
        twice, count = Counter(name.casefold() for name in names).most_common(1)[0]  # some systems ignore case
        if count == 1:
            return names
    alike = [str(file) for file, name in zip(files, names, strict=True) if name.casefold() == twice]
    raise ValueError(f"{alike[0]} and {alike[1]} would both be written to {names[0]!r}: reconstruct them one at a time")


def reconstruct_frames(
    files: Sequence[Path], output: Path, job: FrameJob, cluster: Cluster | None = None
) -> list[Outcome]:
    """Reconstruct each file into ``output``/NAME, print a table at the end; a bad frame is said and passed over.

    Raises ``ValueError`` at the end where a frame could not be answered, and before the work as ``FrameJob.check`` and
    loading do; ``FileExistsError`` where ``output`` is itself a folder of results.
    """
    names = folder_names(files)
    check_place(output, may_be_link=True)
    if output.exists() and not output.is_dir():
        raise FileExistsError(f"{output} is a file; a folder for each frame is written there: choose another --output")
    if (output / MARKER).exists():
        raise FileExistsError(
            f"{output} is a folder of results; each frame gets a folder of its own in --output: choose another"
        )
    job.check()
    _ = job.object, job.placed  # what is wrong with them is no frame's fault
    folders = [output / name for name in names]
    found: dict[Path, Told | None] = {}
    started = time.monotonic()

    def heading(file: Path) -> None:
        left = _left([*found.values()], len(files), time.monotonic() - started)
        print(f"\n[{len(found) + 1}/{len(files)}] {file}{left}", flush=True)

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=FrameWarning)  # for each frame, also in the same words
        for file, told in (
            _answer_here(files, folders, job, heading)
            if cluster is None
            else answer_in_tasks(files, folders, job, cluster, heading, _say)
        ):
            found[file] = told
    outcomes = [Outcome(file, folder, found[file]) for file, folder in zip(files, folders, strict=True)]
    _show(outcomes, output)
    failed = sum(outcome.told is None for outcome in outcomes)
    if failed:
        raise ValueError(
            f"{failed} of {len(files)} frames could not be reconstructed, each for the reason given with it; the "
            "others are written: correct them, and name only those again"
        )
    return outcomes


def _answer_here(
    files: Sequence[Path], folders: Sequence[Path], job: FrameJob, heading: Callable[[Path], None]
) -> Iterator[tuple[Path, Told | None]]:
    """Answer frames one after the other; None for a bad one, which is said."""
    for file, folder in zip(files, folders, strict=True):
        heading(file)
        try:
            told = Told.of(reconstruct_file(file, folder, job))
        except Exception as problem:
            _say(file, problem)
            yield file, None
        else:
            yield file, told


def _left(done: Sequence[Told | None], count: int, seconds: float) -> str:
    """Words on the time that is left of ``count`` frames, where something is known of it; bad frames take none."""
    answered = sum(told is not None for told in done)
    return f", {duration(seconds / answered * (count - len(done)))} left" if answered else ""


def _say(file: Path, problem: Exception) -> None:
    """Say on standard error what is wrong with a frame."""
    if os.environ.get("MEREO_TRACEBACK") == "1":
        raise problem
    print(f"mereo: error: {frame_error(problem, file.name)}", file=sys.stderr, flush=True)


def _show(outcomes: Sequence[Outcome], output: Path) -> None:
    """Table of all frames."""
    print()
    table = Table(title=f"{len(outcomes)} frames, results in {output}", title_justify="left")
    table.add_column("frame")
    table.add_column("answer")
    for column in ("explained", "known", "segments", "seconds"):
        table.add_column(column, justify="right")
    table.add_column("folder", overflow="fold")
    for outcome in outcomes:
        table.add_row(outcome.path.name, *_row(outcome))
    console = Console(markup=False, emoji=False)
    console.print(table)


def _row(outcome: Outcome) -> tuple[str, ...]:
    told = outcome.told
    if told is None:
        return "none", "", "", "", "", ""
    return told.answer, told.explained, told.known, told.segments, f"{told.seconds:.1f}", outcome.folder.name
