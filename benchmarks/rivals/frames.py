"""One frame as every rival gets it: the observed cloud, and the object's model in the pose to start from."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.moving_least_squares import spread
from mereo.fitting.problem.residuals import Surface
from mereo.geometry.downsampling import random_subset
from mereo.geometry.transforms import transform_points
from mereo.scenes.statistical_model import StatisticalModel
from mereo_learning.icp import exposed

DENSE = 6000
TARGETS = 1000
"""Observed points that a rival is given, evenly spread: all of them on most synthetic views."""


@dataclass(frozen=True, eq=False)
class Frame:
    """What a rival may know; scene units, camera frame.

    Attributes:
        model: rest mesh, material points and modes.
        cloud: observed points, at most ``TARGETS``.
        posed: all material points in the start pose, in the rest state or the mean one.
        rotation: of that pose.
        surface: indices of the material points that can be seen from outside.
    """

    model: StatisticalModel
    cloud: Float[np.ndarray, "n 3"]
    posed: Float[np.ndarray, "m 3"]
    rotation: Float[np.ndarray, "3 3"]
    surface: Int[np.ndarray, " e"]

    @cached_property
    def center(self) -> Float[np.ndarray, "3"]:
        """Mean of the surface in the start pose."""
        return self.posed[self.surface].mean(axis=0)

    @cached_property
    def size(self) -> float:
        """Root mean square distance of the surface from its mean: the unit of lengths in the paper on CPD."""
        return float(np.sqrt(((self.posed[self.surface] - self.center) ** 2).sum(axis=1).mean()))

    def normalized(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points relative to ``center``, in units of ``size``."""
        return (points - self.center) / self.size

    def restored(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Inverse of ``normalized``."""
        return points * self.size + self.center

    def source(self, count: int, facing: bool) -> Int[np.ndarray, " s"]:
        """At most ``count`` material points of the surface, evenly spread; with ``facing`` of faces seen from outside.

        These faces are turned towards the camera in the start pose; others may still hide them.
        """
        chosen = self.surface
        if facing:
            shown = Surface.through(self.model, self.posed).facing
            seen = np.intersect1d(chosen, self.model.faces[shown])
            chosen = seen if len(seen) > 3 else chosen
        return chosen[spread(self.posed[chosen], count)]

    def started(self, shape: Float[np.ndarray, "m 3"], T_camera_shape: Float[np.ndarray, "4 4"]) -> "Frame":
        """The same frame with another start: a shape (all material points) and its pose."""
        return replace(self, posed=transform_points(T_camera_shape, shape), rotation=T_camera_shape[:3, :3])


def surface_points(model: StatisticalModel) -> Int[np.ndarray, " e"]:
    """Indices of the vertices that can be seen from outside: not of nested segments, nor where segments touch."""
    firsts = np.cumsum([0, *model.vertex_counts[:-1]])
    shown = exposed(model.rest).segments
    return np.concatenate([np.unique(part.faces) + first for part, first in zip(shown, firsts, strict=True)])


def thinned_cloud(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "t 3"]:
    """At most ``TARGETS`` points, evenly spread."""
    points = random_subset(points, DENSE)
    return points[spread(points, TARGETS)]
