"""Folders of results that `mereo reconstruct` leaves on disk."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import describe
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import Matrix, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.attachments import Surfaces, write_attachment
from mereo.io.config import DEFAULT_FILES, FilesConfig
from mereo.io.sensor_frame import SensorFrame
from mereo.io.writers.formats import Results, chosen_formats, write_formats, write_single
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION, write_segments_glb
from mereo.results.carry import Carried
from mereo.results.joints import measure_joints, pose_covariance, segment_poses
from mereo.results.state import write_state
from mereo.scenes.rest_pose import rest_digest
from mereo.visualization.previews import render_cloud_and_segments
from mereo.visualization.reconstruction_report import REPORT, Report, cluster, trust
from mereo.visualization.units import Unit

INSTANCE = "instance{}"
"""Folder of each further instance of the object, from the second on, in that of a result."""


def summary_of(
    answer: Answer, carried: Sequence[Carried] = (), timings_s: Mapping[str, float] | None = None
) -> JsonObject:
    """Content of ``summary.json``: what people read first, then facts of answer and frame, the coefficients last.

    Of a lost object without an answer there are no segments.
    """
    seen, frame = answer.seen, answer.seen.frame
    model, registrar = answer.model, answer.registrar
    facts: JsonObject = {
        "title": seen.frame.source,
        "weights": None if model is None else model.name,
        "resolution": answer.resolution,
        "points": len(seen.cloud),
        "recognition": answer.recognition.facts(),
    }
    if model is not None:
        facts |= {"device": model.device_type, "precision": model.working_precision}
    if carried:
        facts["carried"] = [item.facts() for item in carried]
    facts |= seen.facts()
    scene = None if registrar is None else registrar.given
    if scene is not None and scene.file is not None:
        # of what the file states and of the segments at rest
        digest = hashlib.sha256((rest_digest(scene.rest) + scene.definition).encode()).hexdigest()
        facts["scene_file"] = {"path": str(scene.file), "sha256": digest}
    if answer.registration is not None:
        facts["registration"] = {"located_by": answer.located_by, **describe(answer.registration)}
    axes = frame.axes if frame.T_result_seen is None else "other"
    # the first mention of a key is its place; what it is comes from the facts
    head = {"title": None, "verdict": trust(facts).level, "recognition": None, "frame": axes, "unit_m": None}
    if answer.is_missing:
        return {**head, "pose": None, "segments": [], "tracking": answer.tracking, **facts}
    result, fit = answer.reconstruction, answer.registered
    poses = {} if fit is None else segment_poses(fit)
    segments = [
        {**asdict(segment), **({} if fit is None else {"pose": poses[segment.name]}), "color": color}
        for segment, color in zip(result.segments, result.surfaces.colors, strict=True)
    ]
    radii = JsonObject()
    sure = None if fit is None else fit.uncertainty
    if fit is not None and sure is not None:
        radii["radius95"] = {**sure.summary(), "unit_m": frame.unit_m}
        for row, segment in zip(segments, sure.segments, strict=True):
            row |= asdict(segment)
        radii["pose_covariance"] = pose_covariance(fit)
    joints = {name: joint.facts() for name, joint in measure_joints(answer).items()}
    return {
        **head,
        "pose": None if fit is None else fit.pose(),
        "segments": segments,
        **({"joints": joints} if joints else {}),
        **radii,
        "model_scale": None if fit is None else fit.model_scale,
        "nested": result.surfaces.nested,
        "spacing": float(result.labels.spacing[0]),
        "evaluated_points": result.evaluated,
        "clipped": result.clipped,
        "calibrated": result.calibrated,
        "timings_s": dict(result.timings_s if timings_s is None else timings_s),
        **({"further_instances": [summary_of(each) for each in answer.further]} if answer.further else {}),
        **facts,
    }


def write_answer(
    directory: Path, answer: Answer, files: FilesConfig = DEFAULT_FILES, carried: Sequence[Carried] = ()
) -> None:
    """Write preview.png, report.html, the state and ``files`` of an answer into a directory that is there.

    By default these are segments.glb, labels.npz and summary.json; ``mereo.io.writers.formats.WRITERS`` names all. The
    format "points" needs an answer with ``label_points``. Files that need metres take the frame's unit for them where
    it is not known.

    What is carried goes into ``carried/`` under its files' own names; its surfaces also into pictures and report, and
    together with the segments into ``carried.glb``, where GLB is asked for. Further instances get folders of their own,
    ``INSTANCE``, and all surfaces of all of them are in ``instances.glb``.

    Raises ``ValueError`` where the network answers and finds no segment, ``ImportError`` where a format's extra is
    missing.
    """
    reconstruction, frame = answer.reconstruction, answer.seen.frame
    started = time.perf_counter()
    formats = chosen_formats(files.formats)
    results = _results(answer, files)
    to_viewer = to_viewer_of(frame)
    write_formats(directory, [name for name in formats if name != "json"], results)  # which states the time of these
    for item in carried:
        write_attachment(directory / "carried" / item.name, item.content, results.factor, to_viewer, frame.metres)
    shown = with_carried(reconstruction.surfaces, carried)
    extra = shown.names[: len(shown.segments) - len(reconstruction.surfaces.segments)]
    if "glb" in formats and extra:
        write_segments_glb(directory / "carried.glb", shown, to_viewer, frame.metres)
    drawn = coarsened(shown)
    write_preview(directory / "preview.png", answer, drawn)
    summary = summary_of(answer, carried, {**reconstruction.timings_s, "write": time.perf_counter() - started})
    rows = [*({"name": name} for name in extra), *summary["segments"]]
    report_of(answer, drawn, {**summary, "segments": rows}).write(directory / REPORT)
    write_formats(directory, [name for name in formats if name == "json"], replace(results, summary=summary))
    write_state(directory, answer)
    for number, each in enumerate(answer.further, start=2):
        (directory / INSTANCE.format(number)).mkdir()
        write_answer(directory / INSTANCE.format(number), each, files)
    if answer.further and "glb" in formats:
        every = [
            replace(segment, name=f"{number} {segment.name}")
            for number, each in enumerate((answer, *answer.further), start=1)
            for segment in each.reconstruction.surfaces.segments
        ]
        write_segments_glb(directory / "instances.glb", SegmentedMesh(tuple(every)), to_viewer, frame.metres)


def write_answer_file(path: Path, suffix: str, answer: Answer, files: FilesConfig) -> None:
    """Write the one file of a folder of results that has this suffix (".glb", ".html", ...) to a path."""
    surfaces = answer.reconstruction.surfaces
    if suffix == ".png":
        write_preview(path, answer, coarsened(surfaces))
    elif suffix == ".html":
        report_of(answer, coarsened(surfaces), summary_of(answer)).write(path)
    else:
        write_single(path, suffix, replace(_results(answer, files), summary=summary_of(answer)))


def _results(answer: Answer, files: FilesConfig) -> Results:
    """What the writers of all formats are given."""
    result, frame = answer.reconstruction, answer.seen.frame
    radii = radii_of(answer.registered)
    to_viewer = to_viewer_of(frame)
    parts = result.surfaces, result.labels, result.observed
    return Results(*parts, to_viewer, frame.metres, files.millimetres, radii=radii)


def to_viewer_of(frame: SensorFrame) -> Matrix:
    """Rotation from a frame's axes to glTF's, in which it is seen as its camera saw it."""
    return GLTF_CAMERA_ROTATION @ frame.T_camera_result[:3, :3]


def report_of(answer: Answer, surfaces: SegmentedMesh, summary: JsonObject) -> Report:
    """Page of an answer with these surfaces, which may be coarser and more than its own."""
    frame, cloud = answer.seen.frame, answer.seen.cloud
    to_viewer = to_viewer_of(frame)
    unit = Unit(frame.unit_m)
    return Report(cloud, surfaces, summary, to_viewer, unit, answer.registered, frame.depth)


def radii_of(registered: Registration | None) -> Radii | None:
    """Radii of a registered model's points, in its frame; None where they are not known."""
    if registered is None or registered.uncertainty is None:
        return None
    return registered.uncertainty.radii(registered.material)


def write_preview(path: Path, answer: Answer, surfaces: SegmentedMesh) -> None:
    """Write the picture of an answer's cloud and these surfaces, both turned as a camera sees them."""
    frame, to_camera = answer.seen.frame, answer.seen.frame.T_camera_result
    cloud = PointCloud(transform_points(to_camera, answer.seen.cloud.points))
    render_cloud_and_segments(path, cloud, surfaces.transformed(to_camera), frame.source)


# --- surfaces as pictures and reports need them -----------------------------------------------------------------------


def coarsened(mesh: SegmentedMesh) -> SegmentedMesh:
    """A mesh coarse enough to be drawn: shading takes seconds for each hundred thousand faces of a segment."""
    return replace(
        mesh,
        segments=tuple(
            cluster(segment, float(np.ptp(segment.vertices, axis=0).max()) / 150)  # cells along the longest side
            if len(segment.faces) > 100_000
            else segment
            for segment in mesh.segments
        ),
    )


def with_carried(surfaces: SegmentedMesh, carried: Sequence[Carried]) -> SegmentedMesh:
    """Segments with all carried surfaces before them, declared to lie inside them, so that they are seen through them.

    Their names are those of their files, with that of the part where a file has several; their colours differ from the
    segments'.
    """
    parts = list[Segment]()
    for item in carried:
        if isinstance(item.content, Surfaces):
            segments = item.content.mesh.segments
            several = len(segments) > 1
            parts += [replace(s, name=f"{item.name}: {s.name}" if several else item.name) for s in segments]
    free = [color for color in reversed(PALETTE) if color not in surfaces.colors] or list(PALETTE)
    parts = [replace(part, color=free[index % len(free)]) for index, part in enumerate(parts)]
    nested = tuple((part.name, name) for part in parts for name in surfaces.names)
    return SegmentedMesh((*parts, *surfaces.segments), (*surfaces.nested, *nested))
