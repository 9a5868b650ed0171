"""Room for one item between a thread that brings and one that works: a newer one takes the place of one that waits."""

import threading
import time
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Taken(Generic[Item]):
    """Item out of a ``LatestSlot``.

    Attributes:
        item: what was put there.
        arrived_s: when it came to wait there, by ``time.perf_counter``.
        replaced: how many items gave way since the last one that was taken.
    """

    item: Item
    arrived_s: float
    replaced: int


class LatestSlot(Generic[Item]):
    """Room for one item, which a newer one replaces, so that no work is older than the one before it took.

    Any thread may call any method.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: Taken[Item] | None = None
        self._ended = self._stopped = False

    @property
    def stopped(self) -> bool:
        """Whether ``stop`` was called."""
        return self._stopped

    def put(self, item: Item, *, wait: bool = False) -> bool:
        """Leave an item, in place of one that waits, or with ``wait`` once that is taken; False after ``stop``."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._stopped or self._waiting is None)
            replaced = 0 if self._waiting is None else self._waiting.replaced + 1
            self._waiting = Taken(item, time.perf_counter(), replaced)
            self._changed.notify_all()
            return not self._stopped

    def take(self, timeout_s: float | None = None) -> Taken[Item] | None:
        """Waiting item, or the next one that comes within ``timeout_s``; by default it waits as long as it takes.

        None where none has come in time, after the last one, and after ``stop``.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._ended or self._waiting is not None, timeout_s)
            taken, self._waiting = self._waiting, None
            self._changed.notify_all()
            return None if self._stopped else taken

    def end(self) -> None:
        """Say that nothing more is brought; what waits is still taken."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Say that nothing more is taken; what waits is dropped."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
