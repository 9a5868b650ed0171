"""The queue of a server: bounded, fair to clients that leave or lose patience, whole when a process dies or it ends."""

import asyncio
import contextlib
import http.server
import re
import runpy
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="fastapi (extra `serve`) is not installed")
pytest.importorskip("python_multipart", reason="python-multipart (extra `serve`) is not installed")

import uvicorn
from serving_parts import ADDRESS, CLOUD, Server, ThreadWorker, balls, figures, npy, run, running, setup, until

from mereo.cli.answers import ServeCommand
from mereo_serving.answering import Answerer
from mereo_serving.config import ServeConfig
from mereo_serving.gate import bound_socket
from mereo_serving.messages import Served
from mereo_serving.server import served_objects

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def analytic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", balls)


def moved(metres: float) -> np.ndarray:
    """The cloud, farther away."""
    return CLOUD + np.array([0.0, 0.0, metres])


def held_up(server: Server) -> ThreadWorker:
    """Its only worker, which answers nothing until it is let go."""
    (worker,) = server.workers
    worker.go.clear()
    return worker


def test_a_full_queue_refuses_and_goes_on(tmp_path: Path) -> None:
    async def ask() -> None:
        async with running(tmp_path, ServeConfig(queue=2)) as server:
            worker = held_up(server)
            first = asyncio.create_task(server.post(npy()))
            await until(worker.begun.is_set)
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

    run(ask())


def test_impatience_leaves_no_work_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is begun is finished and its answer dropped; what waits is never begun."""
    monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 100.0)

    async def ask() -> None:
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

    run(ask())


def test_a_frame_whose_client_has_left_is_not_begun(tmp_path: Path) -> None:
    async def ask() -> None:
        async with running(tmp_path) as server:
            worker = held_up(server)
            first = asyncio.create_task(server.post(npy()))
            await until(worker.begun.is_set)
            told, statuses = asyncio.Event(), list[int | None]()
            messages = iter([{"type": "http.request", "body": npy(), "more_body": False}])

            async def receive() -> dict[str, Any]:
                for message in messages:
                    return message
                await told.wait()
                return {"type": "http.disconnect"}

            async def send(message: dict[str, Any]) -> None:
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

    run(ask())


def test_a_frame_that_ends_its_process_costs_no_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One of four that wait is deadly: it alone is refused, and the process is started again."""
    deadly = npy(np.full((40, 3), 0.6))

    async def ask() -> None:
        async with running(tmp_path) as server:
            (worker,) = server.workers

            worker.dies = lambda frame: frame.path.read_bytes() == deadly
            worker.go.clear()
            first = asyncio.create_task(server.post(npy()))
            await until(worker.begun.is_set)
            bodies = [npy(moved(1)), deadly, npy(moved(2)), npy(moved(3))]
            rest = [asyncio.create_task(server.post(body)) for body in bodies]
            await until(lambda: server.dispatcher.held == 4)
            worker.go.set()
            answers = await asyncio.gather(first, *rest)
            assert [answer.status_code for answer in answers] == [200, 200, 500, 200, 200]
            assert "has ended over it" in answers[2].json()["error"]
            depths = [figures(answer)["segments"][0]["centroid"][2] for answer in answers if answer.status_code == 200]
            np.testing.assert_allclose(np.diff(depths), 1.0, atol=0.01)
            assert worker.restarts == 1
            assert server.dispatcher.ready and not list(tmp_path.iterdir())

    run(ask())
    assert "it is started again" in caplog.text


def test_a_process_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 0.002)  # of a minute

    async def ask() -> None:
        async with running(tmp_path) as server:
            worker = held_up(server)
            found = await server.post(npy())
            assert found.status_code == 500 and "or took far too long" in found.json()["error"]
            monkeypatch.setattr("mereo_serving.dispatcher.HANGS", 2.0)
            worker.dies = lambda message: False
            await until(lambda: worker.restarts == 1 and server.dispatcher.ready)
            assert (await server.post(npy())).status_code == 200

    run(ask())


def test_the_end_answers_what_is_begun_and_refuses_the_rest(tmp_path: Path) -> None:
    async def ask() -> None:
        async with running(tmp_path) as server:
            worker = held_up(server)
            first = asyncio.create_task(server.post(npy()))
            await until(worker.begun.is_set)
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

    run(ask())


# --- over a real socket -----------------------------------------------------------------------------------------------


@contextmanager
def listening(folder: Path) -> Iterator[int]:
    """A server of uvicorn's in a thread; its port."""
    worker = ThreadWorker(Answerer.of(setup()))
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


def test_the_client_of_the_documentation_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/serving.md").read_text(), re.DOTALL)
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


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.cli.answers.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"fastapi is not installed; .* run pip install 'mereo\[serve\]'"):
        ServeCommand(weights=("bunny",)).run()


def test_a_port_that_is_taken_is_said_before_the_work() -> None:
    with http.server.HTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as other:
        port = other.server_address[1]
        with pytest.raises(OSError, match=f"port {port} is taken"):
            ServeCommand(weights=("bunny",), port=port, workers=1).run()
