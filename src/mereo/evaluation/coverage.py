"""Coverage: how often true places lie within the radii of a registration, and the factor with which 95 % of them do.

Registration, truth -RadiusRatios.of-> ratios of each view -together, scale-> Calibration.radius_scale
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from mereo.fitting.problem.posterior import LEVEL
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud

SEEN_WITHIN = 1.5
"""Distance in scene units up to which a material point counts as seen: that of the nearest observed point."""


def seen_points(truth: Float[np.ndarray, "m 3"], cloud: PointCloud, scene_unit: float) -> Bool[np.ndarray, " m"]:
    """Which material points a cloud shows, by their true places in its frame and unit."""
    near: Bool[np.ndarray, " m"] = cKDTree(cloud.points).query(truth)[0] <= SEEN_WITHIN * scene_unit
    return near


@dataclass(frozen=True, eq=False)
class RadiusRatios:
    """Distances of registered material points from their true places, in the radii that they have.

    Attributes:
        ratios: factor of the posterior's Gaussian radius with which the true place lies on the rim of the whole one; 0
            where it lies within in any case.
        gaussian: these radii, scene units.
        beside: radii of the other parts, whose squares add to theirs (``RadiusParts.open`` and ``Uncertainty.beside``).
        seen: which of the points the cloud shows.
    """

    ratios: Float[np.ndarray, " n"]
    gaussian: Float[np.ndarray, " n"]
    beside: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " n"]

    @classmethod
    def of(
        cls, registration: Registration, truth: Float[np.ndarray, "m 3"], seen: Bool[np.ndarray, " m"]
    ) -> "RadiusRatios":
        """Ratios of one view, to the radii that its registration has, with the weights' calibration if there is one.

        Args:
            registration: fitted, not read from a file.
            truth: true places of its material points, vertices and interior ones, or of the first of them, in its frame
                and unit.
            seen: which of these the cloud shows (``seen_points``).

        Raises ``ValueError`` for a registration without an optimum.
        """
        found = registration.uncertainty
        if found is None:
            raise ValueError("the registration was read from a file, which has no posterior: fit its frame again")
        count, own = len(truth), found.optimum.unit / registration.scene_unit
        off = np.linalg.norm(registration.material[:count] - truth, axis=1) / registration.scene_unit
        gaussian, beside = own * found.parts.gaussian[:count], own * np.hypot(found.parts.open[:count], found.beside)
        ratios = np.sqrt(np.maximum(off**2 - beside**2, 0.0)) / gaussian
        return cls(ratios, gaussian, beside, seen).by(found.scale)

    @classmethod
    def together(cls, each: Sequence["RadiusRatios"]) -> "RadiusRatios":
        """Ratios of several views, every point counted once."""
        columns = zip(*((one.ratios, one.gaussian, one.beside, one.seen) for one in each), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    @property
    def radii(self) -> Float[np.ndarray, " n"]:
        """Radii of all points, scene units."""
        return np.hypot(self.gaussian, self.beside)

    def scale(self) -> float:
        """Factor of the Gaussian's radii that holds 95 % of the true places: ``Calibration.radius_scale``."""
        return float(np.quantile(self.ratios, LEVEL))

    def by(self, scale: float | None) -> "RadiusRatios":
        """The same with the Gaussian's radii times a scale, where there is one."""
        if scale is None:
            return self
        return RadiusRatios(self.ratios / scale, self.gaussian * scale, self.beside, self.seen)

    def with_beside(self, radius: float) -> "RadiusRatios":
        """The same with a radius, in scene units, that every point has beside the others."""
        off = np.maximum((self.ratios * self.gaussian) ** 2 - radius**2, 0.0)
        return RadiusRatios(np.sqrt(off) / self.gaussian, self.gaussian, np.hypot(self.beside, radius), self.seen)

    def summary(self, unit_mm: float | None = None) -> dict[str, float | None]:
        """Share of the true places within the radii, and how large these are.

        Of ``all``, ``seen`` and ``hidden`` points (None where there are none), with the medians of the radii in scene
        units, and in mm where ``unit_mm``, millimetres per scene unit, is known.
        """
        named = {"all": np.ones(len(self.seen), dtype=bool), "seen": self.seen, "hidden": ~self.seen}
        result = {
            name: float((self.ratios[rows] <= 1.0).mean()) if rows.any() else None for name, rows in named.items()
        }
        for name in ("seen", "hidden"):
            median = float(np.median(self.radii[named[name]])) if named[name].any() else None
            result[f"radius_{name}"] = median
            result[f"radius_{name}_mm"] = None if median is None or unit_mm is None else median * unit_mm
        return result
