"""Roofline: the least time that a stage can take here, by the measured rates of large products and of copies."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from mereo.models.device import linear


@dataclass(frozen=True)
class Machine:
    """Measured rates of a machine.

    Attributes:
        operations: floating-point operations per second.
        bandwidth: bytes per second.
    """

    operations: float
    bandwidth: float


@dataclass(frozen=True)
class Work:
    """Work that a stage must do at least.

    Attributes:
        operations: floating-point operations of matrix products, two for a multiplication with addition.
        bytes: bytes that are read and written at least once.
    """

    operations: float
    bytes: float

    def seconds(self, machine: Machine) -> float:
        """Least time on a machine that does both at once: the longer of the two."""
        return max(self.operations / machine.operations, self.bytes / machine.bandwidth)


def _operations_of_linear(rows: Sequence[int], weight: Sequence[int], *_: object, **__: object) -> int:
    """Floating-point operations of a product of these shapes."""
    return 2 * math.prod(rows) * weight[0]


ONEDNN = {torch.ops.mkldnn._linear_pointwise: _operations_of_linear}
"""Products of ``mereo.models.device`` that torch's counter does not know."""


def timed(work: Callable[[], Any], device: torch.device) -> tuple[float, Any]:
    """Seconds that ``work`` takes, until the device has done what it was asked, and what it gives."""
    start = time.perf_counter()
    result = work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start, result


def measure_machine(device: torch.device, dtype: torch.dtype = torch.float32) -> Machine:
    """Rates of a machine: of a product of 4096 x 512 by 512 x 512 and of copying 256 MB, each the median of 15."""
    left, right = torch.ones(4096, 512, device=device, dtype=dtype), torch.ones(512, 512, device=device, dtype=dtype)
    source = torch.ones(64 * 2**20, device=device)
    target = torch.empty_like(source)
    with torch.inference_mode():
        product = _median(lambda: linear(left, right), device)
    copied = _median(lambda: target.copy_(source), device)
    return Machine(2 * left.numel() * right.shape[0] / product, 2 * source.nbytes / copied)


def _median(work: Callable[[], object], device: torch.device, repeats: int = 15) -> float:
    return statistics.median([timed(work, device)[0] for _ in range(repeats + 2)][2:])


def count_operations(work: Callable[[], object]) -> int:
    """Number of floating-point operations in the matrix products that ``work`` asks torch for."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the counter sees what its own thread asks for
    try:
        with FlopCounterMode(display=False, custom_mapping=ONEDNN) as counter:
            work()
    finally:
        torch.set_num_threads(threads)
    return counter.get_total_flops()
