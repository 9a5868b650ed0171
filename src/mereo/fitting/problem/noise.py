"""Noise of a frame, told by what a first fit leaves over, and the constants of a fit to such a frame.

Depth cameras are off by a twentieth of a scene unit or by half of one, depending on their principle, the distance and
the slant. Differences between neighbouring pixels do not tell, as edges and curvature look like noise too; a fitted
model takes these away. What it leaves over is noise where every pixel has its own; where neighbours have the same, the
model is wrong.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mereo.fitting.config import FitConfig
from mereo.fitting.problem.residuals import robust_square

TO_STD = 1.4826
"""Standard deviation of normal numbers over the median of their absolute values."""

CLEAN = 0.1
"""Noise, in scene units, up to which the constants are as they are; clean frames have 0.05 to 0.07."""

COHERENT = 1.3
"""What a fit leaves over, in noises, from which on it is wrong; right ones have 0.8 to 1.1, whatever the camera."""

NORMAL = 4.3
"""The 95 % quantile of what a fit leaves over, in its median, up to which it looks like normal numbers, with 2.9.

Right fits to simulated and real cameras have 2.7 to 4.2, of sheets in a wrong state 5.5 to 8.6."""

SIGMAS = 1.5
"""Standard deviation that the cloud gets, in noises: mixed pixels are far beyond ``residuals.ROBUST`` of these."""

NOISES = 3.0
"""Distance, in noises, that counts as a standard deviation of a clean frame does where a fit is to be believed."""

LARGEST = 1.0
"""Largest standard deviation of the cloud, in scene units."""

SHARED = 1.05
"""Misfit of a noisy cloud, in misfits of what neighbours do not share, up to which nothing more is to be explained.

Fits to noisy training views that other states do not improve have 1.02 to 1.15, those that they do mostly more."""

ACCEPTED = 0.75
"""Share of a noisy frame's points that a fit must explain to be believed: what remains are strays that nothing tells.

Of 13 noisy training views that explain .76 to .95, the network was better in one, that with .76."""


def unshared(offset: Float[np.ndarray, " n"], around: Int[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """What each point's offset does not share with those around it, as large as its noise alone would be."""
    own = offset - np.median(offset[around], axis=1)
    # the median of k neighbours is itself off by pi / 2k of their variance
    return own / np.sqrt(1.0 + np.pi / (2 * around.shape[1]))


def noise_of(offset: Float[np.ndarray, " n"], around: Int[np.ndarray, "n k"]) -> float:
    """Standard deviation of what each point's offset does not share with those around it; robust.

    Args:
        offset: signed distance of each observed point from a fitted surface.
        around: indices of each point's neighbours.
    """
    return TO_STD * float(np.median(np.abs(unshared(offset, around))))


def noise_with_shared(offset: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of all that a fit leaves over, shared by neighbours or not; robust."""
    return TO_STD * float(np.median(np.abs(offset)))


def looks_normal(offset: Float[np.ndarray, " n"]) -> bool:
    """Whether what a fit leaves over is spread as normal numbers are, with no part of the frame far off.

    Stereo cameras match windows of pixels, so neighbours share their errors, as they share a wrong fit's. That is
    right in most of the frame and far off elsewhere.
    """
    return float(np.quantile(np.abs(offset), 0.95)) <= NORMAL * float(np.median(np.abs(offset)))


def is_shared_noise(offset: Float[np.ndarray, " n"]) -> bool:
    """Whether what a fit leaves over may be noise that neighbours share: it looks normal, and constants reach to it."""
    return noise_with_shared(offset) * SIGMAS <= LARGEST and looks_normal(offset)


def is_noise(offset: Float[np.ndarray, " n"], noise: float) -> bool:
    """Whether what a fit leaves over is noise, and not the fit's own error."""
    return noise_with_shared(offset) <= COHERENT * noise


def shared(offset: Float[np.ndarray, " n"], around: Int[np.ndarray, "n k"], sigma: float) -> float:
    """Misfit of a cloud, in misfits of what its points' offsets do not share with those around them."""
    own = unshared(offset, around)
    return float(robust_square(offset, sigma).mean() / max(robust_square(own, sigma).mean(), 1e-12))


def constants_for(noise: float, config: FitConfig) -> FitConfig:
    """Constants for a frame of this noise in scene units; the same where it is as on clean frames."""
    if noise <= CLEAN:
        return config
    sigma = min(max(SIGMAS * noise, config.cloud_sigma), LARGEST)
    tolerance = config.tolerance * min(max(NOISES * noise, config.cloud_sigma), LARGEST) / config.cloud_sigma
    return replace(config, cloud_sigma=sigma, tolerance=tolerance, accepted=min(config.accepted, ACCEPTED))
