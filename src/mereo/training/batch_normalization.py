"""Batch normalization of a batch that several processes share, or one process takes in parts.

Notation: n rows, c channels.
"""

from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor, nn

from mereo.training.processes import Process


def share_statistics(network: nn.Module, process: Process, device: torch.device) -> nn.Module:
    """Network whose batch normalization has the statistics of all processes' rows together, as one process would.

    The network is changed in place. Its parameters and buffers keep their names. torch's own does it on CUDA only.
    """
    if process.world == 1:
        return network
    if device.type != "cpu":
        return nn.SyncBatchNorm.convert_sync_batchnorm(network)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.__class__ = SharedBatchNorm
    return network


def adapt_momentum(network: nn.Module, parts: int) -> None:
    """Let the running statistics move as far in ``parts`` updates of a step as they would in one."""
    if parts == 1:
        return
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.SyncBatchNorm) and module.momentum is not None:
            module.momentum = 1 - (1 - module.momentum) ** (1 / parts)


class SharedBatchNorm(nn.BatchNorm1d):
    """Batch normalization with the statistics of all processes' rows, of which each has equally many."""

    @torch.compiler.disable  # type: ignore[untyped-decorator]
    def forward(self, rows: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Rows, normalized: in training by their own statistics, else by the running ones."""
        if not self.training:
            return super().forward(rows)
        assert self.momentum is not None and self.running_mean is not None and self.running_var is not None
        normalized, mean, variance = _Normalize.apply(rows, self.weight, self.bias, self.eps)
        count = len(rows) * dist.get_world_size()
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked.add_(1)
        return normalized


class _Normalize(torch.autograd.Function):
    """Normalization of Ioffe and Szegedy (2015), whose sums run over the rows of all processes."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Float[Tensor, "n c"],
        weight: Float[Tensor, " c"],
        bias: Float[Tensor, " c"],
        eps: float,
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, " c"], Float[Tensor, " c"]]:
        exact = rows.float()
        variance, mean = torch.var_mean(exact, dim=0, correction=0)
        own = torch.stack([mean, variance])
        every = [torch.empty_like(own) for _ in range(dist.get_world_size())]
        dist.all_gather(every, own)
        means, variances = torch.stack(every).unbind(1)
        mean = means.mean(dim=0)
        # by differences of means, not of squares: a mean may be hundreds of spreads
        variance = (variances + (means - mean).square()).mean(dim=0)
        inverse = (variance + eps).rsqrt()
        standard = (exact - mean) * inverse
        ctx.save_for_backward(standard, inverse, weight)
        ctx.mark_non_differentiable(mean, variance)
        return (standard * weight + bias).to(rows.dtype), mean, variance

    @staticmethod
    def backward(
        ctx: Any, gradient: Float[Tensor, "n c"], *_: Tensor
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, " c"], Float[Tensor, " c"], None]:
        standard, inverse, weight = ctx.saved_tensors
        exact = gradient.float()
        own = torch.stack([exact.sum(dim=0), (exact * standard).sum(dim=0)])  # of bias and weight, which DDP averages
        every = own.clone()
        dist.all_reduce(every)
        shift, slope = every / (len(standard) * dist.get_world_size())
        rows = (exact - shift - standard * slope) * (inverse * weight)
        return rows.to(gradient.dtype), own[1], own[0], None
