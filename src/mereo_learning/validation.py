"""Answers of a network in training on stored examples: held-out scores, and class offsets when it is finished.

Notation: n points, c classes.
"""

from collections.abc import Iterator
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mereo.geometry.metrics import Scores, confusion_matrix, intersection_over_union
from mereo.models.network import Network
from mereo_learning.config import AugmentConfig, TrainConfig
from mereo_learning.dataset import Batch, Dataset, Draws

SEARCHED = 16
"""Held-out examples of an autodecoder's curve: each one's code must be searched for first."""


def held_out(data: Dataset, config: TrainConfig) -> range:
    """Examples of the validation curve, none of which is trained on."""
    first = len(data) - config.holdout
    count = min(config.holdout, SEARCHED) if config.network.encoder == "autodecoder" else config.holdout
    return range(first, first + count)


@torch.no_grad()
def validate(network: Network, data: Dataset, config: TrainConfig, further: bool = False) -> Scores:
    """IoU and mIoU on the held-out examples' queries (not the paper's grid metric).

    With ``further``, of the examples' further observations: example i is seen as its (i mod k)-th of k.
    """
    segmented = config.supervision.labels
    classes = network.segments + 1 if segmented else 2
    total = torch.zeros(classes, classes, dtype=torch.long)
    for batch, logits, distance in _answers(network, data, config, held_out(data, config), further):
        guess = logits.argmax(-1) if segmented else (distance < 0).long()
        truth = batch.labels if segmented else (batch.labels > 0).long()
        total += torch.from_numpy(confusion_matrix(truth.cpu().numpy(), guess.cpu().numpy(), classes))
    return intersection_over_union(total.numpy(), segmented)


@torch.no_grad()
def choose_offsets(network: Network, data: Dataset, config: TrainConfig) -> Float[Tensor, " c"] | None:
    """Class offsets (``logit_adjustment``) from the first training examples; None when off."""
    count = min(config.offset_examples, len(data) - config.holdout)
    uniform = data.uniform_queries
    if not (count and uniform and config.supervision.labels):
        return None
    answers = _answers(network, data, config, range(count))
    pairs = [(logits[:, -uniform:], batch.labels[:, -uniform:]) for batch, logits, _ in answers]
    return class_offsets(*(torch.cat(part).flatten(0, 1).cpu() for part in zip(*pairs, strict=True)))


def _answers(
    network: Network, data: Dataset, config: TrainConfig, examples: range, further: bool = False
) -> Iterator[tuple[Batch, Float[Tensor, "b q c"], Float[Tensor, "b q"]]]:
    """Logits and distances at all queries of stored examples, encoded as in use, batch by batch."""
    network.eval()
    for start in examples[:: config.batch]:
        index = torch.arange(start, min(start + config.batch, examples.stop))
        observation = 1 + index % data.further if further else torch.zeros_like(index)
        batch = data.batch(index, config.network.points, 0, AugmentConfig(), Draws.of(0), observation)
        prediction = network.query(network.encode(batch.cloud, batch.viewpoint), batch.positions)
        yield batch, prediction.logits, prediction.distance


# --- logit_adjustment -------------------------------------------------------------------------------------------------

# Class offsets that make the most likely class the one with the best mIoU.
#
# Training queries are not spread as space is: samplers put as many of them into an ear as into the body, and crowd them
# at surfaces. A network trained on them draws small segments too large. One number per class, added to its logit, makes
# up for the average of it (logit adjustment; Menon et al., ICLR 2021). The numbers are chosen on training examples, at
# their queries that are uniform in space, and become part of the last layer's bias.
#
# Notation: n points, c classes.

STEPS = (1.0, -1.0, 0.5, -0.5, 0.25, -0.25)
ROUNDS = 3


def class_offsets(logits: Float[Tensor, "n c"], labels: Int[Tensor, " n"]) -> Float[Tensor, " c"]:
    """Offsets (empty space: 0) found by moving one class at a time while the mIoU of ``logits + offsets`` grows."""
    offsets = torch.zeros(logits.shape[1])
    best = _miou(logits, labels)
    for _, index in product(range(ROUNDS), range(1, logits.shape[1])):
        for step in STEPS:
            trial = offsets.clone()
            trial[index] += step
            score = _miou(logits + trial, labels)
            if score > best:
                best, offsets = score, trial
    return offsets


def _miou(logits: Float[Tensor, "n c"], labels: Int[Tensor, " n"]) -> float:
    return intersection_over_union(confusion_matrix(labels.numpy(), logits.argmax(dim=1).numpy(), logits.shape[1])).miou
