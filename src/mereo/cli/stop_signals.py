"""TERM and HUP as Ctrl-C: an exception in the main thread, so that what is half-written is removed on the way out."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals by which systems, job schedulers (TERM) and closed terminals (HUP) end a program; Windows has no HUP."""


class Stopped(KeyboardInterrupt):
    """End by a signal other than Ctrl-C's, which everything that knows Ctrl-C takes as that.

    Attributes:
        signal: which one.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.signal = signal.Signals(number)


@contextmanager
def stop_signals() -> Iterator[None]:
    """Raise ``Stopped`` in the block where a signal asks for the end; once, so that a second cuts no cleaning short.

    A signal that is ignored stays so (``nohup``). Outside the main thread, where Python sets no handlers, nothing
    changes; nor do processes that are started meanwhile inherit anything.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in STOPPING}
    taken = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}

    def stop(number: int, _: FrameType | None) -> None:
        for each in taken:
            signal.signal(each, signal.SIG_IGN)
        raise Stopped(number)

    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)
