"""``mereo demo``: a real range scan and two rendered depth frames, back to segments, compared with the truth.

First the scan by its object's meshes alone, with nothing trained. Where torch is installed, all three with shipped
weights then, network and registered model side by side. What is written is the answer that `mereo reconstruct` gives.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mereo.api.objects import Object, load_object
from mereo.api.reconstruct import reconstruct
from mereo.api.result import Result
from mereo.cli.reconstruct import print_source
from mereo.evaluation.cases import grid_confusion, labels_on
from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.sample_views import SHIPPED_SCAN, load_view, shipped_frame
from mereo.evaluation.scans import BUNNY_SCAN_POSES
from mereo.fitting.config import AnswerMethod
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.atomic_files import check_place
from mereo.io.extras import has_network
from mereo.io.output_folders import check_new_directory, new_directory
from mereo.io.progress import shown_stages
from mereo.io.sensor_frame import SensorFrame
from mereo.io.writers.stl import write_surface_stl
from mereo.models.weights_place import statistical_model_in
from mereo.visualization.report_words import confidence_title
from mereo.visualization.units import Unit

FRAMES = ("liver", "rope")
RESOLUTION = 100

OWN_OBJECT = """[bold]On your own object[/bold], from its meshes: nothing is trained; docs/own-object.md has joints
  mereo reconstruct cloud.ply --object PART.stl PART.stl --output result
  mereo reconstruct depth.png --intrinsics camera.json --depth-scale 1000 --object PART.stl PART.stl --output result

[bold]At once, and telling look-alike parts apart[/bold]: with a network, where that helps, ten minutes for an object
  mereo learn PART.stl PART.stl --output learned --minutes 10
  mereo reconstruct frame.ply --object learned --output result

In another shell, first: source .venv/bin/activate"""

WITHOUT = (
    "PyTorch is not installed, so nothing is shown of networks, which start the fit at once: run pip install "
    "'mereo[network]' and this again."
)


@dataclass(frozen=True, eq=False)
class Case:
    """Input of the demo with its truth.

    Attributes:
        name: of the output folder.
        title: one line about it.
        object: that is found in it.
        frame: as its sensor gives it.
        truth: the right answer, in the frame's axes and unit.
    """

    name: str
    title: str
    object: Object
    frame: SensorFrame
    truth: TruthGrid


@dataclass(frozen=True, eq=False)
class Column:
    """Scores of one answer to a case, and the seconds that it took from the frame on."""

    scores: Scores
    seconds: float

    def facts(self) -> dict[str, float | None]:
        """IoU, mIoU and seconds."""
        return {"iou": self.scores.iou, "miou": self.scores.miou, "seconds": self.seconds}


def main(output: str | Path = Path("out/demo")) -> dict[str, Any]:
    """Reconstruct every input, print tables, and write a folder each below ``output``; returns the scores."""
    check_place(Path(output), may_be_link=True)
    console, started = Console(markup=False, emoji=False), time.perf_counter()
    scores: dict[str, Any] = {}
    for make in _inputs(Path(output)):
        with shown_stages():
            case = make()
        folder = _folder(Path(output) / case.name)
        with shown_stages():
            columns = _show(case, folder, console)
        scores[case.name] = {"output": str(folder), **{name: column.facts() for name, column in columns.items()}}
    if not has_network():
        console.print(f"{WITHOUT}\n", highlight=False, soft_wrap=True)
    console.print(f"All in {time.perf_counter() - started:.0f} s.\n", highlight=False)
    console.print(OWN_OBJECT, markup=True, highlight=False, soft_wrap=True)
    return scores


def _folder(wanted: Path) -> Path:
    """Folder for a case: the first of NAME, NAME-2, NAME-3, ... that is free or holds only what mereo wrote.

    A folder of a version without lists of files, or with somebody's notes, is kept and stops nobody: the next name is
    taken, and replaced from then on.
    """
    for folder in (wanted, *(wanted.with_name(f"{wanted.name}-{number}") for number in range(2, 1000))):
        try:
            check_new_directory(folder, force=True)
        except FileExistsError:
            continue
        if folder != wanted:
            print(f"{wanted} holds what mereo may not replace; it is kept, and this result is written to {folder}")
        return folder
    raise FileExistsError(f"{wanted}, and every name up to {folder}, is taken: choose another --output")


def _inputs(output: Path) -> Iterator[Callable[[], Case]]:
    """Inputs of the demo: the real scan by meshes; with a network the scan again, then frames of other objects."""
    yield partial(_mesh_case, output)
    if not has_network():
        return
    yield _scan_case
    for name in FRAMES:
        yield partial(_frame_case, name)


def _mesh_case(output: Path) -> Case:
    """The scan by nothing but the bunny's meshes, which are written beside the results: a user has such files."""
    files, rest = [], _bunny_at_rest()
    with new_directory(output / "bunny-meshes", force=True) as folder:
        for part in rest.segments:
            write_surface_stl(folder / f"{part.name}.stl", SegmentedMesh((part,)))
            files.append(output / "bunny-meshes" / f"{part.name}.stl")
    known = load_object(files, units="m")
    title = f"{SHIPPED_SCAN}: a real range scan of the Stanford bunny, by its meshes alone, nothing trained"
    return Case(f"{SHIPPED_SCAN}-meshes", title, known, shipped_frame(SHIPPED_SCAN), _scan_truth(rest))


def _scan_case() -> Case:
    known = load_object("bunny")
    title = f"{SHIPPED_SCAN}: the same scan, with weights"
    return Case(SHIPPED_SCAN, title, known, shipped_frame(SHIPPED_SCAN), _scan_truth(_bunny_at_rest()))


def _bunny_at_rest() -> SegmentedMesh:
    """The bunny in its own files' frame, metres."""
    model = statistical_model_in("bunny")
    assert model.source_frame is not None
    return model.rest.transformed(np.linalg.inv(model.source_frame.T_scene_source))


def _scan_truth(rest: SegmentedMesh) -> TruthGrid:
    return truth_grid(rest.transformed(np.linalg.inv(BUNNY_SCAN_POSES[SHIPPED_SCAN])))


def _frame_case(name: str) -> Case:
    frame, view = shipped_frame(name), load_view(name)
    camera = view.depth.camera
    title = f"{name}: a rendered {camera.width} x {camera.height} depth image with noise"
    return Case(name, title, load_object(name), frame, view.truth.scaled(view.metres))


def _show(case: Case, folder: Path, console: Console) -> dict[str, Column]:
    """Reconstruct a case, print network and registered model beside the truth, and write the default answer."""
    columns: dict[str, Column] = {}
    registrar = case.object.registrar()
    if case.object.network is None:
        result, columns["search"] = _answer(case, "auto")
    else:
        result, columns["network"] = _answer(case, "network")
    if registrar is not None and case.object.network is not None:
        result, columns["fit"] = _answer(case, "auto")
    console.print(_table(case, result, columns))
    if registrar is None:
        print(f"the network's answer: the weights {case.name!r} carry no statistical model that could be registered")
    else:
        print_source(result)
    started = time.perf_counter()
    result.save(folder, overwrite=True)
    written_s = time.perf_counter() - started
    page = f", or in the browser: mereo view {folder}" if result.taken else ""
    line = f"{len(case.frame.cloud)} points; written in {written_s:.1f} s; look at {folder / 'report.html'}{page}\n"
    console.print(line, highlight=False, soft_wrap=True)
    return columns


def _answer(case: Case, method: AnswerMethod) -> tuple[Result, Column]:
    """Answer to a case, its scores and seconds."""
    started = time.perf_counter()
    result = reconstruct(case.frame, case.object, method, resolution=RESOLUTION)
    seconds = time.perf_counter() - started
    labels = labels_on(result.surfaces, case.truth.grid)
    network = case.object.network
    confusion = grid_confusion(case.truth, labels, len(result.names))
    return result, Column(intersection_over_union(confusion, network is None or network.segmented), seconds)


def _table(case: Case, result: Result, columns: dict[str, Column]) -> Table:
    """Table of the scores of each segment by network and fit, and of what is written."""
    unit = Unit(result.unit_m)
    table = Table(title=case.title, title_justify="left")
    table.add_column("IoU with the truth")
    known = not all(np.isnan(segment.confidence) for segment in result)
    sure = [confidence_title(result.reconstruction.calibrated)] if known else []
    for column in (*columns, *sure, f"volume ({unit.volume_name})"):
        table.add_column(column, justify="right")
    each = [column.scores.per_segment for column in columns.values()]
    for segment, *ious in zip(result, *each, strict=True):
        told = [f"{segment.confidence:.2f}"] if known else []
        row = (*(f"{iou:.3f}" for iou in ious), *told, unit.volume(segment.volume))
        table.add_row(segment.name, *row)
    table.add_section()
    table.add_row("all as one (IoU)", *(f"{column.scores.iou:.3f}" for column in columns.values()))
    table.add_row("mean of segments (mIoU)", *(f"{column.scores.miou:.3f}" for column in columns.values()))
    table.add_row("seconds", *(f"{column.seconds:.1f}" for column in columns.values()))
    return table
