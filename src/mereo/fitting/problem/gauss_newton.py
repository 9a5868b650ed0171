"""Least squares over a pose and the coefficients of a linear model, with analytic Jacobians.

A material point is at ``y = e^s R q + t`` with ``q = mean + modes z``. A step turns by a small
rotation vector, shifts, scales and changes z:

    dy = w x (y - t) + dt + (y - t) ds + e^s R modes dz

Notation: n points, r residuals, p = 7 + k parameters in the order w, dt, ds, dz.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from mereo.geometry.transforms import Points

POSE = 7
"""Parameters before the coefficients."""

DAMPING = 1e-3
"""Damping of a step of the modes, relative to the diagonal."""

Rows = tuple[Float[np.ndarray, "p q"], Float[np.ndarray, " p"], Float[np.ndarray, " p"], Float[np.ndarray, "p a"]]
"""Derivatives of residuals by the q parameters, the residuals, their weights, and those by a nuisance, as
``NormalEquations.add`` takes."""


@dataclass(frozen=True, eq=False)
class Posed:
    """Similarity into the camera frame, and coefficients of the modes: a state of the model."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    z: Float[np.ndarray, " k"]
    log_scale: float = 0.0

    def place(self, unposed: Points) -> Points:
        """Points of the model's frame in the camera frame."""
        return np.exp(self.log_scale) * (unposed @ self.rotation.T) + self.translation

    def moved(self, step: Float[np.ndarray, " p"]) -> "Posed":
        """State after one step of the parameters."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return Posed(
            turn @ self.rotation, self.translation + step[3:6], self.z + step[POSE:], self.log_scale + float(step[6])
        )


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Sum of weighted squared residuals near a state: ``matrix step = -gradient`` is its least."""

    matrix: Float[np.ndarray, "p p"]
    gradient: Float[np.ndarray, " p"]

    @classmethod
    def prior(
        cls,
        z: Float[np.ndarray, " k"],
        center: Float[np.ndarray, " k"],
        precision: Float[np.ndarray, "k k"],
        log_scale: float,
        scale_std: float,
    ) -> "NormalEquations":
        """Equations of ``(z - center)^T precision (z - center)`` and of a scale that is known up to ``scale_std``."""
        count = POSE + len(z)
        matrix, gradient = np.zeros((count, count)), np.zeros(count)
        matrix[POSE:, POSE:], gradient[POSE:] = precision, precision @ (z - center)
        matrix[6, 6], gradient[6] = 1.0 / scale_std**2, log_scale / scale_std**2
        return cls(matrix, gradient)

    def add(
        self,
        jacobian: Float[np.ndarray, "r p"],
        residual: Float[np.ndarray, " r"],
        weight: Float[np.ndarray, " r"],
        nuisance: Float[np.ndarray, "r a"] | None = None,
    ) -> "NormalEquations":
        """Sum with further residuals, which may have a ``nuisance`` (``pull``)."""
        weighted = pull(jacobian, weight, nuisance)
        matrix = (weighted.T @ jacobian).astype(np.float64)
        return NormalEquations(self.matrix + matrix, self.gradient + weighted.T.astype(np.float64) @ residual)

    @classmethod
    def nothing(cls, count: int) -> "NormalEquations":
        """Equations of no residuals in so many parameters."""
        return cls(np.zeros((count, count)), np.zeros(count))

    def plus(self, other: "NormalEquations") -> "NormalEquations":
        """Sum with other equations."""
        return NormalEquations(self.matrix + other.matrix, self.gradient + other.gradient)

    def step(self, damping: float) -> Float[np.ndarray, " p"]:
        """Levenberg and Marquardt's step."""
        damped = self.matrix + np.diag(damping * np.diag(self.matrix) + 1e-9)
        solved: np.ndarray = cho_solve(cho_factor(damped), -self.gradient)
        return solved

    def narrowing(self) -> float:
        """``log det`` of the coefficients' posterior precision, whatever the pose is; 0 where there are none.

        By so much, in the units of twice a log-likelihood, they are narrower than N(0, 1).
        """
        pose, cross, z = self.matrix[:POSE, :POSE], self.matrix[:POSE, POSE:], self.matrix[POSE:, POSE:]
        # without a frame nothing is known of the pose, whose block has no inverse then
        return float(np.linalg.slogdet(z - cross.T @ np.linalg.pinv(pose) @ cross)[1])


def pull(
    jacobian: Float[np.ndarray, "r p"], weight: Float[np.ndarray, " r"], nuisance: Float[np.ndarray, "r a"] | None
) -> Float[np.ndarray, "r p"]:
    """How much each residual adds to the gradient of the parameters: its weighted derivatives.

    With a ``nuisance``, the derivatives by amplitudes, each N(0, 1), under the amplitudes that are best for any
    parameters: the normal equations are those of all of them with the amplitudes eliminated (Schur complement).
    """
    weighted = jacobian * weight[:, None].astype(jacobian.dtype)
    if nuisance is None or nuisance.shape[1] == 0:
        return weighted
    apart: np.ndarray = weighted - nuisance * weight[:, None] @ amplitudes(jacobian, weight, nuisance)
    return apart


def amplitudes(
    columns: Float[np.ndarray, "r *c"], weight: Float[np.ndarray, " r"], nuisance: Float[np.ndarray, "r a"]
) -> Float[np.ndarray, "a *c"]:
    """Likeliest amplitudes of a ``nuisance``, each N(0, 1), which with weighted noise makes up the columns."""
    weighted = (nuisance * weight[:, None].astype(nuisance.dtype)).T
    precision = (weighted @ nuisance).astype(np.float64) + np.eye(len(weighted))
    solved: np.ndarray = cho_solve(cho_factor(precision), weighted.astype(np.float64) @ columns)
    return solved


def along(
    posed: Posed,
    points: Points,
    modes: Float[np.ndarray, "n 3 k"],
    direction: Points,
) -> Float[np.ndarray, "n p"]:
    """Derivatives of ``direction . y`` at posed points with their modes."""
    arm = points - posed.translation
    local = (np.exp(posed.log_scale) * (direction @ posed.rotation)).astype(modes.dtype)
    result = np.empty((len(points), POSE + modes.shape[2]), dtype=modes.dtype)
    result[:, :3] = cross(arm, direction)
    result[:, 3:6] = direction
    result[:, 6] = np.einsum("ni,ni->n", arm, direction)
    result[:, POSE:] = sum(local[:, i, None] * modes[:, i] for i in range(3))
    return result


def in_space(posed: Posed, points: Points, modes: Float[np.ndarray, "n 3 k"]) -> Float[np.ndarray, "m p"]:
    """Derivatives of y at posed points, three rows for each point: x, y, z."""
    result = np.empty((len(points), 3, POSE + modes.shape[2]), dtype=modes.dtype)
    result[:, :, :POSE] = rigid_motion((points - posed.translation).astype(modes.dtype))
    result[:, :, POSE:] = np.matmul((np.exp(posed.log_scale) * posed.rotation).astype(modes.dtype), modes)
    return result.reshape(3 * len(points), -1)


def rigid_motion(arm: Points) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives of points by a turn, a shift and the scale, from their positions relative to the pose's centre."""
    rigid = np.zeros((len(arm), 3, POSE), dtype=arm.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rigid[:, i, j], rigid[:, i, k] = arm[:, k], -arm[:, j]
        rigid[:, i, 3 + i] = 1.0
    rigid[:, :, 6] = arm
    return rigid


def cross(a: Points, b: Points) -> Points:
    """Cross products; numpy's own spends more time on the axes than on the numbers."""
    result = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return result


def geman_mcclure(residual: Float[np.ndarray, " r"], scale: float) -> Float[np.ndarray, " r"]:
    """Weights of iteratively reweighted least squares for ``r^2 / (1 + r^2 / scale^2)``."""
    weight: np.ndarray = 1.0 / (1.0 + (residual / scale) ** 2) ** 2
    return weight
