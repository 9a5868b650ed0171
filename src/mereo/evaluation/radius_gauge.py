"""Gauge of radii: the factors with which 95 % of the true places lie within what the posterior of a fit says."""

from typing import Any

import numpy as np

from mereo.evaluation.calibration_views import CalibrationView
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.fitting.registration.readings import FittedFrame
from mereo.fitting.registration.recognition import is_noisy
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.models.calibration import RADIUS_FIELDS

LEAST = 4
"""Views without which nothing is said."""

ELSEWHERE = 5.0
"""Radii by which half of a view's points are off where its fit has ended in a wrong state. Of that no radius tells, and
one such view in twenty would be all that the scale is made of; recognition is to tell it."""


class RadiusGauge:
    """Measurement of all scales of ``Calibration``'s radii. Satisfies ``Gauge``.

    Attributes:
        full: registrar that fits the scene's draws to what the modes were fitted to; None where no scene is at hand.
        ratios: of the views whose registration is believed, by the field that they decide.
    """

    def __init__(self, full: Registrar | None = None) -> None:
        self.full = None if full is None or full.at_hand is None else full
        self.ratios: dict[str, list[RadiusRatios]] = {name: [] for name in RADIUS_FIELDS.values()}

    def add(self, view: CalibrationView, frame: FittedFrame, registration: Registration | None) -> None:
        """Take in a view of the object where its registration is believed: of others users get no radii."""
        each = [("modes", registration)]
        if self.full is not None and frame.modes is not None:
            drawn = self.full.finish(frame.modes)
            each += [("draws", drawn)] if drawn.method == "draws" else []
        for method, one in each:
            if one is None or not one.accepted:
                continue
            truth = view.material(one.model)
            ratios = RadiusRatios.of(one, truth, seen_points(truth, view.seen, 1.0))
            self.ratios[RADIUS_FIELDS[method, is_noisy(one)]].append(ratios)

    def add_strange(self, frame: FittedFrame, registration: Registration | None) -> None:
        """Leave out what is not the object: there are no true places."""

    def fields(self) -> dict[str, Any]:
        """The scales, of the views whose fit is not elsewhere; none where these are too few."""
        fields = {}
        for name, each in self.ratios.items():
            right = [one for one in each if np.median(one.all) <= ELSEWHERE]
            if len(right) >= LEAST:
                fields[name] = RadiusRatios.together(right).scale()
        return fields
