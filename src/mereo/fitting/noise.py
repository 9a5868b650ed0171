"""Noise of a frame, told by what a first fit leaves over, and the constants of a fit to such a frame.

Depth cameras are off by a twentieth of a scene unit or by half of one, depending on their principle, the distance and
the slant. The observed points' distances from a fitted model tell: their median hardly sees the places where the model
is wrong. A fit that is wrong everywhere must not pass for a noisy camera, so the noise is at most what the cloud itself
shows where it is smoothest; on thin objects, whose clouds are rough everywhere, that bounds little.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mereo.fitting.config import FitConfig
from mereo.fitting.evidence import Evidence

TO_STD = 1.4826
"""Standard deviation of normal numbers over the median of their absolute values."""

CLEAN = 0.1
"""Noise, in scene units, up to which the constants are as they are; clean frames leave 0.05 to 0.06."""

SIGMAS = 3.0
"""Standard deviation that the cloud gets, in noises: as on clean frames."""

MOST_ROUGH = 2.0
"""Noise over the roughness of a cloud (``Evidence``) at most: 1.3 to 1.6 on smooth objects under simulated depth
cameras, 2 where every pixel is noisy by itself."""

LARGEST = 1.0
"""Largest standard deviation of the cloud, in scene units: beyond, the fit is wrong and not the camera."""


def noise_of(distance: Float[np.ndarray, " p"]) -> float:
    """Standard deviation of the noise, from the observed points' distances from a fitted surface; robust."""
    return TO_STD * float(np.median(distance))


def noise_of_frame(distance: Float[np.ndarray, " p"], evidence: Evidence) -> float:
    """Standard deviation of a frame's noise in scene units.

    Args:
        distance: of the observed points from a fitted surface.
        evidence: the frame.
    """
    return min(noise_of(distance), MOST_ROUGH * evidence.roughness)


def constants_for(noise: float, config: FitConfig) -> FitConfig:
    """Constants for a frame of this noise in scene units; the same where it is as on clean frames."""
    if noise <= CLEAN:
        return config
    sigma = min(max(SIGMAS * noise, config.cloud_sigma), LARGEST)
    return replace(config, cloud_sigma=sigma, tolerance=config.tolerance * sigma / config.cloud_sigma)
