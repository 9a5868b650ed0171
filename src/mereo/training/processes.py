"""Processes that train together, which torchrun starts; the first one writes, and where it fails all end."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist

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
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return Process(dist.get_rank(), world)


@contextmanager
def meeting(process: Process) -> Iterator[None]:
    """Block in which process 0 may work alone; all meet at its end, and where process 0 fails there, all end.

    Process 0 raises its own error. The others leave by ``SystemExit`` without a word: the sentence is said once, and
    no connection breaks, about which they would each complain.
    """
    if process.world == 1:
        yield
        return
    failed = torch.ones(1, device=pick_device(process.rank) if dist.get_backend() == "nccl" else "cpu")
    try:
        yield
        failed.zero_()
    finally:
        dist.broadcast(failed, src=0)
    if failed.item():
        raise SystemExit(USER_ERROR)
