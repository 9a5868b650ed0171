"""Processes that train together, which torchrun starts; the first one writes, and where one fails all end."""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

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
    process = Process(int(os.environ["RANK"]), world)
    if process.is_main and _keeps_addresses():
        print(f"processes may not find each other again after a restart: give torchrun {SEPARATE}=1", flush=True)
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


SEPARATE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"
"""Variable by which torchrun's processes get a new store of addresses at each restart, instead of its own."""


def _keeps_addresses() -> bool:
    """Whether nodes that torchrun starts again would meet the addresses of processes that have ended.

    It does since 2.5 unless told otherwise, and no restart of several nodes succeeds then (docs/many-machines.md).
    """
    several = int(os.environ.get("GROUP_WORLD_SIZE", "1")) > 1
    return several and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


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


@contextmanager
def together(process: Process) -> Iterator[None]:
    """Block in which all processes work; all meet at its end, and where one has failed there, all end.

    The first one that failed raises its own error, the others leave by ``SystemExit`` without a word.
    """
    if process.world == 1:
        yield
        return
    first = torch.full((1,), process.rank, device=collective_device(process))
    try:
        yield
        first.fill_(process.world)
    finally:
        dist.all_reduce(first, dist.ReduceOp.MIN)
        if first.item() < process.world and first.item() != process.rank:
            raise SystemExit(USER_ERROR)


def agreed(process: Process, wish: bool) -> bool:
    """Wish of process 0, which decides for all: clocks differ, and validation is collective."""
    if process.world == 1:
        return wish
    flag = torch.tensor([float(wish)], device=collective_device(process))
    dist.broadcast(flag, src=0)
    return bool(flag.item())


def told(process: Process, find: Callable[[], T]) -> T:
    """What process 0 finds, in all processes; where that fails, all end as in ``meeting``."""
    found: list[T | None] = [None]
    with meeting(process):
        if process.is_main:
            found[0] = find()
    if process.world > 1:
        dist.broadcast_object_list(found, src=0, device=collective_device(process))
    return found[0]  # type: ignore[return-value]


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
