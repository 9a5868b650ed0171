"""Gauge of radii: the factor with which 95 % of the true places lie within what the posterior of the modes says."""

from typing import Any

from mereo.evaluation.calibration_views import CalibrationView
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.fitting.readings import FittedFrame
from mereo.fitting.registration import Registration

LEAST = 4
"""Views without which nothing is said."""


class RadiusGauge:
    """Measurement of ``Calibration.radius_scale``. Satisfies ``Gauge``."""

    def __init__(self) -> None:
        self.each: list[RadiusRatios] = []

    def add(self, view: CalibrationView, frame: FittedFrame, registration: Registration | None) -> None:
        """Take in a view of the object where its registration is believed: of others users get no radii."""
        if registration is not None and registration.accepted:
            truth = view.material(registration.model)
            self.each.append(RadiusRatios.of(registration, truth, seen_points(truth, view.seen, 1.0)))

    def add_strange(self, frame: FittedFrame, registration: Registration | None) -> None:
        """Leave out what is not the object: there are no true places."""

    def fields(self) -> dict[str, Any]:
        """The scale; nothing where too few views were registered."""
        return {} if len(self.each) < LEAST else {"radius_scale": RadiusRatios.together(self.each).scale()}
