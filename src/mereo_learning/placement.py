"""Where each segment of an object lies in a scan: the stages of ``mereo align``, and how well they fit.

First all segments that share the object's start move as one, then each moves by itself. A segment that the scan hardly
shows is not moved by what little there is: it keeps its own start where it was given one, or else its place at rest
relative to the nearest segment that is seen.
"""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mereo.geometry.conventions import LARGEST, CloudAxes
from mereo.geometry.downsampling import random_subset
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Points, Transform, Vector, fit_rigid, rigid, transform_points
from mereo.io.errors import readable
from mereo_learning.icp import (
    CONTACT,
    SEGMENT_LIMITS,
    WHOLE_LIMITS,
    Poses,
    Registration,
    Scan,
    diagonal,
    exposed,
    facing,
    match,
    moved,
    register,
)


@dataclass(frozen=True, eq=False)
class Start:
    """Rough poses of an object's segments, from which registration starts.

    Attributes:
        poses: ``T_scan_segment`` of every segment.
        separate: whether the segment was given a pose of its own; the others share the object's.
        how: where they come from, for the truth file.
    """

    poses: Poses
    separate: Bool[np.ndarray, " s"]
    how: str


@dataclass(frozen=True, eq=False)
class PlacedSegment:
    """Pose of one segment in the scan, and how well it fits. Lengths are in the scan's unit.

    Attributes:
        name: name of the segment.
        T_scan_segment: pose, from rest coordinates (scene units).
        placed_by: what decided the pose: "scan"; "object": as one with it, as asked; "start"; or "with NAME": at its
            place at rest relative to that segment.
        points: number of the scan's points that lie on it.
        median: median of their distances; NaN without points.
        rms: root of their mean square; NaN without points.
        p95: distance below which 95 % of them lie; NaN without points.
        shift: distance of its middle from where it started.
        turn_deg: angle from where it started.
        held: number of the six directions in which the scan did not constrain it.
    """

    name: str
    T_scan_segment: Transform
    placed_by: str
    points: int
    median: float
    rms: float
    p95: float
    shift: float
    turn_deg: float
    held: int

    @property
    def seen(self) -> bool:
        """Whether the scan decided the segment's pose, by itself or as one with the object."""
        return self.placed_by in ("scan", "object")


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of all segments in a scan, and how much of it they explain.

    Attributes:
        segments: pose and fit of each segment, in label order.
        mesh: the segments in the scan's frame and unit.
        limit: distance from the surface beyond which points do not count, in the scan's unit.
        explained: share of the scan's points within the limit.
    """

    segments: tuple[PlacedSegment, ...]
    mesh: SegmentedMesh
    limit: float
    explained: float


def scale_of(pose: Transform) -> float:
    """Scale of a similarity: scan units per scene unit; negative for a reflection."""
    return float(np.cbrt(np.linalg.det(pose[:3, :3])))


def place(
    rest: SegmentedMesh,
    points: Points,
    start: Start,
    frame: CloudAxes = "camera",
    *,
    is_rigid: bool = False,
    hold: Collection[str] = (),
) -> Placement:
    """Place every segment of ``rest`` on a scan.

    Args:
        rest: the object at rest, scene units.
        points: points of the scan, any unit.
        start: rough poses; the object's segments may be off by 20 degrees and a tenth of its size.
        frame: axes of the scan, as in ``mereo reconstruct``.
        is_rigid: whether the object is rigid; then only the first stage is done.
        hold: names of segments that are placed as if the scan did not show them.

    Raises ``ValueError`` when the result cannot be right: most of the scan lies far away, or a segment ran away.
    """
    if unknown := sorted(set(hold) - set(rest.names)):
        raise ValueError(
            f"there is no segment {unknown[0]!r} to hold; the segments are {', '.join(rest.names)}: correct the name"
        )
    size = scale_of(start.poses[0]) * diagonal(rest)
    # a scanner does not say where it stood: far off along z
    viewpoint = np.zeros(3) if frame == "camera" else points.mean(axis=0) + np.array([0.0, 0.0, 1000.0 * size])
    scan = Scan.of(points, viewpoint, size)
    shown = exposed(rest)
    held = np.isin(rest.names, list(hold))
    together = [int(index) for index in np.flatnonzero(~start.separate)]
    alone = [[int(index)] for index in np.flatnonzero(start.separate & ~held)]
    whole = register(shown, scan, start.poses, [together, *alone] if together else alone, WHOLE_LIMITS)
    _check(rest, start.poses, whole, scan, diagonal(rest))
    if is_rigid:
        return _measured(rest, shown, points, scan, start, whole, ["object"] * len(held))
    others = [[index] for index in range(len(held)) if not held[index]]
    each = register(shown, scan, whole.poses, others, SEGMENT_LIMITS, hold=True)
    _check(rest, np.where(start.separate[:, None, None], start.poses, whole.poses), each, scan)
    # segments that are not seen get their start or their neighbour's pose
    poses = each.poses.copy()
    placed_by = ["scan"] * len(each.poses)
    counts = np.bincount(each.matches.owner[each.matches.owner >= 0], minlength=len(poses))
    for index in np.flatnonzero(~each.fitted):
        if start.separate[index]:
            poses[index], placed_by[index] = start.poses[index], "start"
        elif each.fitted.any():
            nearest = neighbour(rest, int(index), each.fitted, counts)
            poses[index], placed_by[index] = each.poses[nearest], f"with {rest.names[nearest]}"
        else:
            raise ValueError("the scan shows no segment well enough to place it: check the start, or give --rigid")
    return _measured(rest, shown, points, scan, start, replace(each, poses=poses), placed_by)


def _check(rest: SegmentedMesh, before: Poses, result: Registration, scan: Scan, least: float = 0.0) -> None:
    """Most of the scan is explained, and no segment has moved farther than its own size, or ``least`` (scene units)."""
    share = float((result.matches.owner >= 0).mean())
    if not (share >= 0.4 and result.matches.limit < 0.1 * scan.size):
        raise ValueError(
            f"{share:.0%} of the scan's points lie within {result.matches.limit:.3g} of the placed object, which is "
            f"{scan.size:.3g} long; most must: check that the scan shows this object alone, its unit and --frame, and "
            "give a better start"
        )

    for index, segment in enumerate(rest.segments):
        low, high = segment.bounds
        shift = _shift(before[index], result.poses[index], (low + high) / 2)
        size = max(float(np.linalg.norm(high - low)), least) * scale_of(before[index])
        if shift > size:
            raise ValueError(
                f"segment {segment.name!r} moved by {shift:.3g} from its start, but at most {size:.3g}, its own size "
                "or the object's, is plausible: give it a start of its own (three pairs), or leave it at its neighbour "
                f"with --hold {segment.name}"
            )


def _shift(before: Transform, after: Transform, point: Vector) -> float:
    return float(np.linalg.norm(transform_points(after, point) - transform_points(before, point)))


def neighbour(rest: SegmentedMesh, index: int, seen: Bool[np.ndarray, " s"], counts: Int[np.ndarray, " s"]) -> int:
    """Index of the seen segment nearest to another one at rest; of several in contact that with the most points."""
    solids = Solids(rest)
    vertices = rest.segments[index].vertices
    gaps = {int(other): float(solids.segment_distance(int(other), vertices).min()) for other in np.flatnonzero(seen)}
    reach = min(gaps.values()) + CONTACT * diagonal(rest)
    return max((other for other, gap in gaps.items() if gap <= reach), key=lambda other: int(counts[other]))


def _measured(
    rest: SegmentedMesh,
    shown: SegmentedMesh,
    points: Points,
    scan: Scan,
    start: Start,
    result: Registration,
    placed_by: Sequence[str],
) -> Placement:
    """Residuals at the scan's own points, not at the thinned ones."""
    points = random_subset(points, 200_000)
    matches = match(points, facing(moved(shown, result.poses), scan.viewpoint), result.matches.limit)
    segments = []
    for index, segment in enumerate(rest.segments):
        distances = matches.distance[matches.owner == index]
        median, p95 = np.quantile(distances, [0.5, 0.95]) if len(distances) else (np.nan, np.nan)
        before, after = start.poses[index], result.poses[index]
        turn = Rotation.from_matrix((after @ np.linalg.inv(before))[:3, :3])
        segments.append(
            PlacedSegment(
                name=segment.name,
                T_scan_segment=after,
                placed_by=placed_by[index],
                points=len(distances),
                median=float(median),
                rms=float(np.sqrt(np.mean(distances**2))) if len(distances) else float("nan"),
                p95=float(p95),
                shift=_shift(before, after, segment.bounds.mean(axis=0)),
                turn_deg=float(np.rad2deg(turn.magnitude())),
                held=int(result.held[index]) if placed_by[index] == "scan" else 0,
            )
        )
    explained = float((matches.owner >= 0).mean())
    return Placement(tuple(segments), moved(rest, result.poses), matches.limit, explained)


# --- initial poses ----------------------------------------------------------------------------------------------------

#     {"object": {"model": [[x, y, z], ...], "scan": [[x, y, z], ...]},
#      "segments": {"tail": [[r, r, r, t], [r, r, r, t], [r, r, r, t], [0, 0, 0, 1]]}}
#
# ``object`` and each of ``segments`` is either a 4 x 4 matrix from model to scan coordinates, or pairs: at least three
# points of the model and the same points in the scan. Model coordinates are those of the scene at rest, as
# ``mereo scene export`` writes it; scan coordinates those of the scan's file.

PAIR_ERROR = 0.1
"""Largest RMS distance of pairs after the best fit, in diagonals of the object."""


def read_start(path: str | Path, rest: SegmentedMesh, scale: float | None = None) -> Start:
    """Rough poses from a start file; segments that it does not name share the object's.

    Args:
        path: the JSON file.
        rest: the object at rest, scene units.
        scale: scan units per scene unit, where known; otherwise the file's matrices must say it.

    Raises ``FileNotFoundError`` or ``ValueError`` naming the entry and what is wrong with it.
    """
    path = Path(path)
    with readable(path, "start file"):
        stated = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(stated, dict) or not {"object", "segments"} & set(stated):
            raise ValueError('it has neither "object" nor "segments"')
    if odd := sorted(set(stated) - {"object", "segments"}):
        raise ValueError(f'{path} has the key {odd[0]!r}; it may have "object" and "segments": correct it')
    segments = stated.get("segments", {})
    if not isinstance(segments, dict):
        raise ValueError(f'"segments" of {path} is not an object; it maps names to poses: see docs/training.md')
    if unknown := sorted(set(segments) - set(rest.names)):
        raise ValueError(
            f"{path} gives a start of the segment {unknown[0]!r}; the segments are {', '.join(rest.names)}: correct "
            "the name"
        )
    try:
        with np.errstate(all="ignore"):
            poses = {name: _pose(entry, f"segment {name!r}", rest, scale) for name, entry in segments.items()}
            common = _pose(stated["object"], "the object", rest, scale) if "object" in stated else None
    except ValueError as error:  # numpy's LinAlgError too
        raise ValueError(f"{path} cannot be used: {error}") from None
    missing = [name for name in rest.names if name not in poses]
    if common is None and missing:
        raise ValueError(
            f'{path} has no start for the segment {missing[0]!r} and none of the object; add it, or add "object", '
            "from which segments without a start of their own begin"
        )
    shared = next(iter(poses.values())) if common is None else common
    return Start(
        np.stack([poses.get(name, shared) for name in rest.names]),
        np.array([name in poses for name in rest.names]),
        "; ".join([*(["object"] if "object" in stated else []), *poses]) + f" from {path.name}",
    )


def _pose(entry: Any, of: str, rest: SegmentedMesh, scale: float | None) -> Transform:
    """Pose by an entry: of pairs, or a matrix, which must be a similarity without reflection, of the known scale."""
    if isinstance(entry, dict):
        if set(entry) != {"model", "scan"}:
            raise ValueError(
                f'the start of {of} has the keys {", ".join(map(repr, entry)) or "none"}; pairs are "model" and '
                '"scan", two lists of points: correct them'
            )
        model, scan = (_numbers(entry[key], (-1, 3), f"{key} of the start of {of}") for key in ("model", "scan"))
        return pose_of_pairs(model, scan, of, scale, PAIR_ERROR * diagonal(rest))
    pose = _numbers(entry, (4, 4), f"the start of {of}")
    size = scale_of(pose)
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ValueError(
            f"the start of {of} has the last row {pose[3].tolist()}; it must be 0 0 0 1: is it transposed?"
        )
    if size < 0:
        raise ValueError(
            f"the start of {of} is a reflection (its determinant is negative); it must turn, scale and shift only: "
            "align again without mirroring"
        )
    if size == 0 or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, size**2 * np.eye(3), atol=0.01 * size**2):
        raise ValueError(
            f"the start of {of} shears or stretches; it must be a rotation times one scale: align again without"
        )
    rotation = Rotation.from_matrix(pose[:3, :3] / size).as_matrix()
    if scale is None:
        return rigid(size * rotation, pose[:3, 3])
    check_scale(size, scale, of)
    middle = rest.bounds.mean(axis=0)  # stays where the start puts it
    return rigid(scale * rotation, pose[:3, :3] @ middle + pose[:3, 3] - scale * rotation @ middle)


def _numbers(value: Any, shape: tuple[int, int], what: str) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.zeros(0)
    fits = array.ndim == 2 and array.shape[1] == shape[1] and shape[0] in (-1, len(array))
    if not (fits and (np.abs(array) <= LARGEST).all()):
        rows = "4 rows of 4" if shape == (4, 4) else "rows of 3"
        raise ValueError(f"{what} must be {rows} finite numbers up to {LARGEST:g}: correct the start file")
    return array


def pose_of_pairs(
    model: Points,
    scan: Float[np.ndarray, "m 3"],
    of: str,
    scale: float | None,
    tolerance: float,
) -> Transform:
    """Similarity of known scale that takes points of the model to those of the scan best (Kabsch, 1976).

    Args:
        model: points of the object at rest, scene units.
        scan: the same points in the scan.
        of: what the pairs are of, for messages.
        scale: scan units per scene unit; None where it is not known, which is an error.
        tolerance: largest RMS distance after the fit, scene units.

    Raises ``ValueError`` for fewer than three pairs, points on a line, an unknown or another scale, mirrored pairs, or
    a residual above ``tolerance``.
    """
    if len(model) != len(scan) or len(model) < 3:  # two leave a turn about their line
        raise ValueError(
            f"the start of {of} has {len(model)} points of the model and {len(scan)} of the scan; at least "
            "3 pairs are needed: pick more"
        )
    source, target = model - model.mean(axis=0), scan - scan.mean(axis=0)
    spread = np.linalg.svd(source, compute_uv=False)
    if not spread[1] > 0.05 * spread[0]:
        raise ValueError(f"the points of the start of {of} lie on a line; they must span a triangle: pick another")
    rotation = fit_rigid(source, target)[:3, :3]
    size = float(np.sum(target * (source @ rotation.T)) / np.sum(source**2))
    if scale is None:
        raise ValueError(
            f"the size of the object is not known, and pairs are too rough to measure it (those of {of} say about "
            f"{size:.4g} scan units per scene unit): give the scene's unit with --scene-unit-mm"
        )
    check_scale(size, scale, of)
    error, mirrored = (misfit(scale * source * hand, target) for hand in ([1, 1, 1], [-1, 1, 1]))
    # nearly flat pairs do not tell whether they are mirrored
    if error > 0.2 * tolerance * scale and mirrored < error / 2:
        raise ValueError(
            f"the pairs of {of} fit a mirror image better ({mirrored:.3g} apart instead of {error:.3g}); poses do not "
            "mirror: check that left and right are not exchanged, and the axes of both files"
        )
    if error > tolerance * scale:
        raise ValueError(
            f"the pairs of {of} are {error:.3g} apart (RMS) after the best fit; at most {tolerance * scale:.3g} makes "
            "a start: check that both lists are in the same order"
        )
    return rigid(scale * rotation, scan.mean(axis=0) - scale * rotation @ model.mean(axis=0))


def misfit(source: Points, target: Points) -> float:
    """RMS distance of pairs of points after the best rigid motion."""
    moved = transform_points(fit_rigid(source, target), source)
    return float(np.sqrt(np.mean(np.sum((target - moved) ** 2, axis=1))))


def check_scale(stated: float, scale: float, of: str) -> None:
    """Raise ``ValueError`` unless the start's scale is about the known one."""
    if not 0.75 < stated / scale < 1.25:  # beyond, the unit is another, not picking inaccurate
        raise ValueError(
            f"the start of {of} has {stated:.4g} scan units per scene unit, but the units of scene and scan give "
            f"{scale:.4g}; they must agree: check --unit, --scene-unit-mm and the coordinates"
        )
