"""Uncertainty of a registration in the input's unit: how far off each point, centre and volume may be.

Optimum -Posterior-> Uncertainty: radii that hold 95 % of the true places
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, UInt8

from mereo.fitting.draws.problem import DrawsFit, DrawsProblem
from mereo.fitting.draws.problem import terms as terms_of_draws
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed
from mereo.fitting.problem.posterior import WITHIN, Observed, Posterior, RadiusParts, Terms, radius95
from mereo.fitting.problem.problem import Problem
from mereo.fitting.problem.residuals import Prior, Surface, add_silhouette
from mereo.fitting.problem.symmetries import left_open
from mereo.geometry.brief import counted
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.geometry.solids import owned_gradients
from mereo.geometry.transforms import transform_points
from mereo.io.cores import one_blas_thread
from mereo.scenes.statistical_model import StatisticalModel

# --- the optimum and its posterior ------------------------------------------------------------------------------------

# Where fits of modes, of the rest model and of draws have ended, from which a posterior is made when it is asked for.
#
# ModesOptimum, DrawsOptimum -> Terms of the normal equations -> Posterior


@dataclass(frozen=True, eq=False)
class ModesOptimum:
    """End of a fit of the modes, or, with a model that has none, of the pose alone.

    Attributes:
        problem: everything the fit worked on.
        posed: coefficients and pose.
        unit: length of a scene unit in the input's unit, before the fit's own scale.
        bent: places of the material points by a fit of the modes, where the answer is the rest model: an object that
            is hardly bent may pass for one at rest. None else.
    """

    problem: Problem
    posed: Posed
    unit: float
    bent: Float[np.ndarray, "m 3"] | None = None

    @property
    def tolerance(self) -> float:
        """Distance in scene units up to which an observed point lies on the surface, by the frame's noise."""
        return self.problem.config.tolerance

    @cached_property
    def terms(self) -> Terms:
        """Terms under the prior of all states; that of states near the answer is too sure (docs/registration.md)."""
        problem, posed, config = self.problem, self.posed, self.problem.config
        nothing = NormalEquations.nothing(POSE + len(posed.z))
        with one_blas_thread():
            samples = problem.samples.posed(posed).few(config.silhouette_vertices)
            return Terms(
                known=problem.known(posed, Prior.whole(problem.model), 0.0),
                network=problem.network.add_to(
                    nothing, posed, problem.network_sigma, config.network_weight[1], robust=True
                ),
                cloud=problem.cloud_rows(posed),
                observed_samples=problem.evidence.observed_samples,
                ruled_out=add_silhouette(nothing, posed, samples, problem.evidence, config.cloud_sigma),
            )

    @cached_property
    def surface(self) -> Surface:
        """The posed surface."""
        return Surface.of(self.problem.model, self.posed)

    @cached_property
    def observed(self) -> Observed:
        """Observed points beside the surface."""
        points = self.problem.evidence.points
        return points, self.surface.nearest(points)[0]

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and coefficients."""
        model = self.problem.model
        material = self.posed.place(model.material(self.posed.z))
        with one_blas_thread():
            open_motion = turns_left_open(self.problem, material)
            if self.bent is not None:
                open_motion = np.concatenate(
                    [open_motion, (self.bent - material)[:, :, None].astype(np.float32)], axis=2
                )
            return Posterior.of(self.terms.total, self.posed, material, model.modes, model.residue, open_motion)


@dataclass(frozen=True, eq=False)
class DrawsOptimum:
    """End of a fit of a scene's draws.

    Attributes:
        problem: everything the fit worked on.
        fit: the played state.
        unit: length of a scene unit in the input's unit, before the fit's own scale.
    """

    problem: DrawsProblem
    fit: DrawsFit
    unit: float

    @property
    def tolerance(self) -> float:
        """Distance in scene units up to which an observed point lies on the surface, by the frame's noise."""
        return self.problem.base.config.tolerance

    @cached_property
    def terms(self) -> Terms:
        """Terms of the neighbourhood in which the scene is linear in its draws."""
        with one_blas_thread():
            return terms_of_draws(self.problem, self.fit, self._motion, self.problem.base.config.cloud_sigma)

    @property
    def surface(self) -> Surface:
        """The posed surface."""
        return self.fit.surface

    @property
    def _motion(self) -> Float32[np.ndarray, "a 3 d"]:
        assert self.fit.motion is not None
        return self.fit.motion

    @cached_property
    def observed(self) -> Observed:
        """Observed points beside the surface."""
        points = self.problem.base.evidence.points
        return points, self.fit.surface.nearest(points)[0]

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and draws."""
        motion, spread = self._motion, self.problem.states.played.spread
        modes: Float32[np.ndarray, "m 3 d"] = (spread @ motion.reshape(len(motion), -1)).reshape(
            spread.shape[0], *motion.shape[1:]
        )
        material: Float[np.ndarray, "m 3"] = self.fit.placed()
        with one_blas_thread():
            turns = turns_left_open(self.problem.base, material)
            return Posterior.of(self.terms.total, self.fit.posed, material, modes, open=turns)


def turns_left_open(problem: Problem, material: Float[np.ndarray, "m 3"]) -> Float32[np.ndarray, "m 3 e"]:
    """How far turns of single segments that the frame does not tell apart may have moved the material points."""
    config = problem.config
    return left_open(
        problem.model, material, problem.evidence.observed_samples, config.cloud_sigma, config.cloud_weight
    )


Optimum = ModesOptimum | DrawsOptimum
"""Where a fit has ended, with all that it worked on."""


# --- what decides a point ---------------------------------------------------------------------------------------------

# Explanation of a place: which observed points decide it, and what leaves it unsure.
#
# At the optimum a point of the object is ``x = A u`` for parameters u of covariance S. Where an observed point moves by
# d along its surface's normal, x moves by ``A S J_i^T w_i d``: its leverage. Each term of the fit adds its part H_t to
# the precision ``S^-1``, so that the variance of x is a sum over the terms of what the error of each contributes to it:
#
#     A S A^T = sum_t A S H_t S A^T
#
# Notation: n observed samples, p parameters, J_i and w_i derivatives and weight of an observed sample's residual.

Evidence = Literal["points", "network", "silhouette", "states"]
"""What leaves a place unsure by its errors: the observed points, what the network says of them, what the frame rules
out, and what was known of the object's states before the frame was seen."""

Decided = tuple[dict[Evidence, float], Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]
"""Shares of each kind of evidence in what is unsure; weight of each observed sample, and its influence in the camera's
axes."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """What decides where a point of the object is; frame and unit of the registration.

    Attributes:
        place: of the point.
        shares: of each kind of evidence in the variance that is left; they sum to one. What a hidden point is unsure by
            comes largely from ``states``: from how far the object's own state may be from the likely ones.
        points: observed points that the surface was fitted to, evenly spread.
        influence: how the place moves, in multiples of its motion, when one of them moves along its surface's normal.
        weights: how much each of them decides the place: the length of its influence over the sum of all.
        unexplained: observed points, of all that were seen, that are farther from the registered surface than the
            tolerance.
    """

    place: Float[np.ndarray, "3"]
    shares: dict[Evidence, float]
    points: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, " n"]
    influence: Float[np.ndarray, "n 3"]
    unexplained: Float[np.ndarray, "k 3"]

    @classmethod
    def of(
        cls,
        place: Float[np.ndarray, "3"],
        decided: Decided,
        optimum: Optimum,
        T_registration_fit: Float[np.ndarray, "4 4"],
    ) -> "Explanation":
        """Explanation in the frame to which ``T_registration_fit`` leads from the fit's, both in the input's unit."""
        unit, (observed, distance), (shares, weights, influence) = optimum.unit, optimum.observed, decided
        return cls(
            place=place,
            shares=shares,
            points=transform_points(T_registration_fit, unit * optimum.terms.observed_samples),
            weights=weights,
            influence=influence @ T_registration_fit[:3, :3].T,
            unexplained=transform_points(T_registration_fit, unit * observed[distance > optimum.tolerance]),
        )

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in self.shares.items())
        return f"Explanation(unsure by {shares}; {counted(len(self.unexplained), 'point')} unexplained)"


@dataclass(frozen=True, eq=False)
class Weighing:
    """Terms of a fit in parameters that are independent and standard normal after it (u = F v, ``F F^T = S``).

    Attributes:
        rows: derivatives of the observed samples' residuals.
        weight: of the residuals.
        parts: of each kind of evidence but the points in the unit matrix that is their sum.
    """

    rows: Float[np.ndarray, "n p"]
    weight: Float[np.ndarray, " n"]
    parts: dict[Evidence, Float[np.ndarray, "p p"]]

    @classmethod
    def of(cls, terms: Terms, posterior: Posterior) -> "Weighing":
        """Weighing of a fit's terms."""
        factor = posterior.factor
        others: dict[Evidence, Float[np.ndarray, "p p"]] = {
            "network": terms.network.matrix,
            "silhouette": terms.ruled_out.matrix,
            "states": terms.known.matrix,
        }
        parts = {name: factor.T @ matrix @ factor for name, matrix in others.items()}
        return cls(terms.cloud[0].astype(np.float64) @ factor, terms.cloud[2], parts)

    def decided(self, motion: Float[np.ndarray, "3 p"]) -> Decided:
        """What decides a place that moves so."""
        motion = motion.astype(np.float64)
        whole, leverage = float((motion**2).sum()), self.rows @ motion.T
        shares: dict[Evidence, float] = {"points": float((self.weight[:, None] * leverage**2).sum()) / whole}
        for name, part in self.parts.items():
            shares[name] = float(((motion @ part) * motion).sum()) / whole
        influence = self.weight[:, None] * leverage
        length = np.linalg.norm(influence, axis=1)
        return shares, length / max(float(length.sum()), np.finfo(np.float64).tiny), influence


# --- uncertainty ------------------------------------------------------------------------------------------------------

AT_ONCE = 20_000
"""Points whose motion is in memory at once."""

OUTLINE = 300
"""Vertices that stand for all of them where time is short."""


@dataclass(frozen=True)
class SegmentUncertainty:
    """How sure the place and the size of a segment are.

    Attributes:
        name: of the segment.
        centroid_radius95: radius around its centroid within which the true one lies with probability 0.95, input unit.
        volume95: least and greatest volume that its own is with that probability, input unit cubed.
    """

    name: str
    centroid_radius95: float
    volume95: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far the true places may be from where a registration has them; lengths in the input's unit.

    A ``radius95`` is that of the ball around a point that holds its true place with probability 0.95: by the posterior
    of the fit, times ``scale`` where the weights were calibrated. It says nothing of an object that is not the model's,
    nor of a fit that ended in a wrong state (``fitting.registration.recognition`` is to tell both).

    Attributes:
        optimum: where the fit has ended.
        model: statistical model of the object.
        scale: factor by which views of training seeds showed the posterior's radii to be too small, in frames like
            this; None where that was not measured, and then they are as the posterior has them.
        beside: radius that every place has beside that, because the network has the object elsewhere; scene units.
    """

    optimum: Optimum
    model: StatisticalModel
    scale: float | None = None
    beside: float = 0.0

    @property
    def calibrated(self) -> bool:
        """Whether the radii were calibrated on training views of the object."""
        return self.scale is not None

    @property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and state, in scene units."""
        return self.optimum.posterior

    @property
    def _scale(self) -> float:
        return 1.0 if self.scale is None else self.scale

    def _of(self, parts: RadiusParts) -> Float[np.ndarray, " n"]:
        return self.optimum.unit * parts.radii(self._scale, self.beside)

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
        """Radii as files and pictures take them, of material points at these places, in a frame of the input's unit."""
        counts = self.model.vertex_counts
        return Radii(material, self.model.labels, self.material, counts, self.calibrated)

    def of_rest(self, points: Float[np.ndarray, "n 3"], labels: UInt8[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """``radius95`` of the places to which points at rest, of the segments ``labels``, are registered."""
        result = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            result[rows] = self._of(self.posterior.radii(self.model.weights(points[rows], labels[rows])))
        return result

    @cached_property
    def _owned(self) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 4 p"]]:
        """Volume that belongs to each segment, and the motion of it and of its centroid; scene units, camera's axes."""
        mesh: SegmentedMesh = self.model.mesh(self.posterior.material)
        gradients = owned_gradients(mesh)
        motion = self.posterior.motion_of(gradients.reshape(-1, *gradients.shape[2:]))
        return mesh.owned_volumes, motion.reshape(*gradients.shape[:2], -1)

    @cached_property
    def segments(self) -> tuple[SegmentUncertainty, ...]:
        """Each segment's, of the volume that belongs to it, without that of segments nested in it."""
        unit, scale = self.optimum.unit, self._scale
        result = []
        for name, volume, motion in zip(self.model.rest.names, *self._owned, strict=True):
            off = WITHIN * scale * float(np.linalg.norm(motion[0]))
            radius = unit * float(np.hypot(scale * radius95((motion[1:] @ motion[1:].T)[None])[0], self.beside))
            between = (max(float(volume) - off, 0.0) * unit**3, (float(volume) + off) * unit**3)
            result.append(SegmentUncertainty(name, radius, between))
        return tuple(result)

    @cached_property
    def _weighing(self) -> Weighing:
        return Weighing.of(self.optimum.terms, self.posterior)

    def decided_centroid(self, index: int) -> Decided:
        """What decides where the centroid of a segment is."""
        return self._weighing.decided(self._owned[1][index, 1:])

    def decided_point(self, point: Float[np.ndarray, "1 3"], label: UInt8[np.ndarray, "1"]) -> Decided:
        """What decides where a point of the rest model is, which moves along with the segment ``label``."""
        return self._weighing.decided(self.posterior.motion_at(self.model.weights(point, label))[0])

    def summary(self, radii: Float[np.ndarray, " n"] | None = None) -> dict[str, float | bool]:
        """Median and greatest ``radius95`` of the vertices, or of the given radii, and whether they are calibrated."""
        radii = np.concatenate(self.vertices) if radii is None else radii
        return {"median": float(np.median(radii)), "max": float(radii.max()), "calibrated": self.calibrated}
