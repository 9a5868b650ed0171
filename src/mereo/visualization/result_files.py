"""Folders of results that `mereo reconstruct` leaves on disk."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.carry import Carried
from mereo.fitting.registration.register import describe
from mereo.fitting.registration.registration import Registration
from mereo.fitting.registration.state import write_state
from mereo.geometry.camera import PointCloud, camera_axes
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import transform_points
from mereo.io.attachments import write_attachment
from mereo.io.config import DEFAULT_FILES, FilesConfig
from mereo.io.writers.formats import WRITERS, Results, chosen_formats, write_formats
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.scenes.rest_pose import rest_digest
from mereo.scenes.scene import Scene
from mereo.visualization.pictured import pictured, with_carried
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.reconstruction_report import write_report
from mereo.visualization.units import Unit


def summary_of(
    answer: Answer, carried: Sequence[Carried] = (), timings_s: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Content of ``summary.json``: facts of the frame, how sure the answer is, each segment, the stages' seconds."""
    result, frame = answer.reconstruction, answer.seen.frame
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
    radii: dict[str, Any] = {}
    sure = None if answer.registered is None else answer.registered.uncertainty
    if sure is not None:
        radii["radius95"] = {**sure.summary(), "unit_m": frame.unit_m}
        for row, one in zip(segments, sure.segments, strict=True):
            row |= {"centroid_radius95": one.centroid_radius95, "volume95": list(one.volume95)}
    return {
        "frame": frame.axes,
        "unit_m": frame.unit_m,
        **frame_facts(answer, carried),
        **radii,
        "nested": [list(pair) for pair in result.surfaces.nested],
        "spacing": float(result.labels.spacing[0]),
        "evaluated_points": result.evaluated,
        "clipped": result.clipped,
        "calibrated": result.calibrated,
        "segments": segments,
        "timings_s": dict(result.timings_s if timings_s is None else timings_s),
    }


def frame_facts(answer: Answer, carried: Sequence[Carried] = ()) -> dict[str, object]:
    """Facts of a summary about the frame, what answered it, and whether it shows the object."""
    seen, model, registrar = answer.seen, answer.model, answer.registrar
    facts: dict[str, object] = {
        "title": seen.frame.source,
        "weights": None if model is None else model.name,
        "resolution": answer.resolution,
        "points": len(seen.cloud),
    }
    if registrar is not None:
        facts["registration"] = registration_facts(answer)
    facts["recognition"] = answer.recognition.facts()
    if model is not None:
        facts |= {"device": model.device_type, "precision": model.working_precision}
    if carried:
        facts["carried"] = [one.facts() for one in carried]
    return {**facts, **seen.facts(), **scene_facts(None if registrar is None else registrar.given)}


def scene_facts(scene: Scene | None) -> dict[str, object]:
    """What a summary says of the scene file that was given; nothing of a scene that is no file's.

    The digest is of what the file states and of the segments at rest.
    """
    if scene is None or scene.file is None:
        return {}
    digest = hashlib.sha256((rest_digest(scene.rest) + scene.definition).encode()).hexdigest()
    return {"scene_file": {"path": str(scene.file), "sha256": digest}}


def registration_facts(answer: Answer) -> dict[str, object]:
    """Facts of a summary about where an answer comes from."""
    source = "registration" if answer.taken else "network"
    if answer.registration is None:
        return {"answer": source, "found_by": answer.found_by, "refusal": answer.refusal}
    return {"answer": source, "found_by": answer.found_by, **describe(answer.registration)}


def write_answer(
    directory: Path, answer: Answer, files: FilesConfig = DEFAULT_FILES, carried: Sequence[Carried] = ()
) -> None:
    """Write preview.png, report.html, the state and ``files`` of an answer into a directory that is there.

    By default these are segments.glb, labels.npz and summary.json; ``mereo.io.writers.formats.WRITERS`` names all. The
    format "points" needs an answer with ``label_points``. Files that need metres take the frame's unit for them where
    it is not known.

    What is carried goes into ``carried/`` under its files' own names; its surfaces also into pictures and report, and
    together with the segments into ``carried.glb``, where GLB is asked for.

    Raises ``ValueError`` where the network answers and finds no segment, ``ImportError`` where a format's extra is
    missing.
    """
    result, frame, cloud = answer.reconstruction, answer.seen.frame, answer.seen.cloud
    started = time.perf_counter()
    formats = chosen_formats(files.formats)
    results, to_viewer = _results(answer, files), viewer_rotation(frame.axes)
    write_formats(directory, [name for name in formats if name != "json"], results)  # which states the time of these
    for one in carried:
        write_attachment(directory / "carried" / one.name, one.content, results.factor, to_viewer, frame.metres)
    shown = with_carried(result.surfaces, carried)
    if "glb" in formats and len(shown.segments) > len(result.surfaces.segments):
        write_segments_glb(directory / "carried.glb", shown, to_viewer, frame.metres)
    drawn = pictured(shown)
    write_preview(directory / "preview.png", drawn, cloud, frame.axes, frame.source)
    summary = summary_of(answer, carried, {**result.timings_s, "write": time.perf_counter() - started})
    extra = shown.segments[: len(shown.segments) - len(result.surfaces.segments)]
    rows = [*({"name": part.name} for part in extra), *summary["segments"]]
    page, unit = {**summary, "segments": rows}, Unit(frame.unit_m)
    write_report(directory / "report.html", cloud, drawn, page, to_viewer, unit, answer.registered, frame.depth)
    write_formats(directory, [name for name in formats if name == "json"], replace(results, summary=summary))
    write_state(directory, answer)


def write_answer_file(path: Path, suffix: str, answer: Answer, files: FilesConfig) -> None:
    """Write the one file of a folder of results that has this suffix (".glb", ".html", ...) to a path."""
    result, frame, cloud = answer.reconstruction, answer.seen.frame, answer.seen.cloud
    if suffix == ".png":
        write_preview(path, pictured(result.surfaces), cloud, frame.axes, frame.source)
    elif suffix == ".html":
        drawn, summary, unit = pictured(result.surfaces), summary_of(answer), Unit(frame.unit_m)
        write_report(path, cloud, drawn, summary, viewer_rotation(frame.axes), unit, answer.registered, frame.depth)
    else:
        (name,) = (name for name, writer in WRITERS.items() if writer.file.endswith(suffix) and name != "points")
        chosen_formats([name])
        WRITERS[name].write(path, replace(_results(answer, files), summary=summary_of(answer)))


def _results(answer: Answer, files: FilesConfig) -> Results:
    """What the writers of all formats are given."""
    result, frame = answer.reconstruction, answer.seen.frame
    radii, to_viewer = radii_of(answer.registered), viewer_rotation(frame.axes)
    parts = result.surfaces, result.labels, result.observed
    return Results(*parts, to_viewer, frame.metres, files.millimetres, radii=radii)


def radii_of(registered: Registration | None) -> Radii | None:
    """Radii of a registered model's points, in its frame; None where they are not known."""
    if registered is None or registered.uncertainty is None:
        return None
    return registered.uncertainty.radii(registered.material)


def write_preview(path: Path, surfaces: SegmentedMesh, cloud: PointCloud, frame: CloudAxes, title: str) -> None:
    """Write the picture of cloud and segments, both turned as a camera sees them."""
    to_camera = camera_axes(frame)
    seen = PointCloud(transform_points(to_camera, cloud.points))
    render_cloud_and_segments(path, seen, surfaces.transformed(to_camera), title)
