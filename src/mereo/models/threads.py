"""Independent pieces of work in several threads, each of which computes alone."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import TypeVar

import torch

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
