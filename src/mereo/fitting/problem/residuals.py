"""Terms of the fit: the observed points, and what the frame rules out.

Every term gives normal equations near a state; lengths in scene units, camera frame. Notation: p observed samples, k
modes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.problem.evidence import Directions, Evidence, Observed, SharedErrors
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, Rows, along, cross, geman_mcclure
from mereo.geometry.mesh import barycentric
from mereo.geometry.solids import cast_rays, search_tree
from mereo.geometry.transforms import Points, Values, unit_rows
from mereo.scenes.mechanism import Mechanism, moved_by, placed
from mereo.scenes.statistical_model import StatisticalModel

# --- the surface as samples -------------------------------------------------------------------------------------------

# Samples are as good as faces, and faster, while the model is farther from the cloud than they are from each other.
#
# Notation: s samples, k modes. A frame is three vectors: the sample's position and two edges of its face.

Planes = tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"], Float32[np.ndarray, "p 3 k"]]
"""Planes that observed points are compared with: a position on each, its normal, and the modes there."""


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """Frames of samples of a model's surface, evenly ``spacing`` apart; every second or fourth of them are as even."""

    mean: Float32[np.ndarray, "s 3 3"]
    modes: Float32[np.ndarray, "s 3 3 k"]
    spacing: float

    @classmethod
    def of(cls, model: StatisticalModel, count: int) -> "SampledSurface":
        """Samples of the rest surface, equal shares of its area each."""
        corners = model.rest_points[model.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        ends = np.cumsum(area)
        face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1])
        share = np.sort(np.random.default_rng(0).random((count, 2)), axis=1)  # uniform in a triangle
        weight = np.diff(share, axis=1, prepend=0.0, append=1.0)
        combine = np.zeros((count, 3, 3))
        combine[:, 0], combine[:, 1:, 0], combine[:, [1, 2], [1, 2]] = weight, -1.0, 1.0
        index = np.broadcast_to(model.faces[face][:, None], combine.shape)
        rows = np.repeat(np.arange(3 * count), 3)
        frames = csr_array((combine.ravel().astype(np.float32), (rows, index.ravel())), (3 * count, len(model.mean)))
        spacing = float(np.sqrt(ends[-1] / 2 / count))
        if isinstance(model, Mechanism):
            rest = (frames @ model.rest_points).reshape(count, 3, 3)
            none = np.empty((count, 3, 3, 0), np.float32)
            owner = model.labels[model.faces[face, 0]].astype(np.int64) - 1
            return SampledMechanism(rest.astype(np.float32), none, spacing, owner, model)
        modes = (frames @ model.modes.reshape(len(model.modes), -1)).reshape(count, 3, 3, model.count)
        mean = (frames @ model.mean).reshape(count, 3, 3)
        return cls(mean.astype(np.float32), modes, spacing)

    def every(self, step: int) -> "SampledSurface":
        """Fewer samples."""
        return SampledSurface(self.mean[::step], self.modes[::step], self.spacing * np.sqrt(step))

    def frames(self, z: Float[np.ndarray, " k"]) -> Float32[np.ndarray, "s 3 3"]:
        """Frames in a state, unposed."""
        flat: np.ndarray = self.modes.reshape(9 * len(self.mean), -1) @ z.astype(np.float32)
        return self.mean + flat.reshape(self.mean.shape)

    def tangent(self, z: Float[np.ndarray, " k"], rows: Int[np.ndarray, " r"]) -> Float32[np.ndarray, "r 3 k"]:
        """Motion of the positions of some samples for one standard deviation of each mode, at a state."""
        return self.modes[rows, 0]

    def posed(self, posed: Posed) -> "PosedSamples":
        """Samples of a state in the camera frame."""
        turn = (np.exp(posed.log_scale) * posed.rotation.T).astype(np.float32)
        frame = (self.frames(posed.z).reshape(-1, 3) @ turn).reshape(self.mean.shape)
        position = frame[:, 0] + posed.translation.astype(np.float32)
        normal = cross(frame[:, 1], frame[:, 2])
        normal /= np.maximum(np.sqrt(np.einsum("si,si->s", normal, normal)), 1e-30)[:, None]
        return PosedSamples(self, posed.z, position, normal, np.einsum("si,si->s", normal, position) < 0)


@dataclass(frozen=True, eq=False)
class SampledMechanism(SampledSurface):
    """The same of a mechanism: ``mean`` at rest, without modes, and the index of the segment that moves each sample."""

    owner: Int[np.ndarray, " s"]
    mechanism: Mechanism

    def every(self, step: int) -> "SampledSurface":
        """Fewer samples."""
        few = super().every(step)
        return SampledMechanism(few.mean, few.modes, few.spacing, self.owner[::step], self.mechanism)

    def frames(self, z: Float[np.ndarray, " k"]) -> Float32[np.ndarray, "s 3 3"]:
        """Frames in a state, unposed."""
        T = self.mechanism.motions(z)[0][self.owner].astype(np.float32)
        frames: np.ndarray = self.mean @ T[:, :3, :3].transpose(0, 2, 1)
        frames[:, 0] += T[:, :3, 3]
        return frames

    def tangent(self, z: Float[np.ndarray, " k"], rows: Int[np.ndarray, " r"]) -> Float32[np.ndarray, "r 3 k"]:
        """Motion of the positions of some samples for one standard deviation of each joint's number, at a state."""
        T, twists = (part[self.owner[rows]] for part in self.mechanism.motions(z))
        return moved_by(twists, placed(T, self.mean[rows, 0]))


@dataclass(frozen=True, eq=False)
class PosedSamples:
    """Samples of a surface in the camera frame: positions, outward normals, whether the camera sees their outside."""

    surface: SampledSurface
    z: Float[np.ndarray, " k"]
    position: Float32[np.ndarray, "s 3"]
    normal: Float32[np.ndarray, "s 3"]
    facing: Bool[np.ndarray, " s"]

    def few(self, count: int) -> "PosedSamples":
        """About ``count`` samples, as evenly spread."""
        step = max(1, len(self.position) // count)
        parts = (part[::step] for part in (self.position, self.normal, self.facing))
        return PosedSamples(self.surface.every(step), self.z, *parts)

    def tangent(self, rows: Int[np.ndarray, " r"]) -> Float32[np.ndarray, "r 3 k"]:
        """``SampledSurface.tangent`` at this state."""
        return self.surface.tangent(self.z, rows)

    def planes(self, points: Float[np.ndarray, "p 3"], directions: Directions | None = None) -> Planes:
        """Planes of the facing samples nearest to points.

        With the points' ``directions``, of the samples that are nearest in place and direction, whether they face the
        camera yet or not.
        """
        if directions is not None:
            near = directions.nearest(points, self.position, self.normal)[1]
        else:
            rows = np.flatnonzero(self.facing)
            rows = rows if len(rows) else np.arange(len(self.position))
            tree = cKDTree(self.position[rows], balanced_tree=False, compact_nodes=False)
            near = rows[tree.query(points)[1]]
        return self.position[near].astype(np.float64), self.normal[near].astype(np.float64), self.tangent(near)


Met = tuple[Float[np.ndarray, " p"], Int[np.ndarray, " p"], Float[np.ndarray, "p 3"]]
"""Distance, face among those that can be compared, and position of what each point is compared with."""

Shows = Callable[[Float[np.ndarray, "f 3"], Float[np.ndarray, "f 3"]], Bool[np.ndarray, " f"]]
"""Says which faces can be compared, by their normals and a place on each."""


# --- residuals --------------------------------------------------------------------------------------------------------

ROBUST = 2.5
"""Residuals beyond this many sigma count for little."""


def robust_square(residual: Float[np.ndarray, " r"], sigma: float, robust: float = ROBUST) -> Float[np.ndarray, " r"]:
    """Geman and McClure's loss, in squared sigmas; ``geman_mcclure`` are its weights."""
    squared = (residual / sigma) ** 2
    return squared / (1.0 + squared / robust**2)


@dataclass(frozen=True, eq=False)
class Surface:
    """Posed material points of a model, and the faces that can be compared, with their unit normals.

    These are the *facing* ones, seen from their outside; all of them where no camera saw the frame.
    """

    model: StatisticalModel
    material: Float[np.ndarray, "m 3"]
    facing: Int[np.ndarray, " g"]
    normals: Float[np.ndarray, "g 3"]
    z: Float[np.ndarray, " k"] | None = None

    @classmethod
    def of(cls, model: StatisticalModel, posed: Posed, shows: Shows = Evidence.shows) -> "Surface":
        """Surface of a state."""
        return replace(cls.through(model, posed.place(model.material(posed.z)), shows), z=posed.z)

    @classmethod
    def through(
        cls, model: StatisticalModel, material: Float[np.ndarray, "m 3"], shows: Shows = Evidence.shows
    ) -> "Surface":
        """Surface through posed material points; ``shows`` is that of the evidence."""
        a, b, c = (material[model.faces[:, i]] for i in range(3))
        normal = cross(b - a, c - a)
        facing = np.flatnonzero(shows(normal, a))
        return cls(model, material, facing, unit_rows(normal[facing]))

    @cached_property
    def _tree(self) -> tuple[igl.AABB, Float[np.ndarray, "m 3"], Int[np.ndarray, "g 3"]]:
        vertices, faces = np.ascontiguousarray(self.material), np.ascontiguousarray(self.model.faces[self.facing])
        return search_tree(vertices, faces), vertices, faces

    def nearest(self, points: Float[np.ndarray, "p 3"]) -> Met:
        """Distance, face among the facing ones, and position of the nearest point of the facing surface."""
        tree, vertices, faces = self._tree
        squared, face, position = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        return np.sqrt(squared), face.astype(np.int64), position

    def along_sight(self, points: Float[np.ndarray, "p 3"], far: float) -> Met:
        """Like ``nearest``, but of the point that each line of sight meets, and of the distance from its plane.

        A depth camera is off along the line of sight; noise across an edge would pull the nearest position along. Where
        nothing is met, or only a plane farther than ``far`` from the point, it is the nearest position all the same.
        """
        met, share, _ = cast_rays(*self._tree, np.zeros_like(points), points)
        rows = np.flatnonzero(met >= 0)
        met, toward = met[rows], points[rows]
        met_position = toward * share[rows, None]
        off = np.abs(np.einsum("pi,pi->p", self.normals[met], toward - met_position))
        near = off <= far
        rows = rows[near]
        other = np.setdiff1d(np.arange(len(points)), rows)
        distance = np.empty(len(points))
        face = np.empty(len(points), dtype=np.int64)
        position = np.empty_like(points)
        distance[rows], face[rows], position[rows] = off[near], met[near], met_position[near]
        if len(other):
            distance[other], face[other], position[other] = self.nearest(points[other])
        return distance, face, position

    def alike(self, points: Float[np.ndarray, "p 3"], directions: Directions) -> Met:
        """Like ``nearest``, but of a place whose normal agrees; where none is near, the distance counts normals too."""
        distance, face, position = self.nearest(points)
        rows = np.flatnonzero(directions.agreement(self.normals[face]) <= 0)
        other = directions.rows(rows)
        corners = self.material[self.model.faces[self.facing]]
        apart, near = other.nearest(points[rows], corners.mean(axis=1), self.normals)
        weight = np.clip(barycentric(corners[near], points[rows]), 0.0, 1.0)  # of the corner or edge where it is beyond
        place = np.einsum("pc,pci->pi", weight / weight.sum(axis=1, keepdims=True), corners[near])
        away = np.linalg.norm(points[rows] - place, axis=1)
        agrees = other.agreement(self.normals[near]) > 0
        face[rows], position[rows], distance[rows] = near, place, np.where(agrees, away, np.maximum(apart, away))
        return distance, face, position

    def compared(
        self, points: Float[np.ndarray, "p 3"], far: float | None = None, directions: Directions | None = None
    ) -> Met:
        """``alike`` with directions, ``along_sight`` with ``far`` alone, else ``nearest``."""
        if directions is not None:
            return self.alike(points, directions)
        return self.nearest(points) if far is None else self.along_sight(points, far)

    def offsets(
        self, points: Float[np.ndarray, "p 3"], far: float | None = None, directions: Directions | None = None
    ) -> Float[np.ndarray, " p"]:
        """Signed distance of each point from what it is ``compared`` with, negative behind it."""
        return self.signed(points, self.compared(points, far, directions))

    def signed(self, points: Float[np.ndarray, "p 3"], met: Met) -> Float[np.ndarray, " p"]:
        """Distance of each point from what it has ``met``, negative behind it."""
        distance, face, position = met
        return np.copysign(distance, np.einsum("pi,pi->p", points - position, self.normals[face]))

    def planes(self, points: Float[np.ndarray, "p 3"], far: float, directions: Directions | None = None) -> Planes:
        """Planes of the surface that each point is ``compared`` with."""
        _, face, position = self.compared(points, far, directions)
        corners = self.model.faces[self.facing[face]]
        weight = barycentric(self.material[corners], position).astype(np.float32)
        assert self.z is not None
        tangent = self.model.tangent(self.z, corners.ravel())
        modes = np.matmul(weight[:, None], tangent.reshape(len(points), 3, -1))
        return position, self.normals[face], modes.reshape(len(points), 3, -1)


@dataclass(frozen=True, eq=False)
class PlacesTerm:
    """Where a network has places of the object, or another state has them.

    Attributes:
        target: in the camera frame, scene units.
        weights: how these places follow the material points.
        confidence: of each, as a weight.
    """

    target: Points
    weights: PointWeights
    confidence: Values

    def energy(self, material: Float[np.ndarray, "m 3"], sigma: float) -> float:
        """Mean robust squared distance from where a state's material points have them, in squared sigmas."""
        distance = np.linalg.norm(self.weights(material) - self.target, axis=1)
        return float(self.confidence @ robust_square(distance, sigma) / self.confidence.sum())


def cloud_rows(
    posed: Posed,
    points: Float[np.ndarray, "p 3"],
    planes: Planes,
    sigma: float,
    total_weight: float,
    errors: SharedErrors,
    directions: Directions | None = None,
) -> Rows:
    """Each point's distance to its plane of the facing surface, its derivatives, and its weight.

    Distances are those of the points as measured, from which ``errors`` were taken out. With the points'
    ``directions``, a point far from its place on the plane or of another direction counts for less.
    """
    position, across, modes = planes
    offset = position - points
    residual = np.einsum("pi,pi->p", across, offset)
    weight = np.full(len(points), total_weight / len(points) / sigma**2)
    if directions is None:
        weight *= geman_mcclure(residual, ROBUST * sigma)
    else:
        weight *= geman_mcclure(np.linalg.norm(offset, axis=1), ROBUST * sigma)
        weight *= directions.agreement(across)
    nuisance = errors.along(across)
    return along(posed, position, modes, across), residual - nuisance @ errors.amplitudes, weight, nuisance


def add_silhouette(
    normal: NormalEquations,
    posed: Posed,
    points: Points,
    modes_at: Callable[[Int[np.ndarray, " r"]], Float32[np.ndarray, "r 3 k"]],
    evidence: Observed,
    sigma: float,
    each: float,
) -> NormalEquations:
    """Sum with those points of the surface that are outside the silhouette or in free space.

    ``modes_at`` gives the modes of some of the points, by their rows.
    """
    direction, amount = evidence.violations(points, ROBUST * sigma)
    rows = np.flatnonzero(amount > 0)
    if len(rows) == 0:
        return normal
    jacobian = along(posed, points[rows], modes_at(rows), direction[rows])
    weight = each / sigma**2 * geman_mcclure(amount[rows], 4 * ROBUST * sigma)
    return normal.add(jacobian, -amount[rows], weight)


def silhouette_losses(points: Points, evidence: Observed, sigma: float) -> Values:
    """Loss of each point of the surface by how far the frame rules it out, in squared sigmas."""
    return robust_square(evidence.violations(points, ROBUST * sigma)[1], sigma, 4 * ROBUST)


# --- priors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian of the coefficients: its mean, and the inverse of its covariance."""

    center: Float[np.ndarray, " k"]
    precision: Float[np.ndarray, "k k"]

    @classmethod
    def whole(cls, model: StatisticalModel) -> "Prior":
        """Prior of all states: N(0, 1) each."""
        return cls(np.zeros(model.count), np.eye(model.count))

    @classmethod
    def near(cls, model: StatisticalModel, z: Float[np.ndarray, " k"], skipped: int = 0) -> "Prior":
        """Prior of the 50 states of the library nearest in shape (after ``skipped``), each coefficient .17 more unsure.

        That of all states where they are normal: the nearest of them lie on no curved set.
        """
        if model.is_normal:
            return cls.whole(model)
        distance = (((model.library - z) * model.motion) ** 2).sum(axis=1)
        near = model.library[np.argsort(distance)[skipped : 50 + skipped]].astype(np.float64)
        center = near.sum(axis=0) / max(1, len(near))  # there may be none
        covariance = (near - center).T @ (near - center) / max(1, len(near) - 1)
        return cls(center, np.linalg.inv(covariance + 0.17**2 * np.eye(model.count)))


@lru_cache(maxsize=8)
def are_near(model: StatisticalModel) -> bool:
    """Whether the states near one say more of it than all do, by twenty of the library: not where they are sparse."""
    gain = 0.0
    for z in model.library[:: max(1, len(model.library) // 20)].astype(np.float64):
        prior = Prior.near(model, z, 1)
        off = z - prior.center
        precision = prior.precision
        gain += float(np.linalg.slogdet(precision)[1] + z @ z - off @ precision @ off)
    return gain > 0


@dataclass(frozen=True, eq=False)
class PairTerm:
    """Distances that the states keep: mean and modes of vectors between points, mean and deviation of their lengths."""

    mean: Float[np.ndarray, "q 3"]
    modes: Float32[np.ndarray, "q 3 k"]
    distance: Float[np.ndarray, " q"]
    std: Float[np.ndarray, " q"]

    @classmethod
    def of(cls, model: StatisticalModel) -> "PairTerm":
        """Term of the distances that a model's states keep."""
        a, b = model.pairs.first, model.pairs.second
        return cls(model.mean[a] - model.mean[b], model.modes[a] - model.modes[b], model.pairs.mean, model.pairs.std)

    def _vectors(self, z: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, " q"]]:
        vector = self.mean + self.modes @ z.astype(np.float32)
        return vector, np.linalg.norm(vector, axis=1)

    def add_to(
        self, normal: NormalEquations, z: Float[np.ndarray, " k"], weight: float, slack: float
    ) -> NormalEquations:
        """Sum with squared errors of all lengths, together worth ``weight`` points; ``slack`` is added to their std."""
        vector, length = self._vectors(z)
        direction = (vector / np.maximum(length, 1e-12)[:, None]).astype(np.float32)
        jacobian = np.zeros((len(length), POSE + len(z)), dtype=np.float32)
        jacobian[:, POSE:] = np.matmul(direction[:, None], self.modes)[:, 0]
        return normal.add(jacobian, length - self.distance, weight / max(1, len(length)) / (self.std**2 + slack**2))

    def energy(self, z: Float[np.ndarray, " k"]) -> float:
        """Mean squared error of the lengths, in standard deviations; 0 without pairs."""
        square = ((self._vectors(z)[1] - self.distance) / self.std) ** 2
        return float(square.sum() / max(1, len(square)))


@dataclass(frozen=True, eq=False)
class Terms:
    """What a fit's normal equations at its optimum are made of.

    Attributes:
        known: without the frame: prior, scale, kept distances.
        cloud: distances of the observed samples (camera frame, scene units) from the surface, as rows.
        ruled_out: silhouette and free space.
    """

    known: NormalEquations
    cloud: Rows
    observed_samples: Points
    ruled_out: NormalEquations

    @cached_property
    def total(self) -> NormalEquations:
        """All of them together."""
        return self.known.add(*self.cloud).plus(self.ruled_out)
