"""Isolation of the object in what a camera saw: cropping, the largest plane, outliers, the largest cluster.

    PointCloud -depth range-> -box-> -plane-> -thin-> -cluster-> -outliers-> PointCloud

Every step is off by default, works on single points (no step moves one), and reports how many points it took away. The
steps that compare neighbours measure lengths in the cloud's own spacing, so they need no unit and no setting. What is
dropped unless kept on request is in ``strays``.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.linalg import eigh, norm
from numpy.random import Generator, default_rng
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mereo.geometry.brief import counted
from mereo.geometry.camera import PointCloud, into_camera
from mereo.geometry.conventions import MIN_POINTS, CloudAxes
from mereo.geometry.downsampling import MAX_POINTS, spacing, thin_to_grid
from mereo.geometry.surface_patches import STRETCH, stretch, surface_patches
from mereo.geometry.transforms import AnyPoints, Flags, Indices, Points, Values, Vector, box_of, transform_points
from mereo.reconstruction.config import IsolationConfig

PLANE_SPACINGS = 3.0
"""Half the thickness of a plane in the middle of the cloud; the noise of depth cameras is a few pixels wide."""

PLANE_SHARE = 0.1
"""Share of the points that the largest plane must hold, or there is none."""

OUTLIER_NEIGHBORS, OUTLIER_STD = 16, 6.0
"""Neighbours whose mean distance makes an outlier, and standard deviations by which it must exceed the cloud's mean.

Rusu et al., RAS 2008; PCL's StatisticalOutlierRemoval. The 1 or 2 standard deviations that are usual take
surfaces that are seen edge-on, and with them the outline that the network's frame is made from."""

CLUSTER_NEIGHBORS, CLUSTER_GAP = 12, 10.0
"""Nearest neighbours that a point belongs together with, as far as they are less than this many spacings away.

Nearest neighbours adapt to density: a surface seen edge-on, whose points are far apart, hangs together, while two dense
sheets at the same distance do not. With a gap of 6, clean views lost up to 2 % of their points."""


@dataclass(frozen=True)
class IsolationStep:
    """Record of what one step left out.

    Attributes:
        name: the step, as its option is called.
        before, kept: points before and after it.
        detail: what it found, in words; may be empty.
    """

    name: str
    before: int
    kept: int
    detail: str = ""

    def __str__(self) -> str:
        note = f" ({self.detail})" if self.detail else ""
        return f"{self.name}: {self.kept} of {self.before} points kept{note}"


Keep = tuple[Flags, str]
"""Points that a step keeps, and why in words."""

Step = Callable[[AnyPoints], Keep]


@dataclass(frozen=True, eq=False)
class Selection:
    """Points of a cloud that are the object's, and why the others are not.

    Attributes:
        keep: the object's points.
        compared: points that the steps which compare neighbours saw; fewer than all that reached them where the cloud
            was thinned before.
        thinned: points that were left out by thinning alone, whatever they are.
        steps: what each step left out.
    """

    keep: Flags
    compared: Flags
    thinned: Flags
    steps: tuple[IsolationStep, ...]

    def of_object(self, points: Points) -> Flags:
        """Points of the object, also those that were thinned out: their nearest compared point is the object's."""
        whole = self.keep.copy()
        if self.thinned.any():
            compared = np.flatnonzero(self.compared)
            nearest = cKDTree(points[compared]).query(points[self.thinned])[1]
            whole[self.thinned] = self.keep[compared[nearest]]
        return whole


def select_object(
    cloud: PointCloud, config: IsolationConfig, unit_m: float = 1.0, frame: CloudAxes = "camera"
) -> Selection:
    """Select the object's points of a cloud.

    Args:
        cloud: everything that was seen, any unit.
        config: the steps. Before one that compares neighbours, a cloud of more than ``MAX_POINTS`` is thinned evenly
            in space.
        unit_m: metres per unit of ``cloud``.
        frame: its axes. In a camera's the noise is taken to grow with distance squared, as that of depth cameras does.

    Raises ``ValueError`` where fewer than ``MIN_POINTS`` points are left, naming the step and its cure.
    """
    points = cloud.points
    rows = np.arange(len(cloud))
    done = list[IsolationStep]()
    thinned = np.zeros(len(cloud), bool)
    compared = np.ones(len(cloud), bool)
    for name, step in _steps(config, unit_m, frame):
        keep, detail = step(points)
        left = int(keep.sum())
        if left < MIN_POINTS:
            box = unit_m * box_of(points)
            corners = " to ".join(f"({', '.join(f'{value:.3g}' for value in corner)})" for corner in box)
            raise ValueError(
                f"the step {name!r} leaves {left} of {len(points)} points, which reach from {corners} m; the object "
                f"needs at least {MIN_POINTS}: {CURES[name]}"
            )
        if left < len(points) or name != "thinning":
            done.append(IsolationStep(name, len(points), left, detail))
        if name == "thinning":
            thinned[rows[~keep]] = True
            compared = np.isin(np.arange(len(cloud)), rows[keep])
        points, rows = points[keep], rows[keep]
    kept = np.zeros(len(cloud), bool)
    kept[rows] = True
    return Selection(kept, compared, thinned, tuple(done))


CURES = {
    "depth range": "widen --depth-range",
    "box": "widen --box",
    "plane": "leave out --remove-plane, or crop with --box first",
    "outliers": "leave out --remove-outliers, or crop with --box first",
    "largest cluster": "leave out --largest-cluster, or crop with --box first",
}
"""Advice for each step that leaves too little."""


def _steps(config: IsolationConfig, unit_m: float, frame: CloudAxes) -> Iterator[tuple[str, Step]]:
    """Steps that are on, in their order: what is cheap and sure comes first."""
    if config.depth_range is not None:
        near, far = (limit / unit_m for limit in config.depth_range)
        yield "depth range", lambda points: ((points[:, 2] >= near) & (points[:, 2] <= far), "")
    if config.box is not None:
        low, high = np.array(config.box).reshape(2, 3) / unit_m
        yield "box", lambda points: (((points >= low) & (points <= high)).all(axis=1), "")
    if config.remove_plane:
        yield "plane", lambda points: _off_plane(points, unit_m, frame)
    if config.remove_outliers or config.largest_cluster:
        yield "thinning", _thinned
    if config.largest_cluster:
        yield "largest cluster", lambda points: _largest_cluster(points, config.cluster_gap / unit_m)
    if config.remove_outliers:
        yield "outliers", _inliers


# --- steps -----------------------------------------------------------------------------------------------------------


def _off_plane(points: Points, unit_m: float, frame: CloudAxes) -> Keep:
    tolerance = np.full(len(points), PLANE_SPACINGS * spacing(points))
    middle = np.median(points[:, 2])
    if frame == "camera" and middle > 0:  # what lies behind the camera is refused later
        tolerance *= np.maximum(points[:, 2] / middle, 1.0) ** 2
    plane = largest_plane(points, tolerance, default_rng(0))
    off = np.ones(len(points), bool) if plane is None else plane.distance(points) > tolerance
    share = 1.0 - off.mean()
    if plane is None or share < PLANE_SHARE:
        raise ValueError(
            f"the largest plane holds {share:.0%} of the {len(points)} points; a table or wall holds {PLANE_SHARE:.0%} "
            "or more: leave out --remove-plane, or crop less before it"
        )
    normal = " ".join(f"{value:.2f}" for value in plane.normal)
    return off, f"the plane with normal {normal}, {2e3 * tolerance.min() * unit_m:.2g} mm thick"


def _thinned(points: Points) -> Keep:
    keep = np.zeros(len(points), bool)
    keep[thin_to_grid(points, MAX_POINTS)] = True
    return keep, "one in each cell of a grid"


def _inliers(points: Points) -> Keep:
    """Points that are no outliers, see ``OUTLIER_STD``."""
    distance = cKDTree(points).query(points, k=min(OUTLIER_NEIGHBORS, len(points) - 1) + 1)[0][:, 1:].mean(axis=1)
    return distance <= distance.mean() + OUTLIER_STD * distance.std(), ""


def clusters(points: Points) -> Indices:
    """Number of each point's cluster, the largest being 0; see ``CLUSTER_NEIGHBORS``."""
    count = min(CLUSTER_NEIGHBORS, len(points) - 1) + 1
    gap = CLUSTER_GAP * spacing(points)
    if gap == 0:  # all at one place
        return np.zeros(len(points), np.int64)
    distance, neighbor = cKDTree(points).query(points, k=range(1, count + 1), distance_upper_bound=gap)
    row, column = np.nonzero(np.isfinite(distance))
    edges = (np.ones(len(row), np.int8), (row, neighbor[row, column]))
    label = connected_components(coo_matrix(edges, shape=(len(points),) * 2), directed=False)[1]
    rank = np.argsort(np.argsort(-np.bincount(label), kind="stable"))
    return np.asarray(rank[label], np.int64)


def _largest_cluster(points: Points, gap: float) -> Keep:
    """Points of the largest cluster, of those nearer than ``gap`` to it, of those nearer to these, and so on.

    Clusters of fewer than ``MIN_POINTS`` are floating points and do not count.
    """
    label = clusters(points)
    keep = label == 0
    sizes = np.bincount(label)
    parts = sizes[label] >= MIN_POINTS
    while gap > 0 and (rest := parts & ~keep).any():
        distance = cKDTree(points[keep]).query(points[rest], distance_upper_bound=gap)[0]
        near = np.unique(label[rest][np.isfinite(distance)])
        if len(near) == 0:
            break
        keep |= np.isin(label, near)
    others = np.unique(label[~keep])
    left_out = f", the largest left out has {sizes[others].max()}" if len(others) else ""
    return keep, f"{len(sizes) - len(others)} of {len(sizes)} clusters{left_out}"


# --- planes -----------------------------------------------------------------------------------------------------------

# By random sample consensus (Fischler, Bolles, CACM 1981) and least squares.

TRIALS = 600
"""Planes tried; one that holds a fifth of the points is missed once in a hundred clouds, one with a third never."""

JUDGES = 3000
"""Points that a tried plane is judged by."""

BATCH = 100
"""Planes judged at once, so that the table of distances stays in cache."""

REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane of points x with ``normal @ x == offset``.

    Attributes:
        normal: unit length.
        offset: in the points' unit.
    """

    normal: Vector
    offset: float

    def distance(self, points: Points) -> Values:
        """Distance of points from the plane, without sign."""
        return np.abs(points @ self.normal - self.offset)


def largest_plane(points: Points, tolerance: Values, rng: Generator) -> Plane | None:
    """Plane with the most points within ``tolerance``; None where no three points span one.

    Args:
        points: any unit.
        tolerance: how far from the plane each point may be to count, in that unit.
        rng: draws the planes that are tried and the points that judge them.
    """
    if len(points) < 3:
        return None
    judges = rng.permutation(len(points))[:JUDGES]
    judging, allowed = points[judges], tolerance[judges, None]
    normals, offsets = _through(points[rng.integers(0, len(points), (TRIALS, 3))])
    if len(normals) == 0:
        return None
    batches = [slice(start, start + BATCH) for start in range(0, len(normals), BATCH)]
    counts = [(np.abs(judging @ normals[each].T - offsets[each]) <= allowed).sum(axis=0) for each in batches]
    best = int(np.concatenate(counts).argmax())
    plane = Plane(normals[best], float(offsets[best]))
    for _ in range(REFINEMENTS):  # by least squares through the points near it
        kept = points[plane.distance(points) <= tolerance]
        if len(kept) >= 3:
            center = kept.mean(axis=0)
            normal = eigh(np.cov((kept - center).T))[1][:, 0]
            plane = Plane(normal, float(normal @ center))
    return plane


def _through(triples: Float[ndarray, "t 3 3"]) -> tuple[Float[ndarray, "u 3"], Float[ndarray, " u"]]:
    """Planes through three points each; triples on a line are left out."""
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = norm(normals, axis=1)
    proper = lengths > 1e-12 * np.ptp(triples.reshape(-1, 3), axis=0).max() ** 2
    normals = normals[proper] / lengths[proper, None]
    return normals, np.einsum("ti,ti->t", normals, triples[proper, 0])


# --- outlier clusters -------------------------------------------------------------------------------------------------

# A mask that is wrong by a pixel leaves a rim of background in the cloud, and cameras add points between both. They are
# few, but the network's frame is the cloud's box, which one of them moves. Geometry alone cannot tell a rim from a thin
# part of the object that something hides the root of; so where it matters there are two readings, and whoever knows
# more of the object may choose (docs/design/0006-sensors.md).

SCATTERED = 4
"""Patches from which on what lies off all surfaces is taken for strays without further evidence.

A rim is torn into many, a part of the object that something cuts off is one or two: so 0.5 % of clean views lose points
without a registration, and 72 % of those of simulated sensors lose strays."""

MOST = 0.5
"""Share of the points that strays are at most; a cloud with more is no view of surfaces, or a very coarse one."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Reading of a cloud: the points that are taken for the object's, and what the others did.

    Attributes:
        whole: every point, in the input's frame and unit.
        keep: which of them are the object's.
    """

    whole: PointCloud
    keep: Flags

    def __repr__(self) -> str:
        return f"Reading({len(self.cloud):,} of {counted(len(self.whole), 'point')})"

    @classmethod
    def of_all(cls, whole: PointCloud) -> "Reading":
        """The reading with every point."""
        return cls(whole, np.ones(len(whole), bool))

    @cached_property
    def cloud(self) -> PointCloud:
        """The object's points; the whole cloud itself where nothing is dropped."""
        return self.whole.rows(self.keep)

    @property
    def dropped(self) -> int:
        """Number of strays."""
        return len(self.whole) - len(self.cloud)

    @property
    def stretch(self) -> float:
        """Times that the longest side of the box is as long with the strays, from 1 up."""
        return stretch(self.whole.points, self.keep)

    @property
    def step(self) -> IsolationStep | None:
        """Record of what was left out; None where nothing was."""
        if not self.dropped:
            return None
        detail = f"the longest side was {self.stretch:.3g} times as long with the others"
        return IsolationStep("strays", len(self.whole), len(self.cloud), detail)

    def __str__(self) -> str:
        """One line for people; empty where nothing was dropped."""
        if not self.dropped:
            return ""
        dropped = f"strays: {self.dropped} of {len(self.whole)} points dropped, the longest side was {self.stretch:.3g}"
        return f"{dropped} times as long with them (--keep-all keeps them)"


def readings(cloud: PointCloud | Points, axes: CloudAxes = "camera", keep_all: bool = False) -> tuple[Reading, ...]:
    """Readings of a cloud, one to three, the more likely first: take that one where nothing else is known.

    One, with every point, where the points off all surfaces do not stretch the cloud's box by more than ``STRETCH``, or
    are more than ``MOST``. Else two: without them, which comes first where they are in ``SCATTERED`` patches or more,
    and with every point. The last is what lies before a gap in range (``nearer_layer``), where there is one.

    Args:
        cloud: points on the object and strays, any unit and density.
        axes: of the cloud. A scanner's lines of sight are estimated, as for the network.
        keep_all: always only the reading with every point.

    Raises ``ValueError`` for points that are not finite.
    """
    seen = cloud if isinstance(cloud, PointCloud) else PointCloud(np.asarray(cloud, float))
    everything = Reading.of_all(seen)
    if keep_all or len(seen) < MIN_POINTS:
        return (everything,)
    points = transform_points(into_camera(seen.points, axes), seen.points)
    patch, keep = surface_patches(points)
    surfaces = Reading(seen, keep)
    layer = nearer_layer(points, patch)
    is_layered = min((keep & layer).sum(), (keep & ~layer).sum()) >= MIN_POINTS
    nearer = (Reading(seen, keep & layer),) if is_layered else ()
    if keep.sum() < max(MIN_POINTS, (1 - MOST) * len(points)) or surfaces.stretch <= STRETCH:
        return (everything, *nearer)
    scattered = len(np.unique(patch[~keep])) >= SCATTERED
    return (surfaces, everything, *nearer) if scattered else (everything, surfaces, *nearer)


def nearer_layer(points: Points, patch: Indices) -> Flags:
    """Mark the points before the largest gap in range between patches of surface; all where there is no gap.

    A mask that is too wide lets in what is behind the object, which may be as many points as the object's own where it
    is thin.
    """
    distance = norm(points, axis=1)
    parts = [distance[patch == number] for number in np.flatnonzero(np.bincount(patch) >= MIN_POINTS)]
    ends = np.array([np.quantile(part, (0.05, 0.95)) for part in sorted(parts, key=np.median)]).reshape(-1, 2)
    near = np.maximum.accumulate(ends[:-1, 1])
    gaps = ends[1:, 0] - near
    if max(gaps, default=0.0) <= 0:
        return np.ones(len(points), bool)
    return distance <= (near + gaps / 2)[gaps.argmax()]
