"""What is known of the coefficients before a frame is seen: Gaussians of all states or of some, and kept distances."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from mereo.fitting.problem.gauss_newton import POSE, NormalEquations
from mereo.scenes.statistical_model import StatisticalModel


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
    def near(cls, model: StatisticalModel, z: Float[np.ndarray, " k"], count: int, extra_std: float) -> "Prior":
        """Prior of the ``count`` states of the library nearest in shape, each coefficient ``extra_std`` more unsure."""
        distance = (((model.library - z) * model.motion) ** 2).sum(axis=1)
        near = model.library[np.argsort(distance)[:count]].astype(np.float64)
        center = near.mean(axis=0)
        covariance = (near - center).T @ (near - center) / max(1, len(near) - 1)
        return cls(center, np.linalg.inv(covariance + extra_std**2 * np.eye(model.count)))


@dataclass(frozen=True, eq=False)
class PairTerm:
    """Distances that the states keep, with the modes' differences at their pairs.

    Attributes:
        mean, modes: of the vector from second to first point.
        distance, std: of its length among the states.
    """

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
        self, normal: NormalEquations, z: Float[np.ndarray, " k"], worth: float, slack: float
    ) -> NormalEquations:
        """Sum with squared errors of all lengths, together worth ``worth`` points; ``slack`` is added to their std."""
        if len(self.std) == 0:
            return normal
        vector, length = self._vectors(z)
        direction = (vector / np.maximum(length, 1e-12)[:, None]).astype(np.float32)
        jacobian = np.zeros((len(length), POSE + len(z)), dtype=np.float32)
        jacobian[:, POSE:] = np.matmul(direction[:, None], self.modes)[:, 0]
        return normal.add(jacobian, length - self.distance, worth / len(length) / (self.std**2 + slack**2))

    def energy(self, z: Float[np.ndarray, " k"]) -> float:
        """Mean squared error of the lengths, in standard deviations; 0 without pairs."""
        if len(self.std) == 0:
            return 0.0
        return float((((self._vectors(z)[1] - self.distance) / self.std) ** 2).mean())
