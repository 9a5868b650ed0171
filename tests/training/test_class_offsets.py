"""Class offsets undo what an uneven share of training queries does to a decision."""

import numpy as np
import torch

from mereo.evaluation.metrics import confusion_matrix, intersection_over_union
from mereo.training.validation import class_offsets


def noisy_world(count: int, share: tuple[float, ...], seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Labels drawn with ``share``, a noisy observation of each, and the log likelihood of every class given it."""
    rng = np.random.default_rng(seed)
    labels = rng.choice(len(share), size=count, p=share)
    seen = labels + rng.normal(scale=0.6, size=count)
    logits = -0.5 * ((seen[:, None] - np.arange(len(share))) / 0.6) ** 2
    return torch.from_numpy(logits).float(), torch.from_numpy(labels)


def miou(logits: torch.Tensor, labels: torch.Tensor) -> float:
    return intersection_over_union(confusion_matrix(labels.numpy(), logits.argmax(1).numpy(), logits.shape[1])).miou


def test_a_rare_class_trained_as_if_common_is_drawn_smaller_and_what_is_right_is_left_alone() -> None:
    """Likelihoods alone are what equal shares would teach; the class is really one point in a hundred."""
    share = (0.69, 0.3, 0.01)
    logits, labels = noisy_world(60_000, share, seed=0)
    offsets = class_offsets(logits, labels)
    assert offsets[0] == 0 and offsets[2] < -0.5
    fresh, truth = noisy_world(60_000, share, seed=1)
    assert miou(fresh + offsets, truth) > miou(fresh, truth) + 0.01
    labels = torch.arange(3).repeat(50)
    assert torch.equal(class_offsets(5.0 * torch.nn.functional.one_hot(labels).float(), labels), torch.zeros(3))
