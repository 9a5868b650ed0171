"""A frame of three balls and the model that answers it, for tests of the Python interface."""

import numpy as np
from analytic import AnalyticModel, ball, logits_of

NAMES = ("big", "<small>", "absent")


CENTERS = ((0.02, -0.03, 0.6), (0.02, 0.0605, 0.6))


RADII = (0.06, 0.03)


MODEL = AnalyticModel.of(
    lambda p: 200.0 * logits_of(ball(CENTERS[0], 0.06), ball(CENTERS[1], 0.03), lambda q: np.full(len(q), 1.0))(p),
    NAMES,
)


def seen() -> np.ndarray:
    """Front halves of two balls, in metres."""
    turned = np.random.default_rng(0).normal(size=(600, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    turned[:, 2] = -np.abs(turned[:, 2])
    return np.concatenate([np.add(c, r * turned) for c, r in zip(CENTERS, RADII, strict=True)])
