"""Batch normalization folded into the layers before it: the same function in fewer passes, for inference.

In evaluation mode normalization is a scale and a shift per channel, ``norm(W x) = (s W) x + t``. Every linear layer
whose output is normalized therefore takes the scale into its weights and the shift into its bias. Rounding apart,
nothing changes.
"""

import copy
from itertools import pairwise
from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from mereo.models.decoder import ConditionedMLP
from mereo.models.encoders.encoding import SharedMLP

AnyModule = TypeVar("AnyModule", bound=nn.Module)


@torch.inference_mode(False)  # a search for codes needs gradients, which tensors of inference mode cannot give
@torch.no_grad()
def fold_batch_norm(network: AnyModule) -> AnyModule:
    """Copy of a network for inference whose decoders and shared layers have no normalization left.

    Its parameters have other names and meanings: it can be neither trained nor saved. Raises ``ValueError`` for a
    network in training mode, whose normalization depends on the batch.
    """
    if network.training:
        raise ValueError("the network is in training mode; batch normalization can be folded after network.eval() only")
    folded = copy.deepcopy(network).requires_grad_(False)
    for module in folded.modules():
        if isinstance(module, SharedMLP):
            _fold_shared(module)
        elif isinstance(module, ConditionedMLP):
            _fold_conditioned(module)
    return folded


def _fold_shared(mlp: SharedMLP) -> None:
    layers = list(mlp.layers)
    for index, (linear, norm) in enumerate(pairwise(mlp.layers)):
        if isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
            layers[index], layers[index + 1] = fuse_linear_bn_eval(linear, norm), nn.Identity()
    mlp.layers = nn.Sequential(*(layer for layer in layers if not isinstance(layer, nn.Identity)))


def _fold_conditioned(mlp: ConditionedMLP) -> None:
    """Every summand of a layer's input to the normalization is scaled; one of them takes the shift."""
    for number, norm in enumerate(mlp.norms):
        assert isinstance(norm, nn.BatchNorm1d)
        assert norm.running_mean is not None and norm.running_var is not None
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        for summand in mlp.summands(number):
            summand.weight = nn.Parameter(summand.weight * scale[:, None], requires_grad=False)
        takes_shift = mlp.latent1 if number == 0 else mlp.hidden[number - 1]
        takes_shift.bias = nn.Parameter(norm.bias - norm.running_mean * scale, requires_grad=False)
    mlp.norms = nn.ModuleList(nn.Identity() for _ in mlp.norms)
