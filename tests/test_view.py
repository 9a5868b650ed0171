"""`mereo view`: its pages in a real browser, and its command."""

import gc
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, Page, pixels_of, until
from PIL import Image
from toy_scene import rest_mesh, toy_scene

from mereo.geometry.camera import PointCloud
from mereo.models.model import Model
from mereo.models.network import Network
from mereo.training.config import PRESETS
from mereo.visualization.units import Unit
from mereo.visualization.viewer import display, html, open_page
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.lab_page import LabPage
from mereo.visualization.viewer.laboratory import Laboratory
from mereo.visualization.viewer.probe import Inspection, Probed

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)


class Told(Inspection):
    """An inspection whose answers are a closed form: the label is the box that holds a point, or nothing."""

    def ask(self, points: np.ndarray) -> Probed:
        label = np.where(np.abs(points[:, 1]) < 6, 1 + np.clip((points[:, 0] + 18) // 12, 0, 2), 0).astype(np.uint8)
        toward = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        return Probed(label, points[:, 2] - 150.0, toward, np.eye(5)[label], None)


def toy_inspection() -> Told:
    """The toy, 150 units in front of a camera."""
    T_camera_rest = np.eye(4)
    T_camera_rest[2, 3] = 150.0
    mesh = rest_mesh().transformed(T_camera_rest)
    points = np.concatenate([segment.vertices[::2] for segment in mesh.segments])
    cloud = PointCloud(points[points[:, 2] <= 162.0])
    model = Model(Network(PRESETS["tiny"].network, 4).eval(), mesh.names, mesh.colors)
    return Told(mesh, np.eye(4), model, "closed form, of course", cloud, model.encode(cloud))


@needs_viser
@needs_browser
def test_the_page_of_a_frame_shows_every_segment_and_answers(tmp_path: Path, server: object) -> None:
    page = FramePage(server, toy_inspection(), "toy <frame>", "closed form", Unit(0.001))
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (760, 480)) as browser:  # type: ignore[attr-defined]
        until(lambda: "toy <frame>" in browser.text())
        browser.still()
        words = {"box_0", "box_1", "box_2", "ball", "Probe", "closed form, of course"}
        assert words <= set(browser.text().split("\n"))

        def all_shown() -> bool:
            shown = browser.screenshot()[:, :420]
            Image.fromarray(shown).save(tmp_path / "page.png")
            return all(pixels_of(shown, segment.color) > 150 for segment in page.mesh.segments)

        until(all_shown)
        # the middle of the stage lies in the middle box: a click there asks the model
        browser.click(220, 250)
        until(lambda: "the nearest surface" in browser.text())
        assert re.search(r"box_\d at -?[\d.,]+", browser.text())
        page.coloring.value = "distance"
        until(lambda: "distance to the nearest observed point" in browser.text())


@pytest.mark.slow
@needs_viser
@needs_browser
def test_the_laboratory_follows_its_sliders_in_a_browser(tmp_path: Path, server: object) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None), "Laboratory: toy", "no weights")
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (1200, 760)) as browser:  # type: ignore[attr-defined]
        until(lambda: "points seen" in browser.text())
        browser.still()
        words = set(browser.text().split("\n"))
        assert {"Camera", "Deformation", "tilt (°)", "shear x", "ball", "Random state"} <= words  # "ball" is a folder
        before, picture = page.moment, page._picture.image.copy()
        assert before is not None
        browser.evaluate("[...document.querySelectorAll('button')].find(b => b.innerText == 'Random state').click()")
        until(lambda: page.moment is not before and (page._picture.image != picture).any())

        def shown() -> bool:
            return all(pixels_of(browser.screenshot(), segment.color) > 150 for segment in rest_mesh().segments)

        until(shown)
    page.close()


@needs_viser
def test_a_page_is_on_this_machine_only_and_a_taken_port_is_said(server: object) -> None:
    port = server.get_port()  # type: ignore[attr-defined]
    assert server.get_host() == "127.0.0.1"  # type: ignore[attr-defined]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as answer:
        assert answer.status == 200
    with pytest.raises(OSError, match=f"port {port} is taken or not allowed; choose another one with --port"):
        display.start_server(port, "mereo")


@pytest.mark.slow
@needs_viser
def test_pages_that_were_closed_leave_nothing_behind(server: object, monkeypatch: pytest.MonkeyPatch) -> None:
    from viser import __version__ as version
    from websockets.asyncio.server import ServerConnection
    from websockets.sync.client import connect

    def connections() -> int:
        return sum(type(known) is ServerConnection for known in gc.get_objects())

    monkeypatch.setattr(open_page, "COLLECT_EVERY_S", 0.05)
    address = f"127.0.0.1:{server.get_port()}"  # type: ignore[attr-defined]
    end = threading.Event()
    keeper = threading.Thread(target=open_page.keep_open, args=(end,))
    gc.collect()
    gc.disable()  # or some of the pages might be collected by chance
    try:
        frozen, before = gc.get_freeze_count(), connections()
        for _ in range(12):
            with connect(f"ws://{address}", origin=f"http://{address}", subprotocols=[f"viser-v{version}"]) as page:
                page.recv(timeout=20)
        assert connections() >= before + 6
        keeper.start()
        until(lambda: connections() <= before)
        assert gc.get_freeze_count() > frozen
        end.set()
        keeper.join(20)
    finally:
        gc.enable()
        end.set()
    assert gc.get_freeze_count() == 0


@needs_viser
@pytest.mark.slow
def test_the_command_prints_where_the_page_is_and_ends_cleanly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mereo", "view", "--scene", "robot", "--port", "0"]
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
            assert process.stderr.read() == ""
        finally:
            process.kill()


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("--weights", "lizard"), "none is shipped for 'lizard'; name a depth image or a point cloud"),
        (("cloud.ply",), "cloud.ply is given without weights; the model of its object is needed: give --weights"),
        (("cloud.ply", "--scene", "rope"), "both cloud.ply and --scene rope are given; one can be shown: drop one"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_sentence(
    arguments: tuple[str, ...], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mereo.__main__ import main

    monkeypatch.setattr("mereo.visualization.viewer.serve.import_viser", lambda: None)
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
    text = html.answer(answer, ("empty", name), ((0, 0, 0), (1, 2, 3)), place, Unit(1.0))
    shown = re.sub(r"<[^>]+>", " ", text)
    assert "<script" not in text + html.chips((name,), ((1, 2, 3),)) + html.heading(name, name) + html.message(name)
    for told in (
        "0.75",
        "2 mm inside the nearest surface",
        "towards 0, 1, 0",
        "at 1 2 3 mm",
        "at rest at 4, 5, 6 scene units",
    ):
        assert told in shown
    assert shown.index("0.75") < shown.index("0.25")  # the likeliest first
