"""Blocks of examples that a thread reads before they are needed, so that a step does not wait for the disk."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Event, Semaphore, Thread

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from mereo.training.orders import Block

Fields = dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A block with its examples, in the order of its draws."""

    block: Block
    fields: Fields


class ReadAhead:
    """Examples of several lanes, drawn in turn; half as many blocks as there are lanes wait in memory for their turn.

    Blocks must come in the order in which ``take`` needs them. No more than one of a lane is in use, and the thread
    stops reading while all places are taken: so memory is bounded, and who waits for a block finds a place free for it.

    Args:
        blocks: what to read.
        gather: the examples of some numbers.
        lanes: that are read.
    """

    def __init__(
        self, blocks: Iterator[Block], gather: Callable[[Int64[np.ndarray, " b"]], Fields], lanes: range
    ) -> None:
        self.places = Semaphore(len(lanes) + max(1, len(lanes) // 2))
        self.arrived: dict[int, SimpleQueue[_Loaded | Exception]] = {lane: SimpleQueue() for lane in lanes}
        self.used: dict[int, _Loaded] = {}
        self.ended = Event()
        self.thread = Thread(target=self._read, args=(blocks, gather), name="read ahead", daemon=True)
        self.thread.start()

    def take(self, lane: int, first: int, count: int) -> tuple[Int64[np.ndarray, " n"], Fields]:
        """Numbers and examples of ``count`` draws of a lane from ``first`` on; raises what reading them has raised."""
        numbers, parts, end = [], [], first + count
        while first < end:
            loaded = self._holding(lane, first)
            begin = first - loaded.block.first
            stop = min(begin + end - first, len(loaded.block.index))
            numbers.append(loaded.block.index[begin:stop])
            # a copy: a view would keep the whole block in memory
            parts.append({name: values[begin:stop].clone() for name, values in loaded.fields.items()})
            first += stop - begin
        joined = parts[0] if len(parts) == 1 else {n: torch.cat([part[n] for part in parts]) for n in parts[0]}
        return np.concatenate(numbers), joined

    def _holding(self, lane: int, draw: int) -> _Loaded:
        """The lane's block that has a draw; the one before it is let go, and its place is free."""
        used = self.used.get(lane)
        if used is not None and draw < used.block.first + len(used.block.index):
            return used
        if used is not None:
            del self.used[lane], used
            self.places.release()
        arrived = self.arrived[lane].get()
        if isinstance(arrived, Exception):
            raise arrived
        self.used[lane] = arrived
        return arrived

    def _read(self, blocks: Iterator[Block], gather: Callable[[Int64[np.ndarray, " b"]], Fields]) -> None:
        try:
            for block in blocks:
                self.places.acquire()
                if self.ended.is_set():
                    return
                self.arrived[block.lane].put(_Loaded(block, gather(block.index)))
        except Exception as error:  # whatever it is, it is raised where the examples are needed
            for queue in self.arrived.values():
                queue.put(error)

    def close(self) -> None:
        """End the thread, and forget what it has read."""
        self.ended.set()
        self.places.release()
        self.thread.join()
        self.used.clear()
        self.arrived.clear()
