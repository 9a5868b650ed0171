"""``mereo reconstruct``: one frame of a sensor to a folder of results."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from mereo.api.objects import Object
from mereo.api.reconstruct import reconstruct_observation
from mereo.api.result import Result, registration_of
from mereo.cli.answers import ReconstructCommand
from mereo.cli.config_file import options_of
from mereo.cli.explain import explain, print_sure, wish_of
from mereo.cli.options import NOT_RECOGNIZED, Outcome, check_named, files_read, loaded_object
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.carry import Carried, Placed, place
from mereo.fitting.registration.carry import carry as carry_one
from mereo.fitting.registration.register import Registrar
from mereo.io.atomic_files import new_directory, write_json
from mereo.io.attachments import Attachment, read_attachments
from mereo.io.config import CONFIG
from mereo.io.progress import shown_stages, stage
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.io.writers.formats import chosen_formats
from mereo.io.writers.volumes import MM_PER_M
from mereo.models.config import InferenceConfig
from mereo.models.trained import Trained
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import files_of
from mereo.visualization.report_words import confidence_title
from mereo.visualization.result_files import summary_of, write_answer
from mereo.visualization.units import Unit


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
        for option, needs in (("carry", "along which things move"), ("explain", "whose fit is explained")):
            if getattr(command, option) and command.method == "network":
                raise ValueError(f"--method is network, but --{option} needs a registration, {needs}: use auto")
        _ = self.attachments  # raises for those that cannot be carried

    @property
    def read(self) -> tuple[str | Path, ...]:
        """Files that are read beside the frames."""
        command = self.command
        named = () if command.scene is None else files_of(command.scene)
        given = (command.reading.intrinsics, command.reading.mask, *command.carry)
        return (*files_read(command.object, command.weights), *named, *(path for path in given if path is not None))

    @cached_property
    def attachments(self) -> tuple[Attachment, ...]:
        """Content of the files that are carried."""
        return tuple(read_attachments(self.command.carry))

    @cached_property
    def object(self) -> Object:
        """What is looked for, its weights on their device; what is carried needs a deformation model."""
        command = self.command
        inference = self.inference or command.inference
        loaded = loaded_object(command.object, command.weights, command.scene, command.units, inference)
        return loaded.with_deformation_model() if self.attachments else loaded

    @cached_property
    def registrar(self) -> Registrar | None:
        """Registrar of the object's model; None where the network alone answers."""
        return self.object.registrar(self.command.method)

    def asking(self, network: Trained | None) -> "FrameJob":
        """The same, asking the same weights on another device; what is known of scene and attachments stays so."""
        _ = self.registrar  # set up once, before it is moved
        moved = copy(self)
        vars(moved).pop("registrar", None)
        vars(moved).update(object=self.object.asking(network))
        return moved

    @cached_property
    def placed(self) -> tuple[Placed, ...]:
        """What is carried, in its place on the object at rest."""
        return (
            () if self.registrar is None else tuple(place(self.attachments, self.registrar, self.command.carry_frame))
        )


def reconstruct_file(input: str | Path, output: str | Path, job: FrameJob) -> Result:
    """Read one frame of a sensor, reconstruct it, write a new directory, print what was found.

    Args:
        input: a depth image, a point cloud or a ROS recording.
        output: folder to create.
        job: everything else.

    Warns with ``SizeWarning`` where what is seen cannot be the object. Raises as ``FrameJob.check``, ``read_frame``,
    ``find_object`` and ``reconstruct`` do, and ``ValueError`` for ``carry`` and
    ``explain`` without a registration.
    """
    job.check()
    with shown_stages(), new_directory(output, job.command.force, [input, *job.read]) as directory:
        found = answer_frame(read_frame(input, job.command.reading), directory, job, Path(input).absolute())
    print_segments(found)
    print(written(output, found.reconstruction.seconds))
    return found


def answer_frame(frame: SensorFrame, directory: Path, job: FrameJob, path: Path) -> Result:
    """Reconstruct a frame that was read, write all its files into a directory that is there, print what was found.

    ``path`` is the frame's own, for the options. Raises and warns as ``reconstruct_file``.
    """
    command = job.command
    seen = find_object(frame, command.isolation)
    print(seen)
    placed = job.placed  # what is carried is refused before the work
    wishes = [wish_of(text, job.object.names) for text in command.explain]
    found = reconstruct_observation(
        seen,
        job.object,
        command.method,
        resolution=command.resolution,
        isolation=command.isolation,
        label_points="points" in chosen_formats(command.files.formats),
    )
    if found.hypothesis.dropped:
        print(found.hypothesis)
    unit = Unit(found.unit_m)
    if job.registrar is not None:
        print_source(found)
        print_sure(found.registered, unit)
    with stage("write the files"):
        write_answer(directory, found, command.files, carried_along(placed, found))
    factor = MM_PER_M * found.seen.frame.metres if command.files.millimetres else 1.0
    explain(found.registered, wishes, directory, found.seen.cloud.points, factor, unit)
    write_json(directory / CONFIG, {**options_of(command, "reconstruct"), "inputs": [str(path)]})
    return found


def outcome_of(result: Result, output: str | Path) -> Outcome:
    """Outcome of a frame whose results are in a folder."""
    facts = {"output": str(output), **summary_of(result)}
    return Outcome(facts, NOT_RECOGNIZED if result.known is False else 0)


def written(output: str | Path, seconds: float) -> str:
    """Line about a folder of results that is there."""
    return f"wrote {output} in {seconds:.1f} s; open {Path(output) / 'report.html'} in a browser"


def carried_along(placed: Sequence[Placed], found: Answer) -> tuple[Carried, ...]:
    """What is carried, in the input's frame and unit, one printed line each; ``ValueError`` without a registration."""
    if not placed:
        return ()
    registered = registration_of(found)
    carried = tuple(carry_one(one, registered) for one in placed)
    for one in carried:
        print(one.told)
    return carried


def print_source(found: Answer) -> None:
    """Print where an answer comes from, and whether it can be believed."""
    registration = found.registration
    if registration is None:
        print(f"the network's answer, as no registration was found: {found.refusal}")
        return
    by = "; found by search" if found.taken and found.found_by == "search" else ""
    explained = f"the registered model explains {registration.explained:.1%} of the cloud ({registration.method}{by})"
    print(explained if found.taken else f"{explained}: too little, the network's answer is kept")
    if found.taken and not registration.accepted:
        cure = "look at the result" if found.model is None else "--method auto keeps the network's answer"
        print(f"that is too little to believe it: {cure}")
    if found.recognition.told is not None:
        print(found.recognition.told)


def print_segments(answered: Result) -> None:
    """Print a table of the segments, and a line of the stages' seconds."""
    result, seen, unit = answered.reconstruction, answered.seen, Unit(answered.unit_m)
    sure = None if answered.registered is None else answered.registered.uncertainty
    radii = {} if sure is None else {one.name: one.centroid_radius95 for one in sure.segments}
    table = Table(title=f"{seen.frame.source}, {len(seen.cloud)} points", title_justify="left")
    table.add_column("segment")
    volume, centroid = f"volume ({unit.volume_name})", f"centroid ({unit.length_name})"
    known = not all(np.isnan(found.confidence) for found in result.segments)
    sure_of = [confidence_title(result.calibrated)] if known else []
    for column in (volume, *sure_of, "components", centroid):
        table.add_column(column, justify="right")
    for found in result.segments:
        # the radius gives the digits; it is in the report, and would break the lines of 80 columns
        place = unit.place(found.centroid, radii.get(found.name)).partition(" ±")[0]
        told = [f"{found.confidence:.2f}"] if known else []
        row = (unit.volume(found.volume), *told, str(found.components), place)
        table.add_row(found.name, *(row if found.voxels else ("0", "not found", "0", "")))
    console = Console(markup=False, emoji=False)
    console.print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in result.timings_s.items())
    console.print(f"seconds: {stages}", highlight=False, soft_wrap=True)
    if result.clipped:
        console.print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")
