"""``mereo demo``: a real range scan and two rendered depth frames, back to segments, compared with the truth.

Network and registered model stand side by side; what is written is the answer that `mereo reconstruct` gives.
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
from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.results import grid_confusion, labels_on
from mereo.evaluation.sample_views import SHIPPED_SCAN, load_view, shipped_frame
from mereo.evaluation.scans import BUNNY_SCAN_POSES
from mereo.fitting.config import AnswerMethod
from mereo.io.output_folders import check_new_directory
from mereo.io.progress import shown_stages
from mereo.io.scratch_folders import check_place
from mereo.io.sensor_frame import SensorFrame
from mereo.visualization.report_words import confidence_title
from mereo.visualization.units import Unit

FRAMES = ("liver", "rope")
RESOLUTION = 100

OWN_OBJECT = """[bold]On your own data[/bold]
  mereo reconstruct cloud.ply --weights bunny --output result
  mereo reconstruct depth.png --intrinsics camera.json --depth-scale 1000 --weights bunny --output result

[bold]On your own object[/bold], from its meshes; docs/own-object.md has joints, and each step by itself
  mereo learn PART.stl PART.stl --output learned --minutes 10
  mereo reconstruct frame.ply --weights learned/weights.safetensors --scene learned/scene.yaml --output result

In another shell, first: source .venv/bin/activate"""


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
    for make in _inputs():
        case = make()
        folder = _folder(Path(output) / case.name)
        with shown_stages():
            columns = _show(case, folder, console)
        scores[case.name] = {"output": str(folder), **{name: column.facts() for name, column in columns.items()}}
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


def _inputs() -> Iterator[Callable[[], Case]]:
    """Inputs of the demo: the real scan first, then frames of other objects."""
    yield _scan_case
    for name in FRAMES:
        yield partial(_frame_case, name)


def _scan_case() -> Case:
    frame, known = shipped_frame(SHIPPED_SCAN), load_object("bunny")
    model = known.with_deformation_model().model
    assert model is not None and model.source_frame is not None
    truth = model.rest.transformed(np.linalg.inv(model.source_frame.T_scene_source @ BUNNY_SCAN_POSES[SHIPPED_SCAN]))
    title = f"{SHIPPED_SCAN}: a real range scan of the Stanford bunny"
    return Case(SHIPPED_SCAN, title, known, frame, truth_grid(truth))


def _frame_case(name: str) -> Case:
    frame, view = shipped_frame(name), load_view(name)
    camera = view.depth.camera
    title = f"{name}: a rendered {camera.width} x {camera.height} depth image with noise"
    return Case(name, title, load_object(name), frame, view.truth.scaled(view.metres))


def _show(case: Case, folder: Path, console: Console) -> dict[str, Column]:
    """Reconstruct a case, print network and registered model beside the truth, and write the default answer."""
    columns: dict[str, Column] = {}
    result, columns["network"] = _answer(case, "network")
    registrar = case.object.registrar()
    if registrar is not None:
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
    for column in (*columns, confidence_title(result.reconstruction.calibrated), f"volume ({unit.volume_name})"):
        table.add_column(column, justify="right")
    each = [column.scores.per_segment for column in columns.values()]
    for segment, *ious in zip(result, *each, strict=True):
        row = (*(f"{iou:.3f}" for iou in ious), f"{segment.confidence:.2f}", unit.volume(segment.volume))
        table.add_row(segment.name, *row)
    table.add_section()
    table.add_row("all as one (IoU)", *(f"{column.scores.iou:.3f}" for column in columns.values()))
    table.add_row("mean of segments (mIoU)", *(f"{column.scores.miou:.3f}" for column in columns.values()))
    table.add_row("seconds", *(f"{column.seconds:.1f}" for column in columns.values()))
    return table
