"""Rigid registration of an object's segments to a scan of it (paper, section 4.3), from a rough start.

Point-to-plane ICP is small_gicp's; what is decided here is which scan points a segment may answer for. A scan shows one
side of an object and every segment only in part, so each round

1. leaves out the faces that cannot be in the scan: those turned away from the scanner, those inside or in contact with
   another segment at rest (nested, a cut, a joint);
2. gives each scan point to the segment whose remaining surface is nearest, unless that is farther than a limit, which
   shrinks from round to round;
3. moves each body (all segments at first, then each by itself) onto its own points.

A body is held in the directions in which its points do not constrain it (a ball turns freely, a rod slides), after
Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems" (ICRA 2016).

Notation: ``T_scan_segment`` maps rest coordinates (scene units) to the scan's frame and unit: a similarity. Motions are
rigid, in the scan's frame. p points, s segments.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mereo.frame import inverse_rigid, rigid, transform_points
from mereo.mesh import Segment, SegmentedMesh
from mereo.solid import Solids

Poses = Float[np.ndarray, "s 4 4"]
"""``T_scan_segment`` of each segment, in label order."""

CELLS = 200
"""Scan points are thinned to one in a cell of a two-hundredth of the object's diagonal."""

CONTACT = 0.005
"""Faces nearer than this to another segment at rest are in contact, in diagonals of the object."""

FACING = -0.1
"""Least cosine between a face's normal and the way to the scanner; below 0, as the pose is not right yet."""

WHOLE_LIMITS = (0.15, 0.1, 0.06, 0.04, 0.025, 0.015, 0.01, 0.007, 0.005)
SEGMENT_LIMITS = (0.05, 0.03, 0.02, 0.013, 0.009, 0.007, 0.005, 0.005)
"""How far a point may lie from the surface in each round, in diagonals of the object, but see ``NOISE_LIMIT``."""

NOISE_LIMIT = 5.0
"""A limit is at least this many medians of the points' distances: it trims outliers, not the scanner's noise."""

LEAST_POINTS = 40
LEAST_SHARE = 0.02
"""A body is moved only by this many points at least, which cover at least this share of its surface."""

LOOSE = 0.002
"""A direction whose curvature, per point and with the body's radius as unit, is below this is held. A flat square turns
about its normal with 0 and tilts with 0.2; the bunny's right ear, seen from the side, has 0.008."""

ITERATIONS = 8
"""Of ICP in each round; the next round goes on."""


def load_icp() -> ModuleType:
    """The library that does ICP; raises ``ImportError`` with a sentence that names the extra."""
    try:
        import small_gicp
    except ImportError:
        raise ImportError(
            "small_gicp, which registers segments to scans, is not installed: pip install 'mereo[align]'"
        ) from None
    module: ModuleType = small_gicp
    return module


# --- the scan, and the surfaces that it can show ---------------------------------------------------------------------


def diagonal(mesh: SegmentedMesh) -> float:
    """Of the joint box of all segments."""
    low, high = mesh.bounds
    return float(np.linalg.norm(high - low))


@dataclass(frozen=True, eq=False)
class Scan:
    """What is registered to, in its own frame and unit.

    Attributes:
        points: thinned.
        viewpoint: where the scanner stood.
        size: the object's diagonal.
        area: of the surface that one point stands for.
    """

    points: Float[np.ndarray, "p 3"]
    viewpoint: Float[np.ndarray, "3"]
    size: float
    area: float

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"], viewpoint: Float[np.ndarray, "3"], size: float) -> "Scan":
        """Thin ``points`` of an object of diagonal ``size``. Raises ``ValueError`` for fewer than ``LEAST_POINTS``."""
        kept = thinned(points, size / CELLS)
        if len(kept) < LEAST_POINTS:
            raise ValueError(
                f"the scan has {len(kept)} points that are {size / CELLS:.3g} apart; at least {LEAST_POINTS} are "
                "needed: check the scan and its unit"
            )
        apart = KDTree(kept).query(kept, k=2)[0][:, 1]
        return cls(kept, viewpoint, size, float(np.median(apart)) ** 2)


def thinned(points: Float[np.ndarray, "n 3"], spacing: float) -> Float[np.ndarray, "p 3"]:
    """One of the points in each cell of a grid: their mean would lie off a curved surface."""
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]


def exposed(rest: SegmentedMesh) -> SegmentedMesh:
    """The faces that can be seen from outside: not inside another segment and not within ``CONTACT`` of one."""
    solids, reach = Solids(rest), CONTACT * diagonal(rest)
    inner = {index for index, _ in rest.nesting}
    shown = []
    for index, segment in enumerate(rest.segments):
        middles = segment.vertices[segment.faces].mean(axis=1)
        hidden = np.full(len(middles), index in inner)
        for other in set(range(solids.count)) - inner - {index}:
            hidden |= (solids.segment_distance(other, middles) < reach) | solids.inside(other, middles)
        shown.append(replace(segment, faces=segment.faces[~hidden]))
    return replace(rest, segments=tuple(shown))


def moved(mesh: SegmentedMesh, poses: Poses) -> SegmentedMesh:
    """Each segment by its own transform."""
    pairs = zip(poses, mesh.segments, strict=True)
    return mesh.with_vertices([transform_points(pose, segment.vertices) for pose, segment in pairs])


def facing(placed: SegmentedMesh, viewpoint: Float[np.ndarray, "3"]) -> SegmentedMesh:
    """The faces that are turned towards ``viewpoint``."""
    return replace(placed, segments=tuple(_facing(segment, viewpoint) for segment in placed.segments))


def _facing(segment: Segment, viewpoint: Float[np.ndarray, "3"]) -> Segment:
    corners = segment.vertices[segment.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    way = viewpoint - corners.mean(axis=1)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
    return replace(segment, faces=segment.faces[np.einsum("ij,ij->i", normal, way) > FACING * size])


@dataclass(frozen=True, eq=False)
class Matches:
    """Which segment each point lies on.

    Attributes:
        owner: its index; -1 where the nearest surface is farther than ``limit``.
        distance: to the nearest surface.
        limit: in the scan's unit.
    """

    owner: Int[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    limit: float


def match(points: Float[np.ndarray, "p 3"], surfaces: SegmentedMesh, limit: float) -> Matches:
    """Give each point to the segment of the nearest surface, if within ``limit`` or ``NOISE_LIMIT`` medians."""
    filled = [index for index, segment in enumerate(surfaces.segments) if len(segment.faces)]
    nearest = Solids(SegmentedMesh(tuple(surfaces.segments[index] for index in filled))).nearest(points)
    limit = max(limit, NOISE_LIMIT * float(np.median(nearest.distance)))
    owner = np.where(nearest.distance < limit, np.asarray(filled)[nearest.owner], -1)
    return Matches(owner, nearest.distance, limit)


# --- motion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Registration:
    """Poses that fit a scan.

    Attributes:
        poses: of every segment.
        fitted: whether the scan moved the segment's body in the last round; otherwise it shows too little of it.
        held: in how many of six directions the body was held.
        matches: of the last round.
    """

    poses: Poses
    fitted: Bool[np.ndarray, " s"]
    held: Int[np.ndarray, " s"]
    matches: Matches


def register(
    shown: SegmentedMesh, scan: Scan, poses: Poses, bodies: Sequence[Sequence[int]], limits: Sequence[float]
) -> Registration:
    """Move each body, a list of segments, onto the scan; all segments take part in saying whose a point is.

    Args:
        shown: from ``exposed``.
        scan: the scan.
        poses: where to start.
        bodies: indices of the segments that move together; what is in none stays.
        limits: one for each round, in diagonals of the object.
    """
    fitted, held = np.zeros(len(poses), dtype=bool), np.zeros(len(poses), dtype=np.int64)
    for limit in limits:
        surfaces = facing(moved(shown, poses), scan.viewpoint)
        matches = match(scan.points, surfaces, limit * scan.size)
        poses = poses.copy()
        for body in map(list, bodies):
            points = scan.points[np.isin(matches.owner, body)]
            surface = SegmentedMesh(tuple(surfaces.segments[index] for index in body))
            fitted[body] = shows(points, surface, scan.area)
            if fitted[body[0]]:
                motion, held[body] = icp(points, surface, matches.limit, scan.area)
                poses[body] = motion @ poses[body]
    surfaces = facing(moved(shown, poses), scan.viewpoint)
    return Registration(poses, fitted, held, match(scan.points, surfaces, limits[-1] * scan.size))


def shows(points: Float[np.ndarray, "p 3"], surface: SegmentedMesh, area: float) -> bool:
    """Whether these points, each standing for ``area``, cover enough of the side that faces the scanner."""
    return len(points) >= LEAST_POINTS and len(points) * area >= LEAST_SHARE * float(face_areas(surface).sum())


def icp(
    points: Float[np.ndarray, "p 3"], surface: SegmentedMesh, limit: float, area: float
) -> tuple[Float[np.ndarray, "4 4"], int]:
    """The rigid motion of ``surface`` onto ``points``, and in how many directions it is held."""
    library = load_icp()
    samples = sample_surface(surface, area / 2)
    center = samples.mean(axis=0)
    radius = float(np.linalg.norm(samples - center, axis=1).max())
    target = library.PointCloud((samples - center) / radius)
    tree = library.KdTree(target)
    library.estimate_normals(target, tree, 12)
    result = library.align(
        target,
        library.PointCloud((points - center) / radius),
        tree,
        registration_type="PLANE_ICP",
        max_correspondence_distance=2 * (limit + np.sqrt(area)) / radius,  # points are chosen; it only must not cut
        max_iterations=ITERATIONS,
        rotation_epsilon=1e-6,
        translation_epsilon=1e-6,
    )
    points_to_surface, held = constrained(result.T_target_source, result.H / max(result.num_inliers, 1))
    motion = inverse_rigid(points_to_surface)
    motion[:3, 3] = center - motion[:3, :3] @ center + radius * motion[:3, 3]
    return motion, held


def constrained(
    motion: Float[np.ndarray, "4 4"], curvature: Float[np.ndarray, "6 6"]
) -> tuple[Float[np.ndarray, "4 4"], int]:
    """``motion`` without its part along directions (turns, then shifts) curved less than ``LOOSE``, and how many."""
    values, directions = np.linalg.eigh(curvature)
    firm = directions[:, values >= LOOSE]
    if firm.shape[1] == 6:
        return motion, 0
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    kept = firm @ (firm.T @ np.concatenate([turn, motion[:3, 3]]))
    return rigid(Rotation.from_rotvec(kept[:3]).as_matrix(), kept[3:]), 6 - firm.shape[1]


def face_areas(mesh: SegmentedMesh) -> Float[np.ndarray, " f"]:
    """Of all faces of all segments."""
    vertices, faces, _ = mesh.merged()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def sample_surface(mesh: SegmentedMesh, area: float, least: int = 1000, most: int = 60_000) -> Float[np.ndarray, "n 3"]:
    """Points on the faces, uniformly, one for each ``area``; the same ones in every call."""
    areas = face_areas(mesh)
    rng = np.random.default_rng(0)
    count = int(np.clip(areas.sum() / area, least, most))
    vertices, faces, _ = mesh.merged()
    corners = vertices[faces[rng.choice(len(faces), size=count, p=areas / areas.sum())]]
    along, across = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return a * (1 - along) + b * along * (1 - across) + c * along * across
