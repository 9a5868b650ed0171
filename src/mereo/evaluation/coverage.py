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
    """Distances of registered material points from their true places, over the radii that they have.

    Attributes:
        seen, hidden: of the points that the cloud shows, and of all others.
        radii_seen, radii_hidden: the radii, scene units.
    """

    seen: Float[np.ndarray, " n"]
    hidden: Float[np.ndarray, " m"]
    radii_seen: Float[np.ndarray, " n"]
    radii_hidden: Float[np.ndarray, " m"]

    @classmethod
    def of(
        cls, registration: Registration, truth: Float[np.ndarray, "m 3"], seen: Bool[np.ndarray, " m"]
    ) -> "RadiusRatios":
        """Ratios of one view, to the radii that the posterior alone gives.

        Args:
            registration: fitted, not read from a file; a calibration that its weights have is left out.
            truth: true places of its material points, vertices and interior ones, or of the first of them, in its frame
                and unit.
            seen: which of these the cloud shows (``seen_points``).

        Raises ``ValueError`` for a registration without an optimum.
        """
        found = registration.uncertainty
        if found is None:
            raise ValueError("the registration was read from a file, which has no posterior: fit its frame again")
        radii = found.material[: len(truth)] / (found.scale or 1.0)
        ratio = np.linalg.norm(registration.material[: len(truth)] - truth, axis=1) / radii
        radii = radii / registration.scene_unit
        return cls(ratio[seen], ratio[~seen], radii[seen], radii[~seen])

    @classmethod
    def together(cls, each: Sequence["RadiusRatios"]) -> "RadiusRatios":
        """Ratios of several views, every point counted once."""
        columns = zip(*((one.seen, one.hidden, one.radii_seen, one.radii_hidden) for one in each), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    @property
    def all(self) -> Float[np.ndarray, " k"]:
        """Ratios of all points."""
        return np.concatenate([self.seen, self.hidden])

    def scale(self) -> float:
        """Factor of the radii with which 95 % of the true places lie within them: ``Calibration.radius_scale``."""
        return float(np.quantile(self.all, LEVEL))

    def by(self, scale: float | None) -> "RadiusRatios":
        """The same with radii times a scale, where there is one."""
        if scale is None:
            return self
        return RadiusRatios(self.seen / scale, self.hidden / scale, self.radii_seen * scale, self.radii_hidden * scale)

    def summary(self, unit_mm: float | None = None) -> dict[str, float | None]:
        """Share of the true places within the radii, and how large these are.

        Of ``all``, ``seen`` and ``hidden`` points (None where there are none), with the medians of the radii in scene
        units, and in mm where ``unit_mm``, millimetres per scene unit, is known.
        """
        named = {"all": self.all, "seen": self.seen, "hidden": self.hidden}
        result = {name: float((ratios <= 1.0).mean()) if len(ratios) else None for name, ratios in named.items()}
        for name, radii in (("seen", self.radii_seen), ("hidden", self.radii_hidden)):
            median = float(np.median(radii)) if len(radii) else None
            result[f"radius_{name}"] = median
            result[f"radius_{name}_mm"] = None if median is None or unit_mm is None else median * unit_mm
        return result
