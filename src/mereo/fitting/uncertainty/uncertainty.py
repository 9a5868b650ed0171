"""Uncertainty of a registration in the input's unit: how far off each point, centre and volume may be.

Optimum -Posterior-> Uncertainty: radii that hold 95 % of the true places
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

from mereo.fitting.problem.posterior import WITHIN, Posterior, radius95
from mereo.fitting.uncertainty.explanation import Decided, Weighing
from mereo.fitting.uncertainty.optimum import Optimum
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.moments import owned_gradients
from mereo.geometry.radii import Radii
from mereo.scenes.statistical_model import StatisticalModel

AT_ONCE = 20_000
"""Points whose motion is in memory at once."""

OUTLINE = 300
"""Vertices that stand for all of them where time is short."""


@dataclass(frozen=True)
class SegmentUncertainty:
    """How sure the place and the size of a segment are.

    Attributes:
        name: of the segment.
        centroid_radius95: radius around its centroid within which the true one lies with probability 0.95, input unit.
        volume95: least and greatest volume that its own is with that probability, input unit cubed.
    """

    name: str
    centroid_radius95: float
    volume95: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far the true places may be from where a registration has them; lengths in the input's unit.

    A ``radius95`` is that of the ball around a point that holds its true place with probability 0.95: by the posterior
    of the fit, times ``scale`` where the weights were calibrated. It says nothing of an object that is not the model's,
    nor of a fit that ended in a wrong state (``fitting.registration.recognition`` is to tell both).

    Attributes:
        optimum: where the fit has ended.
        model: statistical model of the object.
        scale: factor by which views of training seeds showed the posterior's radii to be too small; None where that
            was not measured, and then they are as the posterior has them.
    """

    optimum: Optimum
    model: StatisticalModel
    scale: float | None = None

    @property
    def calibrated(self) -> bool:
        """Whether the radii were calibrated on training views of the object."""
        return self.scale is not None

    @property
    def posterior(self) -> Posterior:
        """Posterior of pose, scale and state, in scene units."""
        return self.optimum.posterior

    @property
    def _factor(self) -> float:
        return self.optimum.unit * (1.0 if self.scale is None else self.scale)

    @cached_property
    def material(self) -> Float[np.ndarray, " m"]:
        """``radius95`` of all material points of the model: vertices of all segments, then interior points."""
        return self._factor * self.posterior.radii()

    @cached_property
    def outline(self) -> Float[np.ndarray, " w"]:
        """``radius95`` of a few hundred vertices, evenly spread: quicker than of all."""
        rows = self.model.witnesses[:: max(1, len(self.model.witnesses) // OUTLINE)]
        return self._factor * self.posterior.radii_of(rows)

    @property
    def vertices(self) -> tuple[Float[np.ndarray, " v"], ...]:
        """``radius95`` of the vertices of each segment."""
        ends = np.cumsum(self.model.vertex_counts)
        return tuple(np.split(self.material[: ends[-1]], ends[:-1]))

    def radii(self, material: Float[np.ndarray, "m 3"]) -> Radii:
        """Radii as files and pictures take them, of material points at these places, in a frame of the input's unit."""
        counts = self.model.vertex_counts
        return Radii(material, self.model.labels, self.material, counts, self.calibrated)

    def of_rest(self, points: Float[np.ndarray, "n 3"], labels: UInt8[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """``radius95`` of the places to which points at rest, of the segments ``labels``, are registered."""
        result = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            result[rows] = self._factor * self.posterior.radii(self.model.weights(points[rows], labels[rows]))
        return result

    @cached_property
    def _own(self) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 4 p"]]:
        """Volume that belongs to each segment, and the motion of it and of its centroid; scene units, camera's axes."""
        mesh: SegmentedMesh = self.model.mesh(self.posterior.material)
        gradients = owned_gradients(mesh)
        motion = self.posterior.motion_of(gradients.reshape(-1, *gradients.shape[2:]))
        return mesh.owned_volumes, motion.reshape(*gradients.shape[:2], -1)

    @cached_property
    def segments(self) -> tuple[SegmentUncertainty, ...]:
        """Each segment's, of the volume that belongs to it, without that of segments nested in it."""
        scale, cubed = 1.0 if self.scale is None else self.scale, self.optimum.unit**3
        result = []
        for name, volume, motion in zip(self.model.rest.names, *self._own, strict=True):
            off = WITHIN * scale * float(np.linalg.norm(motion[0]))
            radius = self._factor * float(radius95((motion[1:] @ motion[1:].T)[None])[0])
            between = (max(float(volume) - off, 0.0) * cubed, (float(volume) + off) * cubed)
            result.append(SegmentUncertainty(name, radius, between))
        return tuple(result)

    @cached_property
    def _weighing(self) -> Weighing:
        return Weighing.of(self.optimum.terms, self.posterior)

    def decided_centroid(self, index: int) -> Decided:
        """What decides where the centroid of a segment is."""
        return self._weighing.decided(self._own[1][index, 1:])

    def decided_point(self, point: Float[np.ndarray, "1 3"], label: UInt8[np.ndarray, "1"]) -> Decided:
        """What decides where a point of the rest model is, which moves along with the segment ``label``."""
        return self._weighing.decided(self.posterior.motion_at(self.model.weights(point, label))[0])

    def summary(self, radii: Float[np.ndarray, " n"] | None = None) -> dict[str, float | bool]:
        """Median and greatest ``radius95`` of the vertices, or of the given radii, and whether they are calibrated."""
        radii = np.concatenate(self.vertices) if radii is None else radii
        return {"median": float(np.median(radii)), "max": float(radii.max()), "calibrated": self.calibrated}
