"""What a server refuses: each with its status and one sentence, and without a trace of what was brought."""

import asyncio
import io
import json
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="fastapi (extra `serve`) is not installed")
pytest.importorskip("python_multipart", reason="python-multipart (extra `serve`) is not installed")

from fuzz import damaged
from serving_parts import ADDRESS, CLOUD, NPY, balls, figures, npy, run, running, setup, until

from mereo.io.errors import LIMIT_VARIABLE
from mereo_serving.config import ServeConfig

PLY = {"Content-Type": "application/ply"}
TEXT = {"Content-Type": "text/plain"}
PNG = {"Content-Type": "image/png"}
HOLES = np.where(CLOUD > 0.58, np.nan, CLOUD)[::2]


@pytest.fixture(autouse=True)
def analytic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", balls)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The server's folder; beside it nothing may change."""
    (tmp_path / "root").mkdir()
    (tmp_path / "secret.npy").write_bytes(npy())
    return tmp_path / "root"


FORM = {"Content-Type": "multipart/form-data; boundary=b"}
LONG = {"Content-Type": f"multipart/form-data; boundary={'b' * 5000}"}
LINE = np.linspace(0.1, 1.0, 600)[:, None] * [1.0, 0.5, 2.0]


def form(**parts: Any) -> dict[str, Any]:
    """Request with these parts beside a whole frame."""
    return {"files": {"frame": ("a.npy", npy()), **parts}}


def asked(query: str, **request: Any) -> dict[str, Any]:
    """Request with these parameters."""
    return {"address": f"{ADDRESS}?{query}", **(request or {"content": npy()})}


REFUSED: dict[str, tuple[int, str, dict[str, Any]]] = {
    "a damaged cloud": (422, "frame.ply cannot be read as a point cloud (", {"content": b"x", "headers": PLY}),
    "an empty body": (422, "frame.ply is empty (0 bytes)", {"content": b"", "headers": PLY}),
    "too few points": (422, "the cloud has 3 points", {"content": b"0 0 1\n1 0 1\n0 1 1\n", "headers": TEXT}),
    "missing points": (422, "leave them out with --drop-invalid", {"content": npy(HOLES)}),
    "no camera": (422, "frame.png is a depth image without intrinsics", {"content": b"x", "headers": PNG}),
    "a recording": (415, "format is 'bag'; a frame is one of", asked("format=bag")),
    "no type": (415, "there is no Content-Type", {"content": b"x", "headers": {}}),
    "a picture": (406, "Accept is 'image/png'", {"content": npy(), "headers": NPY | {"Accept": "image/png"}}),
    "an unknown parameter": (422, "there is no parameter 'unitm'", asked("unitm=1")),
    "a word for a number": (422, "unit-m is 'mm'; it must be a valid number", asked("unit-m=mm")),
    "no number": (422, "unit-m is 'nan'; it must be", asked("unit-m=nan")),
    "a negative unit": (422, "the unit is -1.0 m; it must be positive", asked("unit-m=-1")),
    "half a range": (422, "depth-range has 1 numbers; it needs 2", asked("depth-range=1")),
    "a range backwards": (422, "the depth range is 0.9 0.4", asked("depth-range=0.9,0.4")),
    "a word in a box": (422, "box is 'a'; it must be", asked("box=a,b")),
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
    "a frame before the first": (
        422,
        "--frame-index is -1; it must be a whole number, at least 0",
        asked("frame-index=-1"),
    ),
    "a frame of a cloud": (422, "frame.npy is one point cloud, not a recording", asked("frame-index=1")),
    "points on a line": (422, "the 600 points of frame.npy lie on a line", {"content": npy(LINE)}),
    "no boundary": (400, "Missing boundary", {"content": b"x", "headers": {"Content-Type": "multipart/form-data"}}),
    "unknown weights": (404, "no weights 'cube' are served; there are balls", {"address": "/v1/cube/reconstruct"}),
    "weights by a path": (404, "is not known", {"address": "/v1/..%2F..%2Fsecret/reconstruct"}),
    "too many points": (413, "frame.npy has 1200 points; at most 1000 are answered here", {"content": npy()}),
}


def test_each_refusal_is_a_status_and_a_sentence(root: Path, tmp_path: Path) -> None:
    async def ask() -> None:
        async with running(root, given=setup(max_points=1000)) as server:
            for name, (status, words, request) in REFUSED.items():
                found = await server.post(**request)
                assert found.status_code == status, (name, found.text)
                (said,) = found.json().values()
                assert words in said and len(said.splitlines()) == 1 and str(tmp_path) not in said, (name, said)
            assert (await server.client.get(ADDRESS)).status_code == 405
            assert server.dispatcher.held == 0

    run(ask())
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["root", "secret.npy"]
    assert not list(root.iterdir())


def test_no_name_of_a_client_is_a_path(root: Path, tmp_path: Path) -> None:
    (root / "link.npy").symlink_to(tmp_path / "secret.npy")
    tricks = (
        "../secret.npy",
        "/etc/passwd.npy",
        "..\\..\\secret.npy",
        "link.npy",
        "a\0.npy",
        "x/" * 500 + "a.npy",
        "é.npy",
    )

    async def ask() -> None:
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

    run(ask())
    assert (tmp_path / "secret.npy").read_bytes() == npy() and len(list(tmp_path.iterdir())) == 2
    assert [path.name for path in root.iterdir()] == ["link.npy"]


def test_a_body_is_counted_as_it_comes(root: Path) -> None:
    """Without Content-Length, with one that is too large, and with one that lies."""
    sent = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal sent
        while sent < 5_000_000:
            sent += 10_000
            yield bytes(10_000)

    async def ask() -> None:
        async with running(root, ServeConfig(max_body_mb=0.1)) as server:
            found = await server.post(endless())
            assert found.status_code == 413 and "the body has more than 0.1 MB" in found.json()["error"]
            assert sent < 500_000, "of what is left no more is taken than a body may have"
            assert (await server.post(bytes(200_000))).status_code == 413
            parts = await server.post(files={"frame": ("a.npy", bytes(200_000))})
            assert parts.status_code == 413
            assert not list(root.iterdir()) and server.dispatcher.held == 0
            assert (await server.post(npy())).status_code == 200

    run(ask())


def test_a_body_that_does_not_come_is_not_waited_for(root: Path) -> None:
    async def slow() -> AsyncIterator[bytes]:
        yield npy()[:100]
        await asyncio.sleep(20)

    async def ask() -> None:
        async with running(root, ServeConfig(timeout=0.2)) as server:
            found = await server.post(slow())
            assert found.status_code == 408 and "has not come within 0.2 s" in found.json()["error"]
            assert server.dispatcher.held == 0 and not list(root.iterdir())

    run(ask())


def test_what_unpacks_to_too_much_is_refused(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "0.5")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(1_000_000_000))
    assert len(packed.getvalue()) < 1_100_000

    async def ask() -> None:
        async with running(root) as server:
            found = await server.post(packed.getvalue(), f"{ADDRESS}?format=npz")
            assert found.status_code == 413 and "frame.npz takes more than 0.5 GB" in found.json()["error"]

    run(ask())


def test_a_fault_of_the_server_is_logged_and_not_told(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise KeyError("inner secret")

    monkeypatch.setattr("mereo_serving.answering.find_object", fail)

    async def ask() -> None:
        async with running(root) as server:
            found = await server.post(npy())
            assert found.status_code == 500
            assert found.json()["error"].startswith("the frame cannot be answered for a fault of the server")

    run(ask())
    assert "inner secret" in caplog.text and "Traceback" in caplog.text


def test_damaged_bodies_are_never_a_fault(root: Path) -> None:
    boundary = b"--b\r\nContent-Disposition: form-data; name="
    form = (
        boundary + b'"frame"; filename="a.npy"\r\n\r\n' + npy(CLOUD[::8]) + b"\r\n"
        + boundary + b'"intrinsics"\r\nContent-Type: application/json\r\n\r\n{"fx": 1}\r\n--b--\r\n'
    )  # fmt: skip
    kinds = {"multipart/form-data; boundary=b": form, "application/x-npy": npy(CLOUD[::8])}

    async def ask() -> None:
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

    run(ask())


def test_others_than_this_machine_need_the_token(root: Path) -> None:
    async def ask() -> None:
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

    run(ask())
