"""Examples that weights have seen in training, those of the weights that they started from included.

A training writes into its weights how many their start had seen (``provenance["examples_before"]``), so that chains of
any length add up. It has a module of its own because runs write it, and cards and `mereo weights show` tell it.
"""

from collections.abc import Mapping
from typing import Any

from mereo.models.weights import load_model

_BEFORE: Mapping[tuple[str, str, str], int] = {
    ("bunny", "3", "6530"): 132_320,
    ("engine", "11", "6240"): 438_448,
    ("human", "7", "4872"): 423_730,
    ("lizard", "10", "3372"): 414_766,
    ("robot", "8", "10326"): 449_668,
    ("rope", "5", "10351"): 70_980,
    ("shapes", "12", "5744"): 407_884,
    ("sheet", "9", "16860"): 433_984,
    ("skull", "6", "10326"): 441_922,
    ("tumor", "4", "4060"): 83_106,
}
"""What shipped weights had seen before their last training, by scene, seed and steps of that one.

Their files are older than ``examples_before``. The chains are in docs/experiments.md, entries 6, 13, 14, 16, 17 and 18:
all but the liver and the rope began with the bunny's 393,520, the tumour with the liver's.
"""


def seen_in_training(provenance: Mapping[str, Any]) -> int | None:
    """Number of examples that a training has shown, repeated ones each time; None where the weights do not say."""
    recipe = provenance.get("recipe") or {}
    steps, batch = provenance.get("steps"), recipe.get("batch")
    return steps * batch if isinstance(steps, int) and isinstance(batch, int) else None


def seen_before(provenance: Mapping[str, Any]) -> int | None:
    """Number of examples that the weights from which a training started had seen, and those before them.

    0 for a start from random weights; None where a chain cannot be told: an older mereo did not write it.
    """
    stated = provenance.get("examples_before")
    if isinstance(stated, int):
        return stated
    recipe = provenance.get("recipe")
    if recipe and not recipe.get("init"):
        return 0
    return _BEFORE.get(
        (str(provenance.get("scene")), str(provenance.get("training_seed")), str(provenance.get("steps")))
    )


def seen_in_all(provenance: Mapping[str, Any]) -> int | None:
    """Number of examples of a training and of the chain behind it; None where the weights do not say."""
    own, before = seen_in_training(provenance), seen_before(provenance)
    return None if own is None or before is None else own + before


def seen_by(init: str) -> int | None:
    """Number of examples that weights have seen in all, by a shipped name or a file; empty are random ones.

    None where they do not say. Raises as ``load_model`` does.
    """
    return seen_in_all(load_model(init).provenance) if init else 0


def told(provenance: Mapping[str, Any]) -> str:
    """Words for the examples of a training and of the chain behind it; empty where the weights do not say."""
    own, before = seen_in_training(provenance), seen_before(provenance)
    if own is None or before == 0:
        return "" if own is None else f"{own:,} examples seen"
    if before is None:
        return f"{own:,} examples seen, and those of the weights that it started from, which do not say how many"
    return f"{own:,} examples seen, {own + before:,} with those of the weights that it started from"
