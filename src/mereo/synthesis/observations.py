"""Further observations of an example: the same state and camera, seen by other sensors.

Training sees a random one of them, so a network learns what cameras, tools and masks do to a cloud. In use a network
sees a cloud in up to three ways: with its strays; without those that the rule of ``surface_patches`` finds, which on
thin objects takes more than strays; and, once a fit knows where the object is, with little but the object's points.
So each observation is read in one of these ways.
"""

import numpy as np
from jaxtyping import Float

from mereo.geometry.camera import DepthImage
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.farthest_point_sampling import farthest_point_order
from mereo.geometry.normalizer import Normalizer
from mereo.geometry.solids import Solids
from mereo.geometry.surface_patches import without_strays
from mereo.synthesis.clutter import OBJECT
from mereo.synthesis.config import OBSERVATIONS, GenerateConfig, SensorConfig
from mereo.synthesis.depth_sensor import observe

UNCLEANED, BY_RULE = 0.1, 0.4
"""Probabilities that an observation keeps its strays and that it loses those that the rule finds; else it loses all."""

Clouds = tuple[Float[np.ndarray, "_ 3"], ...]


def further_observations(
    solids: Solids, first: DepthImage, normalizer: Normalizer, settings: GenerateConfig, rng: np.random.Generator
) -> Clouds:
    """Clouds of the sensors ``settings.further``, normalized as the first one, each in farthest-point order.

    Each is drawn from a stream of its own that is spawned from ``rng``, so what is drawn from ``rng`` stays the same
    with any of them. One that shows fewer than ``MIN_POINTS`` points of the object is the first cloud instead.

    Args:
        solids: the object in the camera frame.
        first: the example's own depth image.
        normalizer: of the first cloud.
        settings: which sensors, and how many points are kept.
        rng: of the example; nothing is drawn from it.
    """
    if not settings.further:
        return ()
    streams = dict(zip(OBSERVATIONS, rng.spawn(len(OBSERVATIONS)), strict=True))
    clouds = []
    for name, sensor in settings.further.items():
        points = _observed_points(solids, first, settings.noise_std, sensor, streams[name])
        cloud = normalizer.apply(first.to_points().points if points is None else points)
        clouds.append(cloud[farthest_point_order(cloud, settings.points)])
    return tuple(clouds)


def _observed_points(
    solids: Solids, first: DepthImage, noise_std: float, sensor: SensorConfig, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"] | None:
    """Points that a sensor sees in place of ``first``, in the camera frame; None where too few show the object."""
    way = rng.random()
    seen = observe(solids, first.camera, noise_std, sensor, rng)
    image = seen.image
    points = image.to_points().points
    if seen.object_points < MIN_POINTS:
        return None
    shows_object = (seen.source == OBJECT)[image.valid]
    if way < UNCLEANED:
        return points
    keep = without_strays(points) if way < UNCLEANED + BY_RULE else shows_object
    return points[keep] if (keep & shows_object).sum() >= MIN_POINTS else None
