"""How a budget of minutes is shared: arithmetic alone, on rates that were measured on this machine and this object."""

import math
from dataclasses import dataclass

from mereo.training.steps_shown import VALIDATIONS

EVALUATION_SHARE = 0.15
"""Of the time that is left after the measurements, for the scores: whose number says how far they can be trusted."""

PASSES = 3.0
"""Times that each example is learnt from, where time allows no more: further ones gain less than new examples."""

MARGIN = 0.93
"""Share of the time for training that is planned: the machine may have more to do by then."""

LEAST_EXAMPLES, MOST_EXAMPLES = 60, 48_000

HOLDOUT = 32
"""Examples of the validation curve, at most; it has 20 scores, each of all of them."""

OFFSET_EXAMPLES = 128
"""Training examples from which class offsets are chosen."""

LEAST_TESTS, MOST_TESTS = 4, 64


@dataclass(frozen=True)
class Rates:
    """Seconds that an example takes, measured.

    Attributes:
        generate_s: to be made, by all processes together.
        train_s: in a step of training.
        score_s: to be answered at all its queries.
    """

    generate_s: float
    train_s: float
    score_s: float


@dataclass(frozen=True)
class Plan:
    """What is made of the time.

    Attributes:
        init: weights from which training starts.
        examples: to be made.
        epochs: passes over those that are not held out.
        generation_s: expected.
        training_s: expected, with all that is scored meanwhile.
        evaluation_s: kept for the scores.
    """

    init: str
    examples: int
    epochs: float
    generation_s: float
    training_s: float
    evaluation_s: float


def plan_for(left_s: float, rates: Rates, init: str, batch: int) -> Plan:
    """Plan for ``left_s`` seconds; where these are too few, the least that can be trained, and so longer.

    Examples are made until each is learnt from ``PASSES`` times in what is left then.
    """
    left_s = max(left_s, 0.0)
    work_s = left_s * (1 - EVALUATION_SHARE)
    examples = LEAST_EXAMPLES
    while examples < MOST_EXAMPLES and _work_s(examples + 1, rates) <= work_s:
        examples += 1
    generation_s = examples * rates.generate_s
    return epochs_for(work_s - generation_s, rates, init, examples, batch, generation_s, left_s * EVALUATION_SHARE)


def epochs_for(
    training_s: float,
    rates: Rates,
    init: str,
    examples: int,
    batch: int,
    generation_s: float = 0.0,
    evaluation_s: float = 0.0,
) -> Plan:
    """Plan for examples that are there already, and so many seconds of training."""
    learnt = examples - holdout(examples)
    steps_s = MARGIN * training_s - _scored_s(examples, rates)
    epochs = max(1.0, steps_s / rates.train_s / learnt)
    epochs = math.ceil(epochs * learnt / batch) * batch / learnt  # whole steps
    expected_s = (epochs * learnt * rates.train_s + _scored_s(examples, rates)) / MARGIN
    return Plan(init, examples, epochs, generation_s, expected_s, evaluation_s)


def holdout(examples: int) -> int:
    """Examples held out of so many."""
    return min(HOLDOUT, examples // 10)


def views_for(left_s: float, each_s: float) -> int:
    """Number of test views that can be scored in ``left_s`` seconds at ``each_s`` for one."""
    return int(max(LEAST_TESTS, min(MOST_TESTS, left_s / max(each_s, 1e-3))))


def _work_s(examples: int, rates: Rates) -> float:
    """Seconds in which so many examples are made, and learnt from ``PASSES`` times."""
    steps_s = PASSES * (examples - holdout(examples)) * rates.train_s
    return examples * rates.generate_s + (steps_s + _scored_s(examples, rates)) / MARGIN


def _scored_s(examples: int, rates: Rates) -> float:
    """Seconds of training that are no steps: the validation curve and the class offsets."""
    return (VALIDATIONS * holdout(examples) + min(OFFSET_EXAMPLES, examples)) * rates.score_s
