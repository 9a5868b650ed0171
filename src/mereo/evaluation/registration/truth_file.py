"""Ground truth of a scan as a file: what ``mereo align`` writes and ``mereo evaluate --scans`` takes."""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from mereo.evaluation.registration.icp import diagonal, moved
from mereo.evaluation.registration.placement import Placement
from mereo.evaluation.scans import PosedScan
from mereo.geometry.conventions import LARGEST, UNITS_M, CloudAxes
from mereo.geometry.mesh import SegmentedMesh
from mereo.io.atomic_files import write_json
from mereo.io.errors import readable
from mereo.io.readers import read_point_cloud
from mereo.scenes.registry import scene_named_in
from mereo.scenes.scene import SCENES, Scene

TRUTH = "truth.json"
"""Name of the file."""

MOST_CHARACTERS = 1000
"""Length of the scan's name."""

FORMAT = 1
"""Version of the file's format; others are not read."""


@dataclass(frozen=True)
class ScanFile:
    """File of the scan that a truth belongs to, and how to read it.

    Attributes:
        path: file of the point cloud.
        unit: unit of its coordinates.
        frame: its axes, as in ``mereo reconstruct``.
        drop_invalid: whether points without a measurement are left out on reading.
    """

    path: Path
    unit: str = "m"
    frame: CloudAxes = "camera"
    drop_invalid: bool = False


def write_truth(
    directory: Path, place: Path, scan: ScanFile, scene: str, rest: SegmentedMesh, placement: Placement, start: str
) -> None:
    """Write truth.json into ``directory``, which will be renamed to ``place``; files are named relative to that."""
    facts = {
        "format": FORMAT,
        "scene": scene if scene in SCENES else _relative(Path(scene), place),
        "scan": _relative(scan.path, place),
        "scan_sha256": sha256_of(scan.path),
        "unit": scan.unit,
        "frame": scan.frame,
        "drop_invalid": scan.drop_invalid,
        "start": start,
        "limit": placement.limit,
        "points_within_limit": placement.explained,
        "segments": {
            segment.name: {
                "rest_box": rest.segments[index].bounds,
                "T_scan_segment": segment.T_scan_segment,
                "placed_by": segment.placed_by,
                "points": segment.points,
                "residual": {"median": segment.median, "rms": segment.rms, "p95": segment.p95},
                "moved": {"shift": segment.shift, "turn_deg": segment.turn_deg},
                "held_directions": segment.held,
            }
            for index, segment in enumerate(placement.segments)
        },
    }
    write_json(directory / TRUTH, facts)


def _relative(path: Path, place: Path) -> str:
    return Path(os.path.relpath(path.resolve(), place.resolve())).as_posix()


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_truth(path: str | Path, scene: Scene | None = None) -> PosedScan:
    """Scan with its placed segments, from truth.json or the folder that holds it.

    Args:
        path: the file or its folder.
        scene: the scene that the scan was aligned with, which has to be given where it is a Python file.

    Raises ``FileNotFoundError`` where the file, its scan or its scene is missing, and ``ValueError`` where one of them
    is not what it was, or where the file names a Python scene and ``scene`` is not given.
    """
    path = Path(path)
    path = path / TRUTH if path.is_dir() else path
    with readable(path, "truth file of mereo align"):
        facts = json.loads(path.read_text(encoding="utf-8"))
        if facts["format"] != FORMAT:
            raise ValueError(f"its format is {facts['format']}, this mereo reads {FORMAT}")
        poses = {name: _array(entry["T_scan_segment"], (4, 4)) for name, entry in facts["segments"].items()}
        boxes = {name: _array(entry["rest_box"], (2, 3)) for name, entry in facts["segments"].items()}
        scan = ScanFile(path.parent / facts["scan"], facts["unit"], facts["frame"], facts["drop_invalid"])
        if not str(scan.path).isprintable() or len(facts["scan"]) > MOST_CHARACTERS:
            raise ValueError(f"the name of its scan is {facts['scan']!r:.40}")
        if scan.unit not in UNITS_M or scan.frame not in get_args(CloudAxes):
            raise ValueError(f"its unit is {scan.unit!r:.40} and its frame {scan.frame!r:.40}, which are unknown")
        name, scan_sha256 = str(facts["scene"]), facts["scan_sha256"]
    loaded = scene_named_in(path, name) if scene is None else scene
    rest, unit_m = loaded.rest, loaded.unit_m
    if rest.names != tuple(poses) or not _same_place(rest, boxes):
        raise ValueError(f"the meshes of the scene {name!r} are not those that {path} was made with: align again")
    if not scan.path.is_file():
        raise FileNotFoundError(f"{scan.path}, the scan of {path}, does not exist: put it there, or align again")
    if sha256_of(scan.path) != scan_sha256:
        raise ValueError(f"{scan.path} is not the file that {path} was made from (another SHA-256): align it again")
    cloud = read_point_cloud(scan.path, scan.drop_invalid)
    title = path.resolve().parent.name if path.name == TRUTH else path.stem
    scene_unit = None if unit_m is None else unit_m / UNITS_M[scan.unit]
    return PosedScan(title, cloud, moved(rest, np.stack(list(poses.values()))), scan.frame, scene_unit)


def _array(value: Any, shape: tuple[int, int]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"an array in it is not {shape[0]} x {shape[1]} numbers up to {LARGEST:g}")
    return array


def _same_place(rest: SegmentedMesh, boxes: dict[str, np.ndarray]) -> bool:
    """Not the same bytes: other versions of the libraries cut the same solid into other triangles."""
    slack = 1e-3 * diagonal(rest)
    return all(np.allclose(segment.bounds, boxes[segment.name], rtol=0, atol=slack) for segment in rest.segments)
