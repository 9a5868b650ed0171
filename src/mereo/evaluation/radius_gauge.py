"""Gauge of radii: the factors with which 95 % of the true places lie within what the posterior of a fit says."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mereo.evaluation.calibration_views import CalibrationView
from mereo.evaluation.coverage import RadiusRatios, seen_points
from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.recognition import is_noisy
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.models.calibration import RadiusFactors

KINDS = ("", "draws_")
"""Beginnings of the fields of ``Calibration`` that are of fits of the modes, and of draws."""

LEAST = 4
"""Views without which nothing is said."""

NOISY = 16
"""Noisy views that are enough: their draws take longest."""

ELSEWHERE = 5.0
"""Radii by which half of a noisy view's points are off where its fit has ended in a wrong state. One such view in
twenty would be all that the scale is made of, and of a camera's views there are more; recognition is to tell them."""

USUALLY = 0.9
"""Share of the views in which network and registered model are no farther apart than usual. A few views may hold none
that ended elsewhere, so that it cannot be measured from where on they do."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Radii of one view, and what of it may make them wider.

    Attributes:
        ratios: to the posterior's own radii.
        misfit: ``Problem.cloud_misfit``.
        displaced: ``Correspondences.displaced``.
        half: of the object's length, scene units.
    """

    ratios: RadiusRatios
    misfit: float
    displaced: float
    half: float

    @classmethod
    def of(cls, view: CalibrationView, candidate: Candidate, registration: Registration) -> "Measured":
        """Measurement of a registration that was made of a candidate, by weights that are not calibrated."""
        truth = view.material(registration.model)
        ratios = RadiusRatios.of(registration, truth, seen_points(truth, view.seen, 1.0))
        assert registration.optimum is not None and candidate.modes is not None
        misfit = candidate.modes.problem.cloud_misfit(registration.optimum.surface)
        return cls(ratios, misfit, candidate.displaced(registration) or 0.0, registration.model.half)

    def widened(self, factors: RadiusFactors) -> RadiusRatios:
        """Ratios to the radii that a calibration makes wider; its scale is left out."""
        return self.ratios.by(factors.widening(self.misfit)).with_beside(self.half * factors.beside(self.displaced))


class RadiusGauge:
    """Measurement of all that scales ``Calibration``'s radii. Satisfies ``Gauge``.

    Attributes:
        full: registrar that fits the scene's draws to what the modes were fitted to; None where no scene is at hand.
        clean, noisy: views whose registration is believed, of the modes and of draws.
    """

    def __init__(self, full: Registrar | None = None) -> None:
        self.full = None if full is None or full.at_hand is None else full
        self.clean: tuple[list[Measured], list[Measured]] = [], []
        self.noisy: tuple[list[Measured], list[Measured]] = [], []
        self.asked = 0

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in a view of the object where its registration is believed: of others users get no radii."""
        candidate, registration = answer.candidate, answer.registration
        self.asked += not view.clean
        if candidate is None or candidate.modes is None or registration is None:
            return
        if not (view.clean or self.asked <= NOISY):
            return
        full = None if self.full is None else self.full.finish(candidate.modes)
        for number, one in enumerate((registration, full)):
            if one is None or not one.accepted or (number == 1 and one.method != "draws"):
                continue
            (self.noisy if is_noisy(one) else self.clean)[number].append(Measured.of(view, candidate, one))

    def add_strange(self, answer: Answer) -> None:
        """Leave out what is not the object: there are no true places."""

    def fields(self) -> dict[str, Any]:
        """Factors of both kinds of fits; none where their views are too few."""
        fields: dict[str, Any] = {}
        for kind, clean, noisy in zip(KINDS, self.clean, self.noisy, strict=True):
            if len(clean) >= LEAST:
                found = factors_of(clean)
                fields[f"{kind}radius_scale"] = found.scale
                fields[f"{kind}usual_misfit"], fields[f"{kind}usual_displaced"] = found.misfit, found.displaced
            right = [one.ratios for one in noisy if np.median(one.ratios.ratios) <= ELSEWHERE]
            if len(right) >= LEAST:
                fields[f"noisy_{kind}radius_scale"] = RadiusRatios.together(right).scale()
        return fields


def factors_of(views: Sequence[Measured]) -> RadiusFactors:
    """Factors by clean views, those that ended in a wrong state included: users meet them."""
    misfit = float(np.median([one.misfit for one in views]))
    displaced = float(np.quantile([one.displaced for one in views], USUALLY))
    factors = RadiusFactors(None, misfit or None, displaced or None)
    scale = RadiusRatios.together([one.widened(factors) for one in views]).scale()
    return replace(factors, scale=scale)
