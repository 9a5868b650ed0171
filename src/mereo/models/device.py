"""Device, precision, and an allocator setting that matters: what this machine offers."""

import ctypes
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from threading import Barrier
from typing import TypeVar

import torch
from torch import Tensor

from mereo.models.config import Device, Precision


def pick_device(rank: int = 0) -> torch.device:
    """CUDA device of a process where there is one, else the CPU."""
    if torch.cuda.is_available():
        return torch.device("cuda", rank % torch.cuda.device_count())
    return torch.device("cpu")


def find_device(device: Device, rank: int = 0) -> torch.device:
    """Device that a process was asked for; ``ValueError`` for CUDA where torch sees none."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("the device is cuda, but torch sees no CUDA device; leave out --device to use the CPU")
    return torch.device("cpu") if device == "cpu" else pick_device(rank)


@cache
def bfloat16_gain() -> float:
    """Ratio of this CPU's rates of matrix products in bfloat16 and in float32, at the network's size.

    Measured once, in about 10 ms, because what a CPU says of itself does not tell: AVX-512's bfloat16 instructions
    double the rate on AMD's Zen 4 and change nothing on Intel's Xeons, where AMX makes it five times.
    """
    # not random numbers: drawing them would change the caller's
    pairs = [(torch.ones(2048, 256, dtype=d), torch.ones(256, 256, dtype=d)) for d in (torch.float32, torch.bfloat16)]
    rounds = [[_seconds(*pair) for pair in pairs] for _ in range(8)]  # in turn, so that a busy moment meets both
    single, half = map(min, zip(*rounds, strict=True))
    return single / half


def _seconds(a: Tensor, b: Tensor) -> float:
    start = time.perf_counter()
    torch.mm(a, b)
    return time.perf_counter() - start


BFLOAT16_PAYS = 1.5
"""Gain in products from which on a training step is faster too: the rest of it stays in float32."""


def pick_precision(precision: Precision, device: torch.device) -> torch.dtype | None:
    """Type of products for autocast, or None for float32; auto takes bfloat16 on CUDA and where a CPU gains by it."""
    if precision == "float32":
        return None
    if precision == "bfloat16" or device.type == "cuda" or bfloat16_gain() >= BFLOAT16_PAYS:
        return torch.bfloat16
    return None


def exact(tensor: Tensor) -> AbstractContextManager[object]:
    """Context that switches autocast off where bfloat16, with its eight bits, is too coarse.

    A coordinate near 1 would be off by up to 0.004, more than sensor noise; and what all rows have in common, which
    batch normalization takes away again, may be hundreds of times their spread, which rounding would then erase.
    """
    device = tensor.device.type
    # where it is off already nothing is done, because an exported graph would keep the switch, which ONNX does not know
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def compiling_pays(device: torch.device, steps: int) -> bool:
    """Whether torch.compile earns its minute back: always on CUDA, on CPUs in long runs where a C++ compiler exists."""
    if device.type == "cuda":
        return True
    return steps >= 1000 and shutil.which("g++") is not None


def keep_freed_memory() -> None:
    """Tell glibc to reuse large freed blocks instead of returning them to the system.

    A training step frees and allocates the same hundreds of megabytes; returning them costs a page fault for each 4 kB,
    measured as half of the time of a float32 CPU step. Does nothing where the C library is not glibc.
    """
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    trim_threshold, mmap_max = -1, -4  # M_TRIM_THRESHOLD, M_MMAP_MAX in malloc.h
    mallopt(mmap_max, 0)
    mallopt(trim_threshold, 2**31 - 1)


def cpu_features() -> dict[str, bool | None]:
    """Instruction sets that decide the speed; None where this torch cannot tell."""
    probes = {
        "avx2": "_is_avx2_supported",
        "avx512": "_is_avx512_supported",
        "avx512_bf16": "_is_avx512_bf16_supported",
        "amx": "_is_amx_tile_supported",
    }
    return {name: _ask_torch(function) for name, function in probes.items()}


def _ask_torch(function: str) -> bool | None:
    """Answer of a private function of torch: they come and go, and must never stop the report."""
    probe = getattr(torch.cpu, function, None)
    try:
        return None if probe is None else bool(probe())
    except (RuntimeError, AttributeError):
        return None


# --- threads ----------------------------------------------------------------------------------------------------------

# Independent pieces of work in several threads, each of which computes alone.

MOST = 8
"""Threads that take pieces; beyond, Python itself would be what they wait for, and each piece gets several instead."""

Piece = TypeVar("Piece")
Found = TypeVar("Found")


def in_threads(work: Callable[[Piece], Found], pieces: Sequence[Piece], most: int = MOST) -> list[Found]:
    """What ``work`` says of each piece, in their order, by as many threads as torch may take here, ``most`` at most.

    Products of a few thousand rows gain little by a second thread: all threads wait after each step. Pieces that know
    nothing of each other wait for nobody, and are the same bits in any number of threads. ``work`` enters torch's
    modes (inference, autocast) itself: they are of one thread each. The first error is raised, the other pieces end.
    """
    threads = torch.get_num_threads()
    takers = min(threads, most, len(pieces))
    if takers < 2:
        return [work(piece) for piece in pieces]
    return list(_pool(takers, threads // takers, os.getpid()).map(work, pieces))


@cache
def _pool(takers: int, each: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for pieces, each with ``each`` of torch's own; of this process, as none survives a fork."""
    ready = Barrier(takers + 1)

    def begin() -> None:
        torch.get_num_threads()  # a thread's first question takes the number of all threads
        torch.set_num_threads(each)
        ready.wait()

    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(takers, thread_name_prefix="mereo", initializer=begin)
    for _ in range(takers):
        pool.submit(int)  # a thread begins with each, as those before it still wait
    ready.wait()
    torch.set_num_threads(before)  # it is also the number with which the caller's next threads would begin
    return pool
