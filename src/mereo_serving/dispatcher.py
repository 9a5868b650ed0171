"""Frames that wait, and the processes that answer them: a bounded queue, every answer once.

    admit -Place-> (the body comes) -submit-> Waiting -take-> FrameRequest -> Reply

All is done in the thread of the event loop, so nothing here is locked; only processes have a thread each.
"""

import asyncio
import logging
import math
import shutil
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from mereo_serving.config import ServeConfig
from mereo_serving.messages import CRASHED, FULL, GOING, FrameRequest, Refused, Reply, failed
from mereo_serving.metrics import Metrics
from mereo_serving.workers import WorkerDied, WorkerProcess

LOG = logging.getLogger("mereo_serving")

HANGS = 2.0
"""Times the client's patience after which a process that still works on a frame is ended."""

AGAIN_S = 5.0
"""Seconds until a process that could not be started is started again."""

FIRST_GUESS_S = 0.5
"""Seconds of a frame before any was answered, for ``Retry-After``."""


@dataclass(eq=False)
class Place:
    """Place in the queue, from before a body comes until its frame is begun."""

    dispatcher: "Dispatcher"
    taken: bool = True

    def leave(self) -> None:
        """Make room for another one; once is enough."""
        self.dispatcher.held -= self.taken
        self.taken = False


@dataclass(eq=False)
class Waiting:
    """Frame that waits, or is being answered.

    Attributes:
        frame: what is wanted; its folder is the dispatcher's, which removes it.
        place: in the queue.
        answer: to come; done where nobody wants it any more.
        since: when it came, by the monotonic clock.
    """

    frame: FrameRequest
    place: Place
    answer: "asyncio.Future[Reply]"
    since: float

    @property
    def wanted(self) -> bool:
        """Whether someone waits for the answer."""
        return not self.answer.done()

    def reply(self, reply: Reply) -> None:
        """Give the answer, if someone waits for it."""
        if self.wanted:
            self.answer.set_result(reply)

    def release(self) -> None:
        """Remove what was written for it: nobody reads it any more."""
        self.place.leave()
        shutil.rmtree(self.frame.folder, ignore_errors=True)


class Dispatcher:
    """Queue in front of processes that answer.

    Attributes:
        held: places that are taken.
        stopping: whether only what is begun is still answered.
    """

    def __init__(self, workers: Sequence[WorkerProcess], config: ServeConfig, metrics: Metrics) -> None:
        self.config, self.metrics, self.held, self.stopping = config, metrics, 0, False
        self._workers, self._alive = list(workers), len(workers)
        self._waiting, self._arrived = deque[Waiting](), asyncio.Event()
        self._threads = ThreadPoolExecutor(len(workers), "mereo-worker")
        self._tasks: list[asyncio.Task[None]] = []
        self._frame_s = FIRST_GUESS_S
        metrics.watch(lambda: self.held, lambda: self._alive)

    @property
    def ready(self) -> bool:
        """Whether frames are taken and there is a process to answer them."""
        return not self.stopping and self._alive > 0

    def start(self) -> None:
        """Begin to answer, in the running event loop."""
        self._tasks = [asyncio.create_task(self._run(worker)) for worker in self._workers]

    def stop(self) -> None:
        """Take no frames any more and refuse those that wait; what is begun is answered."""
        self.stopping = True
        self._arrived.set()
        while self._waiting:
            waiting = self._waiting.popleft()
            waiting.reply(failed(503, GOING))
            waiting.release()

    async def close(self) -> None:
        """``stop``, wait for what is begun, and end the processes."""
        self.stop()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for worker in self._workers:
            await asyncio.get_running_loop().run_in_executor(self._threads, worker.close)
        self._threads.shutdown()

    def admit(self) -> Place:
        """Place for a frame whose body is still to come; raises ``Refused`` (429, 503)."""
        if self.stopping:
            raise Refused(503, GOING)
        if self.held >= self.config.queue:
            wait_s = self.held * self._frame_s / max(self._alive, 1)
            headers = {"Retry-After": str(min(max(math.ceil(wait_s), 1), 60))}
            raise Refused(429, FULL.format(queue=self.config.queue), headers)
        self.held += 1
        return Place(self)

    def submit(self, frame: FrameRequest, place: Place) -> Waiting:
        """Let a frame wait; raises ``Refused`` (503). From here on its folder is removed by the dispatcher."""
        if self.stopping:
            raise Refused(503, GOING)
        answer = asyncio.get_running_loop().create_future()
        waiting = Waiting(frame, place, answer, time.monotonic())
        self._waiting.append(waiting)
        self._arrived.set()
        return waiting

    def drop(self, waiting: Waiting, reason: str) -> None:
        """Nobody waits for this answer any more: "gone", "timeout". Its work is left out if it is not begun."""
        waiting.answer.cancel()
        self.metrics.dropped(reason)
        if waiting in self._waiting:
            self._waiting.remove(waiting)
            waiting.release()

    # --- taking -------------------------------------------------------------------------------------------------------

    async def _take(self) -> Waiting | None:
        """The frame that has waited longest, where it is wanted still; None at the end."""
        while True:
            while not self._waiting:
                if self.stopping:
                    return None
                self._arrived.clear()
                await self._arrived.wait()
            first = self._waiting.popleft()
            first.place.leave()
            if first.wanted:
                self.metrics.stages({"wait": time.monotonic() - first.since})
                return first
            first.release()

    # --- answering ----------------------------------------------------------------------------------------------------

    async def _run(self, worker: WorkerProcess) -> None:
        """Answer frames with one process until the end."""
        while (waiting := await self._take()) is not None:
            started = time.monotonic()
            try:
                reply = await self._ask(worker, waiting.frame)
                self.metrics.stages(reply.seconds)
                self._frame_s += 0.1 * (time.monotonic() - started - self._frame_s)
            except WorkerDied as error:
                waiting.reply(failed(500, CRASHED))
                waiting.release()
                LOG.error("%s; it is started again", error)
                await self._revive(worker)
            else:
                waiting.reply(reply)
                waiting.release()

    async def _ask(self, worker: WorkerProcess, frame: FrameRequest) -> Reply:
        """Answer of a process; one that takes far too long is ended."""
        future = asyncio.get_running_loop().run_in_executor(self._threads, worker.ask, frame)
        done, _ = await asyncio.wait([future], timeout=HANGS * self.config.timeout)
        if not done:
            worker.kill()
        return await future

    async def _revive(self, worker: WorkerProcess) -> None:
        """Start a process again, until it is ready."""
        self._alive -= 1
        while not self.stopping:
            try:
                await asyncio.get_running_loop().run_in_executor(self._threads, worker.restart)
            except Exception as error:
                LOG.error("a process that answers cannot be started: %s", error)
                await asyncio.sleep(AGAIN_S)
            else:
                self.metrics.restarted()
                self._alive += 1
                return
