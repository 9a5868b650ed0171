"""Uncertainty of a fit: its optimum as a Gaussian, the radii and intervals that follow, and what decided them.

    normal equations at the optimum -> Posterior (Gaussian of pose, scale and state) -> Uncertainty (radii of 95 %)

Laplace's approximation (MacKay, Neural Computation 1992): around the optimum the misfit is quadratic, so pose, scale
and state are Gaussian with the inverse of the normal equations' matrix as covariance, and every point of the object,
which is linear in them, is Gaussian too. Lengths are scene units, those of ``Uncertainty`` the input's unit.

Notation: m material points, n queried ones, k coefficients, p = 7 + k parameters as in ``gauss_newton``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.linalg import eigh
from scipy.stats import chi2, norm

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.draws.fit import DrawsFit, DrawsProblem
from mereo.fitting.draws.fit import terms as terms_of_draws
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, pull, rigid_motion
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import Prior, Surface, Terms
from mereo.fitting.problem.segments import left_open
from mereo.geometry.brief import counted
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.solids import moment_gradients, owned_gradients
from mereo.geometry.transforms import Indices, Points, Values, Vector, transform_points
from mereo.io.cores import limit_blas_threads
from mereo.scenes.statistical_model import StatisticalModel

# --- posterior --------------------------------------------------------------------------------------------------------

LEVEL = 0.95
"""Probability with which a true position lies within a radius, and a true number in an interval."""

WITHIN = float(max(norm.interval(LEVEL)))
"""Standard deviations of one Gaussian number on either side that hold it with this probability: 1.96."""

MEAN_ABSOLUTE = float(norm.expect(np.abs))
"""Mean size of a standard normal number: the root of 2 over pi."""

UNCALIBRATED = 1.25
"""Factor of the posterior's radii of noisy frames of an object that was not calibrated, by training views of 17 objects
without calibrations (docs/experiments/085.md); those of clean frames are right as they are."""

_FREEDOM = np.linspace(1.0, 3.0, 201)
_QUANTILE = chi2.ppf(LEVEL, _FREEDOM)
"""Quantile of chi square by its degrees of freedom, between which it is nearly straight."""


def radius95(covariance: Float[np.ndarray, "n 3 3"]) -> Values:
    """Return the radius of the ball around the mean that holds a Gaussian point with probability 0.95.

    By a chi square of the same mean and variance as the squared distance (Satterthwaite, Biometrics Bulletin 1946):
    exact where one direction alone is unsure or all are alike, within 2 % between.
    """
    first = np.trace(covariance, axis1=1, axis2=2)
    second = np.einsum("nij,nij->n", covariance, covariance)
    freedom = np.clip(first**2 / np.maximum(second, np.finfo(np.float64).tiny), 1.0, 3.0)
    squared: np.ndarray = first / freedom * np.interp(freedom, _FREEDOM, _QUANTILE)
    return np.sqrt(squared)


@dataclass(frozen=True, eq=False)
class RadiusParts:
    """Radii of 95 % in parts: the squares of the first two add, and views of the object calibrate the first.

    Attributes:
        gaussian: by the Gaussian around the optimum, which a calibration scales.
        open: by what else the frame leaves open, far from it (``Posterior.open``), which is as it is.
        reach: distance of the farthest of the other states, around which a place is as unsure as around this one.
    """

    gaussian: Values
    open: Values
    reach: Values

    @classmethod
    def of(
        cls,
        motion: Float[np.ndarray, "n 3 p"],
        open: Float[np.ndarray, "n 3 e"],
        ways: Float[np.ndarray, "n 3 o"],
        residue: float = 0.0,
    ) -> "RadiusParts":
        """Radii of n points, with the arguments as of ``Posterior``."""
        gaussian, far = (np.matmul(each, each.transpose(0, 2, 1)).astype(np.float64) for each in (motion, open))
        gaussian[:, range(3), range(3)] += residue**2 / 3
        return cls(radius95(gaussian), radius95(far), np.linalg.norm(ways, axis=1).max(axis=1, initial=0.0))

    def radii(self, scale: float = 1.0) -> Values:
        """Radii with a scale of the Gaussian, in the parts' unit."""
        result: np.ndarray = self.reach + np.hypot(scale * self.gaussian, self.open)
        return result


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian around a registered state, as factors of its covariance.

    Attributes:
        posed: pose of the optimum; its coefficients do not matter.
        material: posed material points.
        modes: how each of them moves with the coefficients, before the pose.
        factor: p x p, ``factor factor^T`` is the covariance of the parameters.
        residue: root mean square distance of the object's states from what the coefficients can express.
        open: motion of the material points with further standard normal numbers, by the second moments of what is far
            from Gaussian (``find_segment_turns``, a state near rest), in the camera's axes.
        ways: to other states that explain the frame alike, in the camera's axes.
    """

    posed: Posed
    material: Float[np.ndarray, "m 3"]
    modes: Float32[np.ndarray, "m 3 k"]
    factor: Float[np.ndarray, "p p"]
    residue: float
    open: Float32[np.ndarray, "m 3 e"]
    ways: Float32[np.ndarray, "m 3 o"]

    @classmethod
    def of(
        cls,
        normal: NormalEquations,
        posed: Posed,
        material: Float[np.ndarray, "m 3"],
        modes: Float32[np.ndarray, "m 3 k"],
        residue: float = 0.0,
        open: Sequence[Float[np.ndarray, "m 3 _"]] = (),
        others: Sequence[Float[np.ndarray, "m 3"]] = (),
    ) -> "Posterior":
        """Posterior whose precision is the matrix of the normal equations at the optimum.

        ``open`` are motions with further numbers, ``others`` the material points in other states.
        """
        motion = np.concatenate([np.empty((len(material), 3, 0)), *open], axis=2, dtype=np.float32)
        ways = np.reshape(others, (len(others), *material.shape)) - material
        ways = np.moveaxis(ways, 0, 2).astype(np.float32)
        return cls(posed, material, modes, covariance_factor(normal.matrix), residue, motion, ways)

    @cached_property
    def _local(self) -> tuple[Float32[np.ndarray, "r p"], Float32[np.ndarray, "k p"]]:
        """Factor in axes that turn with the object: its rows of the pose, and of the coefficients with the scale."""
        turned = self.factor.copy()
        rotation = self.posed.rotation
        turned[:3], turned[3:6] = rotation.T @ self.factor[:3], rotation.T @ self.factor[3:6]
        turned[POSE:] *= np.exp(self.posed.log_scale)
        return turned[:POSE].astype(np.float32), turned[POSE:].astype(np.float32)

    @cached_property
    def _arm(self) -> Float32[np.ndarray, "m 3"]:
        """Material points from the pose's centre, in axes that turn with the object."""
        return ((self.material - self.posed.translation) @ self.posed.rotation).astype(np.float32)

    @cached_property
    def motion(self) -> Float32[np.ndarray, "m 3 p"]:
        """Motion of each material point with each of p independent standard normal numbers, in the object's axes."""
        return self._motion(slice(None))

    def _motion(self, rows: slice | Indices) -> Float32[np.ndarray, "n 3 p"]:
        pose, state = self._local
        moved = rigid_motion(self._arm[rows]).reshape(-1, POSE) @ pose
        if len(state):
            moved += self.modes[rows].reshape(-1, len(state)) @ state
        return moved.reshape(-1, 3, moved.shape[1])

    def radii(self, follow: PointWeights | None = None) -> RadiusParts:
        """Radii of 95 % of all material points, or of points that follow them; scene units."""
        with limit_blas_threads():
            motion, open_motion, ways = (
                part if follow is None else follow(part) for part in (self.motion, self.open, self.ways)
            )
            return RadiusParts.of(motion, open_motion, ways, self.residue)

    def radii_of(self, rows: Indices) -> RadiusParts:
        """Radii of 95 % of some material points alone, which cost as little as they are few."""
        with limit_blas_threads():
            return RadiusParts.of(self._motion(rows), self.open[rows], self.ways[rows], self.residue)

    def motion_of(self, gradient: Float[np.ndarray, "c v 3"]) -> Float[np.ndarray, "c p"]:
        """Change of c numbers with each of p independent standard normal ones.

        ``gradient`` is theirs by the first v material points, in the camera's axes. What the coefficients cannot
        express (``residue``) is left out: over a segment it averages out.
        """
        pose, state = self._local
        turned = (gradient @ self.posed.rotation).astype(np.float32)
        count = gradient.shape[1]
        flat = turned.reshape(len(turned), -1)
        each: np.ndarray = flat @ rigid_motion(self._arm[:count]).reshape(-1, POSE) @ pose
        if len(state):
            each = each + flat @ self.modes[:count].reshape(-1, len(state)) @ state
        return each.astype(np.float64)

    def motion_at(self, follow: PointWeights) -> Float[np.ndarray, "n 3 p"]:
        """Motion of points that follow the material points, in the camera's axes."""
        moved: np.ndarray = np.matmul(self.posed.rotation, follow(self.motion).astype(np.float64))
        return moved


def covariance_factor(precision: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Factor F of an inverse, ``F F^T = precision^-1``; unlike units of the parameters do no harm.

    Precisions are sums of products in single precision: what these leave open (a scale that nobody knows, next to
    states that grow) is as unsure as their rounding can tell, and may come out below zero.
    """
    unit = 1.0 / np.sqrt(np.diag(precision))
    values, vectors = eigh(precision * unit[:, None] * unit)
    least = 4 * float(np.finfo(np.float32).eps) * float(values[-1])  # smaller ones are rounding
    factor: np.ndarray = unit[:, None] * vectors / np.sqrt(np.maximum(values, least))
    return factor


# --- the optimum and its posterior ------------------------------------------------------------------------------------

# ModesOptimum, DrawsOptimum -> Terms of the normal equations -> Posterior


@dataclass(frozen=True, eq=False, repr=False)
class ModesOptimum:
    """End of a fit of the modes, or, with a model that has none, of the pose alone.

    Attributes:
        problem: everything the fit worked on.
        posed: coefficients and pose.
        unit: length of a scene unit in the input's unit, before the fit's own scale.
        others: positions of the material points in other states that explain the frame alike; scene units.
        bent: positions of the material points by a fit of the modes, where the answer is the rest model: an object that
            is hardly bent may pass for one at rest. None else.
    """

    problem: Problem
    posed: Posed
    unit: float
    others: tuple[Float[np.ndarray, "m 3"], ...] = ()
    bent: Float[np.ndarray, "m 3"] | None = None

    @property
    def frame(self) -> Problem:
        """The frame, explained by modes."""
        return self.problem

    @cached_property
    def terms(self) -> Terms:
        """Terms under the prior of all states; that of states near the answer is too sure (docs/registration.md)."""
        problem, posed = self.problem, self.posed
        nothing = NormalEquations.nothing(POSE + len(posed.z))
        with limit_blas_threads():
            return Terms(
                known=problem.known(posed, Prior.whole(problem.model), 0.0),
                cloud=problem.cloud_rows(posed),
                observed_samples=problem.evidence.observed_samples,
                ruled_out=problem.add_silhouette(nothing, posed, problem.samples.posed(posed), problem.cloud_sigma),
            )

    @cached_property
    def surface(self) -> Surface:
        """The posed surface."""
        return self.problem.surface(self.posed)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and coefficients."""
        model = self.problem.model
        material = self.posed.place(model.material(self.posed.z))
        tangent = model.tangent(self.posed.z)
        with limit_blas_threads():
            open = [turns_left_open(self.problem, material)]
            open += [] if self.bent is None else [(self.bent - material)[:, :, None]]
            residue = model.residue_at(self.posed.z)
            return Posterior.of(self.terms.total, self.posed, material, tangent, residue, open, self.others)


@dataclass(frozen=True, eq=False, repr=False)
class DrawsOptimum:
    """End of a fit of a scene's draws.

    Attributes:
        problem: everything the fit worked on.
        fit: the played state.
        unit, others: as of ``ModesOptimum``.
    """

    problem: DrawsProblem
    fit: DrawsFit
    unit: float
    others: tuple[Float[np.ndarray, "m 3"], ...] = ()

    @property
    def frame(self) -> Problem:
        """The frame, explained by modes."""
        return self.problem.base

    @cached_property
    def terms(self) -> Terms:
        """Terms of the neighbourhood in which the scene is linear in its draws."""
        assert self.fit.motion is not None
        with limit_blas_threads():
            return terms_of_draws(self.problem, self.fit, self.fit.motion, self.problem.base.cloud_sigma)

    @property
    def surface(self) -> Surface:
        """The posed surface."""
        return self.fit.surface

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and draws."""
        motion, spread = self.fit.motion, self.problem.states.played.spread
        assert motion is not None
        modes: Float32[np.ndarray, "m 3 d"] = (spread @ motion.reshape(len(motion), -1)).reshape(
            spread.shape[0], *motion.shape[1:]
        )
        material: Float[np.ndarray, "m 3"] = self.fit.surface.material
        with limit_blas_threads():
            turns = turns_left_open(self.problem.base, material)
            return Posterior.of(self.terms.total, self.fit.posed, material, modes, 0.0, [turns], self.others)


def turns_left_open(problem: Problem, material: Float[np.ndarray, "m 3"]) -> Float32[np.ndarray, "m 3 e"]:
    """How far turns of single segments that the frame does not tell apart may have moved the material points."""
    samples, config = problem.evidence.observed_samples, problem.config
    return left_open(problem.model, material, samples, problem.cloud_sigma, config.cloud_weight)


Optimum = ModesOptimum | DrawsOptimum
"""Where a fit has ended, with all that it worked on."""


# --- what decides a point ---------------------------------------------------------------------------------------------

# At the optimum a point of the object is ``x = A u`` for parameters u of covariance S. Where an observed point moves by
# d along its surface's normal, x moves by ``A S J_i^T w_i d``: its leverage. Each term of the fit adds its part H_t to
# the precision ``S^-1``, so that the variance of x is a sum over the terms of what the error of each contributes to it:
#
#     A S A^T = sum_t A S H_t S A^T
#
# Notation: n observed samples, p parameters, J_i and w_i derivatives and weight of an observed sample's residual. Where
# neighbours share errors, its ``pull`` stands for w_i J_i.

Evidence = Literal["points", "silhouette", "states"]
"""What leaves a position unsure by its errors: the observed points, what the frame rules out, and what was known of the
object's states before the frame was seen."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What decides where a point of the object is; frame and unit of the registration.

    Attributes:
        place: of the point.
        shares: of each kind of evidence in the variance that is left; they sum to one. What a hidden point is unsure by
            comes largely from ``states``: from how far the object's own state may be from the likely ones.
        points: observed points that the surface was fitted to, evenly spread.
        influence: how the position moves, in multiples of its motion, when one of them moves along the normal.
        weights: how much each of them decides the place: the length of its influence over the sum of all.
        unexplained: observed points, of all that were seen, that are farther from the registered surface than the
            tolerance.
    """

    place: Vector
    shares: dict[Evidence, float]
    points: Points
    weights: Values
    influence: Points
    unexplained: Float[np.ndarray, "k 3"]

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in self.shares.items())
        return f"Explanation(unsure by {shares}; {counted(len(self.unexplained), 'point')} unexplained)"


# --- uncertainty ------------------------------------------------------------------------------------------------------

AT_ONCE = 20_000
"""Points whose motion is in memory at once."""

OUTLINE = 300
"""Vertices that stand for all of them where time is short."""


@dataclass(frozen=True)
class SegmentUncertainty:
    """How sure the position and the size of a segment are.

    Attributes:
        name: of the segment.
        centroid_radius95: radius around its centroid within which the true one lies with probability 0.95, input unit.
        volume95: least and greatest volume that its own is with that probability, input unit cubed.
        expected_iou: intersection over union of its volume with the true one, as it may be expected.
    """

    name: str
    centroid_radius95: float
    volume95: tuple[float, float]
    expected_iou: float


def expected_iou(swept: Float[np.ndarray, "s 2 a"]) -> float:
    """Mean of the intersections over unions that volumes have with true ones, by what is between both.

    Half of that is a volume's alone, half the true one's alone, in the mean over what is as likely inside as outside.

    Args:
        swept: of s segments, and a states that are alike, as ``Uncertainty.swept``.
    """
    volume, between = swept.sum(axis=0)
    return float(((volume - between / 2) / (volume + between / 2)).mean())


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far the true positions may be from where a registration has them; lengths in the input's unit.

    A ``radius95`` is that of the ball around a point that holds its true position with probability 0.95: by the
    posterior of the fit, times ``factor``. It does not cover another object, nor a fit that ended in a wrong state
    (``fitting.registration.recognition`` detects both).

    Attributes:
        optimum: where the fit has ended.
        model: statistical model of the object.
        scale: factor by which views of training seeds showed the posterior's radii to be too small, in frames like
            this; None where that was not measured.
    """

    optimum: Optimum
    model: StatisticalModel
    scale: float | None = None

    @property
    def calibrated(self) -> bool:
        """Whether the radii were calibrated on training views of the object."""
        return self.scale is not None

    @property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and state, in scene units."""
        return self.optimum.posterior

    @property
    def factor(self) -> float:
        """Factor of the posterior's radii."""
        return self.scale or (UNCALIBRATED if self.optimum.frame.shares_noise else 1.0)

    def _of(self, parts: RadiusParts) -> Values:
        return self.optimum.unit * parts.radii(self.factor)

    @cached_property
    def parts(self) -> RadiusParts:
        """Parts of the ``radius95`` of all material points, as the posterior has them; scene units."""
        return self.posterior.radii()

    @cached_property
    def material(self) -> Float[np.ndarray, " m"]:
        """``radius95`` of all material points of the model: vertices of all segments, then interior points."""
        return self._of(self.parts)

    @cached_property
    def outline(self) -> Float[np.ndarray, " w"]:
        """``radius95`` of a few hundred vertices, evenly spread: quicker than of all."""
        rows = self.model.silhouette_vertices[:: max(1, len(self.model.silhouette_vertices) // OUTLINE)]
        return self._of(self.posterior.radii_of(rows))

    @property
    def vertices(self) -> tuple[Float[np.ndarray, " v"], ...]:
        """``radius95`` of the vertices of each segment."""
        ends = np.cumsum(self.model.vertex_counts)
        return tuple(np.split(self.material[: ends[-1]], ends[:-1]))

    def radii(self, material: Float[np.ndarray, "m 3"]) -> Radii:
        """Radii as files and pictures take them, of material points at these positions, in the input's unit."""
        counts = self.model.vertex_counts
        return Radii(material, self.model.labels, self.material, counts, self.calibrated)

    def of_rest(self, points: Points, labels: UInt8[np.ndarray, " n"]) -> Values:
        """``radius95`` of the positions to which points at rest, of the segments ``labels``, are registered."""
        result = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            result[rows] = self._of(self.posterior.radii(self.model.weights(points[rows], labels[rows])))
        return result

    @cached_property
    def _owned(self) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 4 p"], RadiusParts]:
        """Volume that belongs to each segment, the motion of it and of its centroid, and the radii of the centroids.

        Scene units, camera's axes.
        """
        posterior = self.posterior
        mesh: SegmentedMesh = self.model.mesh(posterior.material)
        gradients = owned_gradients(mesh)
        motion = posterior.motion_of(gradients.reshape(-1, *gradients.shape[2:])).reshape(*gradients.shape[:2], -1)
        others = (part[: gradients.shape[2]] for part in (posterior.open, posterior.ways))
        open_motion, ways = (np.tensordot(gradients[:, 1:], part, axes=2) for part in others)
        return mesh.owned_volumes, motion, RadiusParts.of(motion[:, 1:], open_motion, ways)

    @cached_property
    def swept(self) -> Float[np.ndarray, "s 2 a"]:
        """Volume in each segment's surface, and that which is expected between it and the true one; scene units.

        First by the Gaussian alone, then as if each of the other states that explain the frame alike were its mean.
        Turns of a segment onto itself (``Posterior.open``) leave its surface where it is.
        """
        posterior = self.posterior
        result = list[Float[np.ndarray, "2 a"]]()
        first = 0
        for segment in self.model.mesh(posterior.material).segments:
            # a vertex's area, outwards, is the derivative of the volume; some stand for all
            every = slice(None, None, max(1, len(segment.vertices) // OUTLINE))
            area = moment_gradients(segment, segment.vertices[0])[0]
            whole = np.linalg.norm(area, axis=1).sum()
            area = area[every]
            rows = np.arange(first, first + len(segment.vertices))[every]
            first += len(segment.vertices)
            moved = np.einsum("vip,vi->vp", posterior._motion(rows), area @ posterior.posed.rotation)
            variance = (moved**2).sum(axis=1) + posterior.residue**2 / 3 * (area**2).sum(axis=1)
            ways = np.abs(np.einsum("vio,vi->vo", posterior.ways[rows], area)).sum(axis=0)
            between = MEAN_ABSOLUTE * np.sqrt(variance).sum() + np.append(0.0, ways)
            between *= whole / np.linalg.norm(area, axis=1).sum()
            result.append(np.stack([np.full_like(between, segment.volume), np.minimum(between, 2 * segment.volume)]))
        return np.stack(result)

    @cached_property
    def segments(self) -> tuple[SegmentUncertainty, ...]:
        """Each segment's, of the volume that belongs to it, without that of segments nested in it."""
        unit = self.optimum.unit
        result = list[SegmentUncertainty]()
        volumes, motion, parts = self._owned
        each = zip(self.model.rest.names, volumes, motion, self._of(parts), self.swept, strict=True)
        for name, volume, moved, radius, swept in each:
            off = WITHIN * self.factor * float(np.linalg.norm(moved[0]))
            between = (max(float(volume) - off, 0.0) * unit**3, (float(volume) + off) * unit**3)
            result.append(SegmentUncertainty(name, float(radius), between, expected_iou(swept[None])))
        return tuple(result)

    @property
    def expected_iou(self) -> float:
        """Intersection over union of all segments' volume with the true one, as it may be expected."""
        return expected_iou(self.swept)

    @cached_property
    def _whitened(
        self,
    ) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n p"], dict[Evidence, Float[np.ndarray, "p p"]]]:
        """Terms of the fit in parameters that are independent and standard normal after it (u = F v, ``F F^T = S``).

        Derivatives of the observed samples' residuals, how much these ``pull``, and the parts of all other kinds of
        evidence in the unit matrix that is the sum of all.
        """
        terms, factor = self.optimum.terms, self.posterior.factor
        jacobian, _, weight, nuisance = terms.cloud
        others: dict[Evidence, Float[np.ndarray, "p p"]] = {
            "silhouette": terms.ruled_out.matrix,
            "states": terms.known.matrix,
        }
        parts = {name: factor.T @ matrix @ factor for name, matrix in others.items()}
        pulls = pull(jacobian, weight, nuisance)
        return *(each.astype(np.float64) @ factor for each in (jacobian, pulls)), parts

    def explain(
        self,
        place: Vector,
        motion: Float[np.ndarray, "3 p"],
        T_registration_fit: Float[np.ndarray, "4 4"],
    ) -> Explanation:
        """What decides a position that moves so; ``T_registration_fit`` leads from the fit's frame, in input units."""
        (rows, pulls, parts), motion, unit = self._whitened, motion.astype(np.float64), self.optimum.unit
        whole = float((motion**2).sum())
        influence = pulls @ motion.T
        shares: dict[Evidence, float] = {"points": float((influence * (rows @ motion.T)).sum()) / whole}
        shares |= {name: float(((motion @ part) * motion).sum()) / whole for name, part in parts.items()}
        length = np.linalg.norm(influence, axis=1)
        return Explanation(
            place=place,
            shares=shares,
            points=transform_points(T_registration_fit, unit * self.optimum.terms.observed_samples),
            weights=length / max(float(length.sum()), np.finfo(np.float64).tiny),
            influence=influence @ T_registration_fit[:3, :3].T,
            unexplained=transform_points(T_registration_fit, unit * self.unexplained),
        )

    @cached_property
    def unexplained(self) -> Float[np.ndarray, "k 3"]:
        """Observed points farther from the surface than the tolerance; the fit's camera frame, scene units."""
        frame = self.optimum.frame
        return frame.evidence.points[np.abs(frame.offsets(self.optimum.surface)) > frame.tolerance]

    def centroid_motion(self, index: int) -> Float[np.ndarray, "3 p"]:
        """Motion of the centroid of a segment, as ``Posterior.motion_at``."""
        return self._owned[1][index, 1:]

    def point_motion(self, point: Float[np.ndarray, "1 3"], label: UInt8[np.ndarray, "1"]) -> Float[np.ndarray, "3 p"]:
        """Motion of a point of the rest model, which moves along with the segment ``label``."""
        return self.posterior.motion_at(self.model.weights(point, label))[0]

    def summary(self, radii: Values | None = None) -> dict[str, float | bool]:
        """Median and greatest ``radius95`` of the vertices, or of the given radii, and whether they are calibrated."""
        radii = np.concatenate(self.vertices) if radii is None else radii
        return {"median": float(np.median(radii)), "max": float(radii.max()), "calibrated": self.calibrated}
