"""Recognize whether a frame shows the object in a learned state, from what a fit leaves unexplained.

    Registration, stated scene unit -Signs.of-> Signs -recognize-> Recognition (known or not, and why)

A sign is a number that is small for the object in learned states, and grows with what is wrong. Each speaks against the
object with so many nats, whatever the object, its weights and the frame's noise. What is left of those that speak for
it is the logarithm of how much likelier the frame shows it in that state than not. The strongest sign gives the reason.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from mereo.fitting.registration.registration import Registration

Known = bool | Literal["unsure"]

FIT, UNEXPLAINED, RULED_OUT, UNSEEN, UNUSUAL = 3.4, 2.1, 18.0, 12.0, 1.5
"""Nats of a fit without any sign, and those that each sign takes off: the roots of shares, what was not seen, and each
standard deviation of an unusual state. By a logistic regression of 715 training views of 17 objects and of other things
(docs/experiments/098.md), parts of the object left out; but for the first, a little more, and the last, less than its
2.4: real states are bent farther than drawn ones."""

SIZE_STD = 0.04
"""Standard deviation of the logarithm of a size: own views are off by .1 to 8 % (docs/experiments/078.md)."""

REFUSED = -3.0
"""Nats below which the object is not known; up to 0 it may be there."""


def known_by(nats: float) -> Known:
    """Whether the object is known by these nats."""
    return True if nats > 0 else "unsure" if nats >= REFUSED else False


@dataclass(frozen=True)
class Signs:
    """Signs that a frame does not show the object in a state that was learned; None where one is not known.

    Attributes:
        size: logarithm, without its sign, of the size found over the one that the frame's unit says; None where no
            unit is stated.
        unexplained: share of the observed points that the model does not explain, in shares that a believed fit may
            leave (5 % of a clean frame, 15 % of a noisy one).
        ruled_out: share of the model's surface that the frame rules out.
        unusual: ``StatisticalModel.unusual``; None at rest, and of a state that the scene plays.
        unseen: share of what the camera would see of the model that it has not seen, though nothing is known to hide it
            (``Evidence.unseen``); None where the frame says what is around the object.
    """

    size: float | None = None
    unexplained: float | None = None
    ruled_out: float | None = None
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
        is_learned = registration.method in ("rest", "draws")
        z = registration.modes_z
        return cls(
            size=None if stated_scene_unit is None else abs(float(np.log(registration.scene_unit / stated_scene_unit))),
            unexplained=(1.0 - registration.explained) / max(1.0 - registration.needed, 0.01),
            ruled_out=registration.ruled_out,
            unusual=None if is_learned or not len(z) else registration.model.unusual(z),
            unseen=unseen,
        )

    @property
    def against(self) -> dict[str, float]:
        """Nats with which each sign speaks against the object."""
        known = {name: value or 0.0 for name, value in vars(self).items()}
        return {
            "size": (known["size"] / SIZE_STD) ** 2 / 2,
            "unexplained": UNEXPLAINED * float(np.sqrt(known["unexplained"])),
            "ruled_out": RULED_OUT * float(np.sqrt(known["ruled_out"])),
            "unusual": UNUSUAL * max(known["unusual"], 0.0),
            "unseen": UNSEEN * known["unseen"],
        }

    @property
    def nats(self) -> float:
        """Nats with which the fit speaks for the object."""
        return FIT - sum(self.against.values())


@dataclass(frozen=True)
class Recognition:
    """Whether a frame shows the object, in a state that was learned.

    Attributes:
        known: true, false, or "unsure".
        reason: why it is not true, a sentence with what to do; None where it is.
        signs: what it was made of; None where the network alone answers, and of a lost object.
        has_weights: whether the object has any, which have learned its states; else its files say them.
    """

    known: Known
    reason: str | None
    signs: Signs | None = None
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
            "nats": self.signs and self.signs.nats,
            "signs": self.signs and asdict(self.signs),
        }


NOT_EVALUATED = Recognition("unsure", "the network alone cannot tell its object from others: use --method auto")
"""Recognition of a frame to which no model was registered."""


def recognize(
    registration: Registration | None,
    stated_scene_unit: float | None = None,
    unseen: float | None = None,
    has_weights: bool = True,
) -> Recognition:
    """Whether a frame shows the object, in a state that was learned.

    Never true of a fit that is not accepted.

    Args:
        registration: of the object's model to the frame; None where the network alone answers.
        stated_scene_unit: length of a scene unit in the frame's unit, where the input states that.
        unseen: as in ``Signs``.
        has_weights: as in ``Recognition``.
    """
    if registration is None:
        return NOT_EVALUATED
    signs = Signs.of(registration, stated_scene_unit, unseen)
    known = known_by(signs.nats)
    against = signs.against
    recognition = Recognition(known, None, signs, has_weights)
    if known is not True or not registration.accepted:
        sign = "unexplained" if known is True else max(against, key=lambda name: against[name])
        reason = _reason(sign, registration, signs, WORDS[has_weights])
        recognition = replace(recognition, known=known and "unsure", reason=reason)  # refused, or unsure
    return recognition


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
    """Sentence about the strongest sign, with what to do."""
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
    if registration.beyond_states > 0.5:
        return (
            f"the state lies {registration.beyond_states:.1f} scene units outside those {words.states}, and rigid "
            f"parts may be bent: {widen}"
        )
    return f"the object would be bent farther than in the states {words.states}: {widen}"
