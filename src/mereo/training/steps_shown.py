"""Progress of a training: steps, their rate, and the time to the very end, with the scores that are no steps."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from mereo.io.progress import Progress, progress
from mereo.training.config import TrainConfig

VALIDATIONS = 20
"""Held-out scores of a run, evenly over its steps: by the clock, a resumed run would have others."""


def steps_between(total: int) -> int:
    """Steps from one held-out score to the next, in a run of ``total``."""
    return math.ceil(total / VALIDATIONS)


class StepsShown:
    """Progress of a run, shown within the block ``showing`` and silent elsewhere.

    Attributes:
        config: of the run.
        total: its steps.
        scored: answers that one validation asks of the network.
    """

    def __init__(self, config: TrainConfig, total: int, scored: int) -> None:
        self.config, self.total, self.scored = config, total, scored
        self.answer_s: float | None = None
        self.shown: Progress | None = None
        self.step = 0

    @contextmanager
    def showing(self, first_step: int) -> Iterator[None]:
        """Block in which the steps after ``first_step`` are shown."""
        self.step = first_step
        with progress("train", self.total - first_step, "steps", each=self.config.batch) as self.shown:
            yield
        self.shown = None

    def took(self, step: int, loss: float) -> None:
        """Show that ``step`` steps are done, the last with this loss."""
        if self.shown is not None:
            self.shown.advance(step - self.step, f"loss {loss:.4f}", self._scores_s(self.shown, step))
            self.step = step

    @contextmanager
    def apart(self, answers: int = 0) -> Iterator[None]:
        """Block that is no step; where it asks the network for so many answers, they are timed."""
        started = time.monotonic()
        with nullcontext() if self.shown is None else self.shown.paused():
            yield
        if answers:
            self.answer_s = (time.monotonic() - started) / answers

    def _scores_s(self, shown: Progress, step: int) -> float:
        """Seconds of the scores that are to come after a step: of held-out examples, and for the class offsets.

        Until the first ones are timed, an answer is taken to cost half of what learning from an example does.
        """
        between = steps_between(self.total)
        validations = -(-self.total // between) - step // between
        each_s = shown.unit_s / self.config.batch / 2 if self.answer_s is None else self.answer_s
        return each_s * (validations * self.scored + self.config.offset_examples)
