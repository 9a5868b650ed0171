"""``mereo reconstruct`` for several frames and folders of them: one model, a folder of results for each frame.

On a cluster each frame is a task: it is read here and its files come back as bytes, so nodes need to see neither.
"""

import io
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, redirect_stdout
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console
from rich.table import Table

from mereo.api.words import option_words
from mereo.cli.options import NOT_RECOGNIZED, Outcome
from mereo.cli.reconstruct import FrameJob, print_segments, reconstruct_file, reconstruct_frame, written
from mereo.fitting.registration.answer import Answer
from mereo.io.atomic_files import MARKER, check_new_directory, check_place, new_directory
from mereo.io.config import InputConfig
from mereo.io.progress import duration
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction.observation import FrameWarning
from mereo.reconstruction.stream import frame_error, frames_in
from mereo.visualization.result_files import summary_of
from mereo.workers.spread import Cluster, spread


@dataclass(frozen=True)
class FrameRow:
    """Row of the table about a frame.

    Attributes:
        cells: who answers, the share of the cloud that a registered model explains, whether the frame shows the object,
            how many segments were found, seconds.
        seconds: that the answer took.
        summary: content of its summary.json.
    """

    cells: tuple[str, ...]
    seconds: float
    summary: Mapping[str, Any]

    @classmethod
    def of(cls, answer: Answer) -> "FrameRow":
        """Row about an answer."""
        registration, segments = answer.registration, answer.reconstruction.segments
        seconds = answer.reconstruction.seconds
        cells = (
            "registered model" if answer.taken else "network",
            "" if registration is None else f"{registration.explained:.1%}",
            {True: "yes", False: "no", "unsure": "unsure"}[answer.recognition.known],
            f"{sum(segment.voxels > 0 for segment in segments)} of {len(segments)}",
            f"{seconds:.1f}",
        )
        return cls(cells, seconds, summary_of(answer))


def reconstruct_inputs(inputs: Sequence[Path], output: Path, job: FrameJob, cluster: Cluster | None = None) -> Outcome:
    """Reconstruct one frame into ``output``, or several, or folders of them, into ``output``/NAME each.

    Several are tasks of ``cluster``, where one is given; ``ValueError`` for a single one then.

    Raises as ``reconstruct_file`` does for one frame; for several as ``reconstruct_frames``.
    """
    if not inputs:
        raise ValueError("no input is given; name a frame, several, or a folder of them: mereo reconstruct FRAME ...")
    if len(inputs) > 1 or is_folder_of_frames(inputs[0]):
        return reconstruct_frames(list_frames(inputs, job.command.reading), output, job, cluster)
    if cluster is not None:
        raise ValueError("--ray is for several frames, each of which is a task: name more, or leave it out")
    result = reconstruct_file(inputs[0], output, job)
    facts = {"output": str(output), **summary_of(result)}
    return Outcome(facts, NOT_RECOGNIZED if result.known is False else 0)


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


def reconstruct_frames(files: Sequence[Path], output: Path, job: FrameJob, cluster: Cluster | None = None) -> Outcome:
    """Reconstruct each file into ``output``/NAME, print a table at the end; a bad frame is said and passed over.

    Raises ``ValueError`` at the end where a frame could not be answered, and before the work as ``FrameJob.check`` and
    loading do; ``FileExistsError`` where ``output`` is itself a folder of results.
    """
    frames = [(file, output / name) for file, name in zip(files, folder_names(files), strict=True)]
    check_place(output, may_be_link=True)
    if output.exists() and not output.is_dir():
        raise FileExistsError(f"{output} is a file; a folder for each frame is written there: choose another --output")
    if (output / MARKER).exists():
        raise FileExistsError(
            f"{output} is a folder of results; each frame gets a folder of its own in --output: choose another"
        )
    job.check()
    _ = job.object, job.placed  # what is wrong with them is no frame's fault
    rows: dict[Path, FrameRow | None] = {}
    started = time.monotonic()
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=FrameWarning)  # for each frame, also in the same words
        for file, finish in _finishing(frames, job, cluster):
            left = _left(list(rows.values()), len(files), time.monotonic() - started)
            print(f"\n[{len(rows) + 1}/{len(files)}] {file}{left}", flush=True)
            try:
                rows[file] = finish()
            except Exception as problem:
                if os.environ.get("MEREO_TRACEBACK") == "1":
                    raise
                print(f"mereo: error: {frame_error(problem, file.name)}", file=sys.stderr, flush=True)
                rows[file] = None
    _print_table(frames, rows, output)
    if failed := list(rows.values()).count(None):
        raise ValueError(
            f"{failed} of {len(files)} frames could not be reconstructed, each for the reason given with it; the "
            "others are written: correct them, and name only those again"
        )
    summaries = [{"output": str(folder), **row.summary} for file, folder in frames if (row := rows[file]) is not None]
    unknown = any(summary["recognition"]["known"] is False for summary in summaries)
    return Outcome({"output": str(output), "frames": summaries}, NOT_RECOGNIZED if unknown else 0)


def _left(done: Sequence[FrameRow | None], count: int, seconds: float) -> str:
    """Words on the time that is left of ``count`` frames, where something is known of it; bad frames take none."""
    answered = sum(row is not None for row in done)
    return f", {duration(seconds / answered * (count - len(done)))} left" if answered else ""


def _print_table(frames: Sequence[tuple[Path, Path]], rows: Mapping[Path, FrameRow | None], output: Path) -> None:
    print()
    table = Table(title=f"{len(frames)} frames, results in {output}", title_justify="left")
    table.add_column("frame")
    table.add_column("answer")
    for column in ("explained", "known", "segments", "seconds"):
        table.add_column(column, justify="right")
    table.add_column("folder", overflow="fold")
    for file, folder in frames:
        row = rows[file]
        table.add_row(file.name, *(["none"] if row is None else [*row.cells, folder.name]))
    Console(markup=False, emoji=False).print(table)


def _finishing(
    frames: Sequence[tuple[Path, Path]], job: FrameJob, cluster: Cluster | None
) -> Iterator[tuple[Path, Callable[[], FrameRow]]]:
    """Each frame's file, with what writes its folder of results, or raises why not."""
    if cluster is not None:
        yield from _answer_in_tasks(frames, job, cluster)
        return
    for file, folder in frames:
        yield file, partial(_answer_alone, file, folder, job)


def _answer_alone(file: Path, folder: Path, job: FrameJob) -> FrameRow:
    return FrameRow.of(reconstruct_file(file, folder, job))


# --- a cluster --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Frame:
    """Frame on its way to a task: its file, the folder of its results, and its content, or why it has none."""

    path: Path
    folder: Path
    content: SensorFrame | Exception


@dataclass(frozen=True, eq=False)
class _Answered:
    """What a task sends back: the frame's row, its files by their path in the folder, what it printed and warned of."""

    row: FrameRow
    files: dict[str, bytes]
    printed: str
    warned: list[str]


@dataclass(frozen=True, eq=False)
class _Answering:
    """Answers frames in a task, with the weights on a GPU of its own or none; ``job`` has all that they share."""

    job: FrameJob
    gpu: bool

    @cached_property
    def moved(self) -> FrameJob:
        """The job with its weights on the task's device, moved there once."""
        if self.job.object.network is None or not self.gpu:
            return self.job
        from mereo.models.weights import to_gpu

        return self.job.asking(to_gpu(self.job.object.network))

    def __call__(self, frame: _Frame) -> _Answered | Exception:
        if isinstance(frame.content, Exception):
            return frame.content
        with (
            option_words(),
            TemporaryDirectory() as name,
            redirect_stdout(io.StringIO()) as printed,
            warnings.catch_warnings(record=True) as warned,
        ):
            warnings.simplefilter("always", FrameWarning)
            folder = Path(name)
            result = reconstruct_frame(frame.content, folder, self.moved, frame.path.absolute())
            print_segments(result)
            files = {
                file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()
            }
        texts = [str(warning.message) for warning in warned if issubclass(warning.category, FrameWarning)]
        return _Answered(FrameRow.of(result), files, printed.getvalue(), texts)


def _answer_in_tasks(
    frames: Iterable[tuple[Path, Path]], job: FrameJob, cluster: Cluster
) -> Iterator[tuple[Path, Callable[[], FrameRow]]]:
    """Answer frames in tasks of a cluster; yields each as it is there, in any order."""
    if job.object.network is not None:
        from mereo.models.weights import to_cpu

        job = job.asking(to_cpu(job.object.network, cluster))
    if job.registrar is not None:
        job.registrar.prepare()  # once, here, and not in every task

    def read(path: Path, folder: Path) -> _Frame:
        try:
            check_new_directory(folder, job.command.force, [path, *job.read])
            return _Frame(path, folder, read_frame(path, job.command.reading))
        except Exception as problem:
            return _Frame(path, folder, problem)

    work, contents = _Answering(job, cluster.gpus > 0), (read(*frame) for frame in frames)
    with closing(spread(work, contents, cluster, lambda _, error: error)) as answers:
        for frame, answered in answers:
            yield frame.path, partial(_write_answer, frame, answered, job)


def _write_answer(frame: _Frame, answered: _Answered | Exception, job: FrameJob) -> FrameRow:
    if isinstance(answered, Exception):
        raise answered
    print(answered.printed, end="")
    for text in answered.warned:
        warnings.warn(text, FrameWarning, stacklevel=2)
    with new_directory(frame.folder, job.command.force, [frame.path, *job.read]) as directory:
        for name, content in answered.files.items():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            (directory / name).write_bytes(content)
    print(written(frame.folder, answered.row.seconds), flush=True)
    return answered.row
