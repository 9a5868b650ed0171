"""Products of layers in float32 on a CPU, by whichever of torch's two libraries is the faster one there.

torch asks Intel's MKL, which takes the slower instructions on AMD's processors; oneDNN, which torch brings as well and
asks for bfloat16, makes twice as many operations a second there in the same precision.
"""

import time
from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

ROWS = 1024
"""Number of rows, or a multiple, of what oneDNN is asked for: it prepares itself for each size, and keeps few."""

PAYS = 1.2
"""Gain from which oneDNN is asked."""


def linear(
    rows: Float[Tensor, "*n i"], weight: Float[Tensor, "o i"], bias: Float[Tensor, " o"] | None = None
) -> Float[Tensor, "*n o"]:
    """The product ``rows weight^T + bias``, as ``torch.nn.functional.linear`` gives it but for rounding."""
    if _suits(rows, weight) and onednn_gain() >= PAYS:
        return _by_onednn(rows, weight, bias)
    return F.linear(rows, weight, bias)


def _suits(rows: Tensor, weight: Tensor) -> bool:
    """Whether these are plain numbers of many rows on a CPU: neither a graph nor a training, which need torch's own."""
    count = rows.numel() // max(rows.shape[-1], 1)
    return (
        rows.device.type == "cpu"
        and rows.dtype == weight.dtype == torch.float32
        and count > 0
        and count % ROWS == 0
        and not torch.is_grad_enabled()
        and not torch.is_autocast_enabled("cpu")
        and not torch.compiler.is_compiling()
    )


def _by_onednn(rows: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    product: Tensor = torch.ops.mkldnn._linear_pointwise(rows, weight, bias, "none", [], "")
    return product


@cache
@torch.inference_mode()
def onednn_gain() -> float:
    """Ratio of oneDNN's rate of float32 products to MKL's, at the network's size; 0 where torch has no oneDNN.

    Measured once, in about 30 ms, as no name of a processor tells it.
    """
    # not random numbers: drawing them would change the caller's
    rows, weight = torch.ones(2 * ROWS, 256), torch.ones(256, 256)
    try:
        pair: tuple[Callable[[], Tensor], ...] = (
            lambda: _by_onednn(rows, weight, None),
            lambda: F.linear(rows, weight),
        )
        rounds = [[_seconds(each) for each in pair] for _ in range(6)]  # in turn, so that a busy moment meets both
    except (AttributeError, RuntimeError, NotImplementedError):  # a private operator: it may go, and stop nothing
        return 0.0
    ours, theirs = map(min, zip(*rounds, strict=True))
    return theirs / ours


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
