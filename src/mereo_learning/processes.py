"""Processes that train together, which torchrun starts; the first one writes, and where one fails all end."""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor, nn

from mereo.models.device import pick_device

USER_ERROR = 2
"""Exit code of the processes that end because process 0 does, as of the command line's refusals."""


@dataclass(frozen=True)
class Process:
    """Place of this process among those that train together."""

    rank: int = 0
    world: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process is the one that writes and prints."""
        return self.rank == 0


def join_processes() -> Process:
    """Join the group that torchrun started, if any; returns this process's place."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        return Process()
    process = Process(int(os.environ["RANK"]), world)
    with connected(process):
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return process


def leave_processes(process: Process) -> None:
    """Leave the group that ``join_processes`` joined, after whatever held on to it in this process is out of use.

    A network that was trained together holds the group, in a cycle. Threads of a group that lives until the interpreter
    ends may wait for it forever then (torch's issue 190489), and torchrun for them; so it is freed here.
    """
    if process.world == 1:
        return
    gc.collect()
    dist.destroy_process_group()


T = TypeVar("T")


def collective_device(process: Process) -> torch.device:
    """Device of the tensors that processes exchange."""
    nccl = process.world > 1 and dist.get_backend() == "nccl"
    return pick_device(process.rank) if nccl else torch.device("cpu")


@contextmanager
def meeting(process: Process) -> Iterator[None]:
    """Block in which process 0 may work alone; all meet at its end, and where process 0 fails there, all end.

    Process 0 raises its own error. The others leave by ``SystemExit`` without a word: the sentence is said once, and
    no connection breaks, about which they would each complain.
    """
    if process.world == 1:
        yield
        return
    failed = torch.ones(1, device=collective_device(process))
    try:
        yield
        failed.zero_()
    finally:
        dist.broadcast(failed, src=0)
    if failed.item():
        raise SystemExit(USER_ERROR)


def agreed(process: Process, decision: bool) -> bool:
    """Decision of process 0, which holds for all: clocks differ, and validation is collective."""
    if process.world == 1:
        return decision
    flag = torch.tensor([float(decision)], device=collective_device(process))
    dist.broadcast(flag, src=0)
    return bool(flag.item())


def broadcast_result(process: Process, compute: Callable[[], T]) -> T:
    """Result that process 0 computes, in all processes; where that fails, all end as in ``meeting``."""
    result: list[T | None] = [None]
    with meeting(process):
        if process.is_main:
            result[0] = compute()
    if process.world > 1:
        dist.broadcast_object_list(result, src=0, device=collective_device(process))
    return result[0]  # type: ignore[return-value]


LOST = ("gloo", "connection closed", "connection reset", "broken pipe", "nccl", "socket")
"""Words in what torch says of a broken connection, of which it has no common exception."""


@contextmanager
def connected(process: Process) -> Iterator[None]:
    """Block that needs the other processes; one sentence where a connection to them breaks.

    Raises ``ConnectionError`` in place of what torch does then.
    """
    try:
        yield
    except RuntimeError as error:
        if process.world == 1 or not any(word in str(error).lower() for word in LOST):
            raise
        raise ConnectionError(
            f"process {process.rank} of {process.world} has lost another one, which has ended or is out of reach; its "
            "own message says why: torchrun --max-restarts N starts all of them again, from the latest checkpoint"
        ) from error


# --- batch normalization ----------------------------------------------------------------------------------------------


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


class SharedBatchNorm(nn.BatchNorm1d):
    """Batch normalization with the statistics of all processes' rows, of which each has equally many."""

    @torch.compiler.disable  # type: ignore[untyped-decorator]
    def forward(self, rows: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Rows, normalized: in training by their own statistics, else by the running ones."""
        if not self.training:
            return super().forward(rows)
        assert self.momentum is not None and self.running_mean is not None and self.running_var is not None
        exact = rows.float()
        world = dist.get_world_size()
        mean = _Sum.apply(exact.mean(dim=0)) / world
        # by distances from the mean, not by squares: a mean may be hundreds of spreads
        variance = _Sum.apply((exact - mean).square().mean(dim=0)) / world
        count = len(rows) * world
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked.add_(1)
        return ((exact - mean) * (variance + self.eps).rsqrt() * self.weight + self.bias).to(rows.dtype)


class _Sum(torch.autograd.Function):
    """Sum over all processes, and so is its gradient."""

    @staticmethod
    def forward(ctx: Any, value: Float[Tensor, " c"]) -> Float[Tensor, " c"]:
        total = value.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Float[Tensor, " c"]) -> Tensor:
        return _Sum.apply(gradient)
