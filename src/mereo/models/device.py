"""Device, precision, products, threads, and an allocator setting that matters: what this machine offers."""

import ctypes
import os
import platform
import shutil
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from threading import Barrier
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from mereo.models.config import Device, Precision

if hasattr(os, "register_at_fork"):  # OpenMP's other threads do not survive it, and would be waited for without end
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


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
def is_amd() -> bool:
    """Whether this is a processor of AMD, as it says itself."""
    listed = Path("/proc/cpuinfo")
    return "AuthenticAMD" in (listed.read_text() if listed.is_file() else platform.processor())


@cache
def bfloat16_pays() -> bool:
    """Whether this CPU multiplies in bfloat16 so much faster that a training step gains by it.

    AVX-512's bfloat16 instructions double the rate on AMD's Zen 4 and change nothing on Intel's Xeons, where AMX makes
    it five times. Measuring it would give other answers on a busy machine.
    """
    features = cpu_features()
    return bool(features["amx"] or (features["avx512_bf16"] and is_amd()))


def pick_precision(precision: Precision, device: torch.device) -> torch.dtype | None:
    """Type of products for autocast, or None for float32; auto takes bfloat16 on CUDA and where a CPU gains by it."""
    if precision == "float32":
        return None
    if precision == "bfloat16" or device.type == "cuda" or bfloat16_pays():
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
    """Whether torch.compile earns its minute or two back: in long runs, on CPUs where a C++ compiler exists.

    An H100 took over 75 s to compile `large` and gained some 5 of 50 ms a step (docs/experiments/075.md).
    """
    if device.type == "cuda":
        return steps >= 20_000
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
    return {name: _probe(function) for name, function in probes.items()}


def _probe(function: str) -> bool | None:
    """Answer of a private function of torch: they come and go, and must never stop the report."""
    probe = getattr(torch.cpu, function, None)
    try:
        return None if probe is None else bool(probe())
    except (RuntimeError, AttributeError):
        return None


# --- products ---------------------------------------------------------------------------------------------------------

# Products of layers in float32 on a CPU, by the faster one of torch's two libraries.
#
# torch asks Intel's MKL, which takes the slower instructions on AMD's processors; oneDNN, which torch brings as well,
# makes twice as many operations a second there in the same precision.

ROWS = 1024
"""Number of rows, or a multiple, of what oneDNN is asked for: it prepares itself for each size, and keeps few."""


def linear(
    rows: Float[Tensor, "*n i"], weight: Float[Tensor, "o i"], bias: Float[Tensor, " o"] | None = None
) -> Float[Tensor, "*n o"]:
    """The product ``rows weight^T + bias``, as ``torch.nn.functional.linear`` gives it but for rounding."""
    if _suits_onednn(rows, weight) and onednn_pays():
        return _by_onednn(rows, weight, bias)
    return F.linear(rows, weight, bias)


@cache
def onednn_pays() -> bool:
    """Whether oneDNN makes float32 products faster than MKL; the same in all processes, which so compute the same."""
    return is_amd() and hasattr(torch.ops.mkldnn, "_linear_pointwise")  # a private operator: it may go


def _suits_onednn(rows: Tensor, weight: Tensor) -> bool:
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
    return torch.ops.mkldnn._linear_pointwise(rows, weight, bias, "none", [], "")


# --- threads ----------------------------------------------------------------------------------------------------------

# Independent pieces of work in several threads, each of which computes alone.

MOST = 8
"""Threads that take pieces; beyond, Python itself would be what they wait for, and each piece gets several instead."""

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece], most: int = MOST) -> list[Result]:
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
