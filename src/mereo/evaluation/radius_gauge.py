"""Gauge of radii: the factor with which 95 % of the true places lie within what the posterior of the modes says."""

from typing import Any

import numpy as np

from mereo.evaluation.calibration_views import CalibrationView
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.fitting.readings import FittedFrame
from mereo.fitting.recognition import is_noisy
from mereo.fitting.registration import Registration

LEAST = 4
"""Views without which nothing is said."""

ELSEWHERE = 5.0
"""Radii by which half of a view's points are off where its fit has ended in a wrong state. Of that no radius tells, and
one such view in twenty would be all that the scale is made of; recognition is to tell it."""


class RadiusGauge:
    """Measurement of both scales of ``Calibration``'s radii. Satisfies ``Gauge``."""

    def __init__(self) -> None:
        self.clean: list[RadiusRatios] = []
        self.noisy: list[RadiusRatios] = []

    def add(self, view: CalibrationView, frame: FittedFrame, registration: Registration | None) -> None:
        """Take in a view of the object where its registration is believed: of others users get no radii."""
        if registration is not None and registration.accepted:
            truth = view.material(registration.model)
            ratios = RadiusRatios.of(registration, truth, seen_points(truth, view.seen, 1.0))
            (self.noisy if is_noisy(registration) else self.clean).append(ratios)

    def add_strange(self, frame: FittedFrame, registration: Registration | None) -> None:
        """Leave out what is not the object: there are no true places."""

    def fields(self) -> dict[str, Any]:
        """The scales, of the views whose fit is not elsewhere; none where these are too few."""
        fields = {}
        for name, each in (("radius_scale", self.clean), ("noisy_radius_scale", self.noisy)):
            right = [one for one in each if np.median(one.all) <= ELSEWHERE]
            if len(right) >= LEAST:
                fields[name] = RadiusRatios.together(right).scale()
        return fields
