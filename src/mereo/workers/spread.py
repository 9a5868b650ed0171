"""One function over many items: in this process, in several of this machine, or in tasks of a Ray cluster.

The result of an item depends on the item alone, so it is the same wherever it is computed; a task whose worker or node
died is done again by another.
"""

import logging
import math
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from ipaddress import ip_address
from itertools import islice
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Annotated, Any, TypeVar

from tyro.conf import arg

from mereo.io.atomic_files import JsonObject
from mereo.io.bounds import Count, NotNegative
from mereo.io.cores import THREAD_VARIABLES, cores, use_threads
from mereo.io.extras import library

LOCAL = "local"
"""Address of a cluster of this machine alone, started for the run."""

RayAddress = Annotated[str | None, arg(metavar="local|auto|HOST:PORT")]
"""Option that names a Ray cluster."""

Item = TypeVar("Item")
Result = TypeVar("Result")
Function = Callable[[Any], Any]
"""Work on an item."""


@dataclass(frozen=True)
class TaskResources:
    """What a task of a cluster has for itself.

    Attributes:
        cpus_per_task: CPUs of a task, and threads in which it computes; only with --ray.
        gpus_per_task: GPUs of a task, as 0.25 for a share of one; 0 computes on CPUs. Only with --ray.
    """

    cpus_per_task: Count = 1
    gpus_per_task: NotNegative = 0


DEFAULT_TASK = TaskResources()


@dataclass(frozen=True)
class Cluster:
    """Ray cluster, and what each task there may use.

    Attributes:
        address: "local" for one of this machine that is started for the run, "auto" for the one that this machine is a
            node of, or HOST:PORT of that one; a cluster that was there before stays.
        cpus, gpus: of a task, which computes in as many threads.
        local_cpus: of a cluster that is started; 0 means one per core.
    """

    address: str = LOCAL
    cpus: int = 1
    gpus: float = 0.0
    local_cpus: int = 0

    @property
    def device(self) -> str:
        """Kind of device on which a task computes: "cuda" or "cpu"."""
        return "cuda" if self.gpus else "cpu"


AHEAD = 2
"""Items on their way for each that can be computed at a time: no worker waits for its next one."""

DEATHS = 20
"""Workers and nodes that may die of one item: then it is the item that kills them."""


def spread(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int | Cluster = 1,
    failed: Callable[[Item, Exception], Result] | None = None,
) -> Generator[tuple[Item, Result], None, None]:
    """Apply ``function`` to every item; yields each with its result, as soon as that is there.

    With one worker, or one item and no cluster, everything happens in this process, in order. Close the generator to
    stop early: then, and after an error or Ctrl-C, work in progress is ended.

    Args:
        function: what to do; sent once to every worker.
        items: also sent; for a cluster only as many are taken as are computed or waited for.
        workers: number of processes, each with one thread; or a cluster.
        failed: result of an item for which ``function`` raises, or whose workers died; without it that ends all.

    Raises what ``function`` raises, ``ValueError`` where it cannot be pickled, or this machine has less than a task
    needs, ``ConnectionError`` where there is no such cluster, and ``ChildProcessError`` where workers were killed.
    """

    def attempt(item: Item, call: Callable[[], Result]) -> Result:
        try:
            return call()
        except Exception as error:
            if failed is None:
                raise
            return failed(item, error)

    if not isinstance(workers, Cluster):
        items = list(items)
        if min(workers, len(items)) <= 1:
            yield from ((item, attempt(item, partial(function, item))) for item in items)
            return
    waiting = iter(items)
    running = dict[Future[Result], Item]()
    with _ray_pool(function, workers) if isinstance(workers, Cluster) else process_pool(function, workers) as submit:
        while True:
            slots = max(1, task_slots(workers)) if isinstance(workers, Cluster) else workers  # a cluster may grow
            for item in islice(waiting, max(0, AHEAD * slots - len(running))):
                running[submit(item)] = item
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                item = running.pop(future)
                yield item, attempt(item, partial(_result, future))


def _result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except BrokenProcessPool:
        raise ChildProcessError(
            "a worker process was killed, most often for memory; what is complete is kept: continue with fewer "
            "--workers and --resume"
        ) from None
    except Exception as error:
        if not type(error).__module__.startswith("ray."):
            raise
        if isinstance(cause := getattr(error, "cause", None), Exception):
            raise cause from error
        raise ChildProcessError(
            f"{DEATHS + 1} workers or nodes died of one task ({type(error).__name__}), most often for memory; what is "
            "complete is kept: let fewer run at a time, by more CPUs for each or fewer workers, and run it again"
        ) from error


# --- processes of this machine ----------------------------------------------------------------------------------------


@contextmanager
def process_pool(function: Function, workers: int) -> Iterator[Callable[[Any], Future[Any]]]:
    """Open a pool of processes, each with one thread; yields what submits an item to ``function`` there.

    An exception in the block ends the processes at once.
    """
    pickled(function, pickle.dumps)
    # spawned, not forked: threads of libraries that this process has used do not survive a fork
    context = multiprocessing.get_context("spawn")
    start_resource_tracker()
    end, parent_end = context.Pipe(duplex=False)
    executor = ProcessPoolExecutor(workers, context, _start_worker, (function, end))
    with end, parent_end, limit_child_threads(), executor as pool:
        try:
            yield lambda item: pool.submit(_apply, item)
        except BaseException:
            parent_end.close()  # which every worker sees at the other end
            raise


def start_resource_tracker() -> None:
    """Start Python's process that frees shared things, once, with HUP blocked: else a closed terminal ends it first."""
    if not hasattr(signal, "SIGHUP"):
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])  # what is blocked stays so in a new process
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_in_worker = list[Function]()
"""The function, from when a worker starts: it need not be sent with every item."""


def _start_worker(function: Function, end: Connection) -> None:
    # Ctrl-C and a closed terminal are the parent's business, which ends its workers; TERM is how the pool ends them
    for number in (signal.SIGINT, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ())):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, args=(end,), daemon=True).start()
    _in_worker.append(function)


def exit_with_parent(*ends: Connection) -> None:
    """End this process when its parent ends, also by a kill, or closes a pipe; blocks, for a thread."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel, *ends])
        os._exit(1)


def _apply(item: Any) -> Any:
    return _in_worker[0](item)


def pickled(function: Function, dumps: Callable[[Function], bytes]) -> bytes:
    """Pickle a function by ``dumps``; ``ValueError`` where it cannot be."""
    try:
        return dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"the work cannot be sent to other processes ({' '.join(str(error).split())}); functions in it must be "
            "defined at the top level of a module, and what they hold must be picklable: change that, or use one "
            "worker and no --ray"
        ) from None


@contextmanager
def limit_child_threads() -> Iterator[None]:
    """Let processes that are started in the block compute in one thread: libraries read this when they are loaded."""
    before = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name in THREAD_VARIABLES:
            os.environ.pop(name, None)
        os.environ.update(before)


# --- Ray --------------------------------------------------------------------------------------------------------------


def choose_cluster(address: str | None, local_cpus: int = 0, task: TaskResources = DEFAULT_TASK) -> Cluster | None:
    """Cluster that options name, None where they name none; a wrong address is an error before any work.

    Raises ``ImportError`` without Ray, ``ValueError`` for resources of tasks without a cluster, and ``ConnectionError``
    where nothing answers at the address.
    """
    if address is None and task != DEFAULT_TASK:
        raise ValueError("--cpus-per-task and --gpus-per-task are for tasks of a cluster: give --ray local")
    if address is None:
        return None
    import_ray()
    if address not in (LOCAL, "auto"):
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=5.0).close()
        except (OSError, OverflowError, ValueError) as error:
            raise ConnectionError(
                f"there is no Ray cluster at {address!r} ({getattr(error, 'strerror', None) or error}): give local, "
                "auto, or the HOST:PORT that `ray start --head` prints"
            ) from None
    return Cluster(address, task.cpus_per_task, task.gpus_per_task, local_cpus)


def import_ray() -> ModuleType:
    """Import Ray, which then sends no statistics; ``ImportError`` where it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    return library("ray", "cluster", "--ray")


def task_slots(cluster: Cluster) -> int:
    """Number of tasks that the connected cluster can run at a time."""
    has = import_ray().cluster_resources()
    gpus = has.get("GPU", 0.0) / cluster.gpus if cluster.gpus else math.inf
    return int(min(has.get("CPU", 0.0) / cluster.cpus, gpus))


@contextmanager
def connect(cluster: Cluster) -> Iterator[None]:
    """Connect this process to a cluster while the block runs; where its caller has done so already, that stays."""
    ray = import_ray()
    if ray.is_initialized():
        yield
        return
    quiet: JsonObject = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    handler = signal.getsignal(signal.SIGTERM)
    # in /tmp, as paths of sockets must be shorter than some systems' folders for temporary files allow
    with TemporaryDirectory(prefix=f"mereo-ray-{os.getpid()}-", dir="/tmp" if os.name == "posix" else None) as folder:
        try:
            if cluster.address == LOCAL:
                count = cluster.local_cpus or cores()
                with _loopback(ray):
                    ray.init("local", num_cpus=count, include_dashboard=False, _temp_dir=folder, **quiet)
                if not task_slots(cluster):
                    raise ValueError(
                        f"a task needs {cluster.cpus} CPUs and {cluster.gpus:g} GPUs, and this machine has less: "
                        "give tasks less, or join a cluster that has it with --ray HOST:PORT"
                    )
            else:
                ray.init(cluster.address, **quiet)
            with suppress(ValueError):  # outside the main thread, where Ray takes none
                signal.signal(signal.SIGTERM, handler)  # which Ray has taken for itself
            yield
        except (ConnectionError, RuntimeError) as error:
            if ray.is_initialized():  # it is the work's
                raise
            raise ConnectionError(
                f"the Ray cluster at {cluster.address} cannot be joined ({' '.join(str(error).split())[:300]}): this "
                "machine must be one of its nodes (`ray start`), with the same Ray and Python; or use --ray local"
            ) from error
        finally:
            ray.shutdown()


@contextmanager
def _loopback(ray: ModuleType) -> Iterator[None]:
    """Let a cluster that starts in the block listen on this machine's own address alone: who reaches it runs code.

    Ray takes an address of the network on Linux, also where ``init`` names the loopback, but for this constant.
    """
    constants: Any = import_module("ray._private.ray_constants")
    before, constants.ENABLE_RAY_CLUSTER = constants.ENABLE_RAY_CLUSTER, False
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER = before
    address = ray.nodes()[0]["NodeManagerAddress"]
    if not ip_address(address).is_loopback:
        raise ConnectionError(
            f"the servers of --ray local listen on {address}; they must listen on the loopback alone: install the "
            "Ray of constraints.txt, or start a cluster with `ray start --head` and give --ray auto"
        )


@contextmanager
def _ray_pool(function: Function, cluster: Cluster) -> Iterator[Callable[[Any], Future[Any]]]:
    ray = import_ray()
    from ray import cloudpickle

    with connect(cluster):
        path = [os.path.abspath(folder) for folder in sys.path]
        # pickled here, as libraries that the function imports must find the number of threads set
        shared = ray.put((pickled(function, cloudpickle.dumps), cluster, os.getcwd(), path))
        running = set[Any]()
        task = ray.remote(_apply_in_task).options(num_cpus=cluster.cpus, num_gpus=cluster.gpus, max_retries=DEATHS)

        def submit(item: Any) -> Future[Any]:
            reference = task.remote([shared], item)
            running.add(reference)
            future = reference.future()
            future.add_done_callback(lambda _: running.discard(reference))
            return future

        try:
            yield submit
        finally:
            for reference in tuple(running):
                ray.cancel(reference, force=True)


_loaded = dict[str, Function]()
"""The function of this worker process, unpickled once: a model takes longer for that than a view to be rendered."""


def _apply_in_task(shared: list[Any], item: Any) -> Any:
    """Task: the result for an item. ``shared`` holds a reference, as Ray would unpickle a value for each task."""
    (reference,) = shared
    key = reference.hex()
    if key not in _loaded:
        function, cluster, folder, path = import_ray().get(reference)
        use_threads(cluster.cpus)
        if not cluster.gpus:  # Ray shows all of a node's GPUs to a task without any
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        with suppress(OSError):
            os.chdir(folder)
        sys.path.extend(item for item in path if item not in sys.path)
        _loaded.clear()
        _loaded[key] = pickle.loads(function)
    return _loaded[key](item)
