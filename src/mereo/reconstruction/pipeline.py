"""The inverse path: from what a camera saw of an object to all its segments, hidden side included.

    PointCloud -normalize-> -encode-> code -query-> field -extract-> SegmentedMesh

Everything that comes out is in the input's frame and units.
"""

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from mereo.evaluation.scans import camera_axes, into_camera
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import PALETTE, Color, SegmentedMesh
from mereo.geometry.transforms import inverse_rigid, transform_points
from mereo.io.atomic_files import new_directory
from mereo.io.config import DEFAULT_FILES, FilesConfig
from mereo.io.writers.formats import Results, chosen_formats, write_formats
from mereo.io.writers.glb import viewer_rotation
from mereo.models.config import InferenceConfig
from mereo.models.model import Model
from mereo.models.weights import load_for
from mereo.reconstruction.coarse_to_fine import Field
from mereo.reconstruction.config import Frame, InputConfig, IsolationConfig
from mereo.reconstruction.isolation import STRAY_SHARE, stray_share
from mereo.reconstruction.isosurfaces import LabelGrid, extract_whole, locate
from mereo.reconstruction.observation import SizeWarning, read_observation, size_warning
from mereo.reconstruction.segment_statistics import FoundSegment, SegmentedCloud, measure, segment_points
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.reconstruction_report import write_report

SEARCH_BOX = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 2.5]])
"""Where segments are looked for first, normalized: the visible part fills [-1, 1], the hidden one lies behind it."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An object with all its segments, in the input's frame and units.

    Attributes:
        surfaces: every segment of the model as a closed mesh; without faces where it was not found. Which lie inside
            another is declared as in the model's scene.
        labels: the label grid.
        segments: each segment in numbers, in the same order.
        timings_s: seconds of each stage.
        evaluated: points at which the network was asked for surfaces.
        clipped: whether a segment still reached the largest box and was closed there.
        observed: the segment of each input point, where it was asked for.
    """

    surfaces: SegmentedMesh
    labels: LabelGrid
    segments: tuple[FoundSegment, ...]
    timings_s: dict[str, float]
    evaluated: int
    clipped: bool
    observed: SegmentedCloud | None = None


def reconstruct(
    cloud: PointCloud | Float[np.ndarray, "n 3"],
    model: Model,
    resolution: int = 128,
    frame: Frame = "camera",
    label_points: bool = False,
) -> Reconstruction:
    """All segments of the object that ``cloud`` shows.

    Args:
        cloud: points on the object, any unit and density.
        model: trained on this object, see ``mereo.load_model``.
        resolution: cells along the longest side of the object's box.
        frame: the cloud's axes: "camera" is x right, y down, z forward from the camera at the origin; "scanner" is y
            up, z toward the scanner.
        label_points: also say on which segment each point of the cloud lies (``Reconstruction.observed``).

    Raises ``ValueError`` for unusable clouds, and where the model finds no segment at all.
    """
    points = np.asarray(cloud.points if isinstance(cloud, PointCloud) else cloud, dtype=np.float64)
    timings: dict[str, float] = {}
    T_camera_input = into_camera(points, frame)
    with _timed(timings, "encode"):
        seen = transform_points(T_camera_input, points)
        code = model.encode(PointCloud(seen))
    field: Field = partial(model.logits, code)
    names, colors = segment_names(model)
    with _timed(timings, "locate"):
        box = locate(field, code.normalizer.invert(SEARCH_BOX))
    with _timed(timings, "extract"):
        found = extract_whole(field, box, resolution, names, colors, model.nested if "ce" in model.loss else ())
    with _timed(timings, "measure"):
        segments = measure(found, model, code)
    observed = None
    if label_points:
        with _timed(timings, "points"):
            observed = segment_points(field(seen), points, names, colors)
    clipped = bool(found.grid.touched_sides().any())
    result = Reconstruction(found.surfaces, found.grid, segments, timings, found.evaluated, clipped, observed)
    return result if frame == "camera" else _turned_back(result, inverse_rigid(T_camera_input))


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start


def segment_names(model: Model) -> tuple[tuple[str, ...], tuple[Color, ...]]:
    """Names and colours of the classes that the model tells apart; one trained on distances knows only the whole."""
    return (model.names, model.colors) if model.segmented else (("object",), PALETTE[:1])


def _turned_back(result: Reconstruction, T_scanner_camera: Float[np.ndarray, "4 4"]) -> Reconstruction:
    """From the camera frame to the scanner's: half a turn about x reverses the grid along y and z."""
    grid = result.labels
    last = np.asarray(grid.labels.shape) - 1
    corner = grid.origin + grid.spacing * last * np.array([0, 1, 1])
    labels = LabelGrid(
        np.ascontiguousarray(grid.labels[:, ::-1, ::-1]),
        transform_points(T_scanner_camera, corner),
        grid.spacing,
        grid.names,
    )
    segments = tuple(
        replace(
            segment,
            centroid=transform_points(T_scanner_camera, segment.centroid),
            box=np.sort(transform_points(T_scanner_camera, segment.box), axis=0),
        )
        for segment in result.segments
    )
    return replace(result, surfaces=result.surfaces.transformed(T_scanner_camera), labels=labels, segments=segments)


# --- files -----------------------------------------------------------------------------------------------------------


def summarize(result: Reconstruction, **facts: object) -> dict[str, Any]:
    """What ``summary.json`` holds: ``facts``, then each segment and the stages' seconds."""
    segments = [
        {
            "name": found.name,
            "label": found.label,
            "color": list(color),
            "volume": found.volume,
            "centroid": found.centroid.tolist(),
            "box": found.box.tolist(),
            "confidence": found.confidence,
            "voxels": found.voxels,
            "components": found.components,
        }
        for found, color in zip(result.segments, result.surfaces.colors, strict=True)
    ]
    return {
        **facts,
        "nested": [list(pair) for pair in result.surfaces.nested],
        "spacing": float(result.labels.spacing[0]),
        "evaluated_points": result.evaluated,
        "clipped": result.clipped,
        "segments": segments,
        "timings_s": result.timings_s,
    }


def write_reconstruction(
    result: Reconstruction,
    cloud: PointCloud,
    output_dir: str | Path,
    *,
    frame: Frame = "camera",
    files: FilesConfig = DEFAULT_FILES,
    unit_m: float = 1.0,
    force: bool = False,
    **facts: object,
) -> None:
    """Write preview.png, report.html and ``files`` into a new directory, all or nothing.

    By default these are segments.glb, labels.npz and summary.json; ``mereo.io.writers.formats.WRITERS`` names all. The
    format "points" needs ``reconstruct(..., label_points=True)``. ``facts`` (``title``, ``unit``, ...) are added to the
    summary and shown in the report. Raises ``FileExistsError`` for a directory with content unless ``force``, and
    ``ImportError`` where a format's extra is missing.
    """
    with new_directory(output_dir, force) as directory:
        _write_files(directory, result, cloud, frame, files, unit_m, facts)


def _write_files(
    directory: Path,
    result: Reconstruction,
    cloud: PointCloud,
    frame: Frame,
    files: FilesConfig,
    unit_m: float,
    facts: dict[str, object],
) -> None:
    started = time.perf_counter()
    formats = chosen_formats(files.formats)
    to_viewer = viewer_rotation(frame)
    results = Results.of(result.surfaces, result.labels, result.observed, to_viewer, files, unit_m)
    write_formats(directory, [name for name in formats if name != "json"], results)  # which states the time of these
    to_camera = camera_axes(frame)
    seen = PointCloud(transform_points(to_camera, cloud.points))
    title = str(facts.get("title", "mereo reconstruction"))
    render_cloud_and_segments(directory / "preview.png", seen, result.surfaces.transformed(to_camera), title)
    timings_s = {**result.timings_s, "write": time.perf_counter() - started}
    summary = summarize(replace(result, timings_s=timings_s), **{"frame": frame, "unit_m": unit_m, **facts})
    write_report(directory / "report.html", cloud, result.surfaces, summary, to_viewer)
    write_formats(directory, [name for name in formats if name == "json"], replace(results, summary=summary))


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
    force: bool = False,
) -> Reconstruction:
    """``mereo reconstruct``: read one frame of a sensor, reconstruct, write a new directory, print what was found."""
    formats = chosen_formats(files.formats)  # a missing extra is said before the work, not after
    with new_directory(output, force) as directory:
        seen = read_observation(input, reading, isolation)
        print(seen)
        apart = 0.0 if isolation.largest_cluster else stray_share(seen.cloud)
        if apart > STRAY_SHARE:
            print(f"{apart:.1%} of it lies apart from the largest group; if that is not the object: --largest-cluster")
        model = load_for(weights, inference)
        warning = size_warning(seen, model.provenance)
        if warning is not None:
            warnings.warn(warning, SizeWarning, stacklevel=2)
        result = reconstruct(seen.cloud, model, resolution, seen.frame, label_points="points" in formats)
        facts = {"title": seen.source, "weights": str(weights), "resolution": resolution, "points": len(seen.cloud)}
        facts |= {"device": model.device.type, "precision": model.working_precision}
        _write_files(directory, result, seen.cloud, seen.frame, files, seen.unit_m, {**facts, **seen.facts()})
    print_segments(result, f"{seen.source}, {len(seen.cloud)} points")
    print(f"wrote {output} in {sum(result.timings_s.values()):.1f} s; open {Path(output) / 'report.html'} in a browser")
    return result


def print_segments(result: Reconstruction, title: str) -> None:
    """A table of the segments, and a line of the stages' seconds."""
    table = Table(title=title, title_justify="left")
    table.add_column("segment")
    for column in ("volume", "confidence", "components", "centroid"):
        table.add_column(column, justify="right")
    for found in result.segments:
        place = " ".join(f"{value:.4g}" for value in found.centroid)
        row = (f"{found.volume:.4g}", f"{found.confidence:.2f}", str(found.components), place)
        table.add_row(found.name, *(row if found.voxels else ("0", "not found", "0", "")))
    console = Console()
    console.print(table)
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in result.timings_s.items())
    console.print(f"seconds: {stages}", highlight=False, soft_wrap=True)
    if result.clipped:
        console.print("a segment reaches out of the largest box and is closed there: check the cloud and the weights")
