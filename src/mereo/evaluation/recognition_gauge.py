"""Gauge of recognition: what is usual of the object's views, and how strange a frame may be."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mereo.evaluation.calibration_views import CalibrationView
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.recognition import CONSERVATIVE, LEAST, Signs, is_noisy, strangeness
from mereo.models.calibration import Recognizing, SignName, Usual

MEASURED: tuple[SignName, ...] = tuple(name for name in LEAST if name != "size")
"""Signs that are measured; what is usual of the size follows from how far units are apart."""

SMALLEST_STD: dict[SignName, float] = {
    "unexplained": 0.5,
    "ruled_out": 0.5,
    "beyond": 0.5,
    "unusual": 0.2,
    "displaced": 0.1,
}
"""Least standard deviations of the signs' logarithms: a few views may be more alike than others will be.

The first three are 0 in most views, where what is added to them alone is left."""

TRUSTED = 4
"""Views from which on their mean and standard deviation are taken; from fewer, the conservative ones."""

MOSTLY, ABOVE = 0.95, 1.25
"""The first limit: that quantile of the strangeness of the object's views, times this: there are few of these.

Not their largest: a camera's view that was not understood may well be called strange."""

LEAST_UNSURE = 3.0
"""Smallest first limit, standard deviations."""

APART = 1.6
"""The second limit at least, in the first."""

STRANGE = 0.1
"""Quantile of the strangeness of other things: the second limit is in the middle between it and the first, by ratio."""


class RecognitionGauge:
    """Measurement of what is usual and of both limits. Satisfies ``Gauge``."""

    def __init__(self) -> None:
        self.clean: list[Signs] = []
        self.noisy: list[Signs] = []
        self.strange: list[tuple[Signs, bool]] = []

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in the signs of a view of the object; one that was not registered has none."""
        if answer.registration is not None and answer.recognition.signs is not None:
            noisy = is_noisy(answer.registration)
            (self.noisy if noisy else self.clean).append(answer.recognition.signs)

    def add_strange(self, answer: Answer) -> None:
        """Take in the signs of a frame that shows something else."""
        if answer.registration is not None and answer.recognition.signs is not None:
            self.strange.append((answer.recognition.signs, is_noisy(answer.registration)))

    def fields(self) -> dict[str, Any]:
        """What is usual, and both limits; nothing where too few views were registered."""
        if len(self.clean) < TRUSTED:
            return {}
        clean = usual_of(self.clean)
        noisy = usual_of(self.noisy) if len(self.noisy) >= TRUSTED else dict(CONSERVATIVE.noisy)
        own = [strangeness(one.strange(clean)) for one in self.clean]
        own += [strangeness(one.strange(noisy)) for one in self.noisy]
        unsure = max(ABOVE * float(np.quantile(own, MOSTLY)), LEAST_UNSURE)
        others = [strangeness(one.strange(noisy if is_noise else clean)) for one, is_noise in self.strange]
        lowest = float(np.quantile(others, STRANGE)) if others else unsure * APART**2
        refused = max(float(np.sqrt(unsure * lowest)), APART * unsure)
        return {"recognizing": Recognizing(clean=clean, noisy=noisy, unsure=unsure, refused=refused)}


def usual_of(signs: Sequence[Signs]) -> dict[SignName, Usual]:
    """What is usual of each sign, from views of the object; robust against a view that was not understood."""
    result: dict[SignName, Usual] = {}
    for name in MEASURED:
        values = [one.logarithms[name] for one in signs if name in one.logarithms]
        if values:
            low, middle, high = np.quantile(values, [0.16, 0.5, 0.84])
            result[name] = Usual(mean=float(middle), std=max(float(high - low) / 2, SMALLEST_STD[name]))
    return result
