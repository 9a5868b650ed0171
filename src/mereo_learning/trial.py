"""Short trainings on a few examples: what a step costs, and from which shipped weights an object is learnt fastest."""

import time
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from mereo.io.progress import Progress
from mereo.models.device import keep_freed_memory, pick_device
from mereo.models.weights_place import shipped_names
from mereo_learning.config import TrainConfig
from mereo_learning.dataset import Batch, Dataset, Draws
from mereo_learning.processes import Process
from mereo_learning.run_directory import fit_config, start_network
from mereo_learning.trainer import Trainer
from mereo_learning.validation import validate

COMPARED = 24
"""Examples on which all shipped weights are compared as they are."""

FINALISTS = 3
"""How many of these, those with the lowest loss, are then trained."""

STEPS = 12
"""Steps of a trial: a training of its own, with warm-up and decay."""

JUDGED = 4
"""Steps, the last ones, whose mean loss is compared."""

SCORED = 16
"""Examples from which the time of an answer is taken."""


def small_dataset(folder: Path) -> Dataset:
    """Dataset of a folder where training would have it; raises as ``Dataset.load``."""
    keep_freed_memory()
    return Dataset.load(folder, pick_device(0))


def trial_steps(compared: bool) -> int:
    """Steps of ``timed``, and before it of ``nearest`` where weights are ``compared``, as progress counts them."""
    shipped = len(shipped_names())
    return STEPS + (shipped + min(FINALISTS, shipped) * STEPS if compared else 0)


def nearest(data: Dataset, recipe: TrainConfig, folder: Path, shown: Progress) -> dict[str, float]:
    """Shipped weights nearest to a dataset, the best first, each with its loss after a trial.

    All are compared by their loss as they are; the ``FINALISTS`` among them then by that after a trial.

    Args:
        data: a few examples.
        recipe: of the training to come.
        folder: for what a run writes.
        shown: progress, in steps; a comparison counts as one.
    """
    before = {}
    for name in shipped_names():
        before[name] = Trial.of(data, replace(recipe, init=name), folder).loss_now()
        shown.advance()
    after = {}
    for name in sorted(before, key=lambda name: before[name])[:FINALISTS]:
        after[name] = Trial.of(data, replace(recipe, init=name), folder).run(shown).latest_loss()
    return dict(sorted(after.items(), key=lambda item: item[1]))


def timed(data: Dataset, recipe: TrainConfig, folder: Path, shown: Progress) -> tuple[float, float]:
    """Seconds that an example takes in a step of training, and to be answered at all its queries.

    The steps are counted by ``shown``.

    Raises ``ValueError`` where the weights that ``recipe`` starts from are of another architecture.
    """
    trial = Trial.of(data, recipe, folder).run(shown)
    rounds = []
    for _ in range(2):  # the first one also sets up what later ones find
        started = time.monotonic()
        validate(trial.average, data, replace(trial.config, holdout=SCORED))
        rounds.append((time.monotonic() - started) / SCORED)
    return float(np.median(trial.times_s)) / recipe.batch, min(rounds)


class Trial(Trainer):
    """Training of ``STEPS`` steps on all of its data, of which only losses and speed are asked."""

    @classmethod
    def of(cls, data: Dataset, recipe: TrainConfig, folder: Path) -> "Trial":
        """Trial of a recipe, but for its length and what is held out."""
        config = replace(recipe, holdout=0, epochs=STEPS * recipe.batch / len(data), compile="off")
        config = fit_config(config, data)
        return cls(config, data, start_network(config, data), folder, Process(), data.device)

    @cached_property
    def times_s(self) -> list[float]:
        """Seconds of each step so far."""
        return []

    def say(self, text: str) -> None:
        """Print nothing: nobody waits for these steps."""

    def run(self, shown: Progress) -> "Trial":
        """Take all steps, each counted."""
        for batch in self.batches():
            self.train_step(batch)
            shown.advance()
        return self

    def train_step(self, batch: Batch) -> None:
        """Take one step, and its time."""
        started = time.monotonic()
        super().train_step(batch)
        self._read_losses()
        self.times_s.append(time.monotonic() - started)

    def latest_loss(self) -> float:
        """Mean of the last ``JUDGED`` steps."""
        assert self.log is not None
        return float(np.mean([row["loss"] for row in self.log.rows[-JUDGED:]]))

    @torch.no_grad()
    def loss_now(self) -> float:
        """Mean loss of the first examples, without a step."""
        self.network.train()
        config = self.config
        index = torch.arange(min(COMPARED, len(self.data)))
        batch = self.data.batch(index, config.network.points, config.queries, config.augment, Draws.of(config.seed))
        return float(self._loss(batch)[0])
