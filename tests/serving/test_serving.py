"""Answers over HTTP are those of the command line, each goes to its own client, and what is refused leaves no trace."""

import asyncio
import contextlib
import http.server
import io
import json
import os
import runpy
import signal
import socket
import sys
import threading
import time
import urllib.request
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from numpy import ndarray
from numpy.random import default_rng
from numpy.testing import assert_allclose

from mereo.io.atomic_files import JsonObject, to_json

pytest.importorskip("fastapi", reason="fastapi (extra `serve`) is not installed")
pytest.importorskip("python_multipart", reason="python-multipart (extra `serve`) is not installed")

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import browser
import httpx2
import serving as bench
import uvicorn
from analytic import AnalyticModel
from camera_files import write_camera
from fuzz import damaged, zipped
from page_blocks import blocks
from PIL import Image
from robot_files import LAPTOP
from two_balls import NAMES, fronts, two_balls

import mereo
from mereo.cli.answers import ReconstructCommand, ServeCommand
from mereo.cli.reconstruct import FrameJob, reconstruct_file
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.models.config import InferenceConfig
from mereo.models.model import Model
from mereo.scenes.files.object_files import scene_of_meshes
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.synthesis.sample_views import load_view
from mereo_serving.answering import Answerer
from mereo_serving.app import Service, make_app
from mereo_serving.config import ServeConfig
from mereo_serving.dispatcher import Dispatcher
from mereo_serving.gate import Entry, bound_socket
from mereo_serving.messages import GLB, FrameRequest, Reply, Served, Setup
from mereo_serving.metrics import Metrics
from mereo_serving.server import serve, served_objects
from mereo_serving.workers import WorkerDied, WorkerProcess

pytestmark = pytest.mark.anyio

PAGE = Path(__file__).parents[2] / "docs/serving.md"
NPY = {"Content-Type": "application/x-npy"}
CLOUD = fronts(-1.0)
MIDDLE, HALF = (CLOUD.min(axis=0) + CLOUD.max(axis=0)) / 2, np.ptp(CLOUD, axis=0).max() / 2
ADDRESS = "/v1/balls/reconstruct"

ONE_AT_A_TIME = threading.Lock()
"""What processes have to themselves and threads share: warnings, most of all."""


def balls(_: object = None, __: InferenceConfig | None = None) -> Model:
    """Two balls wherever a cloud is and however large: the answer tells which cloud it is of."""
    field = lambda points: two_balls(MIDDLE + HALF * points)  # noqa: E731
    return replace(AnalyticModel.of(field, NAMES, normalized=True), provenance={})


def npy(points: ndarray = CLOUD) -> bytes:
    file = io.BytesIO()
    np.save(file, points)
    return file.getvalue()


def figures(answer: httpx2.Response | bytes) -> JsonObject:
    """What of an answer no clock decides."""
    found = json.loads(answer if isinstance(answer, bytes) else answer.content)
    found.get("registration", {}).pop("seconds", None)
    return {key: value for key, value in found.items() if key != "timings_s"}


class ThreadWorker(WorkerProcess):
    """Answers in this process; a test may hold it up, or let it die."""

    def __init__(self, answerer: Answerer) -> None:
        self.answerer, self.ready = answerer, answerer.ready()
        self.go, self.begun, self.restarts, self.asked = threading.Event(), threading.Event(), 0, list[FrameRequest]()
        self.go.set()
        self.dies = lambda frame: False

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


async def until(condition: Callable[[], bool]) -> None:
    """Wait for what other tasks and threads bring about."""
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.002)


EXACT = InferenceConfig(precision="float32")


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(autouse=True)
def analytic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", balls)


@pytest.fixture
def rope_only(rope: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: rope)


async def test_the_answer_is_that_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "s").mkdir()
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: replace(balls(), name="balls"))
    np.save(tmp_path / "frame.npy", CLOUD)
    options = ReconstructCommand((), weights="any", resolution=12, inference=EXACT, method="network")
    reconstruct_file(tmp_path / "frame.npy", tmp_path / "out", FrameJob(options))
    expected = figures((tmp_path / "out/summary.json").read_bytes())

    async with running(tmp_path / "s") as server:
        found = await server.post(npy())
        assert found.status_code == 200, found.text
        assert figures(found) == {**expected, "warnings": []}
        assert found.headers["content-type"] == "application/json"
        assert (found.headers["mereo-known"], found.headers["mereo-answer"]) == ("unsure", "network")
        surfaces = await server.post(npy(), headers=NPY | {"Accept": GLB})
        assert surfaces.headers["content-type"] == GLB
        assert surfaces.content == (tmp_path / "out/segments.glb").read_bytes()
    assert not list((tmp_path / "s").iterdir()), "what requests brought is removed"


async def test_what_is_told_is_in_the_words_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = replace(balls(), provenance={"visible_m": [2, 3]})
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: large)

    async with running(tmp_path) as server:
        assert figures(await server.post(npy()))["warnings"] == [], "of no unit that anybody has said"
        (told,) = figures(await server.post(npy(), f"{ADDRESS}?unit-m=1"))["warnings"]
        assert "the visible part is 0.18 m long, but 2 to 3 m in training" in told
        assert "--unit-m 0.001" in told and "--box" in told


async def test_a_depth_image_is_registered_as_alone(tmp_path: Path, rope: Model, rope_only: None) -> None:
    (tmp_path / "s").mkdir()
    view = load_view("rope")
    frame, mask, camera = tmp_path / "frame.png", tmp_path / "mask.png", tmp_path / "intrinsics.json"
    Image.fromarray(np.rint(view.depth.depth * 0.01 * 20_000).astype(np.uint16)).save(frame)
    Image.fromarray((view.depth.depth > 0).astype(np.uint8) * 255).save(mask)
    write_camera(camera, view.depth.camera)
    reading = InputConfig(intrinsics=camera, mask=mask, depth_scale=20_000)
    alone = mereo.reconstruct(read_frame(frame, reading), rope, "modes", resolution=12)
    expected = figures(alone.save(tmp_path / "summary.json").read_bytes())
    files = {name: (path.name, path.read_bytes()) for name, path in (("frame", frame), ("mask", mask))}
    address = f"{ADDRESS}?depth-scale=20000"

    given = Setup((Served("balls", "rope"),), "modes", EXACT)
    async with running(tmp_path / "s", given=given) as server:
        parts = {**files, "intrinsics": ("c.json", camera.read_bytes())}
        found = await server.post(address=address, files=parts)
        assert found.status_code == 200, found.text
        told = figures(found)
        assert told.pop("warnings") == [] and told == {**expected, "weights": "balls"}
        assert found.headers["mereo-answer"] == "registration" and "explained" in told["registration"]
        assert told["recognition"]["known"] is True and found.headers["mereo-known"] == "true"
        assert told["radius95"]["median"] > 0 and "centroid_radius95" in told["segments"][0]
        again = await server.client.post(
            address, params={"intrinsics": camera.read_text(), "depth-scale": 20_000}, files=files,
            headers={"Accept": GLB},
        )  # fmt: skip
        assert again.content == alone.save(tmp_path / "segments.glb").read_bytes()


@pytest.fixture
def laptop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Setup:
    """A laptop alone, with a frame of it in ``frame.npy`` of the working folder."""
    pytest.importorskip("yourdfpy", reason="yourdfpy (extra `robot`) is not installed")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    Path("s").mkdir()
    Path("laptop.urdf").write_text(LAPTOP)
    scene = scene_of_meshes([Path("laptop.urdf")])
    assert scene.unit_m is not None
    cloud = scene.unit_m * sample_view(scene, GenerateConfig(), default_rng(0)).depth.to_points().points
    Path("frame.npy").write_bytes(npy(cloud))
    return Setup((Served("laptop", object=("laptop.urdf",)),), "auto", EXACT)


async def test_joints_are_in_the_answer_and_known_ones_are_of_one_request(tmp_path: Path, laptop: Setup) -> None:
    address = "/v1/laptop/reconstruct?unit-m=1"
    cloud = np.load("frame.npy")
    joints = mereo.reconstruct(cloud, mereo.load_object("laptop.urdf"), unit_m=1.0).joints
    free = to_json({"hinge": joints["hinge"].facts()})
    true = round(joints["hinge"].value, 3)
    async with running(tmp_path / "s", given=laptop) as server:
        for given in (None, {"hinge": true}, {"name": ["wheel", "hinge"], "position": [0, true]}, None):
            query = "" if given is None else f"&{urlencode({'joints': json.dumps(given)})}"
            answer = figures(await server.post(npy(cloud), address + query))
            assert answer["verdict"] == "yes" and answer["warnings"] == []
            if given is None:
                assert answer["joints"] == free
            else:
                hinge = answer["joints"]["hinge"]
                assert [hinge["value"], *hinge["interval"]] == pytest.approx([true] * 3, abs=1e-9)
        for wrong, sentence in WRONG_JOINTS.items():
            refused = await server.post(npy(cloud), f"{address}&{urlencode({'joints': wrong})}")
            assert (refused.status_code, refused.json()) == (422, {"error": sentence})


WRONG_JOINTS = {
    '{"hinge": 86}': "joint 'hinge' is 86; its limits are 0.3 to 2.2 rad: give radians, correct it, or add `within`",
    '{"lid": 1}': "no joint is called 'lid'; it must be one of hinge: correct it",
    "{hinge: 1}": "joints is '{hinge: 1}'; it must be JSON: correct it",
    '"laptop.urdf"': "joints is 'laptop.urdf'; it must be a valid dictionary: correct it",  # no file is read
}


def clouds(count: int) -> Iterator[ndarray]:
    for number in range(count):
        rng = default_rng(number)
        kept = np.sort(rng.choice(len(CLOUD), 700 + 20 * number, replace=False))
        yield CLOUD[kept] * (1 + 0.1 * number) + [0.01 * number, 0.0, 0.02 * number]


async def test_every_client_gets_the_answer_to_its_own_frame(tmp_path: Path) -> None:
    count = 8

    async with running(tmp_path) as alone:
        single = [figures(await alone.post(npy(points))) for points in clouds(count)]
    async with running(tmp_path, workers=2) as server:
        answers = await asyncio.gather(*(server.post(npy(points)) for points in clouds(count)))
        for found, expected in zip(answers, single, strict=True):
            assert figures(found) == expected, "the analytic model answers from the cloud's own box"
        assert sum(len(worker.asked) for worker in server.workers) == count
        places = [tuple(found["segments"][0]["centroid"]) for found in map(figures, answers)]
        assert len(set(places)) == count, "no two clouds have the same answer"


async def test_weights_health_and_the_page_are_there(tmp_path: Path) -> None:
    async with running(tmp_path) as server:
        (told,) = (await server.client.get("/v1/weights")).json()["weights"]
        assert [one["name"] for one in told["segments"]] == ["big", "small", "absent"]
        assert (told["name"], told["method"], told["calibrated"]) == ("balls", "network", False)
        assert (await server.client.get("/healthz")).json() == {"status": "ok"}
        assert (await server.client.get("/readyz")).status_code == 200
        described = (await server.client.get("/openapi.json")).json()
        asked = described["paths"]["/v1/{weights}/reconstruct"]["post"]
        assert {"depth-range", "unit-m", "keep-all"} <= {p["name"] for p in asked["parameters"]}
        assert "multipart/form-data" in asked["requestBody"]["content"] and "429" in asked["responses"]
        page = (await server.client.get("/docs")).text
        assert "depth-range" in page and "POST /v1/{weights}/reconstruct" in page
        assert "http://" not in page and "https://" not in page and "<script" not in page
        assert "width=device-width" in page and "`" not in page and "<code>error</code>" in page
        assert "Parts of a form: <code>frame</code>, <code>mask</code> (where there is one)" in page
        assert page.count("<td>text/plain<td>Always") == 1 and "<td>503<td>application/json<td>Not ready" in page


async def test_numbers_for_prometheus_count(tmp_path: Path) -> None:
    async with running(tmp_path) as server:
        await server.post(npy())
        await server.post(b"nonsense")
        await server.client.get("/nowhere/17")
        text = (await server.client.get("/metrics")).text
    endpoint = 'endpoint="/v1/{weights}/reconstruct"'
    for line in (
        f'mereo_requests_total{{code="200",{endpoint}}} 1.0',
        f'mereo_requests_total{{code="422",{endpoint}}} 1.0',
        'mereo_requests_total{code="404",endpoint="other"} 1.0',
        f"mereo_request_seconds_count{{{endpoint}}} 2.0",
        'mereo_stage_seconds_count{stage="encode"} 1.0',
        'mereo_stage_seconds_count{stage="wait"} 2.0',
        "mereo_waiting_frames 0.0",
        "mereo_processes 1.0",
    ):
        assert line in text, line


# --- the queue: bounded, fair to clients that leave, whole when a process dies or it ends -----------------------------


def moved(metres: float) -> ndarray:
    return CLOUD + np.array([0.0, 0.0, metres])


def held_up(server: Server) -> ThreadWorker:
    """Its only worker, which answers nothing until it is let go."""
    (worker,) = server.workers
    worker.go.clear()
    return worker


async def begun(server: Server) -> tuple[ThreadWorker, asyncio.Task[httpx2.Response]]:
    """Its held-up worker, and a frame that it has begun."""
    worker = held_up(server)
    first = asyncio.create_task(server.post(npy()))
    await until(worker.begun.is_set)
    return worker, first


async def test_a_full_queue_refuses_and_goes_on(tmp_path: Path) -> None:
    async with running(tmp_path, ServeConfig(queue=2)) as server:
        worker, first = await begun(server)
        waiting = [asyncio.create_task(server.post(npy(moved(n)))) for n in range(2)]
        await until(lambda: server.dispatcher.held == 2)
        refused = await server.post(npy())
        assert refused.status_code == 429 and 1 <= int(refused.headers["retry-after"]) <= 60
        assert "2 frames wait already" in refused.json()["error"]
        assert (await server.client.get("/healthz")).status_code == 200, "while all are busy"
        worker.go.set()
        answers = await asyncio.gather(first, *waiting)
        assert [answer.status_code for answer in answers] == [200] * 3
        assert (await server.post(npy())).status_code == 200


async def test_impatience_leaves_no_work_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 100.0)

    async with running(tmp_path, ServeConfig(timeout=0.3)) as server:
        worker = held_up(server)
        answers = await asyncio.gather(server.post(npy()), server.post(npy()))
        assert [answer.status_code for answer in answers] == [504, 504]
        assert "not answered within 0.3 s" in answers[0].json()["error"]
        assert len(worker.asked) == 1 and server.dispatcher.held == 0
        worker.go.set()
        await until(lambda: not list(tmp_path.iterdir()))
        object.__setattr__(server.service, "config", ServeConfig())  # now there is time
        assert (await server.post(npy())).status_code == 200
        assert len(worker.asked) == 2
        text = (await server.client.get("/metrics")).text
        assert 'mereo_dropped_frames_total{reason="timeout"} 2.0' in text


async def test_a_frame_whose_client_has_left_is_not_begun(tmp_path: Path) -> None:
    async with running(tmp_path) as server:
        worker, first = await begun(server)
        told = asyncio.Event()
        statuses = list[int | None]()
        messages = iter([{"type": "http.request", "body": npy(), "more_body": False}])

        async def receive() -> JsonObject:
            for message in messages:
                return message
            await told.wait()
            return {"type": "http.disconnect"}

        async def send(message: JsonObject) -> None:
            statuses.append(message.get("status"))

        headers = [(b"host", b"localhost"), (b"content-type", b"application/x-npy")]
        scope = {"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST"}
        scope |= {"scheme": "http", "path": ADDRESS, "root_path": "", "query_string": b"", "headers": headers}
        left = asyncio.create_task(server.app(scope, receive, send))
        await until(lambda: server.dispatcher.held == 1)
        told.set()
        await left
        assert server.dispatcher.held == 0 and statuses[0] == 499
        worker.go.set()
        assert (await first).status_code == 200
        assert len(worker.asked) == 1, "only the first was ever begun"
        assert not list(tmp_path.iterdir())


async def test_a_frame_that_ends_its_process_costs_no_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    deadly = npy(np.full((40, 3), 0.6))

    async with running(tmp_path) as server:
        worker, first = await begun(server)
        worker.dies = lambda frame: frame.path.read_bytes() == deadly
        bodies = [npy(moved(1)), deadly, npy(moved(2)), npy(moved(3))]
        rest = [asyncio.create_task(server.post(body)) for body in bodies]
        await until(lambda: server.dispatcher.held == 4)
        worker.go.set()
        answers = await asyncio.gather(first, *rest)
        assert [answer.status_code for answer in answers] == [200, 200, 500, 200, 200]
        assert "has ended over it" in answers[2].json()["error"]
        depths = [figures(answer)["segments"][0]["centroid"][2] for answer in answers if answer.status_code == 200]
        assert_allclose(np.diff(depths), 1.0, atol=0.01)
        assert worker.restarts == 1
        assert server.dispatcher.ready and not list(tmp_path.iterdir())
    assert "it is started again" in caplog.text


async def test_a_process_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 0.002)  # of a minute

    async with running(tmp_path) as server:
        worker = held_up(server)
        found = await server.post(npy())
        assert found.status_code == 500 and "or took far too long" in found.json()["error"]
        monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 2.0)
        worker.dies = lambda message: False
        await until(lambda: worker.restarts == 1 and server.dispatcher.ready)
        assert (await server.post(npy())).status_code == 200


async def test_the_end_answers_what_is_begun_and_refuses_the_rest(tmp_path: Path) -> None:
    async with running(tmp_path) as server:
        worker, first = await begun(server)
        waits = asyncio.create_task(server.post(npy()))
        await until(lambda: server.dispatcher.held == 1)
        server.dispatcher.stop()
        assert (await waits).status_code == 503
        late = await server.post(npy())
        assert late.status_code == 503 and "the server is being stopped" in late.json()["error"]
        assert (await server.client.get("/readyz")).status_code == 503
        worker.go.set()
        assert (await first).status_code == 200
        await until(lambda: not list(tmp_path.iterdir()))


# --- over a real socket -----------------------------------------------------------------------------------------------


@contextmanager
def listening(folder: Path, given: Setup | None = None) -> Iterator[int]:
    worker = ThreadWorker(Answerer.of(given or setup()))
    server = Server(folder, [worker], ServeConfig())
    settings = uvicorn.Config(server.app, http="h11", ws="none", log_level="critical", lifespan="on")
    running_server = uvicorn.Server(settings)
    with bound_socket("127.0.0.1", 0) as place:
        thread = threading.Thread(target=running_server.run, kwargs={"sockets": [place]})
        thread.start()
        while not running_server.started:
            time.sleep(0.01)
        try:
            yield place.getsockname()[1]
        finally:
            running_server.should_exit = True
            thread.join(20)


def test_the_documented_client_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    code, _ = blocks(PAGE, "python")
    assert len(code.splitlines()) <= 16
    (tmp_path / "s").mkdir()
    np.save(tmp_path / "cloud.npy", CLOUD)
    (tmp_path / "bad.ply").write_text("nonsense")
    with listening(tmp_path / "s") as port:
        script = tmp_path / "client.py"
        script.write_text(code.replace(":8000", f":{port}").replace("/bunny/", "/balls/"))
        monkeypatch.setattr(sys, "argv", ["client.py", str(tmp_path / "cloud.npy")])
        runpy.run_path(str(script))
        printed = capsys.readouterr().out.splitlines()
        assert printed[0] == "the object is known: unsure" and printed[1].startswith("big [")
        monkeypatch.setattr(sys, "argv", ["client.py", str(tmp_path / "bad.ply")])
        with pytest.raises(SystemExit, match="422: frame.ply cannot be read as a point cloud"):
            runpy.run_path(str(script))
        # a client that sends on gets to read why not
        with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
            line.sendall(f"POST {ADDRESS} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 900000000\r\n\r\n".encode())
            with contextlib.suppress(OSError):
                line.sendall(bytes(200_000))
            assert line.recv(100).startswith(b"HTTP/1.1 413")
        with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
            line.sendall(b"POST /v1/balls/reconstruct HTTP/1.1\r\nHost: localhost\r\nContent-Length: -5\r\n\r\n")
            assert line.recv(100).startswith(b"HTTP/1.1 400")


def test_the_documented_joints_are_kept(tmp_path: Path, laptop: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    client, address = blocks(PAGE, "python")
    monkeypatch.setattr(sys, "argv", ["client.py", "frame.npy"])
    with listening(tmp_path / "s", laptop) as port:
        code = client.replace("request = ", f"{address}request = ", 1).replace(":8000", f":{port}")
        Path("client.py").write_text(code)
        assert runpy.run_path("client.py")["found"]["joints"]["hinge"]["value"] == pytest.approx(1.51, abs=1e-9)


# --- names and options ------------------------------------------------------------------------------------------------


def test_weights_are_called_by_what_tells_them_apart(tmp_path: Path) -> None:
    given = ("bunny", "learned/weights.safetensors", "old/liver.safetensors", "x=a/b.safetensors")
    found = served_objects(given, ("x=scene.yaml",))
    assert [one.name for one in found] == ["bunny", "learned", "liver", "x"]
    assert found[3] == Served("x", "a/b.safetensors", "scene.yaml") and found[1].weights == given[1]
    bare = served_objects((), (), ("liver=liver.stl,tumor.stl", "parts/arm.stl,parts/hand.stl"))
    assert [(one.name, one.object) for one in bare] == [
        ("liver", ("liver.stl", "tumor.stl")),
        ("arm", ("parts/arm.stl", "parts/hand.stl")),
    ]


@pytest.mark.parametrize(
    "weights, scenes, words",
    [
        ((), (), "no object is given"),
        (("bunny", "bunny"), (), "two objects are called 'bunny'"),
        (("a b=bunny",), (), "'a b' cannot be a part of an address"),
        (("x=",), (), "'x=' is no NAME=FILE"),
        (("bunny",), ("liver=a.yaml",), "--scene is for 'liver', which is not served"),
    ],
)
def test_weights_that_cannot_be_served_are_a_sentence(weights: Any, scenes: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        served_objects(weights, scenes)


def test_an_object_that_is_served_has_one_scene() -> None:
    words = "--scene is for 'x', whose --object says what it is: leave one of them out"
    with pytest.raises(ValueError, match=words):
        served_objects((), ("x=bunny",), ("x=part.stl",))


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.cli.answers.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"fastapi is not installed; .* run pip install 'mereo\[serve\]'"):
        ServeCommand(weights=("bunny",)).run()


def test_a_port_that_is_taken_is_said_before_the_work() -> None:
    with http.server.HTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as other:
        port = other.server_address[1]
        with pytest.raises(OSError, match=f"port {port} is taken"):
            ServeCommand(weights=("bunny",), port=port, workers=1).run()


# --- refusals: each has its status and one sentence, and leaves no trace of what was brought --------------------------


def test_no_default_is_beyond_the_most_of_a_request() -> None:
    with pytest.raises(
        ValueError, match="--resolution is 128, more than --max-resolution 64, which no .*: lower the one"
    ):
        serve((), config=ServeConfig(max_resolution=64))


PLY, TEXT, PNG = ({"Content-Type": kind} for kind in ("application/ply", "text/plain", "image/png"))
HOLES = np.where(CLOUD > 0.58, np.nan, CLOUD)[::2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The server's folder; beside it nothing may change."""
    (tmp_path / "root").mkdir()
    (tmp_path / "secret.npy").write_bytes(npy())
    return tmp_path / "root"


FORM = {"Content-Type": "multipart/form-data; boundary=b"}
LONG = {"Content-Type": f"multipart/form-data; boundary={'b' * 5000}"}


def form(**parts: Any) -> JsonObject:
    return {"files": {"frame": ("a.npy", npy()), **parts}}


def asked(query: str, **request: Any) -> JsonObject:
    return {"address": f"{ADDRESS}?{query}", **(request or {"content": npy()})}


REFUSED = {
    "a damaged cloud": (422, "frame.ply cannot be read as a point cloud (", {"content": b"x", "headers": PLY}),
    "too few points": (422, "the cloud has 3 points", {"content": b"0 0 1\n1 0 1\n0 1 1\n", "headers": TEXT}),
    "missing points": (422, "leave them out with --drop-invalid", {"content": npy(HOLES)}),
    "no camera": (422, "frame.png is a depth image without intrinsics", {"content": b"x", "headers": PNG}),
    "a recording": (415, "format is 'bag'; a frame is one of", asked("format=bag")),
    "no type": (415, "there is no Content-Type", {"content": b"x", "headers": {}}),
    "a picture": (406, "Accept is 'image/png'", {"content": npy(), "headers": NPY | {"Accept": "image/png"}}),
    "an unknown parameter": (422, "there is no parameter 'unitm'", asked("unitm=1")),
    "a word for a number": (422, "unit-m is 'mm'; it must be a valid number", asked("unit-m=mm")),
    "a negative unit": (422, "the unit is -1.0 m; it must be positive", asked("unit-m=-1")),
    "half a range": (422, "depth-range is ['1']; it must be 2 numbers: correct it", asked("depth-range=1")),
    "too many cells": (422, "resolution is 9999; it must be a whole number, from 4 to 256", asked("resolution=9999")),
    "a mask for a cloud": (422, "is read as a point cloud; leave out", form(mask=b"x")),
    "two cameras": (422, "intrinsics are given twice", asked("intrinsics=1", **form(intrinsics=b"x"))),
    "a part too many": (422, "the form has a part 'carry'", form(carry=b"x")),
    "a part twice": (422, "the form has two parts 'frame'", {"files": [("frame", ("a.npy", npy()))] * 2}),
    "no frame": (422, "the form has no part 'frame'", {"files": {"mask": b"x"}}),
    "a frame of no kind": (415, "the part 'frame' has the Content-Type", form(frame=("a.exe", b"x"))),
    "half a form": (400, "the form is cut off", {"content": b"--b\r\n", "headers": FORM}),
    "no form": (400, "the form cannot be read", {"content": b"nonsense", "headers": FORM}),
    "a long boundary": (400, "the form cannot be read (Invalid multipart data.)", {"content": b"x", "headers": LONG}),
    "a frame of a cloud": (422, "frame.npy is one point cloud, not a recording", asked("frame-index=1")),
    "no boundary": (400, "Missing boundary", {"content": b"x", "headers": {"Content-Type": "multipart/form-data"}}),
    "unknown weights": (404, "no weights 'cube' are served; there are balls", {"address": "/v1/cube/reconstruct"}),
    "weights by a path": (404, "is not known", {"address": "/v1/..%2F..%2Fsecret/reconstruct"}),
    "too many points": (413, "frame.npy has 1200 points; at most 1000 are answered here", {"content": npy()}),
}


async def test_each_refusal_is_a_status_and_a_sentence(root: Path, tmp_path: Path) -> None:
    async with running(root, given=setup(max_points=1000)) as server:
        for name, (status, words, request) in REFUSED.items():
            found = await server.post(**request)
            assert found.status_code == status, (name, found.text)
            (said,) = found.json().values()
            assert words in said and len(said.splitlines()) == 1 and str(tmp_path) not in said, (name, said)
        assert (await server.client.get(ADDRESS)).status_code == 405
        assert server.dispatcher.held == 0
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["root", "secret.npy"]
    assert not list(root.iterdir())


async def test_no_name_of_a_client_is_a_path(root: Path, tmp_path: Path) -> None:
    (root / "link.npy").symlink_to(tmp_path / "secret.npy")
    tricks = ("../secret.npy", "/etc/passwd.npy", "..\\..\\secret.npy", "link.npy", "a\0.npy", "x/" * 500 + "a.npy")

    async with running(root) as server:
        whole = figures(await server.post(npy()))
        assert whole["title"] == whole["source"] == "frame.npy"
        for name in tricks:
            found = await server.post(files={"frame": (name, npy())})
            assert found.status_code == 200, (name, found.text)
            assert figures(found) == whole, name
        camera = f'{{"fx": 1, "include": "{tmp_path}/secret.npy"}}'
        found = await server.post(address=f"{ADDRESS}?format=png", params={"intrinsics": camera}, content=b"x")
        assert found.status_code == 415 or "secret" not in found.text
    assert (tmp_path / "secret.npy").read_bytes() == npy() and len(list(tmp_path.iterdir())) == 2
    assert [path.name for path in root.iterdir()] == ["link.npy"]


async def test_a_body_is_counted_as_it_comes(root: Path) -> None:
    sent = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal sent
        while sent < 5_000_000:
            sent += 10_000
            yield bytes(10_000)

    async with running(root, ServeConfig(max_body_mb=0.1)) as server:
        found = await server.post(endless())
        assert found.status_code == 413 and "the body has more than 0.1 MB" in found.json()["error"]
        assert sent < 500_000, "of what is left no more is taken than a body may have"
        assert (await server.post(bytes(200_000))).status_code == 413
        parts = await server.post(files={"frame": ("a.npy", bytes(200_000))})
        assert parts.status_code == 413
        assert not list(root.iterdir()) and server.dispatcher.held == 0
        assert (await server.post(npy())).status_code == 200


async def test_a_body_that_does_not_come_is_not_waited_for(root: Path) -> None:
    async def slow() -> AsyncIterator[bytes]:
        yield npy()[:100]
        await asyncio.sleep(20)

    async with running(root, ServeConfig(timeout=0.2)) as server:
        found = await server.post(slow())
        assert found.status_code == 408 and "has not come within 0.2 s" in found.json()["error"]
        assert server.dispatcher.held == 0 and not list(root.iterdir())


async def test_what_unpacks_to_too_much_is_refused(root: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**15, 3)})
    async with running(root) as server:
        found = await server.post(zipped({"points.npy": header.getvalue()}), f"{ADDRESS}?format=npz")
        assert found.status_code == 413 and "frame.npz takes more than 8 GB" in found.json()["error"]


async def test_a_fault_of_the_server_is_logged_and_not_told(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise KeyError("inner secret")

    monkeypatch.setattr("mereo_serving.answering.find_object", fail)

    async with running(root) as server:
        found = await server.post(npy())
        assert found.status_code == 500
        assert found.json()["error"].startswith("the frame cannot be answered for a fault of the server")
    assert "inner secret" in caplog.text and "Traceback" in caplog.text


async def test_damaged_bodies_are_never_a_fault(root: Path) -> None:
    boundary = b"--b\r\nContent-Disposition: form-data; name="
    form = (
        boundary + b'"frame"; filename="a.npy"\r\n\r\n' + npy(CLOUD[::8]) + b"\r\n"
        + boundary + b'"intrinsics"\r\nContent-Type: application/json\r\n\r\n{"fx": 1}\r\n--b--\r\n'
    )  # fmt: skip
    kinds = {"multipart/form-data; boundary=b": form, "application/x-npy": npy(CLOUD[::8])}

    async with running(root, ServeConfig(max_body_mb=1)) as server:
        for kind, whole in kinds.items():
            for number in range(60):
                content = damaged(whole, Random(f"serving/{kind}/{number}"))
                found = await server.post(content, headers={"Content-Type": kind})
                assert found.status_code in (200, 400, 413, 415, 422), (kind, number, found.text)
                if found.status_code != 200:
                    assert len(json.loads(found.content)["error"].splitlines()) == 1, (kind, number)
        assert not list(root.iterdir()) and server.dispatcher.held == 0
        await until(lambda: server.dispatcher.ready)


async def test_others_than_this_machine_need_the_token(root: Path) -> None:
    async with running(root) as server:
        client = server.client
        for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
            assert (await client.get("/healthz", headers=headers)).status_code == 403
            assert (await server.post(npy(), headers=NPY | headers)).status_code == 403
    async with running(root, token="word") as server:
        client = server.client
        assert (await client.get("/v1/weights")).status_code == 401
        assert (await client.get("/v1/weights?token=wrong")).status_code == 401
        refused = await server.post(npy(), headers=NPY | {"Authorization": "Bearer wrong"})
        assert refused.status_code == 401 and refused.headers["www-authenticate"] == "Bearer"
        assert "there is no token, or another one" in refused.json()["error"]
        assert (await client.get("/healthz")).status_code == 200
        assert (await client.get("/metrics")).status_code == 401
        assert (await server.post(npy(), headers=NPY | {"Authorization": "Bearer word"})).status_code == 200
        assert (await server.post(npy(), f"{ADDRESS}?token=word&unit-m=1")).status_code == 200
        assert (
            await client.get("/v1/weights?token=word", headers={"Origin": "http://evil.example"})
        ).status_code == 403


# --- the server as it is run: processes, signals, and clients that ask all the time -----------------------------------


def get(port: int, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=20) as answer:
        return answer.read()


def workers_of(server: Any) -> list[int]:
    return [pid for pid, mb in bench.resident_mb(server.pid).items() if pid != server.pid and mb > 150]


def wait_for_the_end_of(processes: list[int]) -> None:
    browser.until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in processes), 10)


@pytest.mark.slow
def test_twenty_seconds_of_four_clients_and_the_end(tmp_path: Path) -> None:
    address = "/v1/{weights}/reconstruct"
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    frames, _ = bench.one_after_the_other(bench.frames_of(["rope"], 6, tmp_path), "modes", 24, tmp_path)
    arguments = ("--weights", "rope", "--method", "modes", "--resolution", "24", "--workers", "2")
    with bench.served(*arguments, scratch=scratch) as (server, port):
        seen = bench.load(port, frames, 4, 20.0, address, lambda _: None)
        assert set(seen.counts) == {"right"} and seen.counts["right"] >= 10
        workers = workers_of(server)
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        before = bench.load(port, frames, 4, 3.0, address, lambda _: None).counts
        assert before["right"] > 0 and before["wrong"] == before["lost"] == 0 and before["500"] <= 1
        browser.until(lambda: b"mereo_restarts_total 1.0" in get(port, "/metrics"), 30)
        assert json.loads(get(port, "/readyz")) == {"status": "ready"}
        workers = workers_of(server)

        tallies = [bench.Tally() for _ in range(4)]
        ended = threading.Event()
        threads = [
            threading.Thread(target=bench.client, args=(port, frames, n, lambda: not ended.is_set(), address, tally))
            for n, tally in enumerate(tallies)
        ]
        for thread in threads:
            thread.start()
        time.sleep(2.0)
        server.send_signal(signal.SIGTERM)
        ended.set()
        assert server.wait(30) == 128 + signal.SIGTERM
        for thread in threads:
            thread.join(20)
        told = sum((tally.counts for tally in tallies), start=type(tallies[0].counts)())
        assert told["wrong"] == told["lost"] == told["500"] == 0, told
        assert set(told) <= {"right", "503"}, told
        wait_for_the_end_of(workers)
    assert not list(scratch.glob(".mereo-serve*")), "what requests brought is removed"


@pytest.mark.slow
def test_processes_end_with_a_server_that_is_killed(tmp_path: Path) -> None:
    with bench.served("--weights", "rope", "--method", "network", "--workers", "1", scratch=tmp_path) as (server, _):
        workers = workers_of(server)
        server.send_signal(signal.SIGKILL)
        server.wait(20)
        wait_for_the_end_of(workers)
