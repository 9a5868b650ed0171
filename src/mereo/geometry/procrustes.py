"""Rigid motions that bring points onto others, in closed form and robustly.

A motion is ``y = R x + t``. Notation: n points, s sets of points; ``T_a_b`` maps b-coordinates to a-coordinates.
"""

import numpy as np
from jaxtyping import Float

from mereo.geometry.transforms import finite_svd, fit_rigid

ROUNDS = 20
"""Rounds of reweighting in ``robust_rigid``; it has converged by then."""


def best_rotations(covariance: Float[np.ndarray, "*s 3 3"]) -> Float[np.ndarray, "*s 3 3"]:
    """Rotations R that maximize ``trace(R H)`` for ``H = sum_i x_i y_i^T``, centred: they bring x onto y (Kabsch)."""
    left, _, right = finite_svd(covariance)
    proper = np.sign(np.linalg.det(left) * np.linalg.det(right))
    left = left.copy()
    left[..., 2] *= np.where(proper == 0, 1.0, proper)[..., None]
    return np.swapaxes(left @ right, -1, -2)


def robust_rigid(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    weight: Float[np.ndarray, " n"],
    sigma: float,
) -> Float[np.ndarray, "4 4"]:
    """``fit_rigid`` under a Cauchy loss whose scale falls from the residuals' own median to ``sigma``."""
    T = fit_rigid(source, target, weight)
    for _ in range(ROUNDS):
        distance = np.linalg.norm(source @ T[:3, :3].T + T[:3, 3] - target, axis=1)
        scale = max(float(np.median(distance)), sigma)
        T = fit_rigid(source, target, weight / (1.0 + (distance / scale) ** 2))
    return T


def align_all(
    shapes: Float[np.ndarray, "s n 3"], rounds: int, tolerance: float
) -> tuple[Float[np.ndarray, "s 3 3"], Float[np.ndarray, "s 3"], Float[np.ndarray, "n 3"]]:
    """Rotations and centres that bring shapes to their mean: generalized Procrustes alignment without scale (Gower).

    ``(shapes - center) @ R.T`` are the aligned shapes. It must converge (the mean moves by less than ``tolerance``):
    stopped early, the aligned states of a bending object do not lie in few dimensions.
    """
    center = shapes.mean(axis=1)
    centred = shapes - center[:, None]
    mean, rotation = centred[0], np.broadcast_to(np.eye(3), (len(shapes), 3, 3))
    for _ in range(rounds):
        covariance = np.matmul(centred.transpose(0, 2, 1), mean)
        rotation = best_rotations(covariance.astype(np.float64)).astype(shapes.dtype)
        moved = np.matmul(centred, rotation.transpose(0, 2, 1)).mean(axis=0)
        change = np.abs(moved - mean).max()
        mean = moved
        if change < tolerance:
            break
    return rotation, center, mean
