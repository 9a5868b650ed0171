"""Budgets of experiments: minutes to prove that they run, hours on two cores, or as published."""

from dataclasses import dataclass, replace
from typing import Literal

from mereo_learning.config import PRESETS, TrainConfig

ExperimentName = Literal[
    "reconstruction", "encoders-losses", "encoders", "sampling", "positional-encoding", "noise", "real-world"
]
ScaleName = Literal["smoke", "cpu", "paper"]

TRAINING_SEED = 1
"""Seed of all datasets; test views come from ``TEST_SEED_START``."""


@dataclass(frozen=True)
class ExperimentScale:
    """Budget of an experiment: how much is made, trained and tested.

    Attributes:
        name: name of the budget.
        recipe: training settings, from which an experiment changes what it compares.
        autodecoder: those of the autodecoder, which has a recipe of its own in the paper too.
        rival: a second recipe to report too where an experiment compares whole recipes; None for one only.
        examples: number of examples of each dataset.
        test_examples: number of test views of each evaluation.
        cells: cells of the evaluation's grid along each axis; the paper's is 100.
        objects: most objects on which variants are compared, in an experiment's own order; None means all.
        downloads: whether objects are taken whose meshes are downloaded.
        decides: whether networks learn enough for claims to be judged.
        chosen: objects that were asked for by name, of an experiment's own, whatever the budget; empty for none.
    """

    name: ScaleName
    recipe: TrainConfig
    autodecoder: TrainConfig
    rival: TrainConfig | None
    examples: int
    test_examples: int
    cells: int
    objects: int | None
    downloads: bool
    decides: bool = True
    chosen: tuple[str, ...] = ()

    def choose(self, objects: tuple[str, ...]) -> tuple[str, ...]:
        """Objects of an experiment that were asked for, or those that fit the budget, in its order."""
        if self.chosen:
            return tuple(name for name in objects if name in self.chosen)
        known = objects if self.downloads else tuple(name for name in objects if name not in DOWNLOADED)
        return known[: self.objects]


DOWNLOADED = ("human", "bunny", "skull", "liver", "tumor", "liver-simulated")
"""Scenes whose meshes are downloaded."""

_TINY, _PAPER = PRESETS["tiny"], PRESETS["paper"]

# Small, because hours are few and there are dozens of runs: on two cores it learns more in minutes than the wide one.
# Without alignment and template, so that what is left is the paper's network with local features and lines of sight:
# each variant of the paper can be switched on its own in it, and it learns in minutes what the paper's network does not
# learn in hours (docs/learning.md).
_SHORT = replace(
    _TINY, network=_TINY.network.changed(points=512, align_points=0, rest_template=False), epochs=8, holdout=32
)

# As published it is for millions of examples: it says "empty" everywhere after any number that fits (experiments 10).
_AUTODECODER = PRESETS["tiny-autodecoder"]

_ALL = (
    ExperimentScale(
        name="smoke",
        recipe=replace(_TINY, epochs=1, holdout=4),
        autodecoder=replace(_AUTODECODER, epochs=4, holdout=4),
        rival=None,
        examples=64,
        test_examples=2,
        cells=24,
        objects=1,
        downloads=False,
        decides=False,
    ),
    ExperimentScale("cpu", _SHORT, _AUTODECODER, None, 1536, 32, 64, 2, downloads=True),
    ExperimentScale(
        "paper", _PAPER, PRESETS["paper-autodecoder"], PRESETS["large"], 28_800, 128, 100, None, downloads=True
    ),
)

SCALES = {str(scale.name): scale for scale in _ALL}
"""Budgets by name."""
