"""Rigid registration of an object's segments to a scan of it (paper, section 4.3), from a rough start.

ICP is small_gicp's generalized one (plane to plane; Segal, Haehnel and Thrun, RSS 2009); what is decided here is which
scan points a segment may answer for. A scan shows one side of an object and every segment only in part, so each round

1. leaves out the faces that cannot be in the scan: those turned away from the scanner, those inside or in contact with
   another segment at rest (nested, a cut, a joint);
2. gives each scan point to the segment whose remaining surface is nearest, unless that is farther than a limit, which
   shrinks from round to round;
3. moves each body (all segments at first, then each by itself) onto its own points.

On request, a body is held in the directions in which its points do not constrain it (a ball turns freely, a rod
slides), after Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems" (ICRA 2016).

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

from mereo.geometry.downsampling import first_in_cell
from mereo.geometry.mesh import SegmentedMesh, area_vectors
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import Points, Transform, Vector, inverse_rigid, rigid, transform_points, unit_rows

# --- the visible surface ----------------------------------------------------------------------------------------------

Poses = Float[np.ndarray, "s 4 4"]
"""``T_scan_segment`` of each segment, in label order."""

CONTACT = 0.005
"""Distance from another segment at rest below which faces are in contact with it, in diagonals of the object."""

CLUSTER = 6
"""Number of points of one sample of the surface; five are the least from which the library estimates a normal."""


def diagonal(mesh: SegmentedMesh) -> float:
    """Length of the diagonal of the joint box of all segments."""
    low, high = mesh.bounds
    return float(np.linalg.norm(high - low))


def exposed(rest: SegmentedMesh) -> SegmentedMesh:
    """Faces that can be seen from outside: not inside another segment and not within ``CONTACT`` of one."""
    solids = Solids(rest)
    reach = CONTACT * diagonal(rest)
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
    """Mesh whose segments are moved, each by its own transform."""
    pairs = zip(poses, mesh.segments, strict=True)
    return mesh.with_vertices([transform_points(pose, segment.vertices) for pose, segment in pairs])


def facing(placed: SegmentedMesh, viewpoint: Vector) -> SegmentedMesh:
    """Faces that are turned towards ``viewpoint``, or nearly."""
    segments = []
    for segment in placed.segments:
        normal = area_vectors(segment.vertices, segment.faces)
        way = viewpoint - segment.vertices[segment.faces].mean(axis=1)
        size = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
        is_facing = np.einsum("ij,ij->i", normal, way) > -0.1 * size  # below 0, as the pose is not right yet
        segments.append(replace(segment, faces=segment.faces[is_facing]))
    return replace(placed, segments=tuple(segments))


def face_areas(mesh: SegmentedMesh) -> Float[np.ndarray, " f"]:
    """Areas of all faces, segment by segment."""
    vertices, faces, _ = mesh.merged()
    return np.linalg.norm(area_vectors(vertices, faces), axis=1) / 2


def sample_surface(
    mesh: SegmentedMesh, area: float, least: int = 1000, most: int = 20_000
) -> Float[np.ndarray, "n c 3"]:
    """Samples spread evenly over the faces, one for each ``area``: tiny rings of ``CLUSTER`` points in the face.

    The library takes no normals but estimates them from neighbours. Rings make the estimate the face's own normal; from
    single points it is so rough that a ball seems to resist turning. The same places in every call.
    """
    areas = face_areas(mesh)
    rng = np.random.default_rng(0)
    count = int(np.clip(areas.sum() / area, least, most))
    vertices, faces, _ = mesh.merged()
    corners = vertices[faces[rng.choice(len(faces), size=count, p=areas / areas.sum())]]
    along = np.sqrt(rng.random((count, 1)))
    across = rng.random((count, 1))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    places = a * (1 - along) + b * along * (1 - across) + c * along * across
    first = unit_rows(b - a)
    normal = np.cross(first, c - a)
    second = np.cross(unit_rows(normal), first)
    angle = np.linspace(0, 2 * np.pi, CLUSTER, endpoint=False)[:, None]
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    return places[:, None] + 1e-3 * np.sqrt(areas.sum() / count) * ring


# --- iterative closest points -----------------------------------------------------------------------------------------

WHOLE_LIMITS = (0.15, 0.1, 0.06, 0.04, 0.025, 0.015, 0.01, 0.007, 0.005)
SEGMENT_LIMITS = (0.05, 0.03, 0.02, 0.013, 0.009, 0.007, 0.005, 0.005)
"""Largest distance of a point from the surface in each round, in diagonals of the object, but see ``match``."""

LEAST_POINTS = 40
LEAST_SHARE = 0.02
"""Least number of points that move a body, and least share of its surface that they must cover."""

LOOSE = 0.002
"""Curvature, per point and with the body's radius as unit, below which a direction is held. A flat square turns
about its normal with 0 and tilts with 0.2; the bunny's right ear, seen from the side, has 0.008."""

FLATNESS = 1e-3
"""Variance of a surface across itself that the library assumes, where that along it is 1. It adds those of scan and
model, so that one point's distance counts 1 / (2 ``FLATNESS``), and its place on the surface 1/2."""


def load_icp() -> ModuleType:
    """Module of the library that does ICP; raises ``ImportError`` with a sentence that names the extra."""
    try:
        import small_gicp
    except ImportError:
        raise ImportError(
            "small_gicp, which registers segments to scans, is not installed: pip install 'mereo[align]'"
        ) from None
    module: ModuleType = small_gicp
    return module


# --- the scan, and whose its points are -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scan:
    """Thinned scan that an object is registered to, in its own frame and unit.

    Attributes:
        points: points of the scan, one in each cell of a grid.
        viewpoint: where the scanner stood.
        size: diagonal of the object.
        area: area of the surface that one point stands for.
    """

    points: Float[np.ndarray, "p 3"]
    viewpoint: Vector
    size: float
    area: float

    @classmethod
    def of(cls, points: Points, viewpoint: Vector, size: float) -> "Scan":
        """Scan of an object of diagonal ``size``, thinned.

        Raises ``ValueError`` where fewer than ``LEAST_POINTS`` points are left.
        """
        spacing = size / 200
        # one of the points in each cell, not their mean, which would lie off a curved surface
        kept = points[first_in_cell(points - points.min(axis=0), spacing)]
        if len(kept) < LEAST_POINTS:
            raise ValueError(
                f"the scan has {len(kept)} points that are {spacing:.3g} apart; at least {LEAST_POINTS} are "
                "needed: check the scan and its unit"
            )
        apart = KDTree(kept).query(kept, k=2)[0][:, 1]
        return cls(kept, viewpoint, size, float(np.median(apart)) ** 2)


@dataclass(frozen=True, eq=False)
class Matches:
    """Segment that each point of a scan lies on.

    Attributes:
        owner: index of the segment; -1 where the nearest surface is farther than ``limit``.
        distance: distance to the nearest surface.
        limit: largest distance that counts, in the scan's unit.
    """

    owner: Int[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    limit: float


def match(points: Float[np.ndarray, "p 3"], surfaces: SegmentedMesh, limit: float) -> Matches:
    """Segment of the nearest surface to each point, if within ``limit`` or 5 medians of all distances.

    So a limit trims outliers, not the scanner's noise.
    """
    filled = [index for index, segment in enumerate(surfaces.segments) if len(segment.faces)]
    nearest = Solids(SegmentedMesh(tuple(surfaces.segments[index] for index in filled))).nearest(points)
    limit = max(limit, 5.0 * float(np.median(nearest.distance)))
    owner = np.where(nearest.distance < limit, np.asarray(filled)[nearest.owner], -1)
    return Matches(owner, nearest.distance, limit)


# --- motion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Registration:
    """Poses of an object's segments that fit a scan.

    Attributes:
        poses: ``T_scan_segment`` of every segment.
        fitted: whether the scan moved the segment's body in the last round; otherwise it shows too little of it.
        held: number of the six directions in which the segment's body was held.
        matches: segment of each point in the last round.
    """

    poses: Poses
    fitted: Bool[np.ndarray, " s"]
    held: Int[np.ndarray, " s"]
    matches: Matches


def register(
    shown: SegmentedMesh,
    scan: Scan,
    poses: Poses,
    bodies: Sequence[Sequence[int]],
    limits: Sequence[float],
    hold: bool = False,
) -> Registration:
    """Poses that bring each body, a list of segments, onto the scan; whose a point is, all segments together decide.

    Args:
        shown: faces that can be seen, from ``exposed``.
        scan: the thinned scan.
        poses: poses to start from.
        bodies: indices of the segments that move together; what is in none stays.
        limits: largest distance of a point in each round, in diagonals of the object.
        hold: whether bodies stay where they are along directions that the scan does not constrain. Not from a rough
            start: from there a body must also slide to where its points are.
    """
    fitted, held = np.zeros(len(poses), dtype=bool), np.zeros(len(poses), dtype=np.int64)
    for limit in limits:
        surfaces = facing(moved(shown, poses), scan.viewpoint)
        matches = match(scan.points, surfaces, limit * scan.size)
        poses = poses.copy()
        for body in map(list, bodies):
            points = scan.points[np.isin(matches.owner, body)]
            surface = SegmentedMesh(tuple(surfaces.segments[index] for index in body))
            shown_area = len(points) * scan.area
            fitted[body] = len(points) >= LEAST_POINTS and shown_area >= LEAST_SHARE * face_areas(surface).sum()
            if fitted[body[0]]:
                motion, held[body] = icp(points, surface, matches.limit, scan.area, hold)
                poses[body] = motion @ poses[body]
    surfaces = facing(moved(shown, poses), scan.viewpoint)
    return Registration(poses, fitted, held, match(scan.points, surfaces, limits[-1] * scan.size))


def icp(
    points: Float[np.ndarray, "p 3"], surface: SegmentedMesh, limit: float, area: float, hold: bool
) -> tuple[Transform, int]:
    """Rigid motion of ``surface`` onto ``points``, in their frame, and the number of directions in which it is held.

    Args:
        points: points of the scan that lie on the surface.
        surface: the faces that the scanner can see.
        limit: largest distance of a point from the surface.
        area: area of the surface that one point stands for.
        hold: whether to leave out motion that the points do not constrain.
    """
    library = load_icp()
    samples = sample_surface(surface, area)
    center = samples.mean(axis=(0, 1))
    radius = float(np.linalg.norm(samples - center, axis=-1).max())
    target, source = (library.PointCloud((a - center) / radius) for a in (samples.reshape(-1, 3), points))
    tree = library.KdTree(target)
    library.estimate_covariances(target, tree, CLUSTER)
    library.estimate_covariances(source, num_neighbors=12)
    result = library.align(
        target,
        source,
        tree,
        registration_type="GICP",
        max_correspondence_distance=2 * (limit + np.sqrt(area)) / radius,  # points are chosen; it only must not cut
        max_iterations=8,  # the next round goes on from there
        rotation_epsilon=1e-6,
        translation_epsilon=1e-6,
    )
    points_to_surface = result.T_target_source
    held = 0
    if hold:
        curvature = 2 * FLATNESS * result.H / max(result.num_inliers, 1)
        points_to_surface, held = constrained(points_to_surface, curvature)
    motion = inverse_rigid(points_to_surface)  # about the centre, in radii
    rotation = motion[:3, :3]
    return rigid(rotation, center - rotation @ center + radius * motion[:3, 3]), held


def constrained(motion: Transform, curvature: Float[np.ndarray, "6 6"]) -> tuple[Transform, int]:
    """Motion without its part along directions (turns, then shifts) curved less than ``LOOSE``, and their number."""
    values, directions = np.linalg.eigh(curvature)
    firm = directions[:, values >= LOOSE]
    if firm.shape[1] == 6:
        return motion, 0
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    kept = firm @ (firm.T @ np.concatenate([turn, motion[:3, 3]]))
    return rigid(Rotation.from_rotvec(kept[:3]).as_matrix(), kept[3:]), 6 - firm.shape[1]
