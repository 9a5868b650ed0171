"""Where each segment of an object lies in a scan: the stages of ``mereo align``, and how well they fit.

First all segments that share the object's start move as one, then each moves by itself. A segment that the scan hardly
shows is not moved by what little there is: it keeps its own start where it was given one, or else its place at rest
relative to the nearest segment that is seen.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mereo.evaluation.registration.icp import SEGMENT_LIMITS, WHOLE_LIMITS, Registration, Scan, match, register
from mereo.evaluation.registration.visible_surface import CONTACT, Poses, diagonal, exposed, facing, moved
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.downsampling import random_subset
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import transform_points

FAR = 1000.0
"""Distance of a scanner where the scan does not say it, in diagonals of the object."""

LEAST_EXPLAINED = 0.4
"""Share of the scan's points that must lie on the placed object: below, the start or the unit is wrong."""

MEASURED = 200_000
"""Most points of the scan at which residuals are taken."""


@dataclass(frozen=True, eq=False)
class Start:
    """Rough poses of an object's segments, from which registration starts.

    Attributes:
        poses: ``T_scan_segment`` of every segment.
        own: whether the segment was given a pose of its own; the others share the object's.
        how: where they come from, for the truth file.
    """

    poses: Poses
    own: Bool[np.ndarray, " s"]
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
    T_scan_segment: Float[np.ndarray, "4 4"]
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


def scale_of(pose: Float[np.ndarray, "4 4"]) -> float:
    """Scale of a similarity: scan units per scene unit; negative for a reflection."""
    return float(np.cbrt(np.linalg.det(pose[:3, :3])))


def viewpoint_of(points: Float[np.ndarray, "n 3"], frame: CloudAxes, size: float) -> Float[np.ndarray, "3"]:
    """Place where the scanner stood: the origin of a camera frame, far off along z of a scanner's."""
    return np.zeros(3) if frame == "camera" else points.mean(axis=0) + np.array([0.0, 0.0, FAR * size])


def place(
    rest: SegmentedMesh,
    points: Float[np.ndarray, "n 3"],
    start: Start,
    frame: CloudAxes = "camera",
    *,
    as_one: bool = False,
    hold: Collection[str] = (),
) -> Placement:
    """Place every segment of ``rest`` on a scan.

    Args:
        rest: the object at rest, scene units.
        points: points of the scan, any unit.
        start: rough poses; the object's segments may be off by 20 degrees and a tenth of its size.
        frame: axes of the scan, as in ``mereo reconstruct``.
        as_one: whether the object is rigid; then only the first stage is done.
        hold: names of segments that are placed as if the scan did not show them.

    Raises ``ValueError`` when the result cannot be right: most of the scan lies elsewhere, or a segment ran away.
    """
    if unknown := sorted(set(hold) - set(rest.names)):
        raise ValueError(
            f"there is no segment {unknown[0]!r} to hold; the segments are {', '.join(rest.names)}: correct the name"
        )
    size = scale_of(start.poses[0]) * diagonal(rest)
    scan = Scan.of(points, viewpoint_of(points, frame, size), size)
    shown = exposed(rest)
    held = np.isin(rest.names, list(hold))
    together = [int(index) for index in np.flatnonzero(~start.own)]
    alone = [[int(index)] for index in np.flatnonzero(start.own & ~held)]
    whole = register(shown, scan, start.poses, [together, *alone] if together else alone, WHOLE_LIMITS)
    _check_explained(whole, scan)
    _check_runaway(rest, start.poses, whole, diagonal(rest))
    if as_one:
        return _measured(rest, shown, points, scan, start, whole, ["object"] * len(held))
    others = [[index] for index in range(len(held)) if not held[index]]
    each = register(shown, scan, whole.poses, others, SEGMENT_LIMITS, hold=True)
    _check_explained(each, scan)
    _check_runaway(rest, np.where(start.own[:, None, None], start.poses, whole.poses), each)
    final, placed_by = _with_neighbours(rest, start, each)
    return _measured(rest, shown, points, scan, start, final, placed_by)


def _check_explained(found: Registration, scan: Scan) -> None:
    share = float((found.matches.owner >= 0).mean())
    if not (share >= LEAST_EXPLAINED and found.matches.limit < 0.1 * scan.size):
        raise ValueError(
            f"{share:.0%} of the scan's points lie within {found.matches.limit:.3g} of the placed object, which is "
            f"{scan.size:.3g} long; most must: check that the scan shows this object alone, its unit and --frame, and "
            "give a better start"
        )


def _check_runaway(rest: SegmentedMesh, before: Poses, found: Registration, least: float = 0.0) -> None:
    """No segment may move farther than its own size, or than ``least`` (scene units)."""
    for index, segment in enumerate(rest.segments):
        low, high = segment.bounds
        shift = _shift(before[index], found.poses[index], (low + high) / 2)
        size = max(float(np.linalg.norm(high - low)), least) * scale_of(before[index])
        if shift > size:
            raise ValueError(
                f"segment {segment.name!r} moved by {shift:.3g} from its start, but at most {size:.3g}, its own size "
                "or the object's, is plausible: give it a start of its own (three pairs), or leave it at its neighbour "
                f"with --hold {segment.name}"
            )


def _shift(before: Float[np.ndarray, "4 4"], after: Float[np.ndarray, "4 4"], place: Float[np.ndarray, "3"]) -> float:
    return float(np.linalg.norm(transform_points(after, place) - transform_points(before, place)))


def _with_neighbours(rest: SegmentedMesh, start: Start, found: Registration) -> tuple[Registration, list[str]]:
    """Segments that are not seen get their start or their neighbour's pose; and by what each one is placed."""
    poses, placed_by = found.poses.copy(), ["scan"] * len(found.poses)
    counts = np.bincount(found.matches.owner[found.matches.owner >= 0], minlength=len(poses))
    for index in np.flatnonzero(~found.fitted):
        if start.own[index]:
            poses[index], placed_by[index] = start.poses[index], "start"
        elif found.fitted.any():
            beside = neighbour(rest, int(index), found.fitted, counts)
            poses[index], placed_by[index] = found.poses[beside], f"with {rest.names[beside]}"
        else:
            raise ValueError("the scan shows no segment well enough to place it: check the start, or give --as-one")
    return replace(found, poses=poses), placed_by


def neighbour(rest: SegmentedMesh, index: int, seen: Bool[np.ndarray, " s"], counts: Int[np.ndarray, " s"]) -> int:
    """Index of the seen segment nearest to another one at rest; of several in contact that with the most points."""
    solids, vertices = Solids(rest), rest.segments[index].vertices
    gaps = {int(other): float(solids.segment_distance(int(other), vertices).min()) for other in np.flatnonzero(seen)}
    reach = min(gaps.values()) + CONTACT * diagonal(rest)
    return max((other for other, gap in gaps.items() if gap <= reach), key=lambda other: int(counts[other]))


def _measured(
    rest: SegmentedMesh,
    shown: SegmentedMesh,
    points: Float[np.ndarray, "n 3"],
    scan: Scan,
    start: Start,
    found: Registration,
    placed_by: Sequence[str],
) -> Placement:
    """Residuals at the scan's own points, not at the thinned ones."""
    points = random_subset(points, MEASURED)
    matches = match(points, facing(moved(shown, found.poses), scan.viewpoint), found.matches.limit)
    segments = []
    for index, segment in enumerate(rest.segments):
        distances = matches.distance[matches.owner == index]
        median, p95 = np.quantile(distances, [0.5, 0.95]) if len(distances) else (np.nan, np.nan)
        before, after = start.poses[index], found.poses[index]
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
                held=int(found.held[index]) if placed_by[index] == "scan" else 0,
            )
        )
    explained = float((matches.owner >= 0).mean())
    return Placement(tuple(segments), moved(rest, found.poses), matches.limit, explained)
