"""Measurements on a few examples before the work is planned: how long they take, and from which weights to start."""

import time
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

from mereo.io.progress import progress
from mereo.learning.schedule import Rates
from mereo.synthesis.config import GenerateConfig, SamplingConfig
from mereo.synthesis.shards import generate
from mereo.training.config import TrainConfig
from mereo.training.trial import STEPS, nearest, small_dataset, timed, trial_steps

MADE_AS = GenerateConfig(sampling=SamplingConfig(uniform_fraction=0.15))
"""How examples are made: with the share of uniform queries that the schedule was measured with; the paper's is more."""

EXAMPLES = 48
"""Examples that are measured; they are of the seed of training, and are made again with the others."""

PARALLEL = 0.8
"""What another process adds: cores share memory and caches."""


def measure(scene: str, folder: Path, recipe: TrainConfig, *, init: str, seed: int, workers: int) -> tuple[Rates, str]:
    """Seconds that examples take, and the weights to start from.

    Args:
        scene: name or file of what is learnt.
        folder: in which a small dataset and short runs are made; the caller removes it.
        recipe: of the training.
        init: weights to start from; empty compares the shipped ones.
        seed: of the examples.
        workers: processes that will make them.

    Raises ``ValueError`` where an example cannot be made, or the weights do not fit the recipe.
    """
    started = time.monotonic()
    with redirect_stdout(StringIO()):  # nobody waits for these few
        generate(scene, folder / "data", MADE_AS, examples=EXAMPLES, seed=seed, workers=1)
    # with the template and 100 states, so a little too long
    generate_s = (time.monotonic() - started) / EXAMPLES / (1 + PARALLEL * (workers - 1))
    data = small_dataset(folder / "data")
    with progress("measure", trial_steps(compared=not init), "steps") as shown:
        found = {} if init else nearest(data, recipe, folder, shown)
        init = init or next(iter(found))
        rates = Rates(generate_s, *timed(data, replace(recipe, init=init), folder, shown))
    if found:
        told = ", ".join(f"{name} {loss:.2f}" for name, loss in found.items())
        print(f"loss after {STEPS} steps from the weights of {told}", flush=True)
    return rates, init
