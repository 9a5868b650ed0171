"""Gauge of recognition: limits of the signs that tell other things and states from the object in a learned state."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mereo.evaluation.calibration_views import CalibrationView
from mereo.fitting.readings import FittedFrame
from mereo.fitting.recognition import LIMITS, Signs
from mereo.fitting.registration import Registration
from mereo.models.calibration import SignLimits, SignName

MEASURED: tuple[SignName, ...] = ("unexplained", "ruled_out", "beyond", "unusual", "displaced")
"""Signs whose limits are measured; those of the size follow from how far units are apart."""

ABOVE = 1.2
"""The first limit, in the largest value of clean views of the object: there are few of these."""

LEAST: dict[SignName, float] = {
    "unexplained": 0.6,
    "ruled_out": 0.01,
    "beyond": 0.1,
    "unusual": 1.5,
    "displaced": 0.08,
}
"""Smallest first limits: below these a sign means nothing, whatever a few views have shown."""

APART = 2.0
"""The second limit at least, in the first."""

STRANGE = 0.5
"""Quantile of a sign among strange frames: the second limit lies in the middle between it and the object's views."""


class RecognitionGauge:
    """Measurement of the limits of signs. Satisfies ``Gauge``."""

    def __init__(self) -> None:
        self.clean: list[Signs] = []
        self.noisy: list[Signs] = []
        self.strange: list[Signs] = []

    def add(self, view: CalibrationView, frame: FittedFrame, registration: Registration | None) -> None:
        """Take in the signs of a view of the object; one that was not registered has none."""
        if registration is not None:
            (self.clean if view.clean else self.noisy).append(signs_of(frame, registration))

    def add_strange(self, frame: FittedFrame, registration: Registration | None) -> None:
        """Take in the signs of a frame that shows something else."""
        if registration is not None:
            self.strange.append(signs_of(frame, registration))

    def fields(self) -> dict[str, Any]:
        """Limits of all signs, where the object was registered at all."""
        if not self.clean:
            return {}
        return {"limits": {name: self._limits(name) for name in MEASURED}}

    def _limits(self, name: SignName) -> SignLimits:
        clean, noisy, strange = (_values(each, name) for each in (self.clean, self.noisy, self.strange))
        unsure = max(ABOVE * max(clean, default=0.0), LEAST[name])
        highest = max([unsure, *noisy])
        lowest = float(np.quantile(strange, STRANGE)) if strange else LIMITS[name].refused
        # in the middle of the gap, on a scale of ratios; where there is none, beyond all views of the object
        refused = float(np.sqrt(highest * lowest)) if lowest > highest else ABOVE * highest
        return SignLimits(unsure=unsure, refused=max(refused, APART * unsure))


def signs_of(frame: FittedFrame, registration: Registration) -> Signs:
    """Signs of a registration of a frame whose unit says nothing."""
    assert frame.modes is not None
    return Signs.of(registration, frame.modes.displaced(registration))


def _values(signs: Sequence[Signs], name: SignName) -> list[float]:
    found = (getattr(one, name) for one in signs)
    return [abs(value) for value in found if value is not None]
