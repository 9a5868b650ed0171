"""Optimization of a network in training: parameter groups, learning rates, gradient norm, averaged weights."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.encoders.encoding import CODES
from mereo.training.config import TrainConfig


def parameter_groups(network: nn.Module, config: TrainConfig) -> list[dict[str, object]]:
    """Groups for the optimizer, each with its "peak" rate: weight decay acts on matrices only.

    It would only slow biases and norms. An autodecoder's codes have a rate of their own.
    """
    named = dict(network.named_parameters())
    codes = [named.pop(CODES)] if CODES in named else []
    matrices = [p for p in named.values() if p.ndim >= 2]
    others = [p for p in named.values() if p.ndim < 2]
    peak = config.learning_rate
    groups: list[dict[str, object]] = [
        {"params": matrices, "weight_decay": config.weight_decay, "peak": peak},
        {"params": others, "weight_decay": 0.0, "peak": peak},
    ]
    if codes:
        groups.append({"params": codes, "weight_decay": 0.0, "peak": config.code_rate})
    return groups


def rate_share(config: TrainConfig, step: int, total: int) -> float:
    """Share of its peak, in [0, 1], that each learning rate has in a step, counted from 0, of ``total`` steps."""
    progress = step / total
    if progress < config.warmup:
        return (step + 1) / math.ceil(config.warmup * total)
    if config.schedule == "constant":
        return 1.0
    return 0.5 * (1 + math.cos(math.pi * (progress - config.warmup) / (1 - config.warmup)))


def clip_gradients(network: nn.Module, most: float) -> Float[Tensor, ""]:
    """Norm of all gradients together, which are then shortened to the norm ``most``; 0 leaves them as they are."""
    if most:
        return nn.utils.clip_grad_norm_(network.parameters(), most).float()
    return nn.utils.get_total_norm([p.grad for p in network.parameters() if p.grad is not None]).float()


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, step: int, decay: float) -> None:
    """Move the exponential moving average of a network's weights, in place, to what they are after ``step`` steps."""
    # a young average follows closely, so that the random initialization is forgotten
    decay = min(decay, (1 + step) / (10 + step)) if decay else 0.0
    for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(value, 1 - decay)
        else:
            mean.copy_(value)
