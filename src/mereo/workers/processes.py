"""Work in several processes that stop at once when asked to, whoever asks: a function applied to many items.

Ctrl-C, an error in the consumer, a killed worker, a killed parent: in every case no process is left behind.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import connection, resource_tracker
from multiprocessing.synchronize import Event
from typing import Any, TypeVar

from mereo.io.cores import THREAD_VARIABLES

Item = TypeVar("Item")
Result = TypeVar("Result")

Function = Callable[[Item, Callable[[], bool]], Result]
"""Takes an item, and a function that tells whether to give up (then what it returns is thrown away)."""


def in_processes(
    function: Function[Item, Result], items: Sequence[Item], workers: int
) -> Generator[tuple[Item, Result], None, None]:
    """Apply ``function`` to every item in several processes; yields each item with its result, in any order.

    With one worker, or one item, everything happens in this process, in order. Close the generator to stop early.

    Args:
        function: what to do; sent once to every worker.
        items: also sent; twice as many as workers are on their way at a time.
        workers: number of processes. Each computes in one thread.

    Raises:
        ValueError: ``function`` cannot be pickled.
        ChildProcessError: a worker was killed.
        Exception: what ``function`` raises; work in progress is given up.
    """
    if min(workers, len(items)) <= 1:
        yield from ((item, function(item, lambda: False)) for item in items)
        return
    _check_can_be_sent(function)
    # spawned, not forked: threads of libraries that this process has used do not survive a fork
    context = multiprocessing.get_context("spawn")
    start_resource_tracker()
    stop = context.Event()
    waiting, running = iter(items), dict[Future[Result], Item]()
    with (
        one_thread_each(),
        ProcessPoolExecutor(min(workers, len(items)), context, _start_worker, (function, stop)) as pool,
    ):
        try:
            while True:
                for item in islice(waiting, 2 * workers - len(running)):
                    running[pool.submit(_apply, item)] = item
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield running.pop(future), future.result()
        except BrokenProcessPool:
            raise ChildProcessError(
                "a worker process was killed, most often for memory; what is complete is kept: continue with fewer "
                "--workers and --resume"
            ) from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


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


_in_worker: tuple[Function[Any, Any], Event] | None = None
"""Set once when a worker starts: an event can only be inherited, and the function need not be sent with every item."""


def _start_worker(function: Function[Any, Any], stop: Event) -> None:
    global _in_worker
    # Ctrl-C and a closed terminal are the parent's business, which sets `stop`; TERM is how the pool ends its processes
    for number in (signal.SIGINT, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ())):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()
    _in_worker = function, stop


def exit_with_parent() -> None:
    """End this process when its parent does; one that was killed cannot stop its workers. Blocks, for a thread."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _apply(item: Any) -> Any:
    assert _in_worker is not None, "only called in a worker, which sets it first"
    function, stop = _in_worker
    return function(item, stop.is_set)


def _check_can_be_sent(function: Function[Any, Any]) -> None:
    try:
        pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"the work cannot be sent to worker processes ({error}); functions in it must be defined at the top level "
            "of a module: move them there, or use one worker"
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
