"""``mereo align``: place every segment of a model on a scan, show the residual, write the truth."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from mereo.evaluation.registration.icp import load_icp
from mereo.evaluation.registration.placement import Placement, Start, place, read_start, start_from_model
from mereo.evaluation.registration.truth_file import TRUTH, ScanFile, write_truth
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import UNITS_M
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.output_folders import new_directory
from mereo.io.readers import read_point_cloud
from mereo.io.writers.glb import viewer_rotation, write_segments_glb
from mereo.models.weights import load_model
from mereo.scenes.registry import files_of, is_yaml, load_scene
from mereo.scenes.scene import SCENES, Scene
from mereo.visualization.contact_sheets import save_png
from mereo.visualization.scan_overlay import overlay


def align_file(
    scan: ScanFile,
    scene: str,
    output: Path,
    *,
    start: Path | None = None,
    weights: str | None = None,
    scene_unit_mm: float | None = None,
    as_one: bool = False,
    hold: Collection[str] = (),
    force: bool = False,
) -> Placement:
    """Write truth.json, overlay.png and segments.glb into a new directory, and print the residuals.

    Args:
        scan: the full-resolution point cloud.
        scene: the scene's name or file.
        output: folder to create.
        start: the start file, see ``initial_poses.read_start``; either this or ``weights``.
        weights: a shipped name or a file, from which a start is made.
        scene_unit_mm: millimetres per scene unit, where the scene does not say.
        as_one: the object is rigid, see ``placement.place``.
        hold: names of segments that stay, see ``placement.place``.
        force: replace an existing folder that mereo wrote.
    """
    if (start is None) == (weights is None):
        raise ValueError(
            f"{'no start is' if start is None else 'two starts are'} given; one is needed: --start FILE or --weights "
            "NAME (docs/own-object.md says how to make a start file)"
        )
    load_icp()  # its absence is better said before the work
    read = [path for path in (scan.path, *files_of(scene), start, weights) if path is not None]
    with new_directory(output, force, read) as directory:
        loaded = load_scene(scene)
        cloud = read_point_cloud(scan.path, scan.drop_invalid)
        scale = known_scale(loaded, scan.unit, scene_unit_mm)
        rough = _start(start, weights, cloud, scan, loaded.rest, scale)
        placement = place(loaded.rest, cloud.points, rough, scan.frame, as_one=as_one, hold=hold)
        write_truth(directory, output, scan, scene, loaded.rest, placement, rough.how)
        write_segments_glb(directory / "segments.glb", placement.mesh, viewer_rotation(scan.frame), UNITS_M[scan.unit])
        save_png(directory / "overlay.png", overlay(placement, cloud, scan))
    print_placement(placement, f"{scan.path.name}, {len(cloud)} points", scan.unit)
    trusted = "" if scene in SCENES or is_yaml(scene) else f" --scene {scene}"  # a data file runs no Python scene
    evaluation = f"mereo evaluate WEIGHTS --scans {output / TRUTH}{trusted}"
    print(f"wrote {output}; look at {output / 'overlay.png'}, then: {evaluation}")
    return placement


def known_scale(scene: Scene, unit: str, scene_unit_mm: float | None) -> float | None:
    """Scan units per scene unit; None where neither the scene nor the user says."""
    if scene_unit_mm is not None and not 0 < scene_unit_mm < np.inf:
        raise ValueError(f"--scene-unit-mm is {scene_unit_mm}; it must be positive: give millimetres per scene unit")
    unit_m = scene.unit_m if scene_unit_mm is None else scene_unit_mm / 1000
    return None if unit_m is None else unit_m / UNITS_M[unit]


def _start(
    start: Path | None, weights: str | None, cloud: PointCloud, scan: ScanFile, rest: SegmentedMesh, scale: float | None
) -> Start:
    if start is not None:
        return read_start(start, rest, scale)
    assert weights is not None
    return start_from_model(load_model(weights), cloud.points, scan.frame, rest, scale)


# --- what is shown ---------------------------------------------------------------------------------------------------


def print_placement(placement: Placement, title: str, unit: str) -> None:
    """Print a table of the segments, lengths in millimetres, and how much of the scan they explain.

    Args:
        placement: in the scan's frame and unit.
        title: of the table.
        unit: of the scan.
    """
    mm = 1000 * UNITS_M[unit]
    table = Table(title=f"{title}; millimetres and degrees", title_justify="left", box=None, padding=(0, 2, 0, 0))
    for column in ("segment", "placed by"):
        table.add_column(column, no_wrap=True)
    for column in ("points", "median", "RMS", "95 %", "moved", "turned", "held"):
        table.add_column(column, justify="right")
    for one in placement.segments:
        fit = [f"{mm * value:.3f}" if one.points else "-" for value in (one.median, one.rms, one.p95)]
        by = one.placed_by if one.seen else f"unseen: {one.placed_by}"
        held = str(one.held) if one.held else ""
        table.add_row(one.name, by, str(one.points), *fit, f"{mm * one.shift:.2f}", f"{one.turn_deg:.1f}", held)
    console = Console(markup=False, emoji=False)
    console.print(table)
    console.print(
        f"{placement.explained:.1%} of the scan lies within {mm * placement.limit:.3g} mm of the placed segments",
        highlight=False,
        soft_wrap=True,
    )
    for one in placement.segments:
        if one.held:
            console.print(
                f"{one.name}: the scan leaves {one.held} of 6 directions open (it could turn or slide); there it "
                "stays where it was placed together with the others",
                highlight=False,
                soft_wrap=True,
            )
