"""A frame as it is understood: what the network states of it, and the fit to both; a noisy one is fitted once more."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mereo.fitting.modes.fit import Judged, fit_modes
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.problem.evidence import MOST_POINTS
from mereo.fitting.problem.problem import Problem
from mereo.geometry.downsampling import means_along_sight
from mereo.geometry.smoothing import smoothed

Ask = Callable[[Float[np.ndarray, "n 3"]], Correspondences]
"""What the network states about points of the camera frame, in their unit."""

Understood = tuple[Problem, Correspondences, Judged]
"""A frame with what the network states of it, and the fit to both."""


def as_noisy(start: Understood, points: Float[np.ndarray, "n 3"], ask: Ask | None) -> Understood:
    """The fit to a noisy frame where what a fit leaves over is noise, else that one.

    Whether that is so is asked of the second fit: noise throws the first off by more than it is itself.

    Args:
        start: the frame, taken for a clean one.
        points: its cloud, scene units.
        ask: the network, which is also asked about the smoothed cloud.
    """
    problem, found, modes = start
    noisy = problem.as_noisy_as(modes.surface)
    if noisy is None:
        return start
    others = [] if ask is None else [ask(smoothed(means_along_sight(points, MOST_POINTS)))]
    candidates = [(noisy, found), *((noisy.with_network(other), other) for other in others)]
    fits = [(*candidate, fit_modes(candidate[0])) for candidate in candidates]
    best = min(fits, key=lambda fit: fit[2].misfit.without_network)
    return best if best[0].leaves_noise(best[2].surface) else start
