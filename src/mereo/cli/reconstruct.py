"""``mereo reconstruct``: one frame of a sensor to a folder of results.

SensorFrame -reconstruct_frame-> Result, its files in a folder, and what is printed of it
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from mereo.api.objects import Object
from mereo.api.reconstruct import reconstruct_observation
from mereo.api.result import Pose, Result, registration_of
from mereo.cli.answers import ReconstructCommand
from mereo.cli.options import check_named, files_read, loaded_object, options_of
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.carry import Placed, carry, place
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.radii import describe_level
from mereo.geometry.symmetry import describe_symmetries
from mereo.io.atomic_files import new_directory, write_json
from mereo.io.attachments import Attachment, read_attachments
from mereo.io.config import CONFIG
from mereo.io.progress import shown_stages, stage
from mereo.io.readers import read_pose
from mereo.io.sensor_frame import SensorFrame, read_frame
from mereo.io.writers.formats import chosen_formats
from mereo.io.writers.meshes import write_explained_ply
from mereo.io.writers.volumes import MM_PER_M
from mereo.models.config import InferenceConfig
from mereo.models.trained import Trained
from mereo.reconstruction.observation import find_object
from mereo.scenes.registry import files_of
from mereo.visualization.reconstruction_report import UNEXPLAINED, describe_shares, mark_colors, point_marks
from mereo.visualization.report_words import confidence_title
from mereo.visualization.result_files import write_answer
from mereo.visualization.units import Unit, rounded

EXPLAINED = "explained"
"""Folder within a folder of results that holds the observed points of each explanation."""


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
        _ = self.attachments, self.initial_pose  # raises for those that cannot be read

    @property
    def read(self) -> tuple[str | Path, ...]:
        """Files that are read beside the frames."""
        command = self.command
        scene = () if command.scene is None else files_of(command.scene)
        given = (command.reading.intrinsics, command.reading.mask, command.initial_pose, *command.carry)
        return (*files_read(command.object, command.weights), *scene, *(path for path in given if path is not None))

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
        """What is looked for, its weights on their device; what is carried needs a deformation model."""
        command = self.command
        inference = self.inference or command.inference
        loaded = loaded_object(command.object, command.weights, command.scene, command.units, inference)
        return loaded.with_deformation_model() if self.attachments else loaded

    @cached_property
    def registrar(self) -> Registrar | None:
        """Registrar of the object's model; None where the network alone answers."""
        return self.object.registrar(self.command.method)

    @cached_property
    def placed(self) -> tuple[Placed, ...]:
        """What is carried, in its place on the object at rest."""
        registrar = self.registrar
        return () if registrar is None else tuple(place(self.attachments, registrar, self.command.carry_frame))

    def asking(self, network: Trained | None) -> "FrameJob":
        """The same, asking the same weights on another device; what is known of scene and attachments stays so."""
        _ = self.registrar  # set up once, before it is moved
        moved = copy(self)
        vars(moved).pop("registrar", None)
        vars(moved).update(object=self.object.asking(network))
        return moved


def reconstruct_file(input: str | Path, output: str | Path, job: FrameJob) -> Result:
    """Read one frame of a sensor, reconstruct it, write a new directory, print what was found.

    Args:
        input: a depth image, a point cloud or a ROS recording.
        output: folder to create.
        job: everything else.

    Warns with ``SizeWarning`` where what is seen cannot be the object. Raises as ``FrameJob.check``, ``read_frame``,
    ``find_object`` and ``reconstruct`` do, and ``ValueError`` for ``carry`` and ``explain`` without a registration.
    """
    job.check()
    with shown_stages(), new_directory(output, job.command.force, [input, *job.read]) as directory:
        result = reconstruct_frame(read_frame(input, job.command.reading), directory, job, Path(input).absolute())
    print_segments(result)
    print(written(output, result.reconstruction.seconds))
    return result


def reconstruct_frame(frame: SensorFrame, directory: Path, job: FrameJob, path: Path) -> Result:
    """Reconstruct a frame that was read, write all its files into a directory that is there, print what was found.

    ``path`` is the frame's own, for the options. Raises and warns as ``reconstruct_file``.
    """
    command = job.command
    seen = replace(find_object(frame, command.isolation), initial_pose=job.initial_pose)
    print(seen)
    placed = job.placed  # what is carried is refused before the work
    targets = [target_of(text, job.object.names) for text in command.explain]
    result = reconstruct_observation(
        seen,
        job.object,
        command.method,
        resolution=command.resolution,
        isolation=command.isolation,
        label_points="points" in chosen_formats(command.files.formats),
    )
    if result.hypothesis.dropped:
        print(result.hypothesis)
    unit = Unit(result.unit_m)
    if job.registrar is not None:
        print_source(result)
        print_uncertainty(result.registered, unit)
    carried = tuple(carry(each, registration_of(result)) for each in placed)
    for each in carried:
        print(each.description)
    with stage("write the files"):
        write_answer(directory, result, command.files, carried)
    factor = MM_PER_M * result.seen.frame.metres if command.files.millimetres else 1.0
    explain(result.registered, targets, directory, result.seen.cloud.points, factor, unit)
    write_json(directory / CONFIG, {**options_of(command, "reconstruct"), "inputs": [str(path)]})
    return result


# --- what is printed --------------------------------------------------------------------------------------------------


def written(output: str | Path, seconds: float) -> str:
    """Line about a folder of results that is there."""
    return f"wrote {output} in {seconds:.1f} s; open {Path(output) / 'report.html'} in a browser"


def print_source(answer: Answer) -> None:
    """Print where an answer comes from, and whether it can be believed."""
    registration = answer.registration
    if registration is None:
        print(f"the network's answer, as no registration was found: {answer.refusal}")
        return
    ways = {"search": "; found by search", "pose": "; from the initial pose"}
    by = ways.get(answer.located_by, "") if answer.taken else ""
    explained = f"the registered model explains {registration.explained:.1%} of the cloud ({registration.method}{by})"
    print(explained if answer.taken else f"{explained}: too little, the network's answer is kept")
    if answer.taken and not registration.accepted:
        cure = "look at the result" if answer.model is None else "--method auto keeps the network's answer"
        print(f"that is too little to believe it: {cure}")
    if answer.recognition.description is not None:
        print(answer.recognition.description)
    model = registration.model
    for symmetry in describe_symmetries(
        [each for each in model.symmetries if not each.keeps_segments], model.rest.names
    ):
        print(symmetry)


def print_uncertainty(registered: Registration | None, unit: Unit) -> None:
    """Print how far off the surface of a registered model may be; nothing for the network's answer."""
    if registered is None or registered.uncertainty is None:
        return
    radii = registered.uncertainty.summary()
    middle, most = (f"{rounded(radii[key] * unit.length_factor)} {unit.length_name}" for key in ("median", "max"))
    level = describe_level(registered.uncertainty.calibrated)
    print(f"its points are within {middle} of their true places in the median, {most} where it is least sure ({level})")


def print_segments(result: Result) -> None:
    """Print a table of the segments, and a line of the stages' seconds."""
    reconstruction, seen, unit = result.reconstruction, result.seen, Unit(result.unit_m)
    sure = None if result.registered is None else result.registered.uncertainty
    radii = {} if sure is None else {segment.name: segment.centroid_radius95 for segment in sure.segments}
    table = Table(title=f"{seen.frame.source}, {len(seen.cloud)} points", title_justify="left")
    table.add_column("segment")
    has_confidence = not all(np.isnan(segment.confidence) for segment in reconstruction.segments)
    confidence = [confidence_title(reconstruction.calibrated)] if has_confidence else []
    for column in (f"volume ({unit.volume_name})", *confidence, "components", f"centroid ({unit.length_name})"):
        table.add_column(column, justify="right")
    for segment in reconstruction.segments:
        # the radius gives the digits; it is in the report, and would break the lines of 80 columns
        centroid = unit.place(segment.centroid, radii.get(segment.name)).partition(" ±")[0]
        confidence = [f"{segment.confidence:.2f}"] if has_confidence else []
        row = (unit.volume(segment.volume), *confidence, str(segment.components), centroid)
        table.add_row(segment.name, *(row if segment.voxels else ("0", "not found", "0", "")))
    console = Console(markup=False, emoji=False)
    console.print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in reconstruction.timings_s.items())
    console.print(f"seconds: {stages}", highlight=False, soft_wrap=True)
    if reconstruction.clipped:
        console.print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")


# --- what decides a position ------------------------------------------------------------------------------------------

Target = str | Float[np.ndarray, "3"]
"""What is to be explained: the name of a segment, or a position in the input's frame and unit."""


def target_of(text: str, names: Sequence[str]) -> Target:
    """Target of an option's text; raises ``ValueError`` for what is neither a segment nor a position."""
    if text in names:
        return text
    try:
        position = np.array([float(part) for part in text.split(",")])
    except ValueError:
        position = np.empty(0)
    if len(position) != 3 or not np.isfinite(position).all():
        raise ValueError(
            f"--explain is {text!r}; it must be a segment ({', '.join(names)}) or a place x,y,z in the input's frame "
            "and unit, such as --explain=0.1,-0.02,0.8"
        )
    return position


def explain(
    registered: Registration | None,
    targets: Sequence[Target],
    directory: Path,
    points: Float[np.ndarray, "n 3"],
    factor: float,
    unit: Unit,
) -> None:
    """Print a line for each target, and write the observed points coloured by how much they decide it.

    Args:
        registered: in the input's frame; None raises ``ValueError`` where there are targets.
        targets: what is to be explained.
        directory: of the results.
        points: observed ones, in the input's frame and unit.
        factor: from the input's unit to that of the file.
        unit: of the lengths that are printed.
    """
    for number, target in enumerate(targets, 1):
        if registered is None or registered.uncertainty is None:
            raise ValueError(
                "the network's answer is kept, but --explain needs a registration, whose fit is explained: leave out "
                "of the cloud what is not the object, or take the registered model in any case with --method modes"
            )
        sure, names = registered.uncertainty, registered.model.rest.names
        if isinstance(target, str):
            title, radius = f"the centre of {target}", sure.segments[names.index(target)].centroid_radius95
        else:
            radii = registered.radius95(target[None], at="camera")
            assert radii is not None
            title, radius = "the object's point", float(radii[0])
        explanation = registered.explain(target)
        assert explanation is not None
        position = f"{unit.place(explanation.place, radius)} {unit.length_name} ({describe_level(sure.calibrated)})"
        text = f"{title} is at {position}; what leaves it unsure: {describe_shares(explanation)}"
        lost = len(explanation.unexplained)
        print(f"{text}; {lost} points are not the model's" if lost else text)
        marks = point_marks(explanation, points)
        (directory / EXPLAINED).mkdir(exist_ok=True)
        path = directory / EXPLAINED / f"{number}.ply"
        write_explained_ply(path, factor * points, mark_colors(marks), marks == UNEXPLAINED, text)
