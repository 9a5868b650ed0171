"""Folders of results that `mereo reconstruct` and `mereo evaluate` leave on disk."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mereo.evaluation.results import Evaluation
from mereo.evaluation.scan_scoring import evaluate_scans
from mereo.evaluation.scoring import CELLS, evaluate, trained_scene
from mereo.evaluation.tables import markdown_table, metrics
from mereo.fitting.config import FitChoice
from mereo.fitting.registration.carry import Carried
from mereo.fitting.registration.registration import Registration
from mereo.fitting.uncertainty.uncertainty import Uncertainty
from mereo.geometry.camera import DepthImage, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.scanner_axes import camera_axes
from mereo.geometry.transforms import transform_points
from mereo.io.atomic_files import write_json
from mereo.io.attachments import write_attachment
from mereo.io.config import CONFIG, DEFAULT_FILES, FilesConfig
from mereo.io.output_folders import new_directory
from mereo.io.writers.formats import WRITERS, Results, chosen_formats, write_formats
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.config import EXACT, InferenceConfig
from mereo.models.elsewhere import for_tasks
from mereo.models.model import Model
from mereo.models.weights import load_for
from mereo.reconstruction.pipeline import Reconstruction
from mereo.scenes.registry import files_of, load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig
from mereo.visualization.error_maps import error_picture
from mereo.visualization.evaluation_report import write_evaluation_report
from mereo.visualization.pictured import pictured, with_carried
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.reconstruction_report import write_report
from mereo.visualization.units import UNKNOWN, Unit
from mereo.workers.config import Cluster


def evaluate_weights(
    weights: Model | str | Path,
    output: str | Path,
    *,
    examples: int = 128,
    seed: int = TEST_SEED_START,
    scene: Scene | str | None = None,
    cells: int = CELLS,
    settings: GenerateConfig | None = None,
    inference: InferenceConfig = EXACT,
    choice: FitChoice = "auto",
    force: bool = False,
    options: Mapping[str, Any] | None = None,
    cluster: Cluster | None = None,
) -> Evaluation:
    """Score weights, write metrics.json, table.md, errors.png, report.html, and print the table: ``mereo evaluate``.

    With ``force`` an existing folder that mereo wrote is replaced; ``options`` are written to config.json.
    Each view is a task of ``cluster``, where one is given.
    """
    read = [*([] if isinstance(weights, Model) else [weights]), *_files_of(scene)]
    with new_directory(output, force, read) as directory:
        model = weights if isinstance(weights, Model) else load_for(weights, for_tasks(inference, cluster))
        settings = settings or GenerateConfig()
        evaluation = evaluate(
            model,
            scene,
            examples=examples,
            seed=seed,
            cells=cells,
            progress=True,
            settings=settings,
            choice=choice,
            cluster=cluster,
        )
        facts = {
            "weights": model.name if isinstance(weights, Model) else str(weights),
            "scene": scene.name if isinstance(scene, Scene) else scene or trained_scene(model),
            "seed": seed,
            "image_size": settings.image_size,
            "noise_std": settings.noise_std,
            "sensor": asdict(settings.sensor),
            "workspace": settings.workspace,
            "device": cluster.device if cluster else model.device.type,
            "precision": model.working_precision,
            "trained": model.provenance,
        }
        write_evaluation(directory, evaluation, facts, options)
    print(markdown_table(evaluation))
    print(f"wrote {output}")
    return evaluation


def evaluate_on_scans(
    model: Model,
    output: str | Path,
    *,
    truths: Sequence[str | Path] = (),
    scene: Scene | str | None = None,
    cells: int = CELLS,
    choice: FitChoice = "auto",
    force: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Score a model on real scans, with the same files as ``evaluate_weights``: ``mereo evaluate --scans``.

    Takes the arguments of ``evaluate_scans``; ``scene`` may be a name or a file; the others are as there.
    """
    with new_directory(output, force, [*truths, *_files_of(scene)]) as directory:
        loaded = load_scene(scene) if isinstance(scene, str) else scene
        evaluation = evaluate_scans(model, truths=truths, scene=loaded, cells=cells, choice=choice)
        facts = {"scans": list(evaluation.examples), "truths": [str(path) for path in truths]}
        write_evaluation(directory, evaluation, {**facts, "trained": model.provenance}, options)
    print(markdown_table(evaluation))
    return evaluation


def _files_of(scene: Scene | str | None) -> list[Path]:
    """Files that a named scene is read from."""
    return files_of(scene) if isinstance(scene, str) else []


def write_evaluation(
    directory: Path, evaluation: Evaluation, facts: dict[str, Any], options: Mapping[str, Any] | None = None
) -> None:
    """Write metrics.json, table.md, errors.png and report.html; ``facts`` come first in the JSON.

    Also config.json of ``options``, where there are any.
    """
    if options is not None:
        write_json(directory / CONFIG, options)
    found = metrics(evaluation, facts)
    write_json(directory / "metrics.json", found)
    (directory / "table.md").write_text(markdown_table(evaluation), encoding="utf-8")
    error_picture(directory / "errors.png", evaluation.views)
    write_evaluation_report(directory / "report.html", found, evaluation.views[0].colors, directory / "errors.png")


def summarize(result: Reconstruction, sure: Uncertainty | None = None, **facts: object) -> dict[str, Any]:
    """Content of ``summary.json``: ``facts``, then how sure it is, each segment and the stages' seconds."""
    segments: list[dict[str, Any]] = [
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
    told: dict[str, Any] = {}
    if sure is not None:
        told["radius95"] = {**sure.summary(), "unit_m": facts.get("unit_m")}
        for row, one in zip(segments, sure.segments, strict=True):
            row |= {"centroid_radius95": one.centroid_radius95, "volume95": list(one.volume95)}
    return {
        **facts,
        **told,
        "nested": [list(pair) for pair in result.surfaces.nested],
        "spacing": float(result.labels.spacing[0]),
        "evaluated_points": result.evaluated,
        "clipped": result.clipped,
        "calibrated": result.calibrated,
        "segments": segments,
        "timings_s": result.timings_s,
    }


def write_reconstruction(
    result: Reconstruction,
    cloud: PointCloud,
    output_dir: str | Path,
    *,
    frame: CloudAxes = "camera",
    files: FilesConfig = DEFAULT_FILES,
    unit_m: float | None = None,
    force: bool = False,
    **facts: object,
) -> None:
    """Write preview.png, report.html and ``files`` into a new directory, all or nothing.

    By default these are segments.glb, labels.npz and summary.json; ``mereo.io.writers.formats.WRITERS`` names all. The
    format "points" needs ``reconstruct(..., label_points=True)``. ``unit_m`` is metres per unit of the cloud; without
    it files that need one take metres, and the report has plain units. ``facts`` (``title``, ...) are added to the
    summary and shown in the report. Raises ``FileExistsError`` for a directory with content unless ``force``, and
    ``ImportError`` where a format's extra is missing.
    """
    with new_directory(output_dir, force) as directory:
        metres = 1.0 if unit_m is None else unit_m
        write_files(directory, result, cloud, frame, files, metres, facts, unit=Unit(unit_m))


def write_files(
    directory: Path,
    result: Reconstruction,
    cloud: PointCloud,
    frame: CloudAxes,
    files: FilesConfig,
    unit_m: float,
    facts: dict[str, object],
    carried: Sequence[Carried] = (),
    unit: Unit = UNKNOWN,
    registered: Registration | None = None,
    depth: DepthImage | None = None,
) -> None:
    """Write what ``write_reconstruction`` does into a directory that is there; ``facts`` go into the summary.

    ``unit`` is that of the report, which tells no metres where they were only assumed. ``registered`` is the model that
    the result is, in the input's frame (``Answer.registered``): then files, summary and report say how sure it is.
    ``depth`` is the image that the cloud comes from, which the report shows.

    What is carried goes into ``carried/`` under its files' own names; its surfaces also into pictures and report, and
    together with the segments into ``carried.glb``, where GLB is asked for.
    """
    started = time.perf_counter()
    formats = chosen_formats(files.formats)
    to_viewer = viewer_rotation(frame)
    radii, sure = radii_of(registered), None if registered is None else registered.uncertainty
    results = Results.of(result.surfaces, result.labels, result.observed, to_viewer, files, unit_m, radii)
    write_formats(directory, [name for name in formats if name != "json"], results)  # which states the time of these
    for one in carried:
        write_attachment(directory / "carried" / one.name, one.content, results.factor, to_viewer, unit_m)
    shown = with_carried(result.surfaces, carried)
    if "glb" in formats and len(shown.segments) > len(result.surfaces.segments):
        write_segments_glb(directory / "carried.glb", shown, to_viewer, unit_m)
    drawn = pictured(shown)
    write_preview(directory / "preview.png", drawn, cloud, frame, facts)
    timings_s = {**result.timings_s, "write": time.perf_counter() - started}
    summary = summarize(replace(result, timings_s=timings_s), sure, **{"frame": frame, "unit_m": unit_m, **facts})
    extra = shown.segments[: len(shown.segments) - len(result.surfaces.segments)]
    told = [*({"name": part.name} for part in extra), *summary["segments"]]
    told_all, page = {**summary, "segments": told}, directory / "report.html"
    write_report(page, cloud, drawn, told_all, to_viewer, unit, registered, depth)
    write_formats(directory, [name for name in formats if name == "json"], replace(results, summary=summary))


def write_one(
    path: Path,
    suffix: str,
    result: Reconstruction,
    cloud: PointCloud,
    frame: CloudAxes,
    files: FilesConfig,
    unit_m: float,
    facts: dict[str, object],
    unit: Unit = UNKNOWN,
    registered: Registration | None = None,
    depth: DepthImage | None = None,
) -> None:
    """Write the one file of a folder of results that has this suffix (".glb", ".html", ...) to a path."""
    if suffix in (".png", ".html"):
        drawn = pictured(result.surfaces)
        if suffix == ".png":
            write_preview(path, drawn, cloud, frame, facts)
            return
    sure = None if registered is None else registered.uncertainty
    summary = summarize(result, sure, **{"frame": frame, "unit_m": unit_m, **facts})
    if suffix == ".html":
        write_report(path, cloud, drawn, summary, viewer_rotation(frame), unit, registered, depth)
        return
    (name,) = (name for name, writer in WRITERS.items() if writer.file.endswith(suffix) and name != "points")
    chosen_formats([name])
    surfaces, labels, turn = result.surfaces, result.labels, viewer_rotation(frame)
    results = Results.of(surfaces, labels, result.observed, turn, files, unit_m, radii_of(registered))
    WRITERS[name].write(path, replace(results, summary=summary))


def radii_of(registered: Registration | None) -> Radii | None:
    """Radii of a registered model's points, in its frame; None where they are not known."""
    if registered is None or registered.uncertainty is None:
        return None
    return registered.uncertainty.radii(registered.material)


def write_preview(
    path: Path, surfaces: SegmentedMesh, cloud: PointCloud, frame: CloudAxes, facts: dict[str, object]
) -> None:
    """Write the picture of cloud and segments, both turned as a camera sees them."""
    to_camera = camera_axes(frame)
    seen = PointCloud(transform_points(to_camera, cloud.points))
    title = str(facts.get("title", "mereo reconstruction"))
    render_cloud_and_segments(path, seen, surfaces.transformed(to_camera), title)
