"""Processes that answer, each with all weights and one thread: a crash or a hang costs one frame, not the server.

The server's own process speaks HTTP and loads no network, so that it answers at once, however busy the others are.
"""

import multiprocessing
import os
import signal
import threading
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

from mereo.io.errors import LIMIT_VARIABLE
from mereo.workers.spread import exit_with_parent, limit_child_threads, start_resource_tracker
from mereo_serving.messages import FrameRequest, Ready, Reply, Setup

POINT_BYTES = 2048
"""Bytes of memory that reading a point may take: of a text, what Python makes of its row."""

END_S = 5.0
"""Seconds that a process has to end by itself."""


class WorkerDied(RuntimeError):
    """A process that answers has ended by itself, or was ended for taking too long."""


class WorkerProcess:
    """Process that answers frames, one at a time.

    Attributes:
        setup: what it serves, with the precision that is settled once it is ready.
        ready: what it said first.
        process: the process, for those who watch its memory.
    """

    setup: Setup
    ready: Ready
    process: Any

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._spawn()

    def wait_until_ready(self) -> None:
        """Wait until the weights are loaded; raises what loading raises, and ``WorkerDied``."""
        message = self._receive()
        if isinstance(message, Exception):
            self.close()
            raise message
        self.ready = message
        self.setup = replace(self.setup, inference=replace(self.setup.inference, precision=message.precision))

    def ask(self, frame: FrameRequest) -> Reply:
        """Answer to a frame; raises ``WorkerDied``. Blocks."""
        try:
            self._pipe.send(frame)
        except OSError as error:
            raise WorkerDied("a process that answers has ended") from error
        reply: Reply = self._receive()
        return reply

    def restart(self) -> None:
        """Start another process in its place; raises ``WorkerDied`` or what loading raises. Blocks."""
        self.kill()
        self._spawn()
        self.wait_until_ready()

    def kill(self) -> None:
        """End the process at once, whatever it does; a pending ``ask`` raises ``WorkerDied``."""
        self.process.kill()
        self.process.join()

    def close(self) -> None:
        """Let the process end after what it does, when nobody speaks to it any more."""
        self._pipe.close()
        self.process.join(END_S)
        self.kill()

    def _spawn(self) -> None:
        # spawned, not forked: threads of libraries that this process has used do not survive a fork
        context = multiprocessing.get_context("spawn")
        start_resource_tracker()
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(target=answer_frames, args=(theirs, self.setup), daemon=True)
        # read when torch is loaded; clouds of ever other sizes would fill it with products that do not come again
        os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "4")
        with limit_child_threads():
            self.process.start()
        theirs.close()  # so that this process sees the other end close

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise WorkerDied("a process that answers has ended") from error


def answer_frames(pipe: Connection, setup: Setup) -> None:
    """Work of a process: load the weights, say so, and answer frames until nobody sends any more."""
    # Ctrl-C, TERM to a whole group and a closed terminal are the server's business: what is begun is answered
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()
    os.environ.setdefault(LIMIT_VARIABLE, f"{max(setup.max_points * POINT_BYTES, setup.max_body) / 1e9:g}")
    try:
        from mereo_serving.answering import Answerer  # loads torch

        answerer = Answerer.of(setup)
    except Exception as error:
        pipe.send(error if isinstance(error, ValueError | OSError | ImportError) else ValueError(repr(error)))
        return
    pipe.send(answerer.ready())
    while True:
        try:
            frame = pipe.recv()
        except EOFError:
            return
        pipe.send(answerer(frame))
