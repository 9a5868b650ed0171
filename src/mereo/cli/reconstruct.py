"""``mereo reconstruct``: frames of a sensor, with one model, to a folder of results each.

SensorFrame -reconstruct_frame-> Result, its files in a folder, and what is printed of it
"""

import io
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, redirect_stdout
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mereo.api.objects import Object
from mereo.api.reconstruct import reconstruct_observation
from mereo.api.result import Pose, Result, free_folder, registration_of
from mereo.api.words import option_words
from mereo.cli.answers import ReconstructCommand
from mereo.cli.options import Outcome, check_named, files_read, loaded_object, options_of
from mereo.cli.stream import frame_error, frames_in
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.symmetry import describe_symmetries
from mereo.io.atomic_files import MARKER, check_new_directory, check_place, new_directory, write_json
from mereo.io.attachments import Attachment, read_attachments
from mereo.io.config import CONFIG, InputConfig
from mereo.io.errors import AnyPath
from mereo.io.progress import duration, shown_stages, stage
from mereo.io.readers import read_pose
from mereo.io.ros_recordings import is_recording
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.io.writers.formats import chosen_formats
from mereo.locating.whole_frame import at_point, is_whole
from mereo.models.config import InferenceConfig
from mereo.models.trained import Trained
from mereo.reconstruction.observation import FrameWarning, find_object
from mereo.results.carry import Placed, carry, place
from mereo.scenes.registry import files_of
from mereo.visualization.reconstruction_report import confidence_title, iou_words, radius_words, trust
from mereo.visualization.result_files import INSTANCE, summary_of, write_answer
from mereo.visualization.units import Unit
from mereo.workers.spread import Cluster, choose_cluster, spread

Summary = Mapping[str, Any]
"""Content of a summary.json."""


@dataclass(frozen=True)
class FrameJob:
    """What all frames of a ``mereo reconstruct`` share, which is read and loaded once.

    Attributes:
        command: its options.
        inference: where and how exactly the network computes, where that is not as the options say.
    """

    command: ReconstructCommand
    inference: InferenceConfig | None = None

    def check(self) -> None:
        """Raise for options that fit together with no frame: before the work, not after.

        ``ImportError`` for a missing extra, ``ValueError`` and ``OSError`` for files that cannot be carried.
        """
        command = self.command
        check_named("reconstruct", command.object, command.weights)
        chosen_formats(command.files.formats)
        if command.carry_frame != "source" and not command.carry:
            raise ValueError(
                f"--carry-frame is {command.carry_frame!r} and nothing is carried: name a file with --carry"
            )
        if command.carry and command.method == "network":
            raise ValueError("--method is network, but --carry needs a registration, along which things move: use auto")
        _ = self.attachments, self.initial_pose  # raises for those that cannot be read

    @property
    def read(self) -> tuple[AnyPath, ...]:
        """Files that are read besides the frames."""
        command = self.command
        scene = () if command.scene is None else files_of(command.scene)
        reading = command.reading
        given = (reading.intrinsics, reading.mask, reading.camera_pose, command.initial_pose, *command.carry)
        named = (*given, command.joints)
        return (*files_read(command.object, command.weights), *scene, *(path for path in named if path is not None))

    @cached_property
    def attachments(self) -> tuple[Attachment, ...]:
        """Content of the files that are carried."""
        return tuple(read_attachments(self.command.carry))

    @cached_property
    def initial_pose(self) -> Pose | None:
        """Rough pose of the object in all frames; None where it is looked for."""
        return None if self.command.initial_pose is None else read_pose(self.command.initial_pose)

    @cached_property
    def object(self) -> Object:
        """What is looked for, its weights on their device."""
        return loaded_object(self.command, self.inference)

    @cached_property
    def registrar(self) -> Registrar | None:
        """Registrar of the object's model; None where the network alone answers."""
        return self.object.registrar(self.command.method)

    @cached_property
    def placed(self) -> tuple[Placed, ...]:
        """What is carried, in its place on the object at rest."""
        if not self.attachments:
            return ()
        registrar = self.registrar or self.object.registrar("modes")  # raises for weights without a deformation model
        assert registrar is not None
        return tuple(place(self.attachments, registrar, self.command.carry_frame))

    def asking(self, network: Trained | None) -> "FrameJob":
        """The same, asking the same weights on another device; what is known of scene and attachments stays so."""
        _ = self.registrar  # set up once, before it is moved
        moved = copy(self)
        vars(moved).pop("registrar", None)
        vars(moved).update(object=self.object.asking(network))
        return moved


def reconstruct_file(input: AnyPath, output: AnyPath, job: FrameJob) -> Result:
    """Read one frame of a sensor, reconstruct it, write a new directory, print what was found.

    Warns with ``SizeWarning`` where what is seen cannot be the object. Raises as ``FrameJob.check``, ``read_frame``,
    ``find_object`` and ``reconstruct`` do, and ``ValueError`` for ``carry`` without a registration.
    """
    job.check()
    started = time.perf_counter()
    with shown_stages(), new_directory(output, job.command.force, [input, *job.read]) as directory:
        result = reconstruct_frame(read_frame(input, job.command.reading), directory, job, Path(input).absolute())
    print_segments(result)
    print(written(output, time.perf_counter() - started))
    return result


def reconstruct_frame(frame: SensorFrame, directory: Path, job: FrameJob, path: Path) -> Result:
    """Reconstruct a frame that was read, write all its files into a directory that is there, print what was found.

    ``path`` is the frame's own, for the options. Raises and warns as ``reconstruct_file``.
    """
    command = job.command
    seen = at_point(replace(find_object(frame, command.isolation), initial_pose=job.initial_pose), job.registrar)
    is_looked_through = job.registrar is not None and is_whole(seen, job.registrar)
    within = f"all {len(seen.cloud)} points {'that are kept' if seen.steps else 'of the frame'}"
    at = "" if seen.point is None else f", {seen.where}"
    print(f"the object is looked for in {within}{at}" if is_looked_through else seen)
    placed = job.placed  # what is carried is refused before the work
    result = reconstruct_observation(
        seen,
        job.object,
        command.method,
        resolution=command.resolution,
        isolation=command.isolation,
        label_points="points" in chosen_formats(command.files.formats),
        instances=command.instances,
    )
    if is_looked_through:
        print(result.seen)
    if result.hypothesis.dropped:
        print(result.hypothesis)
    unit = Unit(result.unit_m)
    if job.registrar is not None:
        print_source(result)
        print_uncertainty(result.registered, unit)
        for name, joint in result.joints.items():
            print(f"joint {name}: {joint}")
    carried = tuple(carry(each, registration_of(result)) for each in placed)
    for each in carried:
        print(each.description)
    for number, other in enumerate(result.instances[1:], start=2):
        print(f"instance {number} of {len(result.instances)}, in the folder {INSTANCE.format(number)}:\n{other.seen}")
    with stage("write the files"):
        write_answer(directory, result, command.files, carried)
    write_json(directory / CONFIG, {**options_of(command, "reconstruct"), "inputs": [str(path)]})
    return result


# --- several frames ---------------------------------------------------------------------------------------------------


def run(command: ReconstructCommand) -> Outcome:
    """Write the folder of results and print the segments."""
    cluster = choose_cluster(command.ray, command.threads, command.task)
    inference = command.inference
    if cluster is not None and command.weights is not None:
        from mereo.models.weights import settings_for

        inference = settings_for(inference, cluster)
    return reconstruct_inputs(command.inputs, command.output or free_folder(), FrameJob(command, inference), cluster)


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
    return Outcome(facts, trust(facts).status)


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
    kinds = (
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
    summaries = dict[Path, Summary | None]()
    started = time.monotonic()
    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=FrameWarning)  # for each frame, also in the same words
        alone = ((file, partial(_reconstruct_alone, file, folder, job)) for file, folder in frames)
        for file, finish in alone if cluster is None else _answer_in_tasks(frames, job, cluster):
            answered = sum(summary is not None for summary in summaries.values())  # bad frames take no time
            left_s = (time.monotonic() - started) / max(answered, 1) * (len(files) - len(summaries))
            left = f", {duration(left_s)} left" if answered else ""
            print(f"\n[{len(summaries) + 1}/{len(files)}] {file}{left}", flush=True)
            try:
                summaries[file] = finish()
            except Exception as problem:
                if os.environ.get("MEREO_TRACEBACK") == "1":
                    raise
                print(f"mereo: error: {frame_error(problem, file.name)}", file=sys.stderr, flush=True)
                summaries[file] = None
    _print_table(frames, summaries, output)
    if failed := list(summaries.values()).count(None):
        raise ValueError(
            f"{failed} of {len(files)} frames could not be reconstructed, each for the reason given with it; the "
            "others are written: correct them, and name only those again"
        )
    results = [{"output": str(folder), **(summaries[file] or {})} for file, folder in frames]
    statuses = {trust(summary).status for summary in results}
    # what is not the object outweighs what may not be
    return Outcome({"output": str(output), "frames": results}, min(statuses - {0}, default=0))


def _reconstruct_alone(file: Path, folder: Path, job: FrameJob) -> Summary:
    return summary_of(reconstruct_file(file, folder, job))


def _print_table(frames: Sequence[tuple[Path, Path]], summaries: Mapping[Path, Summary | None], output: Path) -> None:
    """Of each frame: who answers, what the registered model explains, whether the frame shows the object, seconds."""
    print()
    table = Table(title=f"{len(frames)} frames, results in {output}", title_justify="left")
    table.add_column("frame")
    table.add_column("answer")
    for column in ("explained", "known", "segments", "seconds"):
        table.add_column(column, justify="right")
    table.add_column("folder", overflow="fold")
    for file, folder in frames:
        summary = summaries[file]
        if summary is None:
            table.add_row(file.name, "none")
            continue
        fit = summary.get("registration", {})
        segments = summary["segments"]
        table.add_row(
            file.name,
            "registered model" if fit else "network",
            f"{fit['explained']:.1%}" if "explained" in fit else "",
            {"yes": "yes", "no": "no"}.get(trust(summary).level, "unsure"),
            f"{sum(segment['voxels'] > 0 for segment in segments)} of {len(segments)}",
            f"{sum(summary['timings_s'].values()):.1f}",
            folder.name,
        )
    Console(markup=False, emoji=False).print(table)


# On a cluster each frame is a task: it is read here and its files come back as bytes, so nodes need to see neither.


@dataclass(frozen=True, eq=False)
class _Answered:
    """What a task sends back: the summary, files by their path in the folder, what it printed and warned of."""

    summary: Summary
    files: dict[str, bytes]
    printed: str
    warned: list[str]


Read = tuple[Path, Path, SensorFrame | Exception]
"""Frame on its way to a task: its file, the folder of its results, and its content, or why it has none."""


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

    def __call__(self, frame: Read) -> _Answered | Exception:
        path, _, content = frame
        if isinstance(content, Exception):
            return content
        with (
            option_words(),
            TemporaryDirectory() as name,
            redirect_stdout(io.StringIO()) as printed,
            warnings.catch_warnings(record=True) as warned,
        ):
            warnings.simplefilter("always", FrameWarning)
            folder = Path(name)
            result = reconstruct_frame(content, folder, self.moved, path.absolute())
            print_segments(result)
            files = {
                file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()
            }
        texts = [str(warning.message) for warning in warned if issubclass(warning.category, FrameWarning)]
        return _Answered(summary_of(result), files, printed.getvalue(), texts)


def _answer_in_tasks(
    frames: Iterable[tuple[Path, Path]], job: FrameJob, cluster: Cluster
) -> Iterator[tuple[Path, Callable[[], Summary]]]:
    """Answer frames in tasks of a cluster; yields each as it is there, in any order."""
    if job.object.network is not None:
        from mereo.models.weights import to_cpu

        job = job.asking(to_cpu(job.object.network, cluster))
    if job.registrar is not None:
        job.registrar.prepare()  # once, here, and not in every task

    def read(path: Path, folder: Path) -> Read:
        try:
            check_new_directory(folder, job.command.force, [path, *job.read])
            return path, folder, read_frame(path, job.command.reading)
        except Exception as problem:
            return path, folder, problem

    work = _Answering(job, cluster.gpus > 0)
    contents = (read(*frame) for frame in frames)
    with closing(spread(work, contents, cluster, lambda _, error: error)) as answers:
        for (path, folder, _), answered in answers:
            yield path, partial(_write_answer, path, folder, answered, job)


def _write_answer(path: Path, folder: Path, answered: _Answered | Exception, job: FrameJob) -> Summary:
    if isinstance(answered, Exception):
        raise answered
    print(answered.printed, end="")
    for text in answered.warned:
        warnings.warn(text, FrameWarning, stacklevel=2)
    with new_directory(folder, job.command.force, [path, *job.read]) as directory:
        for name, content in answered.files.items():
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            (directory / name).write_bytes(content)
    print(written(folder, sum(answered.summary["timings_s"].values())), flush=True)
    return answered.summary


# --- what is printed --------------------------------------------------------------------------------------------------


def written(output: AnyPath, seconds: float) -> str:
    """Line about a folder of results that is there."""
    return f"wrote {output} in {seconds:.1f} s; open {Path(output) / 'report.html'} in a browser"


def print_source(answer: Answer) -> None:
    """Print where an answer comes from, and whether it can be believed."""
    registration = answer.registration
    if registration is None:
        return
    ways = {"search": "; found by search", "pose": "; from the initial pose"}
    by = ways.get(answer.located_by, "")
    print(f"the registered model explains {registration.explained:.1%} of the cloud ({registration.method}{by})")
    if not registration.accepted:
        print("that is too little to believe it: look at the result")
    if answer.recognition.description is not None:
        print(answer.recognition.description)
    model = registration.model
    for symmetry in describe_symmetries(model.symmetries, model.rest.names, of_segments=True):
        print(symmetry)


def print_uncertainty(registered: Registration | None, unit: Unit) -> None:
    """Print how far off the surface of a registered model may be; nothing for the network's answer."""
    if registered is None or registered.uncertainty is None:
        return
    print(radius_words(registered.uncertainty.summary(), unit))
    print(iou_words(registered.uncertainty.expected_iou))


def print_segments(result: Result) -> None:
    """Print a table of the segments, and a line of the stages' seconds."""
    reconstruction = result.reconstruction
    seen = result.seen
    unit = Unit(result.unit_m)
    table = Table(title=f"{seen.frame.source}, {len(seen.cloud)} points", title_justify="left")
    table.add_column("segment")
    has_confidence = not all(np.isnan(segment.confidence) for segment in reconstruction.segments)
    confidence = [confidence_title(reconstruction.calibrated)] if has_confidence else []
    for column in (f"volume ({unit.volume_name})", *confidence, "components", f"centroid ({unit.length_name})"):
        table.add_column(column, justify="right")
    sure = None if result.registered is None else result.registered.uncertainty
    for segment in reconstruction.segments:
        # radii give the digits; they are in the report, and would break lines of 80 columns
        between = None if sure is None else sure.segments[segment.label - 1].volume95
        volume = unit.volume(segment.volume, between).partition(" (")[0]
        centroid = unit.place(segment.centroid, result[segment.name].error_radius).partition(" ±")[0]
        confidence = [f"{segment.confidence:.2f}"] if has_confidence else []
        row = (volume, *confidence, str(segment.components), centroid)
        table.add_row(segment.name, *(row if segment.voxels else ("0", *["" for _ in confidence], "0", "not found")))
    Console(markup=False, emoji=False).print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in reconstruction.timings_s.items())
    print(f"seconds: {stages}")
    if reconstruction.clipped:
        print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")
