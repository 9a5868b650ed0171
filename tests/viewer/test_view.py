"""`mereo view`: its pages in a real browser, and its command."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, Page, pixels_of, until
from PIL import Image
from toy_scene import rest_mesh

from mereo.geometry.camera import PointCloud
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION
from mereo.visualization.color_scales import ColorScale
from mereo.visualization.units import Unit
from mereo_viewer import server as viewer_server
from mereo_viewer.display import chips, heading, message
from mereo_viewer.result_page import Content, Probed, ResultPage, probe_html

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)


def toy_content() -> Content:
    """The toy, 150 units in front of a camera; a point is in the box that holds it, or in nothing."""
    T_camera_rest = np.eye(4)
    T_camera_rest[2, 3] = 150.0
    mesh = rest_mesh().transformed(T_camera_rest)
    points = np.concatenate([segment.vertices[::2] for segment in mesh.segments])
    cloud = PointCloud(points[points[:, 2] <= 162.0])

    def ask(points: np.ndarray) -> Probed:
        label = np.where(np.abs(points[:, 1]) < 6, 1 + np.clip((points[:, 0] + 18) // 12, 0, 2), 0).astype(np.uint8)
        toward = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        return Probed(label, points[:, 2] - 150.0, toward, np.eye(5)[label])

    def by_depth() -> tuple[list[np.ndarray], ColorScale]:
        scale = ColorScale("depth of the toy", 130.0, 170.0, ((0, 0, 0), (250, 250, 250)), ("near", "far"))
        return [scale.colors(segment.vertices[:, 2]) for segment in mesh.segments], scale

    up = GLTF_CAMERA_ROTATION
    colorings = {"depth": by_depth}
    return Content(
        "toy <frame>", "7 facts", "closed form, of course", mesh, Unit(0.001), up, cloud, None, colorings, ask
    )


@needs_viser
@needs_browser
def test_the_page_of_a_frame_shows_every_segment_and_answers(tmp_path: Path, server: object) -> None:
    page = ResultPage(server, toy_content())
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (760, 480)) as browser:  # type: ignore[attr-defined]
        until(lambda: "toy <frame>" in browser.text())
        browser.still()
        words = {"box_0", "box_1", "box_2", "ball", "Probe", "closed form, of course"}
        assert words <= set(browser.text().split("\n"))

        def all_shown() -> bool:
            shown = browser.screenshot()[:, :420]
            Image.fromarray(shown).save(tmp_path / "page.png")
            return all(pixels_of(shown, segment.color) > 150 for segment in page.content.mesh.segments)

        until(all_shown)
        # the middle of the stage lies in the middle box: a click there asks the model
        browser.click(220, 250)
        until(lambda: "the nearest surface" in browser.text())
        assert re.search(r"box_\d at -?[\d.,]+", browser.text())
        page.coloring.value = "depth"
        until(lambda: "depth of the toy" in browser.text())


@needs_viser
def test_points_give_way_to_colours_and_a_probe_is_shown(server: object) -> None:
    page = ResultPage(server, toy_content())
    nodes = server.scene._handle_from_node_name  # type: ignore[attr-defined]
    assert nodes["/cloud"].visible and page.legend.visible is False
    page.coloring.value = "depth"
    assert not nodes["/cloud"].visible and page.legend.visible
    page.coloring.value = "segment"
    assert nodes["/cloud"].visible
    page.move_probe(np.array([0.0, 0.0, 148.0]))
    assert "box_1" in page.facts.content and "2 mm inside the nearest surface" in page.facts.content
    assert nodes["/probe"].visible and nodes["/arrow"].visible


def first_message(port: int, host: str, origin: str | None) -> bytes:
    """First message of the websocket, of which a page of ``origin`` asks the name ``host``."""
    from viser import __version__ as version
    from websockets.sync.client import connect

    with (
        socket.create_connection(("127.0.0.1", port), timeout=20) as line,
        connect(f"ws://{host}", sock=line, origin=origin, subprotocols=[f"viser-v{version}"]) as page,  # type: ignore[arg-type, list-item]
    ):
        return bytes(page.recv(timeout=20))  # type: ignore[arg-type]


@needs_viser
@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]"])
def test_its_own_page_gets_the_scene(server: object, name: str) -> None:
    port = server.get_port()  # type: ignore[attr-defined]
    assert first_message(port, f"{name}:{port}", f"http://{name}:{port}")
    assert first_message(port, f"{name}:{port}", None), "programs other than browsers"
    assert first_message(port, f"{name}:9000", f"http://{name}:9000"), "the end of a tunnel"


@needs_viser
@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "null", "http://127.0.0.1.evil.example", "http://127.0.0.2", "https://127.0.0.1"),
        *("http://user@127.0.0.1", "http://evil.example:{port}"),
    ],
)
def test_a_page_of_another_address_gets_nothing(server: object, origin: str) -> None:
    """The last one is a name that is made to mean 127.0.0.1: page and websocket then have the same address."""
    from websockets.exceptions import InvalidStatus

    port = server.get_port()  # type: ignore[attr-defined]
    origin = origin.format(port=port)
    host = origin.removeprefix("http://") if origin.endswith(f":{port}") else f"127.0.0.1:{port}"
    with pytest.raises(InvalidStatus, match="403"):
        first_message(port, host, origin)


@needs_viser
def test_a_viser_that_starts_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "local_pages_only", lambda: contextlib.nullcontext([]))
    with pytest.raises(ImportError, match="starts its server in a way that mereo cannot close to other web pages"):
        viewer_server.start_server(0)


@needs_viser
def test_a_page_is_on_this_machine_only_and_a_taken_port_is_said(server: object) -> None:
    port = server.get_port()  # type: ignore[attr-defined]
    assert server.get_host() == "127.0.0.1"  # type: ignore[attr-defined]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as answer:
        assert answer.status == 200
    with pytest.raises(OSError, match=f"port {port} is taken or not allowed; choose another one with --port"):
        viewer_server.start_server(port)


@needs_viser
@pytest.mark.slow
def test_the_command_prints_where_the_page_is_and_ends_cleanly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mereo", "view", "--object", "robot", "--port", "0"]
    variables = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables) as process:
        try:
            assert process.stdout and process.stderr
            line = process.stdout.readline()
            address = re.search(r"open (http://127\.0\.0\.1:\d+) in a browser", line)
            assert address, line
            with urllib.request.urlopen(address[1], timeout=60) as answer:
                assert b"<html" in answer.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
            assert process.stdout.read() == "closed\n"
            progress = process.stderr.read().splitlines()  # of stages that take seconds, on a machine that is busy
            assert [line for line in progress if not line.endswith("so far")] == []
        finally:
            process.kill()


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("--weights", "lizard"), "none is shipped for 'lizard'; name a depth image or a point cloud"),
        (("cloud.ply",), "cloud.ply is given without its object: name the object's meshes or scene with --object"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_sentence(
    arguments: tuple[str, ...], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mereo.__main__ import main

    monkeypatch.setattr("mereo.api.view.import_viser", lambda: None)
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mereo: error: ") and error.count("\n") == 1
    assert sentence in error


def test_without_viser_one_sentence_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mereo.__main__ import main

    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view"]) == 2
    assert "`mereo view` needs it: run pip install 'mereo[view]'" in capsys.readouterr().err


def test_names_cannot_break_the_panels() -> None:
    name = "<script>x</script>"
    answer = Probed(
        np.array([1], dtype=np.uint8),
        np.array([-0.002]),
        np.array([[0.0, 1.0, 0.0]]),
        np.array([[0.25, 0.75]]),
        np.array([[4.0, 5.0, 6.0]]),
    )
    place = np.array([0.001, 0.002, 0.003])
    text = probe_html(answer, ("empty", name), ((0, 0, 0), (1, 2, 3)), place, Unit(1.0))
    shown = re.sub(r"<[^>]+>", " ", text)
    assert "<script" not in text + chips((name,), ((1, 2, 3),)) + heading(name, name) + message(name)
    for told in (
        "0.75",
        "2 mm inside the nearest surface",
        "towards 0, 1, 0",
        "at 1 2 3 mm",
        "at rest at 4, 5, 6 scene units",
    ):
        assert told in shown
    assert shown.index("0.75") < shown.index("0.25")  # the likeliest first
