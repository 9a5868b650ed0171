"""Work in tasks of a Ray cluster: a function applied to many items, whichever worker or node dies meanwhile.

The function goes over the wire once for each node, every item with its task, and every result back to this process. A
task whose worker or node died is done again by another one; as it depends on its item alone, its result is the same.
"""

import os
import pickle
import socket
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from mereo.io.cores import use_threads
from mereo.workers.cluster import aside, connected, ray_library, task_slots
from mereo.workers.config import Cluster
from mereo.workers.installation import Installation, installation
from mereo.workers.processes import Function, Item, Result

DEATHS = 20
"""Workers and nodes that may die of one item: then it is the item that kills them."""

AHEAD = 2
"""Tasks on their way for each that can run at a time: no worker waits for its next item, and no more is in memory."""

LOOK_EVERY_S = 5.0
"""Seconds between two looks at how many tasks can run: nodes come and go."""


@dataclass(frozen=True, eq=False)
class _Work:
    """What all tasks have in common.

    Attributes:
        function: pickled: what it imports must find the number of threads set.
        threads: in which a task computes.
        gpu: whether a task has a GPU, or a share of one; else it must see none.
        places: where this process finds modules; on this machine, and where nodes share files, tasks find them too.
        installation: of the machine that wants the results.
    """

    function: bytes
    threads: int
    gpu: bool
    places: tuple[str, ...]
    installation: Installation


@dataclass(frozen=True)
class _Failed:
    """Exception of the function, which is not tried again; its traceback as text, which is all that can be sent."""

    error: Exception
    told: str


class _RemoteTraceback(Exception):
    """Where in a task an exception came from: the cause of the same exception here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def in_tasks(
    function: Function[Item, Result],
    items: Iterable[Item],
    cluster: Cluster,
    lost: Callable[[Item, ChildProcessError], Result] | None = None,
) -> Generator[tuple[Item, Result], None, None]:
    """Apply ``function`` to every item in tasks of a cluster; yields each item with its result, in any order.

    Close the generator to stop early: then, and after an error or Ctrl-C, tasks on their way are ended.

    Args:
        function: what to do; functions of the user's main module are sent with their code, those of other modules by
            name. It is not told to give up, but ended.
        items: also sent; ``AHEAD`` times as many as can run at a time are taken from it and on their way.
        cluster: where, and what each task has for itself. It computes in as many threads as it has CPUs.
        lost: result of an item of which ``DEATHS`` workers or nodes died; without it that ends all.

    Raises:
        ImportError: Ray is not installed.
        ValueError: ``function`` cannot be sent, or a node has another installation than this machine.
        ConnectionError: there is no such cluster.
        ChildProcessError: ``DEATHS`` workers or nodes died of one item.
        Exception: what ``function`` raises; work in progress is given up.
    """
    ray = ray_library()
    with connected(cluster):
        work = _Work(_pickled(function), cluster.cpus, cluster.gpus > 0, _places(), installation())
        shared = ray.put(work)
        task = ray.remote(_apply).options(
            num_cpus=cluster.cpus, num_gpus=cluster.gpus, max_retries=DEATHS, retry_exceptions=False
        )
        waiting, running, slots = iter(items), dict[Any, Item](), _Slots(cluster)
        try:
            while True:
                for item in islice(waiting, max(0, AHEAD * slots.now() - len(running))):
                    running[task.remote([shared], item)] = item
                if not running:
                    break
                for reference in aside(partial(_done, list(running))):
                    item = running.pop(reference)
                    yield item, _result(reference, item, lost)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)


def _done(running: list[Any]) -> list[Any]:
    """The tasks that are done, one at most, as soon as one is; none after a second, in which nobody could interrupt."""
    done: list[Any] = ray_library().wait(running, num_returns=1, timeout=1.0)[0]
    return done


class _Slots:
    """How many tasks a cluster can run at a time, by what its nodes have; looked up again now and then."""

    def __init__(self, cluster: Cluster) -> None:
        self.cluster, self.count, self.looked = cluster, 0, -LOOK_EVERY_S

    def now(self) -> int:
        """Number of tasks, at least 1: a cluster that has no node for them yet may start one."""
        if time.monotonic() - self.looked >= LOOK_EVERY_S:
            self.looked, self.count = time.monotonic(), max(1, task_slots(self.cluster))
        return self.count


def _pickled(function: Function[Any, Any]) -> bytes:
    """A function as bytes, with the code of what other processes cannot import; ``ValueError`` where it cannot be."""
    from ray import cloudpickle

    alone = [module for name, module in list(sys.modules.items()) if _is_here_alone(name, module)]
    for module in alone:
        cloudpickle.register_pickle_by_value(module)
    try:
        pickled: bytes = cloudpickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"the work cannot be sent to a cluster ({' '.join(str(error).split())}): what a scene or function holds "
            "must be values that can be pickled; mend that, or leave out --ray"
        ) from None
    finally:
        for module in alone:
            cloudpickle.unregister_pickle_by_value(module)
    return pickled


def _is_here_alone(name: str, module: Any) -> bool:
    """Whether a module was loaded from a file that nobody finds by its name, as a Python scene's is."""
    file = getattr(module, "__file__", None)
    if "." in name or name == "__main__" or file is None or getattr(module, "__path__", None) is not None:
        return False
    return str(Path(file).parent) not in _places()


def _places() -> tuple[str, ...]:
    """``sys.path`` by absolute names."""
    return tuple(str(Path(place).absolute()) for place in sys.path)


_arrived: tuple[str, Function[Any, Any]] | None = None
"""The function of this worker process, unpickled once: a model takes longer for that than a view to be rendered."""


def _apply(shared: list[Any], item: Any) -> Any:
    """Task: the function's result for an item, or why there is none.

    ``shared`` holds a reference to the work, and not the work, which Ray would unpickle for every task.
    """
    try:
        return _function(shared[0])(item, lambda: False)
    except Exception as error:
        return _Failed(_sendable(error), traceback.format_exc())


def _function(reference: Any) -> Function[Any, Any]:
    """The function of a piece of work, unpickled where this process does not have it yet."""
    global _arrived
    if _arrived is None or _arrived[0] != reference.hex():
        work: _Work = ray_library().get(reference)
        use_threads(work.threads)
        if not work.gpu:  # Ray shows all of a node's GPUs to a task that asked for none
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        difference = work.installation.difference(installation(), f"node {socket.gethostname()}")
        if difference is not None:  # it has joined the cluster since that was looked at
            raise ValueError(difference)
        sys.path.extend(place for place in work.places if place not in sys.path)
        _arrived = reference.hex(), pickle.loads(work.function)
    return _arrived[1]


def _sendable(error: Exception) -> Exception:
    """The exception, or its words where it cannot be pickled."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


def _result(reference: Any, item: Any, lost: Callable[[Any, ChildProcessError], Any] | None) -> Any:
    """Result of a task that is done; raises what the function raised, and where its workers died too often."""
    ray = ray_library()
    try:
        found = ray.get(reference)
    except ray.exceptions.RayError as error:
        died = ChildProcessError(
            f"{DEATHS + 1} workers or nodes died of one task ({type(error).__name__}), most often for memory; what is "
            "complete is kept: let fewer run at a time, by more CPUs for each or fewer workers, and run it again"
        )
        if lost is None:
            raise died from error
        return lost(item, died)
    if isinstance(found, _Failed):
        raise found.error from _RemoteTraceback(found.told)
    return found
