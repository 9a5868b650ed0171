"""``mereo serve``: load the weights in processes of their own, listen, and answer until a signal asks for the end."""

import asyncio
import logging
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn

from mereo.fitting.config import AnswerMethod
from mereo.io.atomic_files import scratch_folder
from mereo.models.config import InferenceConfig
from mereo_serving.app import Service, make_app
from mereo_serving.config import ServeConfig
from mereo_serving.dispatcher import Dispatcher
from mereo_serving.gate import LOOPBACK, Entry, bound_socket
from mereo_serving.messages import Served, Setup
from mereo_serving.metrics import Metrics
from mereo_serving.workers import WorkerProcess

CONNECTIONS = 256
"""Connections beyond those of frames that wait; more are turned away before they are read."""


def serve(
    served: Sequence[Served],
    *,
    method: AnswerMethod = "auto",
    resolution: int = 128,
    address: tuple[str, int] = (LOOPBACK, 8000),
    workers: int = 1,
    config: ServeConfig | None = None,
    inference: InferenceConfig | None = None,
) -> None:
    """Serve objects until Ctrl-C or TERM: then what is begun is answered, and the rest refused.

    Args:
        served: the objects, from ``served_objects``.
        method: source of the answers.
        resolution: cells along the longest side where a request does not say.
        address: host and port. Hosts other than this machine need the token of the printed address; port 0 takes any
            that is free.
        workers: processes that answer.
        config: limits.
        inference: where and how exactly the networks compute.

    Raises ``ValueError`` and ``OSError`` for weights that cannot be served, ``ValueError`` for a resolution that no
    request may have, and ``OSError`` for an address that is
    taken or not this machine's.
    """
    config = config or ServeConfig()
    if resolution > config.max_resolution:
        raise ValueError(
            f"--resolution is {resolution}, more than --max-resolution {config.max_resolution}, which no request may "
            "exceed: lower the one or raise the other"
        )
    setup = Setup(tuple(served), method, inference or InferenceConfig(), config.max_points, config.max_body)
    entry = Entry.of(address[0])
    metrics = Metrics()
    with ExitStack() as stack:
        socket = stack.enter_context(bound_socket(*address))
        processes = stack.enter_context(started(setup, workers))
        root = stack.enter_context(private_folder())
        dispatcher = Dispatcher(processes, config, metrics)
        service = Service(dispatcher, metrics, config, root, processes[0].ready.facts, resolution, entry)
        names = ", ".join(service.names)
        url = entry.address(socket.getsockname()[1])
        many = "1 process" if workers == 1 else f"{workers} processes"
        greeting = f"serving {names} at {url} ({many}; /docs says how to ask); Ctrl-C ends"
        settings = uvicorn.Config(
            make_app(service),
            http="h11",
            ws="none",
            loop="asyncio",
            lifespan="on",
            log_level=logging.WARNING,
            access_log=False,
            server_header=False,
            limit_concurrency=config.queue + CONNECTIONS,
        )
        GracefulServer(settings, dispatcher, greeting).run(sockets=[socket])


class GracefulServer(uvicorn.Server):
    """Server that refuses what waits as soon as it has to end, and answers what is begun."""

    def __init__(self, config: uvicorn.Config, dispatcher: Dispatcher, greeting: str) -> None:
        super().__init__(config)
        self._dispatcher, self._greeting = dispatcher, greeting
        self._loop: asyncio.AbstractEventLoop | None = None

    async def serve(self, sockets: Any = None) -> None:
        """Serve until a signal."""
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)

    async def startup(self, sockets: Any = None) -> None:
        """Listen, and only then say so."""
        await super().startup(sockets)
        if not self.should_exit:
            print(self._greeting, flush=True)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to end."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._dispatcher.stop)
        super().handle_exit(sig, frame)


@contextmanager
def started(setup: Setup, workers: int) -> Iterator[list[WorkerProcess]]:
    """Processes that have loaded the weights; they end with the block. Raises what loading raises."""
    processes: list[WorkerProcess] = []
    try:
        processes.append(WorkerProcess(setup))
        processes[0].wait_until_ready()  # alone: what is wrong with the weights is said once, and the precision settled
        processes += [WorkerProcess(processes[0].setup) for _ in range(workers - 1)]
        for process in processes[1:]:
            process.wait_until_ready()
        yield processes
    finally:
        for process in processes:
            process.kill()


@contextmanager
def private_folder() -> Iterator[Path]:
    """Folder that only this user reads, for what requests bring; removed at the end, or by the next server."""
    with scratch_folder(Path(tempfile.gettempdir()) / "mereo-serve") as folder:
        folder.chmod(0o700)
        yield folder


# --- names ------------------------------------------------------------------------------------------------------------

# Clients know objects by their own name, their folder's, or what the operator says.

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def served_objects(
    weights: Sequence[str], scenes: Sequence[str] = (), objects: Sequence[str] = ()
) -> tuple[Served, ...]:
    """Weights of ``bunny``, ``learned/weights.safetensors`` or ``liver=learned/weights.safetensors``, with scenes.

    Objects without weights are ``scene.yaml``, ``part.stl,other.stl`` or ``liver=part.stl,other.stl``. Without a name a
    file is called by its own, and one that is called weights by its folder; meshes are called by the first.

    Raises ``ValueError`` for none, for a name that is no part of an address, for two of one name, and for a scene of
    an object that has its own, or to which there are no weights.
    """
    if not weights and not objects:
        raise ValueError(
            "no object is given; name what is to be served: mereo serve --object part.stl, or --weights bunny"
        )
    named, bare = [_named(text) for text in weights], [_named(text) for text in objects]
    played = dict(_pair(text) for text in scenes)
    names = [name for name, _ in (*named, *bare)]
    for name in names:
        if not NAME.fullmatch(name):
            raise ValueError(
                f"{name!r} cannot be a part of an address; names are letters, digits, '.', '_' and '-': give one, as "
                "in --weights liver=FILE"
            )
        if names.count(name) > 1:
            raise ValueError(f"two objects are called {name!r}; clients must tell them apart: --weights NAME=FILE")
    if double := sorted(set(played) & {name for name, _ in bare}):
        raise ValueError(f"--scene is for {double[0]!r}, whose --object says what it is: leave one of them out")
    if lost := sorted(set(played) - set(names)):
        raise ValueError(f"--scene is for {lost[0]!r}, which is not served; there are {', '.join(names)}: name one")
    of_weights = [Served(name, file, played.get(name)) for name, file in named]
    return (*of_weights, *(Served(name, object=tuple(_files(text))) for name, text in bare))


def _files(text: str) -> list[str]:
    """Files that are joined by commas; one whose name has commas is itself."""
    return [text] if Path(text).exists() else text.split(",")


def _named(text: str) -> tuple[str, str]:
    if "=" in text and not Path(text).exists():
        return _pair(text)
    path = Path(text if Path(text).exists() else text.partition(",")[0])
    if path.suffix == "":
        return path.name, text
    return (path.absolute().parent.name if path.stem == "weights" else path.stem), text


def _pair(text: str) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise ValueError(f"{text!r} is no NAME=FILE; say which weights it is for: give for example liver=scene.yaml")
    return name, file
