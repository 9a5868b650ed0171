"""A Ray cluster: one of this machine for the time of a command, or one that is there and stays.

What Ray itself would leave or change is put right: its files lie in a scratch folder of ours, which goes; it sends no
statistics, prints nothing, and signals end the command as before.
"""

import logging
import math
import os
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from mereo.io.atomic_files import scratch_folder
from mereo.io.cores import cores
from mereo.workers.config import LOCAL, Cluster
from mereo.workers.installation import Installation, installation

ANSWER_S = 5.0
"""Seconds in which an address must take a connection."""

Value = TypeVar("Value")

LONGEST_PLACE = 16
"""Characters of a folder's name in which Ray's sockets have names that are short enough: at most 107 bytes on Linux."""

PROBE_S = 60.0
"""Seconds in which every node must say what is installed there: its first worker has to start."""


def ray_library() -> ModuleType:
    """Ray, imported where it is used, quiet and without statistics; ``ImportError`` where it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise ImportError("Ray, which --ray needs, is not installed: run pip install 'mereo[cluster]'") from None
    library: ModuleType = ray
    return library


@contextmanager
def connected(cluster: Cluster) -> Iterator[None]:
    """Connection of this process to a cluster, for as long as the block runs.

    Where the process is connected already (its caller uses Ray too), that connection is used and stays.

    Raises:
        ConnectionError: there is no such cluster.
        ValueError: the address is none, a node has another installation, or this machine has not what a task asks for.
    """
    ray = ray_library()
    if ray.is_initialized():
        _check_nodes()
        yield
    elif cluster.address == LOCAL:
        with _started(cluster):
            yield
    else:
        with _joined(cluster):
            yield


def joined_first(cluster: Cluster | None) -> AbstractContextManager[None]:
    """Connection to a cluster that is there already, before any work: a wrong address is said at once.

    One that would be started, or none, is left to ``in_tasks``: other mistakes are said before seconds go by.
    """
    return nullcontext() if cluster is None or cluster.address == LOCAL else connected(cluster)


@contextmanager
def _started(cluster: Cluster) -> Iterator[None]:
    """Cluster of this machine, which ends with the block."""
    ray = ray_library()
    with scratch_folder(_place()) as folder, ThreadPoolExecutor(1) as starter, _ended():
        start = partial(
            ray.init,
            address="local",
            num_cpus=cluster.local_cpus or cores(),
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
            _temp_dir=str(folder),
        )
        with _own_signals():  # in a thread that stays: Linux ends what a thread has started when that ends
            _finished(starter.submit(start))
        _quiet()
        if not task_slots(cluster):
            raise ValueError(
                f"a task has {_asked(cluster)}, more than there is here ({_offered()}): ask for less, or join a "
                "cluster that has it with --ray HOST:PORT"
            )
        yield


@contextmanager
def _joined(cluster: Cluster) -> Iterator[None]:
    """Connection to a cluster that stays."""
    ray = ray_library()
    address = cluster.address
    if address != "auto":
        _check_reachable(address)
    with _ended():
        try:
            with _own_signals():
                aside(partial(ray.init, address=address, log_to_driver=False, logging_level=logging.CRITICAL))
            _quiet()
        except (ConnectionError, RuntimeError, ValueError, TimeoutError, OSError) as error:
            raise ConnectionError(_not_joined(address, error)) from error
        _check_nodes()
        if not task_slots(cluster):
            print(
                f"mereo: warning: a task has {_asked(cluster)}, which no node of the cluster has now ({_offered()}); "
                "waiting for one that does",
                file=sys.stderr,
            )
        yield


@contextmanager
def _ended() -> Iterator[None]:
    """Block after which this process is connected to nothing, and what it has started has ended."""
    try:
        yield
    finally:
        ray_library().shutdown()


def aside(function: Callable[[], Value]) -> Value:
    """Result of a function, which runs in a thread of its own so that this one can be interrupted.

    In the main thread Ray takes TERM for itself and makes one exception, its own, of all that signals raise. What is
    interrupted is waited for before the exception goes on.
    """
    with ThreadPoolExecutor(1) as thread:
        return _finished(thread.submit(function))


def _finished(running: Future[Value]) -> Value:
    """Result of what runs in a thread; an interruption goes on once that has ended."""
    try:
        return running.result()
    except BaseException:
        wait([running])
        raise


@contextmanager
def _own_signals() -> Iterator[None]:
    """Block after which signals are handled as before: Ray's compiled code would abort the process at TERM."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _quiet() -> None:
    """Let Ray print nothing about workers and nodes that die: what they did is done again.

    Nothing public stops that: Ray's own errors are printed even where the output of workers is not.
    """
    from ray._private import worker

    worker._worker_logs_enabled = False


def _place() -> Path:
    """Where the scratch folder of a cluster lies: the system's place for such, or /tmp where that has a long name."""
    place = tempfile.gettempdir()
    return Path("/tmp" if os.name == "posix" and len(place) > LONGEST_PLACE else place) / "mereo-ray"


# --- addresses --------------------------------------------------------------------------------------------------------


def _check_reachable(address: str) -> None:
    """Raise where nothing answers at an address, at once; Ray itself would try for a minute."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise ValueError(
            f"--ray is {address!r}; it must be local, auto, or the HOST:PORT that `ray start --head` prints: correct it"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConnectionError(
            f"there is no Ray cluster at {address} ({reason}): correct the address, start one there with `ray start "
            "--head`, or use --ray local"
        ) from None


def _not_joined(address: str, error: BaseException) -> str:
    """Sentence on why a cluster that may be there cannot be joined."""
    told = " ".join(str(error).split())[:300]
    if address == "auto":
        return (
            f"this machine is a node of no Ray cluster{f' ({told})' if told else ''}: start one or join it with `ray "
            "start`, or use --ray local"
        )
    return (
        f"the Ray cluster at {address} cannot be joined ({told or type(error).__name__}): this machine must be one of "
        f"its nodes (`ray start --address={address}`), with the same Ray and Python"
    )


# --- nodes ------------------------------------------------------------------------------------------------------------


def task_slots(cluster: Cluster) -> int:
    """Number of tasks that the nodes can run at a time, by what they have."""
    return sum(
        int(min(has.get("CPU", 0.0) / cluster.cpus, has.get("GPU", 0.0) / cluster.gpus if cluster.gpus else math.inf))
        for has in _resources()
    )


def _resources() -> list[dict[str, float]]:
    """What each living node has."""
    return [node["Resources"] for node in ray_library().nodes() if node["Alive"]]


def _asked(cluster: Cluster) -> str:
    return f"{cluster.cpus} CPUs" + (f" and {cluster.gpus:g} GPUs" if cluster.gpus else "")


def _offered() -> str:
    each = [f"{has.get('CPU', 0):g} CPUs and {has.get('GPU', 0):g} GPUs" for has in _resources()]
    return "; ".join(each) or "no node"


def _check_nodes() -> None:
    """Raise ``ValueError`` where a node has another installation than this machine, before any work."""
    ray = ray_library()
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    told: dict[Any, str] = {}
    probe = ray.remote(_installed)
    for node in ray.nodes():
        if node["Alive"]:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            reference = probe.options(num_cpus=0, max_retries=3, scheduling_strategy=there).remote()
            told[reference] = node["NodeManagerAddress"]
    for reference, address in told.items():
        try:
            found = ray.get(reference, timeout=PROBE_S)
        except Exception as error:
            reason = " ".join(str(error).split())
            missing = "No module named 'mereo'" in reason
            raise ValueError(
                f"node {address} has no mereo: install the same there, or take another --ray"
                if missing
                else f"node {address} cannot say what is installed there ({reason[-300:]}): look at `ray status`"
            ) from error
        check_same(found, f"node {address}")


def check_same(theirs: Installation, place: str) -> None:
    """Raise ``ValueError`` where another installation differs from this process's."""
    difference = installation().difference(theirs, place)
    if difference is not None:
        raise ValueError(difference)


def _installed() -> Installation:
    """Task: what is installed on a node."""
    return installation()
