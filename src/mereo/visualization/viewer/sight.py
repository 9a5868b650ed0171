"""What the laboratory's camera gives: a sensor, its image and noise, and what stands in front of the object.

mesh, Camera, Sensing -see-> SimulatedView: the depth image that is answered, and how much of the object it hides
"""

from dataclasses import dataclass

import numpy as np

from mereo.geometry.camera import Camera
from mereo.geometry.conventions import MIN_POINTS
from mereo.geometry.raycasting import Hits
from mereo.geometry.solids import Solids
from mereo.synthesis.clutter import Capsule
from mereo.synthesis.config import SENSORS, GenerateConfig, Occluder, Sensor
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.examples import View
from mereo.synthesis.occluded_views import PLACES, occluder_hiding

PAPER = GenerateConfig()


@dataclass(frozen=True)
class Sensing:
    """Camera of the laboratory, beside its place.

    Attributes:
        sensor: name of its model in ``synthesis.config.SENSORS``.
        image_size: of the square depth image, pixels.
        noise_std: Gaussian noise on the depth beside the sensor's own, standard deviation in scene units.
        front: what stands in front of the object.
        hidden: share of the object's pixels that this should hide, 0 to 1.
    """

    sensor: Sensor = "paper"
    image_size: int = PAPER.image_size
    noise_std: float = PAPER.noise_std
    front: Occluder = "none"
    hidden: float = 0.1


@dataclass(frozen=True, eq=False)
class Sight(View):
    """View of the laboratory.

    Attributes:
        hidden: share of the object's pixels, 0 to 1, that a tool or hand hides.
    """

    hidden: float = 0.0


def see(solids: Solids, camera: Camera, sensing: Sensing) -> tuple[SimulatedView, float]:
    """Measurement of an object in the camera frame, and the share of its pixels that something hides.

    Noise is the same every time, so that pictures do not flicker.
    """
    capsules, hidden = in_front(solids, camera, sensing)
    rng = np.random.default_rng(0)
    return observe(solids, camera, sensing.noise_std, SENSORS[sensing.sensor], rng, occluders=capsules), hidden


def in_front(solids: Solids, camera: Camera, sensing: Sensing) -> tuple[tuple[Capsule, ...], float]:
    """Tool or hand in front of an object, and the share of its pixels that it hides: nearest to what is asked for.

    It is one of ``PLACES`` that the synthesis of examples could draw (``synthesis.clutter``). Those that leave fewer
    than ``MIN_POINTS`` points are not taken.
    """
    directions = camera.directions().reshape(-1, 3)
    hits = solids.first_hit(directions)
    visible = np.isfinite(hits.distance)
    if sensing.front == "none" or visible.sum() < MIN_POINTS:
        return (), 0.0
    rays, alone = directions[visible], Hits(hits.distance[visible], hits.normal[visible])
    reach = float(np.linalg.norm(directions[:, :2], axis=1).max())
    unit = 1 / SENSORS[sensing.sensor].metres_per_unit
    places = [np.random.default_rng(place) for place in range(PLACES)]
    return occluder_hiding(sensing.front, sensing.hidden, rays, alone, reach, unit, places)
