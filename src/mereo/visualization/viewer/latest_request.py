"""Work that always turns to the newest request: what a slider asks for while it is dragged."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Request = TypeVar("Request")

SETTLE_S = 0.35
"""A request that is the newest for this long is worth the fine work."""


class LatestWins(Generic[Request]):
    """A thread with room for one waiting request, which a newer one replaces.

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
        self._changed = threading.Condition()
        self._waiting: list[Request] = []
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="latest-wins", daemon=True)
        self._thread.start()

    def submit(self, request: Request) -> None:
        """Returns at once. A request that still waits is dropped."""
        with self._changed:
            self._waiting = [request]
            self._changed.notify()

    def stop(self) -> None:
        """What runs is finished, what waits is dropped."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        rested: list[Request] = []
        while True:
            with self._changed:
                wait_s = self._settle_s if rested else None
                self._changed.wait_for(lambda: self._stopped or bool(self._waiting), wait_s)
                if self._stopped:
                    return
                newest, self._waiting = self._waiting, []
            if newest:
                rested = newest if self._did(self._quick, newest[0]) else []
            elif rested:
                self._did(self._fine, rested.pop())

    def _did(self, work: Callable[[Request], None], request: Request) -> bool:
        try:
            work(request)
        except Exception as error:  # whatever it is, the page must live on and say it
            self._failed(error)
            return False
        return True
