"""``mereo reconstruct --ray``: each frame is answered in a task of a cluster, and its folder is written here.

    file -read_frame-> SensorFrame ~~task: answer_frame~~> files and words -> OUTPUT/NAME

Frames are read here and results come back as the bytes of their files, so nodes need to see neither.
"""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

from mereo.api.words import option_words
from mereo.cli.reconstruct import FrameJob, Told, answer_frame, print_segments, written
from mereo.io.output_folders import check_new_directory, new_directory
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.reconstruction.observation import FrameWarning
from mereo.workers.config import Cluster
from mereo.workers.spread import spread

Failed = Callable[[Path, Exception], None]
"""Says what is wrong with a frame, which is passed over."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Frame on its way to a task.

    Attributes:
        path: its file, as it was named.
        absolute: the same from the root.
        folder: of its results.
        read: its content.
    """

    path: Path
    absolute: Path
    folder: Path
    read: SensorFrame


@dataclass(frozen=True, eq=False)
class _Answered:
    """What a task sends back.

    Attributes:
        told: what the table says of the frame.
        files: content of its folder, by path in it.
        printed: what was printed.
        warned: warnings about its size.
        segments: the table of its segments, which is printed once they are written.
    """

    told: Told
    files: dict[str, bytes]
    printed: str
    warned: tuple[str, ...]
    segments: str


@dataclass(frozen=True, eq=False)
class _Answering:
    """Answers frames, with the weights on the device of whoever calls; ``job`` has all that they share, loaded."""

    job: FrameJob
    gpu: bool

    @cached_property
    def here(self) -> FrameJob:
        """The job with its weights where this is called, moved there once."""
        network = self.job.object.network
        if network is None:
            return self.job
        from mereo.models.elsewhere import arrived

        return self.job.asking(arrived(network, self.gpu))

    def __call__(self, frame: Frame, cancelled: Callable[[], bool]) -> _Answered | Exception:
        """Answer to a frame, or why there is none: a bad frame stops no other."""
        printed = io.StringIO()
        try:
            with (
                option_words(),
                TemporaryDirectory() as folder,
                redirect_stdout(printed),
                warnings.catch_warnings(record=True) as warned,
            ):
                warnings.simplefilter("always", FrameWarning)
                found = answer_frame(frame.read, Path(folder), self.here, frame.absolute)
                files = {
                    path.relative_to(folder).as_posix(): path.read_bytes()
                    for path in Path(folder).rglob("*")
                    if path.is_file()
                }
        except Exception as error:
            return error
        segments = io.StringIO()
        with redirect_stdout(segments):
            print_segments(found)
        sizes = tuple(str(one.message) for one in warned if issubclass(one.category, FrameWarning))
        return _Answered(Told.of(found), files, printed.getvalue(), sizes, segments.getvalue())


def answer_in_tasks(
    files: Sequence[Path],
    folders: Sequence[Path],
    job: FrameJob,
    cluster: Cluster,
    heading: Callable[[Path], None],
    failed: Failed,
) -> Iterator[tuple[Path, Told | None]]:
    """Answer frames in tasks of a cluster, and write the folder of each; yields each as it is there, in any order.

    What a task prints is printed here, below what ``heading`` prints of its frame. None is yielded for a frame for
    which ``failed`` was called.
    """
    lost: list[Path] = []

    def frames() -> Iterator[Frame]:
        for path, folder in zip(files, folders, strict=True):
            try:
                check_new_directory(folder, job.command.force, [path, *job.read])
                yield Frame(path, path.absolute(), folder, read_frame(path, job.command.reading))
            except Exception as problem:
                failed(path, problem)
                lost.append(path)

    if job.object.network is not None:
        from mereo.models.elsewhere import sent

        job = job.asking(sent(job.object.network, cluster))
    if job.registrar is not None:
        job.registrar.prepare()  # once, here, and not in every task
    work = _Answering(job, cluster.gpus > 0)
    with closing(spread(work, frames(), cluster=cluster)) as answers:
        for frame, found in answers:
            yield from ((path, None) for path in lost)
            lost.clear()
            heading(frame.path)
            yield frame.path, _written(frame, found, job, failed)
    yield from ((path, None) for path in lost)


def _written(frame: Frame, found: _Answered | Exception, job: FrameJob, failed: Failed) -> Told | None:
    """Write what came back; None where there is nothing, or where it cannot be written."""
    if isinstance(found, Exception):
        failed(frame.path, found)
        return None
    print(found.printed, end="")
    for text in found.warned:
        warnings.warn(text, FrameWarning, stacklevel=2)
    try:
        with new_directory(frame.folder, job.command.force, [frame.path, *job.read]) as directory:
            for name, content in found.files.items():
                (directory / name).parent.mkdir(parents=True, exist_ok=True)
                (directory / name).write_bytes(content)
    except Exception as problem:
        failed(frame.path, problem)
        return None
    print(found.segments, end="")
    print(written(frame.folder, found.told.seconds), flush=True)
    return found.told
