"""Recognize whether a frame shows the object in a learned state, from what a fit leaves unexplained.

    Registration, stated scene unit -Signs.of-> Signs -recognize-> Recognition (known or not, and why)

A sign is a number that is small for the object in learned states, and grows with what is wrong. Views of the object
tell how large some usually are, clean and under a camera's noise (``Calibration.recognizing``). How far all lie above
the usual, in standard deviations and together, is the frame's strangeness; the strangest sign gives the reason.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from mereo.fitting.registration.registration import BELIEVED, Registration
from mereo.models.calibration import Calibration, Recognizing, Usual

Known = bool | Literal["unsure"]

UNSURE, REFUSED = 3.5, 7.0
"""Strangeness up to which the object is known, and that from which on it is not.

Of 295 right answers to training views of ten objects four lie beyond the first, and none beyond the second
(docs/experiments/075.md)."""

MOST = 1e3
"""Strangeness that is not exceeded, and that of a lost object."""

LEAST: Mapping[str, float] = {
    "size": 0.01,
    "unexplained": 0.1,
    "ruled_out": 0.01,
    "beyond": 0.1,
    "unseen": 0.02,
}
"""What is added to a sign before its logarithm is taken: less than that means nothing."""

FIXED: Mapping[str, Usual] = {
    "size": Usual(mean=float(np.log(LEAST["size"] + 0.03)), std=0.3),
    "unseen": Usual(mean=float(np.log(LEAST["unseen"] + 0.02)), std=0.45),
}
"""Usual logarithms of two signs, of all weights: sizes are off by 3 %, and where they are by 10 %, the unit is wrong or
the answer (docs/experiments/078.md); of whole objects, cameras miss 2 to 3 %, of what was fitted to other things 10 to
87 % (docs/experiments/075.md)."""

MEASURED: tuple[str, ...] = ("unexplained", "ruled_out", "beyond")
"""Signs of which a calibration measures what is usual."""


def _usual(*means: float) -> dict[str, Usual]:
    """Usual values of the ``MEASURED`` signs, with wider spreads of their logarithms than single objects have."""
    return {name: Usual(mean=float(np.log(mean)), std=0.5) for name, mean in zip(MEASURED, means, strict=True)}


CONSERVATIVE, OF_SOLIDS = (
    Recognizing(clean=_usual(unexplained, 0.015, 0.15), noisy=_usual(0.6, 0.03, 0.2)) for unexplained in (0.12, 0.3)
)
"""For objects that were not calibrated, and for elastic solids among them: these are near their states and never in
one, so that right answers leave up to 6 % of the points, fits to other things 9 to 80 % (docs/experiments/077.md)."""


@dataclass(frozen=True)
class Signs:
    """Signs that a frame does not show the object in a state that was learned; None where one is not known.

    Attributes:
        size: logarithm, without its sign, of the size found over the one that the frame's unit says; None where no
            unit is stated.
        unexplained: share of the observed points that the model does not explain, in shares that a believed fit may
            leave (5 % of a clean frame, 15 % of a noisy one).
        ruled_out: share of the model's surface that the frame rules out.
        beyond: how far the state lies outside all that were learned, scene units; None at rest.
        unusual: ``StatisticalModel.unusual``, which needs no usual value; None at rest.
        unseen: share of what the camera would see of the model that it has not seen, though nothing is known to hide it
            (``Evidence.unseen``); None where the frame says what is around the object.
    """

    size: float | None = None
    unexplained: float | None = None
    ruled_out: float | None = None
    beyond: float | None = None
    unusual: float | None = None
    unseen: float | None = None

    @classmethod
    def of(
        cls,
        registration: Registration,
        stated_scene_unit: float | None = None,
        unseen: float | None = None,
    ) -> "Signs":
        """Signs of a registration; ``stated_scene_unit`` is the length of a scene unit as the frame's unit says it."""
        # at rest it is known, whatever was learned, and what its scene plays is one of its states
        is_learned, z = registration.method in ("rest", "draws"), registration.modes_z
        return cls(
            size=None if stated_scene_unit is None else abs(float(np.log(registration.scene_unit / stated_scene_unit))),
            unexplained=(1.0 - registration.explained) / max(1.0 - registration.needed, 0.01),
            ruled_out=registration.ruled_out,
            beyond=None if is_learned else registration.beyond_states,
            unusual=None if is_learned or not len(z) else registration.model.unusual(z),
            unseen=unseen,
        )

    @property
    def logarithms(self) -> dict[str, float]:
        """Logarithms of the signs that are known, of which views of the object tell what is usual."""
        signs = {name: getattr(self, name) for name in LEAST}
        return {name: float(np.log(value + LEAST[name])) for name, value in signs.items() if value is not None}

    def strange(self, usual: Mapping[str, Usual]) -> dict[str, float]:
        """Standard deviations by which each sign lies above what is usual; 0 where it does not."""
        known, strange = {**usual, **FIXED}, dict[str, float]()
        for name, value in self.logarithms.items():
            if name in known:  # the few views of a calibration are more alike than others will be
                least = known[name] if name in FIXED else CONSERVATIVE.clean[name]
                strange[name] = (value - known[name].mean) / max(known[name].std, least.std)
        if self.unusual is not None:
            strange["unusual"] = self.unusual
        return {name: min(max(value, 0.0), MOST) for name, value in strange.items()}


def strangeness(strange: Mapping[str, float]) -> float:
    """Strangeness of a frame by all its signs: the root of the sum of their squares."""
    return min(float(np.sqrt(sum(value**2 for value in strange.values()))), MOST)


def is_noisy(registration: Registration) -> bool:
    """Whether the frame was fitted as one with more noise than the paper's."""
    return registration.needed < BELIEVED


@dataclass(frozen=True)
class Recognition:
    """Whether a frame shows the object, in a state that was learned.

    Attributes:
        known: true, false, or "unsure".
        reason: why it is not true, a sentence with what to do; None where it is.
        strangeness: of all signs together, in standard deviations of what is usual.
        signs: what it was made of; None where the network alone answers, and of a lost object.
        calibrated: whether what is usual was measured with the weights.
        has_weights: whether the object has any, which have learned its states; else its files say them.
    """

    known: Known
    reason: str | None
    strangeness: float
    signs: Signs | None = None
    calibrated: bool = False
    has_weights: bool = True

    @property
    def description(self) -> str | None:
        """Sentence for people; None where the object is known."""
        if self.reason is None:
            return None
        refused = f"not the object in a state {WORDS[self.has_weights].state}"
        return f"{'doubtful' if self.known == 'unsure' else refused}: {self.reason}"

    def doubted(self, reason: str | None) -> "Recognition":
        """The same, unsure for a reason that outweighs its own; itself without one, and where the object is refused."""
        return replace(self, known="unsure", reason=reason) if reason and self.known is not False else self

    def facts(self) -> dict[str, Any]:
        """Content of ``recognition`` in a result's summary."""
        return {
            "known": self.known,
            "reason": self.reason,
            "strangeness": self.strangeness,
            "calibrated": self.calibrated,
            "signs": None if self.signs is None else asdict(self.signs),
        }


NOT_EVALUATED = Recognition("unsure", "the network alone cannot tell its object from others: use --method auto", 0.0)
"""Recognition of a frame to which no model was registered."""


def recognize(
    registration: Registration | None,
    calibration: Calibration | None = None,
    stated_scene_unit: float | None = None,
    unseen: float | None = None,
    has_weights: bool = True,
) -> Recognition:
    """Whether a frame shows the object, in a state that was learned; never true of a fit that is not accepted.

    Args:
        registration: of the object's model to the frame; None where the network alone answers.
        calibration: of the weights, with what is usual.
        stated_scene_unit: length of a scene unit in the frame's unit, where the input states that.
        unseen: as in ``Signs``.
        has_weights: as in ``Recognition``.
    """
    if registration is None:
        return NOT_EVALUATED
    calibrated = None if calibration is None else calibration.recognizing
    usual = calibrated or (OF_SOLIDS if registration.model.is_normal else CONSERVATIVE)
    signs = Signs.of(registration, stated_scene_unit, unseen)
    each = signs.strange(usual.noisy if is_noisy(registration) else usual.clean)
    total = strangeness(each)
    is_usual = total <= UNSURE
    if is_usual and registration.accepted:
        return Recognition(True, None, total, signs, calibrated is not None, has_weights)
    sign = "unexplained" if is_usual else max(each, key=lambda name: each[name])
    reason = _reason(sign, registration, signs, WORDS[has_weights])
    known: Known = False if total >= REFUSED else "unsure"
    return Recognition(known, reason, total, signs, calibrated is not None, has_weights)


# --- reasons ----------------------------------------------------------------------------------------------------------

FEATURELESS = (
    "neither the object's outline nor any relief is in the frame, and any smooth surface explains its points as well: "
    "take a frame that shows more of the object"
)
"""Reason of ``Candidate.is_featureless``."""

LOOK = "look at the result before you rely on it"


class Words(NamedTuple):
    """Words about an object: whose it is, the options of its units, how its states are known, how to have more."""

    source: str
    units: str
    state: str
    states: str
    widen: str


WORDS = {
    True: Words(
        source="weights",
        units="--unit-m, --depth-scale",
        state="that was learned",
        states="that were learned",
        widen="the scene's ranges and learn it again",
    ),
    False: Words(
        source="files",
        units="--unit-m, --depth-scale, of its files --units",
        state="that its files allow",
        states="that its files allow",
        widen="its ranges in a scene file (mereo scene new)",
    ),
}
"""Of an object with weights, and of one without."""


def _reason(sign: str, registration: Registration, signs: Signs, words: Words) -> str:
    """Sentence about the sign that is strangest, with what to do."""
    if sign == "size":
        return (
            f"its size differs by a factor of {np.exp(signs.size or 0.0):.3g} from the object's in the frame's unit: "
            f"correct the unit ({words.units}), or name the object's own {words.source}"
        )
    if sign == "unexplained" and registration.explained < 0.5:
        return (
            f"only {registration.explained:.0%} of the points can be the model's: this is probably another object, "
            "not the object alone, or no camera frame: leave out what is not the object, turn the cloud (--frame), or "
            f"name the object's own {words.source}"
        )
    if sign == "unexplained":
        return (
            f"{1 - registration.explained:.0%} of the points are not the model's: {LOOK}, or leave out of the cloud "
            "what is not the object"
        )
    if sign == "ruled_out":
        return (
            f"{registration.ruled_out:.0%} of the model's surface lies where the frame shows none of it, next to or in "
            f"front of what was seen: {LOOK}, or take the frame from nearer"
        )
    if sign == "unseen":
        return (
            f"{signs.unseen:.0%} of what the camera would see of the object was not seen, and the frame does not say "
            "what hides it: give the whole depth image, state that a part is seen (--extent partial), or take a frame "
            "of the whole object"
        )
    widen = f"{LOOK}, or name the {words.source} of what it is; if it is this object, widen {words.widen}"
    if sign == "beyond" or (sign == "unusual" and registration.beyond_states > 0.5):
        return (
            f"the state lies {registration.beyond_states:.1f} scene units outside those {words.states}, and rigid "
            f"parts may be bent: {widen}"
        )
    return f"the object would be bent farther than in the states {words.states}: {widen}"
