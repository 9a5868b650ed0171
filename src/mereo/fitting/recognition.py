"""Is it my object, in a state that I know? One answer from what a fit and the network leave unexplained.

    Registration, correspondences, stated unit -Signs.of-> Signs -recognize-> Recognition (known or not, and why)

A sign is a number that is small for the object in states that were learned, whatever the camera, and grows with what is
wrong. Each has two limits: up to the first it says nothing, from the second on the frame is refused. Calibrated weights
have limits of their own (``Calibration.limits``), others the conservative ones here. The sign that is farthest beyond
its limits decides, and gives the reason: there is one voice.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from mereo.fitting.readings import FittedFrame
from mereo.fitting.registration import Registration
from mereo.models.calibration import Calibration, SignLimits, SignName
from mereo.models.model import Model

Known = bool | Literal["unsure"]

UNSURE, REFUSED = 1.0, 2.0
"""Strangeness at the first and at the second limit of a sign."""

MOST = 1e3
"""Strangeness that is not exceeded, and that of a frame in which nothing was found."""

LIMITS: Mapping[SignName, SignLimits] = {
    "unexplained": SignLimits(unsure=1.0, refused=8.0),
    "ruled_out": SignLimits(unsure=0.03, refused=0.3),
    "beyond": SignLimits(unsure=1.0, refused=5.0),
    "unusual": SignLimits(unsure=3.0, refused=12.0),
    "displaced": SignLimits(unsure=0.15, refused=0.6),
    "size": SignLimits(unsure=0.15, refused=0.7),
}
"""Limits for weights that were not calibrated; those of the size hold for all, as units differ by 2.5 and more."""

LOOK = "look at the result before you rely on it"


@dataclass(frozen=True)
class Signs:
    """Signs that a frame does not show the object in a state that was learned; None where one is not known.

    Attributes:
        unexplained: share of the observed points that the model does not explain, in shares that a believed fit may
            leave (5 % of a clean frame, 25 % of a noisy one).
        ruled_out: share of the model's surface that the frame rules out.
        beyond: how far the state lies outside all that were learned, scene units.
        unusual: mean square of the state's coefficients, which is 1 in the mean of the states that were learned.
        displaced: median distance between where the network and the registered model have the same place of the
            object, as a share of half its length; None where the network was not asked.
        size: logarithm of the size found over the one that the frame's unit says; None where no unit is stated.
    """

    unexplained: float | None = None
    ruled_out: float | None = None
    beyond: float | None = None
    unusual: float | None = None
    displaced: float | None = None
    size: float | None = None

    @classmethod
    def of(
        cls, registration: Registration, displaced: float | None = None, stated_unit: float | None = None
    ) -> "Signs":
        """Signs of a registration; ``stated_unit`` is the length of a scene unit in its unit as the input says it."""
        z = registration.modes_z
        return cls(
            unexplained=(1.0 - registration.explained) / (1.0 - registration.needed),
            ruled_out=registration.ruled_out,
            beyond=registration.beyond_states,
            unusual=float((z**2).mean()) if len(z) else 0.0,
            displaced=displaced,
            size=None if stated_unit is None else float(np.log(registration.scene_unit / stated_unit)),
        )

    def strangeness(self, limits: Mapping[SignName, SignLimits]) -> dict[SignName, float]:
        """Strangeness by each sign that is known: ``UNSURE`` at its first limit, ``REFUSED`` at its second."""
        found: dict[SignName, float] = {}
        for name, limit in limits.items():
            value = getattr(self, name)
            if value is not None:
                found[name] = strangeness(abs(value), limit)
        return found


def strangeness(value: float, limit: SignLimits) -> float:
    """Strangeness of a sign: a share of its first limit, and beyond that it grows with the logarithm."""
    if not np.isfinite(value):
        return MOST
    if value <= limit.unsure:
        return UNSURE * value / limit.unsure
    grown = np.log(value / limit.unsure) / np.log(limit.refused / limit.unsure)
    return float(min(UNSURE + (REFUSED - UNSURE) * grown, MOST))


@dataclass(frozen=True)
class Recognition:
    """Whether a frame shows the object, in a state that was learned.

    Attributes:
        known: true, false, or "unsure".
        reason: why it is not true, a sentence with what to do; None where it is.
        strangeness: of the sign that decides: below 1 where the object is known, from 2 on where it is not.
        signs: what it was made of; None where no registration was found.
        calibrated: whether the limits are the weights' own.
    """

    known: Known
    reason: str | None
    strangeness: float
    signs: Signs | None = None
    calibrated: bool = False

    @property
    def told(self) -> str | None:
        """Sentence for people; None where the object is known."""
        return None if self.reason is None else told_of(self.known, self.reason)

    def facts(self) -> dict[str, Any]:
        """Content of ``recognition`` in a result's summary."""
        return {
            "known": self.known,
            "reason": self.reason,
            "strangeness": self.strangeness,
            "calibrated": self.calibrated,
            "signs": None if self.signs is None else asdict(self.signs),
        }


def told_of(known: Known, reason: str) -> str:
    """Sentence for people about a frame that is not known for sure."""
    return f"{'doubtful' if known == 'unsure' else 'not the object in a state that was learned'}: {reason}"


NOT_ASKED = Recognition("unsure", "the network alone cannot tell its object from others: use --fit auto", UNSURE)
"""Recognition of a frame to which no model was registered."""


def recognize(
    registration: Registration | None,
    calibration: Calibration | None = None,
    displaced: float | None = None,
    stated_unit: float | None = None,
    refusal: str | None = None,
) -> Recognition:
    """Whether a frame shows the object, in a state that was learned.

    Args:
        registration: of the object's model to the frame; None where none was found or none was asked for.
        calibration: of the weights, with their limits.
        displaced: as in ``Signs``.
        stated_unit: length of a scene unit in the frame's unit, where the input states that.
        refusal: why no registration was found; None where none was asked for, and then it cannot be told.
    """
    if registration is None:
        if refusal is not None:
            return Recognition(False, refusal, MOST)
        return NOT_ASKED
    own = None if calibration is None else calibration.limits
    signs = Signs.of(registration, displaced, stated_unit)
    each = signs.strangeness({**LIMITS, **(own or {})})
    worst = max(each, key=lambda name: each[name])
    most, calibrated = each[worst], own is not None
    if most <= UNSURE:
        return Recognition(True, None, most, signs, calibrated)
    reason = REASONS[worst](registration, signs, most >= REFUSED)
    return Recognition(False if most >= REFUSED else "unsure", reason, most, signs, calibrated)


def recognized(
    found: FittedFrame, registration: Registration | None, model: Model, stated_unit: float | None = None
) -> Recognition:
    """Whether a frame shows the object that ``registration``, made of it, is of."""
    displaced = None if registration is None or found.modes is None else found.modes.displaced(registration)
    refusal = None if found.error is None else str(found.error)
    return recognize(registration, model.calibration, displaced, stated_unit, refusal)


# --- reasons ----------------------------------------------------------------------------------------------------------


def _unexplained(registration: Registration, signs: Signs, refused: bool) -> str:
    if refused:
        return (
            f"only {registration.explained:.0%} of the points can be the model's: this is probably another object, "
            "not the object alone, or no camera frame: leave out what is not the object, turn the cloud (--frame), or "
            "name the object's own weights"
        )
    return (
        f"{1 - registration.explained:.0%} of the points are not the model's: {LOOK}, or leave out of the cloud what "
        "is not the object"
    )


def _ruled_out(registration: Registration, signs: Signs, refused: bool) -> str:
    return (
        f"{registration.ruled_out:.0%} of the model's surface lies where the frame shows none of it, beside or in "
        f"front of what was seen: {LOOK}, or take the frame from nearer"
    )


def _beyond(registration: Registration, signs: Signs, refused: bool) -> str:
    return (
        f"the state lies {registration.beyond_states:.1f} scene units outside those that were learned, and rigid parts "
        f"may be bent: {LOOK}, or widen the scene's ranges and learn it anew"
    )


def _unusual(registration: Registration, signs: Signs, refused: bool) -> str:
    return (
        f"the object is bent {np.sqrt(signs.unusual or 0.0):.1f} times as far as in the mean of the states that were "
        f"learned: {LOOK}, or widen the scene's ranges and learn it anew"
    )


def _displaced(registration: Registration, signs: Signs, refused: bool) -> str:
    return (
        f"network and registered model have the same places of the object {signs.displaced or 0.0:.0%} of half its "
        f"length apart: {LOOK}, or name the object's own weights"
    )


def _size(registration: Registration, signs: Signs, refused: bool) -> str:
    return (
        f"it is {np.exp(signs.size or 0.0):.3g} times as large as the object is in the frame's unit: correct the unit "
        "(--unit-m), or name the object's own weights"
    )


REASONS: Mapping[SignName, Callable[[Registration, Signs, bool], str]] = {
    "unexplained": _unexplained,
    "ruled_out": _ruled_out,
    "beyond": _beyond,
    "unusual": _unusual,
    "displaced": _displaced,
    "size": _size,
}
"""Sentences by the sign that decides."""
