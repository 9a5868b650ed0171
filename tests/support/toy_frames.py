"""A frame of two balls and the model that answers it, for tests of the Python interface."""

import numpy as np
from analytic import AnalyticModel
from two_balls import fronts, two_balls

NAMES = ("big", "<small>", "absent")


MODEL = AnalyticModel.of(two_balls, NAMES)


def seen() -> np.ndarray:
    """Front halves of two balls, in metres."""
    return fronts(-1.0)
