"""Several processes of this machine that work, and stop at once when this one stops or is killed."""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from mereo.io.cores import THREAD_VARIABLES

Function = Callable[[Any], Any]
"""Work on an item."""


@contextmanager
def process_pool(function: Function, workers: int) -> Iterator[Callable[[Any], Future[Any]]]:
    """Open a pool of processes, each with one thread; yields what submits an item to ``function`` there.

    An exception in the block ends the processes at once. Raises ``ValueError`` where ``function``, which is sent once
    to every process, cannot be pickled.
    """
    pickled(function, pickle.dumps)
    # spawned, not forked: threads of libraries that this process has used do not survive a fork
    context = multiprocessing.get_context("spawn")
    start_resource_tracker()
    end, here = context.Pipe(duplex=False)
    executor = ProcessPoolExecutor(workers, context, _start_worker, (function, end))
    with end, here, one_thread_each(), executor as pool:
        try:
            yield lambda item: pool.submit(_apply, item)
        except BaseException:
            here.close()  # which every worker sees at the other end
            raise


def start_resource_tracker() -> None:
    """Start Python's process that frees shared things, once; it ignores INT and TERM by itself, with HUP blocked too.

    A closed terminal would end it before the others, which then complain that what they free is gone.
    """
    if not hasattr(signal, "SIGHUP"):
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])  # what is blocked stays so in a new process
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_in_worker: Function | None = None
"""Set once when a worker starts: it need not be sent with every item."""


def _start_worker(function: Function, end: Connection) -> None:
    global _in_worker
    # Ctrl-C and a closed terminal are the parent's business, which ends its workers; TERM is how the pool ends them
    for number in (signal.SIGINT, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ())):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, args=(end,), daemon=True).start()
    _in_worker = function


def exit_with_parent(*ends: Connection) -> None:
    """End this process when its parent ends, as one that was killed cannot stop its workers, or closes a pipe.

    Blocks, for a thread.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel, *ends])
        os._exit(1)


def _apply(item: Any) -> Any:
    assert _in_worker is not None, "only called in a worker, which sets it first"
    return _in_worker(item)


def pickled(function: Function, dumps: Callable[[Function], bytes]) -> bytes:
    """Pickle a function, by ``pickle.dumps`` or one like it; ``ValueError`` where it cannot be."""
    try:
        return dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"the work cannot be sent to other processes ({' '.join(str(error).split())}); functions in it must be "
            "defined at the top level of a module, and what they hold must be picklable: change that, or use one "
            "worker and no --ray"
        ) from None


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let processes that are started in the block compute in one thread: libraries read this when they are loaded."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
