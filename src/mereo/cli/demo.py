"""``mereo demo``: a real range scan and two rendered depth frames, back to segments, compared with the truth."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mereo.evaluation.ground_truth import TruthGrid, truth_grid
from mereo.evaluation.metrics import Scores, intersection_over_union
from mereo.evaluation.results import grid_confusion
from mereo.evaluation.sample_views import load_view
from mereo.evaluation.scans import bunny_posed
from mereo.evaluation.scoring import predict_grid
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.pipeline import Reconstruction, reconstruct, segment_names
from mereo.scenes.assets import AssetUnavailable
from mereo.visualization.result_files import write_reconstruction

REAL_SCAN = "bun000"
FRAMES = ("liver", "rope")
RESOLUTION = 100

OWN_OBJECT = """[bold]On your own data[/bold]
  mereo reconstruct cloud.ply --weights bunny --output result
  mereo reconstruct depth.png --intrinsics camera.json --depth-scale 1000 --weights bunny --output result

[bold]On your own object[/bold], from its meshes; docs/own-object.md explains each step
  mereo scene new PART.stl PART.stl --output NAME.yaml
  mereo scene check NAME.yaml
  mereo scene preview NAME.yaml --output states.png
  mereo generate NAME.yaml --examples 12000 --seed 1 --sampler nested-sort-sample --uniform-fraction 0.5 --output data
  mereo train data --output run --preset base --init bunny
  mereo evaluate run/weights.safetensors --scene NAME.yaml --output test
  mereo reconstruct frame.ply --weights run/weights.safetensors --output result"""


@dataclass(frozen=True, eq=False)
class Case:
    """Input of the demo with its truth.

    Attributes:
        name: of the output folder.
        title: one line about it.
        weights: a shipped name.
        cloud, frame: the input as its sensor gives it.
        truth: the right answer, in a camera frame.
    """

    name: str
    title: str
    weights: str
    cloud: PointCloud
    frame: CloudAxes
    truth: TruthGrid


def main(output: str | Path = Path("out/demo")) -> None:
    """Reconstruct every input that can be had, print tables, and write a folder each below ``output``."""
    console, started = Console(), time.perf_counter()
    for make in _inputs():
        try:
            case = make()
        except AssetUnavailable as error:
            console.print(f"The real scan {REAL_SCAN} is left out: {error}\n", highlight=False, soft_wrap=True)
            continue
        _show(case, load_model(case.weights), Path(output) / case.name, console)
    console.print(f"All in {time.perf_counter() - started:.0f} s.\n", highlight=False)
    console.print(OWN_OBJECT, highlight=False, soft_wrap=True)


def _inputs() -> Iterator[Callable[[], Case]]:
    """Inputs of the demo: the real scan first, then frames of other objects."""
    yield _scan_case
    for name in FRAMES:
        yield partial(_frame_case, name)


def _scan_case() -> Case:
    scan = bunny_posed(REAL_SCAN)
    _, truth, _ = scan.in_camera()
    title = f"{REAL_SCAN}: a real Cyberware range scan of the Stanford bunny, metres"
    return Case(REAL_SCAN, title, "bunny", scan.cloud, scan.frame, truth_grid(truth))


def _frame_case(name: str) -> Case:
    view = load_view(name)
    camera = view.depth.camera
    cloud = view.depth.to_points()
    title = f"{name}: a rendered {camera.width} x {camera.height} depth image with noise, scene units"
    return Case(name, title, name, cloud, "camera", view.truth)


def _show(case: Case, model: Model, folder: Path, console: Console) -> None:
    result = reconstruct(case.cloud, model, RESOLUTION, case.frame)
    started = time.perf_counter()
    write_reconstruction(
        result, case.cloud, folder, frame=case.frame, force=True, title=case.title, weights=case.weights
    )
    written_s = time.perf_counter() - started
    predicted = predict_grid(model, result.code, case.truth)
    scores = intersection_over_union(
        grid_confusion(case.truth, predicted, len(segment_names(model)[0])), model.segmented
    )
    console.print(_table(case, result, scores))
    stages = {**result.timings_s, "write": written_s}
    seconds = ", ".join(f"{stage} {value:.1f} s" for stage, value in stages.items())
    console.print(f"{len(case.cloud)} points; {seconds}", highlight=False, soft_wrap=True)
    console.print(f"look at {folder / 'report.html'}\n", highlight=False, soft_wrap=True)


def _table(case: Case, result: Reconstruction, scores: Scores) -> Table:
    table = Table(title=case.title, title_justify="left")
    table.add_column("segment")
    for column in ("IoU with the truth", "confidence", "volume"):
        table.add_column(column, justify="right")
    for found, iou in zip(result.segments, scores.per_segment, strict=True):
        table.add_row(found.name, f"{iou:.3f}", f"{found.confidence:.2f}", f"{found.volume:.4g}")
    table.add_section()
    table.add_row("all as one (IoU)", f"{scores.iou:.3f}", "", "")
    table.add_row("mean of segments (mIoU)", f"{scores.miou:.3f}", "", "")
    return table
