"""Search for a lost object beside the frames that come meanwhile: one frame at a time, always the latest.

    TrackedFrame -BackgroundSearch.start-> (seconds later) -BackgroundSearch.take-> Searched

A search takes a second to several, and frames come 30 times a second. NumPy lets go of the interpreter in most of a
search, so a thread is enough.
"""

from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from mereo.fitting.registration.answer import Candidate
from mereo.fitting.registration.hypotheses import search_hypotheses
from mereo.fitting.registration.register import Registrar
from mereo.reconstruction.observation import Observation

ROUNDS = 2
"""Rounds of a search at most. Where they find nothing, a newer frame is worth more than the last round, which takes as
long as both and longer."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Frame of a sequence, with what is known of it.

    Attributes:
        seen: the object in the frame.
        time_s: of the frame.
        scene_unit: length of a scene unit in the frame's unit, where it is known for certain.
        keep_all: take every point for the object's.
    """

    seen: Observation
    time_s: float
    scene_unit: float | None = None
    keep_all: bool = False


class Searched(NamedTuple):
    """Frame in which a lost object was searched for, and the best candidate there, which may not explain it."""

    frame: TrackedFrame
    candidate: Candidate


class SynchronousExecutor(Executor):
    """Executor that does the work at once, in the caller's thread: for recordings, and for tests."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work, and return what has come of it."""
        future = Future[Any]()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as problem:  # as an executor does
            future.set_exception(problem)
        return future


class BackgroundSearch:
    """Searches of one object, one at a time; used by one thread.

    Attributes:
        registrar: of the object.
        executor: what does the searches, the caller's to end; None for a thread of its own, which starts when the
            first search does and ends with ``close``.
    """

    def __init__(self, registrar: Registrar, executor: Executor | None = None) -> None:
        self.registrar = replace(registrar, config=replace(registrar.config, search_rounds=ROUNDS))
        self.executor = executor
        self._own: ThreadPoolExecutor | None = None
        self._running: Future[Searched] | None = None

    def start(self, frame: TrackedFrame) -> None:
        """Search a frame, unless one is being searched, or was and has not been taken."""
        if self._running is None:
            if self.executor is None and self._own is None:
                self._own = ThreadPoolExecutor(1, "mereo-search")
            executor = self.executor or self._own
            assert executor is not None
            self._running = executor.submit(_search, self.registrar, frame)

    def take(self) -> Searched | None:
        """What the last search has found; None while it goes on, and where nothing was searched or could be.

        Raises what a search does, but for the ``ValueError`` of an unusable frame.
        """
        if self._running is None or not self._running.done():
            return None
        ended, self._running = self._running, None
        try:
            return ended.result()
        except ValueError:
            return None

    def drop(self) -> None:
        """Forget the frame that is being searched."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    def close(self, wait: bool) -> None:
        """Forget it, and let the own thread end with its search, which ``wait`` waits for."""
        self.drop()
        if self._own is not None:
            self._own.shutdown(wait, cancel_futures=True)
            self._own = None


def _search(registrar: Registrar, frame: TrackedFrame) -> Searched:
    return Searched(frame, search_hypotheses(frame.seen, registrar, frame.keep_all, frame.scene_unit)[0])
