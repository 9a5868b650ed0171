"""Answers over HTTP are those of the command line, whoever asks beside, and each goes to its own client."""

import asyncio
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("fastapi", reason="fastapi (extra `serve`) is not installed")
pytest.importorskip("python_multipart", reason="python-multipart (extra `serve`) is not installed")

from camera_files import write_camera
from PIL import Image
from serving_parts import ADDRESS, CLOUD, NPY, balls, figures, npy, run, running

import mereo
from mereo.cli.answers import ReconstructCommand
from mereo.cli.reconstruct import FrameJob, reconstruct_file
from mereo.io.config import InputConfig
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.sensor_frame import read_frame
from mereo.models.config import InferenceConfig
from mereo.models.model import Model
from mereo.synthesis.sample_views import load_view
from mereo_serving.messages import GLB, Served, Setup

EXACT = InferenceConfig(precision="float32")


@pytest.fixture(autouse=True)
def analytic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", balls)


@pytest.fixture
def rope_only(rope: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: rope)


def test_the_answer_is_that_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: replace(balls(), name="balls"))
    np.save(tmp_path / "frame.npy", CLOUD)
    options = ReconstructCommand((), weights="any", resolution=12, inference=EXACT, method="network")
    reconstruct_file(tmp_path / "frame.npy", tmp_path / "out", FrameJob(options))
    expected = figures((tmp_path / "out/summary.json").read_bytes())

    async def ask() -> None:
        async with running(tmp_path / "s") as server:
            found = await server.post(npy())
            assert found.status_code == 200, found.text
            assert figures(found) == {**expected, "warnings": []}
            assert found.headers["content-type"] == "application/json"
            assert (found.headers["mereo-known"], found.headers["mereo-answer"]) == ("unsure", "network")
            surfaces = await server.post(npy(), headers=NPY | {"Accept": GLB})
            assert surfaces.headers["content-type"] == GLB
            assert surfaces.content == (tmp_path / "out/segments.glb").read_bytes()

    (tmp_path / "s").mkdir()
    run(ask())
    assert not list((tmp_path / "s").iterdir()), "what requests brought is removed"


def test_what_is_told_is_in_the_words_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose options are the parameters of the address."""
    large = replace(balls(), provenance={"visible_m": [2, 3]})
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: large)

    async def ask() -> None:
        async with running(tmp_path) as server:
            assert figures(await server.post(npy()))["warnings"] == [], "of no unit that anybody has said"
            (told,) = figures(await server.post(npy(), f"{ADDRESS}?unit-m=1"))["warnings"]
            assert "the visible part is 0.18 m long, but 2 to 3 m in training" in told
            assert "--unit-m 0.001" in told and "--box" in told

    run(ask())


def test_a_depth_image_is_registered_as_alone(tmp_path: Path, rope: Model, rope_only: None) -> None:
    """Intrinsics as a part and in the address, and a mask; surfaces with how sure they are."""
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

    async def ask() -> None:
        given = Setup((Served("balls", "rope"),), "modes", EXACT)
        async with running(tmp_path / "s", given=given) as server:
            parts = {**files, "intrinsics": ("c.json", camera.read_bytes())}
            found = await server.post(address=address, files=parts)
            assert found.status_code == 200, found.text
            told = figures(found)
            assert told.pop("warnings") == [] and told == {**expected, "weights": "balls"}
            assert told["registration"]["answer"] == found.headers["mereo-answer"] == "registration"
            assert told["recognition"]["known"] is True and found.headers["mereo-known"] == "true"
            assert told["radius95"]["median"] > 0 and "centroid_radius95" in told["segments"][0]
            again = await server.client.post(
                address, params={"intrinsics": camera.read_text(), "depth-scale": 20_000}, files=files,
                headers={"Accept": GLB},
            )  # fmt: skip
            assert again.content == alone.save(tmp_path / "segments.glb").read_bytes()
            (tmp_path / "served.glb").write_bytes(again.content)

    (tmp_path / "s").mkdir()
    run(ask())
    length = struct.unpack("<I", (tmp_path / "served.glb").read_bytes()[12:16])[0]
    document = json.loads((tmp_path / "served.glb").read_bytes()[20 : 20 + length])
    assert all("_RADIUS95" in mesh["primitives"][0]["attributes"] for mesh in document["meshes"])
    names = [segment["name"] for segment in expected["segments"]]
    assert set(trimesh.load(tmp_path / "served.glb").geometry) == set(names)
    assert read_segmented_mesh(tmp_path / "served.glb").names == tuple(names)


def clouds(count: int) -> Iterator[np.ndarray]:
    """Different ones: of another size, at another place, of other points."""
    for number in range(count):
        rng = np.random.default_rng(number)
        kept = np.sort(rng.choice(len(CLOUD), 700 + 20 * number, replace=False))
        yield CLOUD[kept] * (1 + 0.1 * number) + [0.01 * number, 0.0, 0.02 * number]


def test_every_client_gets_the_answer_to_its_own_frame(tmp_path: Path) -> None:
    """Bit by bit, whether it comes alone or with others."""
    count = 8

    async def ask() -> None:
        async with running(tmp_path) as alone:
            single = [figures(await alone.post(npy(points))) for points in clouds(count)]
        async with running(tmp_path, workers=2) as server:
            answers = await asyncio.gather(*(server.post(npy(points)) for points in clouds(count)))
            for found, expected in zip(answers, single, strict=True):
                assert figures(found) == expected, "the analytic model answers from the cloud's own box"
            assert sum(len(worker.asked) for worker in server.workers) == count
            places = [tuple(found["segments"][0]["centroid"]) for found in map(figures, answers)]
            assert len(set(places)) == count, "no two clouds have the same answer"

    run(ask())


def test_weights_health_and_the_page_are_there(tmp_path: Path) -> None:
    async def ask() -> None:
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

    run(ask())


def test_numbers_for_prometheus_count(tmp_path: Path) -> None:
    async def ask() -> None:
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

    run(ask())
