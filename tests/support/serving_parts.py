"""A server in the tests' own process: analytic models, workers in threads, requests without a network."""

import asyncio
import io
import json
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
from analytic import AnalyticModel
from two_balls import BIG, NAMES, SMALL, front, two_balls

from mereo.models.config import InferenceConfig
from mereo.models.model import Model
from mereo_serving.answering import Answerer
from mereo_serving.app import Service, make_app
from mereo_serving.config import ServeConfig
from mereo_serving.dispatcher import Dispatcher
from mereo_serving.gate import Entry
from mereo_serving.messages import FrameRequest, Reply, Served, Setup
from mereo_serving.metrics import Metrics
from mereo_serving.workers import WorkerDied, WorkerProcess

NPY = {"Content-Type": "application/x-npy"}
CLOUD = np.concatenate([front(*BIG, -1.0), front(*SMALL, -1.0)])
MIDDLE, HALF = (CLOUD.min(axis=0) + CLOUD.max(axis=0)) / 2, np.ptp(CLOUD, axis=0).max() / 2
ADDRESS = "/v1/balls/reconstruct"

ONE_AT_A_TIME = threading.Lock()
"""What processes have to themselves and threads share: warnings, most of all."""


def balls(_: object = None, __: InferenceConfig | None = None) -> Model:
    """Two balls wherever a cloud is and however large: the answer tells which cloud it is of."""
    field = lambda points: two_balls(MIDDLE + HALF * points)  # noqa: E731
    return replace(AnalyticModel.of(field, NAMES, normalized=True), provenance={})


def npy(points: np.ndarray = CLOUD) -> bytes:
    file = io.BytesIO()
    np.save(file, points)
    return file.getvalue()


def figures(answer: httpx2.Response | bytes) -> dict[str, Any]:
    """What of an answer no clock decides."""
    found: dict[str, Any] = json.loads(answer if isinstance(answer, bytes) else answer.content)
    found.get("registration", {}).pop("seconds", None)
    return {key: value for key, value in found.items() if key != "timings_s"}


class ThreadWorker(WorkerProcess):
    """Answers in this process; a test may hold it up, or let it die."""

    def __init__(self, answerer: Answerer) -> None:
        self.answerer, self.ready = answerer, answerer.ready()
        self.go, self.begun, self.restarts, self.asked = threading.Event(), threading.Event(), 0, list[FrameRequest]()
        self.go.set()
        self.dies: Callable[[FrameRequest], bool] = lambda frame: False

    def ask(self, frame: FrameRequest) -> Reply:
        self.asked.append(frame)
        self.begun.set()
        assert self.go.wait(20)
        if self.dies(frame):
            raise WorkerDied("a process that answers has ended")
        with ONE_AT_A_TIME:
            return self.answerer(frame)

    def restart(self) -> None:
        self.restarts += 1

    def kill(self) -> None:
        self.dies = lambda frame: True
        self.go.set()

    def close(self) -> None:
        pass


class Server:
    """Server under test: its parts, and a client."""

    def __init__(self, folder: Path, workers: list[ThreadWorker], config: ServeConfig, token: str = "") -> None:
        self.workers, metrics = workers, Metrics()
        self.dispatcher = Dispatcher(workers, config, metrics)
        entry = Entry("0.0.0.0" if token else "127.0.0.1", token)
        facts = workers[0].ready.facts
        self.service = Service(self.dispatcher, metrics, config, folder, facts, 12, entry)
        self.app = make_app(self.service)
        transport = httpx2.ASGITransport(app=self.app, raise_app_exceptions=False)
        self.client = httpx2.AsyncClient(transport=transport, base_url="http://localhost:8000", timeout=60)

    async def post(self, content: Any = None, address: str = ADDRESS, **options: Any) -> httpx2.Response:
        headers = options.pop("headers", NPY if content is not None else None)
        return await self.client.post(address, content=content, headers=headers, **options)


def setup(max_points: int = 100_000) -> Setup:
    return Setup((Served("balls", "balls"),), "network", InferenceConfig(precision="float32"), max_points)


@asynccontextmanager
async def running(
    folder: Path, config: ServeConfig | None = None, workers: int = 1, token: str = "", given: Setup | None = None
) -> AsyncIterator[Server]:
    """A server whose weights are the balls, unless a setup is given; ``load_for`` is to be replaced beforehand."""
    config = config or ServeConfig()
    answerers = [Answerer.of(given or setup()) for _ in range(workers)]
    server = Server(folder, [ThreadWorker(answerer) for answerer in answerers], config, token)
    server.dispatcher.start()
    try:
        yield server
    finally:
        for worker in server.workers:
            worker.go.set()
        await server.client.aclose()
        await server.dispatcher.close()


def run(work: Coroutine[Any, Any, Any]) -> Any:
    """What a test does, in an event loop of its own."""
    return asyncio.run(work)


async def until(condition: Callable[[], bool]) -> None:
    """Wait for what other tasks and threads bring about."""
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.002)
