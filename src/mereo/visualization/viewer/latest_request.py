"""Worker that always turns to the newest request: for what a slider asks while it is dragged."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from mereo.reconstruction.stream import LatestSlot

Request = TypeVar("Request")

SETTLE_S = 0.35
"""Seconds after which a request that is still the newest is worth the fine work."""


class LatestWins(Generic[Request]):
    """Thread with room for one waiting request, which a newer one replaces.

    Each request that is reached gets the quick work; the last one, when no other has come for ``settle_s``, the fine
    work too. An exception goes to ``failed``, and the thread goes on.
    """

    def __init__(
        self,
        quick: Callable[[Request], None],
        fine: Callable[[Request], None],
        failed: Callable[[Exception], None],
        settle_s: float = SETTLE_S,
    ) -> None:
        self._quick, self._fine, self._failed, self._settle_s = quick, fine, failed, settle_s
        self._slot = LatestSlot[Request]()
        self._thread = threading.Thread(target=self._run, name="latest-wins", daemon=True)
        self._thread.start()

    def submit(self, request: Request) -> None:
        """Ask for the work on ``request``, and return at once. A request that still waits is dropped."""
        self._slot.put(request)

    def stop(self) -> None:
        """End the thread: what runs is finished, what waits is dropped."""
        self._slot.stop()
        self._thread.join()

    def _run(self) -> None:
        rested: list[Request] = []
        while True:
            newest = self._slot.take(self._settle_s if rested else None)
            if self._slot.stopped:
                return
            if newest is not None:
                rested = [newest.item] if self._did(self._quick, newest.item) else []
            elif rested:
                self._did(self._fine, rested.pop())

    def _did(self, work: Callable[[Request], None], request: Request) -> bool:
        try:
            work(request)
        except Exception as error:  # whatever it is, the page must live on and say it
            self._failed(error)
            return False
        return True
