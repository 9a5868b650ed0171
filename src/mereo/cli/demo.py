"""``mereo demo``: a real range scan and two rendered depth frames, back to segments, compared with the truth.

Network and registered model stand side by side; what is written is the answer that `mereo reconstruct` gives.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from rich.console import Console
from rich.table import Table

from mereo.cli.reconstruct import print_source
from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.results import grid_confusion
from mereo.evaluation.sample_views import load_view
from mereo.evaluation.scans import bunny_posed
from mereo.evaluation.scoring import predict_grid
from mereo.fitting.registration.answer import Answer, answer_fitted
from mereo.fitting.registration.readings import fitted_frame
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.fitting.registration.state import write_state
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.solids import label_grid
from mereo.io.config import DEFAULT_FILES
from mereo.io.output_folders import check_new_directory, new_directory
from mereo.io.scratch_folders import check_place
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.pipeline import Reconstruction, extract, segment_names
from mereo.scenes.assets import AssetUnavailable
from mereo.visualization.report_words import confidence_title
from mereo.visualization.result import registration_facts
from mereo.visualization.result_files import write_files
from mereo.visualization.units import Unit

REAL_SCAN = "bun000"
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
        weights: a shipped name.
        cloud, frame: the input as its sensor gives it.
        truth: the right answer, in a camera frame.
        unit_m: metres in the input's unit; None for scene units.
    """

    name: str
    title: str
    weights: str
    cloud: PointCloud
    frame: CloudAxes
    truth: TruthGrid
    unit_m: float | None = None


@dataclass(frozen=True, eq=False)
class Column:
    """Scores of one answer to a case, and the seconds that it took from the cloud on."""

    scores: Scores
    seconds: float


def main(output: str | Path = Path("out/demo")) -> None:
    """Reconstruct every input that can be had, print tables, and write a folder each below ``output``."""
    check_place(Path(output), may_be_link=True)
    console, started = Console(markup=False, emoji=False), time.perf_counter()
    for make in _inputs():
        try:
            case = make()
        except AssetUnavailable as error:
            console.print(f"The real scan {REAL_SCAN} is left out: {error}\n", highlight=False, soft_wrap=True)
            continue
        folder = _folder(Path(output) / case.name)
        _show(case, load_model(case.weights), folder, console)
    console.print(f"All in {time.perf_counter() - started:.0f} s.\n", highlight=False)
    console.print(OWN_OBJECT, markup=True, highlight=False, soft_wrap=True)


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
    scan = bunny_posed(REAL_SCAN)
    _, truth, _ = scan.in_camera()
    title = f"{REAL_SCAN}: a real Cyberware range scan of the Stanford bunny, metres"
    return Case(REAL_SCAN, title, "bunny", scan.cloud, scan.frame, truth_grid(truth), 1.0)


def _frame_case(name: str) -> Case:
    view = load_view(name)
    camera = view.depth.camera
    cloud = view.depth.to_points()
    title = f"{name}: a rendered {camera.width} x {camera.height} depth image with noise, scene units"
    return Case(name, title, name, cloud, "camera", view.truth)


def _show(case: Case, model: Model, folder: Path, console: Console) -> None:
    """Reconstruct a case, print network and fit beside the truth, and write the folder of the default answer."""
    registrar = registrar_for(model, "auto")
    stated = None if case.unit_m is None or registrar is None else registrar.stated_unit(case.unit_m)
    started = time.perf_counter()
    fitted = fitted_frame(case.cloud, model, registrar, case.frame, stated_unit=stated)
    spent = time.perf_counter() - started
    network = extract(fitted.unaided, model, RESOLUTION)
    labels = predict_grid(model, network.code, case.truth)
    columns = {"network": Column(_scores(case, model, labels), seconds_of(network))}
    found = Answer(network)
    if registrar is not None:
        started = time.perf_counter()
        found = answer_fitted(fitted, model, registrar, RESOLUTION, stated_unit=stated)
        seconds = spent + time.perf_counter() - started
        if found.registration is not None:
            labels = label_grid(found.registration.mesh, *case.truth.grid.axes())
            columns["fit"] = Column(_scores(case, model, labels), seconds)
    console.print(_table(case, found.reconstruction, columns))
    started = time.perf_counter()
    _write(case, found, registrar, folder)
    written_s = time.perf_counter() - started
    page = f", or in the browser: mereo view {folder}" if found.taken else ""
    line = f"{len(case.cloud)} points; written in {written_s:.1f} s; look at {folder / 'report.html'}{page}\n"
    console.print(line, highlight=False, soft_wrap=True)


def _write(case: Case, found: Answer, registrar: Registrar | None, folder: Path) -> None:
    """Say which answer it is, and write its folder."""
    facts: dict[str, object] = {"title": case.title, "weights": case.weights}
    if registrar is None:
        print(f"the network's answer: the weights {case.weights!r} carry no statistical model that could be registered")
    else:
        print_source(found)
        facts["registration"] = registration_facts(found)
        facts["recognition"] = found.recognition.facts()
    with new_directory(folder, force=True) as directory:
        write_files(
            directory,
            found.reconstruction,
            case.cloud,
            case.frame,
            DEFAULT_FILES,
            1.0,
            facts,
            unit=Unit(case.unit_m),
            registered=found.registered,
        )
        write_state(directory, found, registrar, case.weights, case.frame, 1.0)


def _scores(case: Case, model: Model, predicted: UInt8[np.ndarray, "x y z"]) -> Scores:
    confusion = grid_confusion(case.truth, predicted, len(segment_names(model)[0]))
    return intersection_over_union(confusion, model.segmented)


def seconds_of(result: Reconstruction) -> float:
    """Seconds of all stages of a reconstruction."""
    return sum(result.timings_s.values())


def _table(case: Case, result: Reconstruction, columns: dict[str, Column]) -> Table:
    """Table of the scores of each segment by network and fit, and of what is written."""
    table = Table(title=case.title, title_justify="left")
    table.add_column("IoU with the truth")
    for column in (*columns, confidence_title(result.calibrated), "volume"):
        table.add_column(column, justify="right")
    each = [column.scores.per_segment for column in columns.values()]
    for found, *ious in zip(result.segments, *each, strict=True):
        table.add_row(found.name, *(f"{iou:.3f}" for iou in ious), f"{found.confidence:.2f}", f"{found.volume:.4g}")
    table.add_section()
    table.add_row("all as one (IoU)", *(f"{column.scores.iou:.3f}" for column in columns.values()))
    table.add_row("mean of segments (mIoU)", *(f"{column.scores.miou:.3f}" for column in columns.values()))
    table.add_row("seconds", *(f"{column.seconds:.1f}" for column in columns.values()))
    return table
