"""``mereo reconstruct``: one frame of a sensor to a folder of results."""

import warnings
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mereo.fitting.answer import Answer, answer
from mereo.fitting.carry import Carried, Placed, place
from mereo.fitting.carry import carry as carry_one
from mereo.fitting.config import FitChoice
from mereo.fitting.register import Registrar, registrar_for
from mereo.geometry.transforms import inverse_rigid
from mereo.io.attachments import read_attachments
from mereo.io.config import DEFAULT_FILES, CarryFrame, FilesConfig, InputConfig
from mereo.io.output_folders import new_directory
from mereo.io.sensor_frame import read_frame
from mereo.io.writers.formats import chosen_formats
from mereo.models.config import InferenceConfig
from mereo.models.weights import load_for
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import SizeWarning, find_object, size_warning
from mereo.reconstruction.pipeline import Reconstruction
from mereo.scenes.registry import files_of
from mereo.visualization.result import Result


def reconstruct_file(
    input: str | Path,
    weights: str | Path,
    output: str | Path,
    *,
    resolution: int = 128,
    reading: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    isolation: IsolationConfig = IsolationConfig(),  # noqa: B008
    inference: InferenceConfig = InferenceConfig(),  # noqa: B008
    files: FilesConfig = DEFAULT_FILES,
    choice: FitChoice = "auto",
    scene: str | None = None,
    carry: Sequence[str | Path] = (),
    carry_frame: CarryFrame = "source",
    force: bool = False,
) -> Reconstruction:
    """Read one frame of a sensor, reconstruct it, write a new directory, print what was found: ``mereo reconstruct``.

    Args:
        input: a depth image, a point cloud or a ROS recording.
        weights: a shipped name or a file.
        output: folder to create.
        resolution: cells along the longest side of the object's box.
        reading: how the frame is read.
        isolation: what of the frame is left out.
        inference: where and how exactly the network computes.
        files: which files are written, and in which unit.
        choice: whether the network answers, or the registered model.
        scene: whose draws are fitted, where it is not the built-in one that the weights were trained on.
        carry: files of what is defined in the rest model, to be brought to where the object is.
        carry_frame: their frame and unit: of the object's own files, or of its scene.
        force: replace an existing folder that mereo wrote.

    Warns with ``SizeWarning`` where what is seen cannot be the object. Raises as ``read_frame``, ``find_object`` and
    ``reconstruct`` do, and ``ValueError`` for ``carry`` without a registration.
    """
    formats = chosen_formats(files.formats)  # a missing extra is said before the work, not after
    attachments = read_attachments(carry)
    if carry_frame != "source" and not attachments:
        raise ValueError(f"--carry-frame is {carry_frame!r} and nothing is carried: name a file with --carry")
    if attachments and choice == "off":
        raise ValueError("--fit is off, but --carry needs a registration, along which things move: use --fit auto")
    named = () if scene is None else files_of(scene)
    read = [path for path in (input, weights, *named, reading.intrinsics, reading.mask, *carry) if path is not None]
    with new_directory(output, force, read) as directory:
        frame = read_frame(input, reading)
        seen = find_object(frame, isolation)
        print(seen)
        model = load_for(weights, inference)
        registrar = Registrar.of(model, choice, scene) if attachments else registrar_for(model, choice, scene)
        placed = place(attachments, registrar, carry_frame) if registrar is not None else ()
        found = answer(
            seen.cloud,
            model,
            registrar,
            resolution,
            frame.axes,
            label_points="points" in formats,
            stated_unit=None if registrar is None else registrar.stated_unit(frame.unit_m),
            keep_all=isolation.keep_all,
        )
        whole = Result.of(found, seen, model, registrar, resolution)
        result, seen = found.reconstruction, whole.seen
        if result.reading.dropped:
            print(result.reading)
        warning = size_warning(seen, model.provenance)
        if warning is not None:
            warnings.warn(warning, SizeWarning, stacklevel=2)
        if registrar is not None:
            print_source(found)
        whole.write(directory, files, carried_along(placed, found))
    print_segments(result, f"{frame.source}, {len(seen.cloud)} points")
    print(f"wrote {output} in {sum(result.timings_s.values()):.1f} s; open {Path(output) / 'report.html'} in a browser")
    return result


def carried_along(placed: Sequence[Placed], found: Answer) -> tuple[Carried, ...]:
    """What is carried, in the input's frame and unit, one printed line each; ``ValueError`` without a registration."""
    if placed and (found.registration is None or not found.taken):
        raise ValueError(
            "the network's answer is kept, but --carry needs a registration, along which things move: leave out of the "
            "cloud what is not the object, or take the registered model in any case with --fit modes"
        )
    if found.registration is None:
        return ()
    here = found.registration.moved(inverse_rigid(found.reconstruction.T_camera_input))
    carried = tuple(carry_one(one, here) for one in placed)
    for one in carried:
        outside = len(one.content.points) - one.inside
        away = f"{outside} of them outside, up to {one.farthest:.4g} away" if outside else "all inside"
        print(f"carried {one.name}: {len(one.content.points)} points, {away}")
    return carried


def print_source(found: Answer) -> None:
    """Print where an answer comes from, and whether it can be believed."""
    registration = found.registration
    if registration is None:
        print(f"the network's answer, as no registration was found: {found.refusal}")
        return
    explained = f"the registered model explains {registration.explained:.1%} of the cloud ({registration.method})"
    print(explained if found.taken else f"{explained}: too little, the network's answer is kept")
    if found.taken and not registration.accepted:
        print("that is too little to believe it: --fit auto keeps the network's answer")
    elif found.taken and registration.doubt is not None:
        print(registration.doubt)


def print_segments(result: Reconstruction, title: str) -> None:
    """Print a table of the segments, and a line of the stages' seconds."""
    table = Table(title=title, title_justify="left")
    table.add_column("segment")
    for column in ("volume", "confidence", "components", "centroid"):
        table.add_column(column, justify="right")
    for found in result.segments:
        place = " ".join(f"{value:.4g}" for value in found.centroid)
        row = (f"{found.volume:.4g}", f"{found.confidence:.2f}", str(found.components), place)
        table.add_row(found.name, *(row if found.voxels else ("0", "not found", "0", "")))
    console = Console(markup=False, emoji=False)
    console.print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in result.timings_s.items())
    console.print(f"seconds: {stages}", highlight=False, soft_wrap=True)
    if result.clipped:
        console.print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")
