"""Two balls that nearly touch, as a depth camera sees them, and a model that knows them exactly."""

import numpy as np
from analytic import AnalyticModel, ball, logits_of
from numpy import ndarray
from numpy.random import default_rng

from mereo.geometry.camera import into_camera
from mereo.geometry.conventions import CloudAxes, Triple
from mereo.geometry.transforms import inverse_rigid, transform_points, unit_rows

NAMES = ("big", "small", "absent")


BIG, SMALL = ((0.02, -0.03, 0.6), 0.06), ((0.02, 0.0605, 0.6), 0.03)


def front(center: Triple, radius: float, toward: float, count: int = 600) -> ndarray:
    """Points on the half of a sphere on the side of z that ``toward`` names."""
    points = unit_rows(default_rng(0).normal(size=(count, 3)))
    points[:, 2] = toward * np.abs(points[:, 2])
    return np.asarray(center) + radius * points


def fronts(toward: float) -> ndarray:
    """Points on the halves of both balls on the side of z that ``toward`` names."""
    return np.concatenate([front(*BIG, toward), front(*SMALL, toward)])


def two_balls(points: ndarray) -> ndarray:
    nowhere = lambda p: np.full(len(p), 1.0)  # noqa: E731
    return 200.0 * logits_of(ball(*BIG), ball(*SMALL), nowhere)(points)


def scene(frame: CloudAxes) -> tuple[ndarray, AnalyticModel]:
    """The two balls as given in ``frame``, and a model that knows them in the camera frame that is made of it."""
    if frame == "camera":
        return fronts(-1.0), AnalyticModel.of(two_balls, NAMES)
    cloud = fronts(1.0)
    back = inverse_rigid(into_camera(cloud, "scanner"))
    return cloud, AnalyticModel.of(lambda points: two_balls(transform_points(back, points)), NAMES)
