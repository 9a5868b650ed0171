"""Explanation of a place: which observed points decide it, and what leaves it unsure.

At the optimum a point of the object is ``x = A u`` for parameters u of covariance S. Where an observed point moves by d
along its surface's normal, x moves by ``A S J_i^T w_i d``: its leverage. Each term of the fit adds its part H_t to the
precision ``S^-1``, so that the variance of x is a sum over the terms of what the error of each contributes to it:

    A S A^T = sum_t A S H_t S A^T

Notation: n observed partners, p parameters, J_i and w_i derivatives and weight of a partner's residual.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from mereo.fitting.problem.posterior import Posterior, Terms
from mereo.fitting.uncertainty.optimum import Optimum
from mereo.geometry.brief import counted
from mereo.geometry.transforms import transform_points

Evidence = Literal["points", "network", "silhouette", "states"]
"""What leaves a place unsure by its errors: the observed points, what the network says of them, what the frame rules
out, and what was known of the object's states before the frame was seen."""

Decided = tuple[dict[Evidence, float], Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]
"""Shares of each kind of evidence in what is unsure, weight of each partner, and its influence in the camera's axes."""


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
        cls, place: Float[np.ndarray, "3"], decided: Decided, optimum: Optimum, T_here_fit: Float[np.ndarray, "4 4"]
    ) -> "Explanation":
        """Explanation in the frame to which ``T_here_fit`` leads from the fit's, both in the input's unit."""
        unit, (observed, distance), (shares, weights, influence) = optimum.unit, optimum.observed, decided
        return cls(
            place=place,
            shares=shares,
            points=transform_points(T_here_fit, unit * optimum.terms.partners),
            weights=weights,
            influence=influence @ T_here_fit[:3, :3].T,
            unexplained=transform_points(T_here_fit, unit * observed[distance > optimum.tolerance]),
        )

    def __repr__(self) -> str:
        told = ", ".join(f"{name} {share:.0%}" for name, share in self.shares.items())
        return f"Explanation(unsure by {told}; {counted(len(self.unexplained), 'point')} unexplained)"


@dataclass(frozen=True, eq=False)
class Weighing:
    """Terms of a fit in parameters that are independent and standard normal after it (u = F v, ``F F^T = S``).

    Attributes:
        rows: derivatives of the partners' residuals.
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
