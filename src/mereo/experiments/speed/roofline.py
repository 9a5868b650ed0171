"""The least time a stage can take on this machine: its products at the measured rate of large ones, or its bytes."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.utils.flop_counter import FlopCounterMode


@dataclass(frozen=True)
class Machine:
    """Measured rates: floating-point operations and bytes per second."""

    operations: float
    bandwidth: float


@dataclass(frozen=True)
class Work:
    """What a stage must do at least.

    Attributes:
        operations: floating-point, two for a multiplication with addition; of matrix products only.
        bytes: read and written at least once.
    """

    operations: float
    bytes: float

    def seconds(self, machine: Machine) -> float:
        """The longer of both on a machine that does them at the same time."""
        return max(self.operations / machine.operations, self.bytes / machine.bandwidth)


def seconds(work: Callable[[], object], device: torch.device) -> float:
    """How long ``work`` takes, until the device has done what it was asked."""
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def measure_machine(device: torch.device, dtype: torch.dtype = torch.float32) -> Machine:
    """Rates of a product of 4096 x 512 by 512 x 512 and of copying 256 MB, medians of 15."""
    left, right = torch.ones(4096, 512, device=device, dtype=dtype), torch.ones(512, 512, device=device, dtype=dtype)
    source = torch.ones(64 * 2**20, device=device)
    target = torch.empty_like(source)
    product = _median(lambda: torch.nn.functional.linear(left, right), device)
    copied = _median(lambda: target.copy_(source), device)
    return Machine(2 * left.numel() * right.shape[0] / product, 2 * source.nbytes / copied)


def _median(work: Callable[[], object], device: torch.device, repeats: int = 15) -> float:
    return statistics.median([seconds(work, device) for _ in range(repeats + 2)][2:])


def count_operations(work: Callable[[], object]) -> int:
    """Floating-point operations of the matrix products that ``work`` asks torch for."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()
