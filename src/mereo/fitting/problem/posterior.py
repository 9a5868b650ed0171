"""Posterior of a fit: how far what was observed leaves each point of the object unsure.

    normal equations at the optimum -Posterior.of-> Gaussian of pose, scale and state -radii-> how far off each point is

Laplace's approximation (MacKay, Neural Computation 1992): around the optimum the misfit is quadratic, so pose, scale
and state are Gaussian with the inverse of the normal equations' matrix as covariance, and every point of the object,
which is linear in them, is Gaussian too. Lengths are scene units.

Notation: m material points, n queried ones, k coefficients, p = 7 + k parameters as in ``gauss_newton``.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.linalg import eigh
from scipy.special import chdtri
from scipy.stats import norm

from mereo.deformation.moving_least_squares import PointWeights
from mereo.fitting.problem.gauss_newton import POSE, NormalEquations, Posed, Rows
from mereo.io.cores import one_blas_thread

LEVEL = 0.95
"""Probability with which a true place lies within a radius, and a true number in an interval."""

WITHIN = float(norm.ppf(0.5 + LEVEL / 2))
"""Standard deviations of one Gaussian number on either side that hold it with this probability: 1.96."""

ROUNDED = 4 * float(np.finfo(np.float32).eps)
"""Share of the greatest precision below which a smaller one is rounding."""

_FREEDOM = np.linspace(1.0, 3.0, 201)
_QUANTILE = chdtri(_FREEDOM, 1.0 - LEVEL)
"""Quantile of chi square by its degrees of freedom, between which it is nearly straight."""


def radius95(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Radius of the ball around the mean that holds a Gaussian point with probability 0.95.

    By a chi square of the same mean and variance as the squared distance (Satterthwaite, Biometrics Bulletin 1946):
    exact where one direction alone is unsure or all are alike, within 2 % between.
    """
    first = np.trace(covariance, axis1=1, axis2=2)
    second = np.einsum("nij,nij->n", covariance, covariance)
    return radius_by_moments(first, second)


def radius_by_moments(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """``radius95`` from the trace of each covariance, and from that of its square."""
    small = np.finfo(np.float64).tiny
    freedom = np.clip(first**2 / np.maximum(second, small), 1.0, 3.0)
    squared: np.ndarray = first / freedom * np.interp(freedom, _FREEDOM, _QUANTILE)
    return np.sqrt(squared)


@dataclass(frozen=True, eq=False)
class RadiusParts:
    """Radii of 95 % in two parts, whose squares add: views of the object say how far the first is to be trusted.

    Attributes:
        gaussian: by the Gaussian around the optimum, which a calibration scales.
        open: by what else the frame leaves open, far from it (``Posterior.open``), which is as it is.
    """

    gaussian: Float[np.ndarray, " n"]
    open: Float[np.ndarray, " n"]

    def radii(self, scale: float = 1.0, extra_radius: float = 0.0) -> Float[np.ndarray, " n"]:
        """Radii with a scale of the Gaussian, and a radius that all points have beside; in the parts' unit."""
        result: np.ndarray = np.sqrt((scale * self.gaussian) ** 2 + self.open**2 + extra_radius**2)
        return result


@dataclass(frozen=True, eq=False)
class Terms:
    """What a fit's normal equations at its optimum are made of.

    Attributes:
        known: without the frame: prior, scale, kept distances.
        network: the correspondences.
        cloud: distances of the observed samples from the surface, as rows.
        observed_samples: the observed samples, camera frame, scene units.
        ruled_out: silhouette and free space.
    """

    known: NormalEquations
    network: NormalEquations
    cloud: Rows
    observed_samples: Float[np.ndarray, "n 3"]
    ruled_out: NormalEquations

    @cached_property
    def total(self) -> NormalEquations:
        """All of them together."""
        return self.known.plus(self.network).add(*self.cloud).plus(self.ruled_out)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian around a registered state, as factors of its covariance.

    Attributes:
        posed: pose of the optimum; its coefficients are not asked.
        material: posed material points.
        modes: how each of them moves with the coefficients, before the pose.
        factor: p x p, ``factor factor^T`` is the covariance of the parameters.
        residue: root mean square distance of the object's states from what the coefficients can express.
        open: motion of the material points with further standard normal numbers, by the second moments of what is far
            from Gaussian (``find_symmetries``, a state beside rest), in the camera's axes; None without.
    """

    posed: Posed
    material: Float[np.ndarray, "m 3"]
    modes: Float32[np.ndarray, "m 3 k"]
    factor: Float[np.ndarray, "p p"]
    residue: float = 0.0
    open: Float32[np.ndarray, "m 3 e"] | None = None

    @classmethod
    def of(
        cls,
        normal: NormalEquations,
        posed: Posed,
        material: Float[np.ndarray, "m 3"],
        modes: Float32[np.ndarray, "m 3 k"],
        residue: float = 0.0,
        open: Float32[np.ndarray, "m 3 e"] | None = None,
    ) -> "Posterior":
        """Posterior whose precision is the matrix of the normal equations at the optimum."""
        return cls(posed, material, modes, covariance_factor(normal.matrix), residue, open)

    @cached_property
    def _local(self) -> tuple[Float32[np.ndarray, "r p"], Float32[np.ndarray, "k p"]]:
        """Factor in axes that turn with the object: its rows of the pose, and of the coefficients with the scale."""
        turned, rotation = self.factor.copy(), self.posed.rotation
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

    def _motion(self, rows: slice | Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3 p"]:
        pose, state = self._local
        moved = rigid_motion(self._arm[rows]).reshape(-1, POSE) @ pose
        if len(state):
            moved += self.modes[rows].reshape(-1, len(state)) @ state
        return moved.reshape(-1, 3, moved.shape[1])

    def radii(self, follow: PointWeights | None = None) -> "RadiusParts":
        """Radii of 95 % of all material points, or of points that follow them; scene units."""
        with one_blas_thread():
            motion, open_motion = self.motion, self._open(slice(None))
            return (
                self._radii(motion, open_motion) if follow is None else self._radii(follow(motion), follow(open_motion))
            )

    def radii_of(self, rows: Int[np.ndarray, " n"]) -> "RadiusParts":
        """Radii of 95 % of some material points alone, which cost as little as they are few."""
        with one_blas_thread():
            return self._radii(self._motion(rows), self._open(rows))

    def _open(self, rows: slice | Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3 e"]:
        """``open`` in the object's axes."""
        if self.open is None:
            return np.zeros((len(self._arm[rows]), 3, 0), dtype=np.float32)
        return np.matmul(self.posed.rotation.T.astype(np.float32), self.open[rows])

    def _radii(self, motion: Float32[np.ndarray, "n 3 p"], open_motion: Float32[np.ndarray, "n 3 e"]) -> "RadiusParts":
        gaussian, open_ = (
            np.matmul(part, part.transpose(0, 2, 1)).astype(np.float64) for part in (motion, open_motion)
        )
        gaussian[:, range(3), range(3)] += self.residue**2 / 3
        return RadiusParts(radius95(gaussian), radius95(open_))

    def motion_of(self, gradient: Float[np.ndarray, "c v 3"]) -> Float[np.ndarray, "c p"]:
        """Change of c numbers with each of p independent standard normal ones.

        What the coefficients cannot express (``residue``) is left out: over a segment it averages out.

        Args:
            gradient: of the numbers by the first v material points, in the camera's axes.
        """
        pose, state = self._local
        turned, count = (gradient @ self.posed.rotation).astype(np.float32), gradient.shape[1]
        flat = turned.reshape(len(turned), -1)
        each: np.ndarray = flat @ rigid_motion(self._arm[:count]).reshape(-1, POSE) @ pose
        if len(state):
            each = each + flat @ self.modes[:count].reshape(-1, len(state)) @ state
        return each.astype(np.float64)

    def motion_at(self, follow: PointWeights) -> Float[np.ndarray, "n 3 p"]:
        """Motion of points that follow the material points, in the camera's axes."""
        moved: np.ndarray = np.matmul(self.posed.rotation, follow(self.motion).astype(np.float64))
        return moved


def rigid_motion(arm: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3 7"]:
    """Motion of points with a turn, a shift and the scale, from their places relative to the pose's centre."""
    rigid = np.zeros((len(arm), 3, POSE), dtype=np.float32)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rigid[:, i, j], rigid[:, i, k] = arm[:, k], -arm[:, j]
        rigid[:, i, 3 + i] = 1.0
    rigid[:, :, 6] = arm
    return rigid


def covariance_factor(precision: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Factor F of an inverse, ``F F^T = precision^-1``; unlike units of the parameters do no harm.

    Precisions are sums of products in single precision: what these leave open (a scale that nobody knows, beside
    states that grow) is as unsure as their rounding can tell, and may come out below zero.
    """
    unit = 1.0 / np.sqrt(np.diag(precision))
    values, vectors = eigh(precision * unit[:, None] * unit)
    least = ROUNDED * float(values[-1])
    factor: np.ndarray = unit[:, None] * vectors / np.sqrt(np.maximum(values, least))
    return factor


Observed = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]
"""Observed points in the fit's camera frame, and the distance of each from the facing surface; scene units."""
