"""`mereo view`: its pages in a real browser, and its command."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh
from answers import answer_to
from browser import Page, needs_browser, pixels_of, until
from numpy import ndarray
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from reported_scenes import ball, example, wall
from toy_scene import rest_mesh, toy_scene
from trimesh.creation import box, icosphere

from mereo.__main__ import main
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import Names, Triple
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import Scores
from mereo.geometry.radii import Radii
from mereo.geometry.transforms import transform_points
from mereo.io.mesh_formats import read_glb
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION, write_segments_glb
from mereo.models.model import Model
from mereo.results.state import STATE
from mereo.scenes.parameters import parameters, random_state, set_value
from mereo.synthesis.sample_views import load_view
from mereo.visualization.color_scales import ColorScale
from mereo.visualization.reconstruction_report import Report, read_report
from mereo.visualization.units import UNKNOWN, Unit
from mereo_viewer import result_page
from mereo_viewer import server as viewer_server
from mereo_viewer.display import color_bar, heading, hint, message
from mereo_viewer.laboratory import CameraPlace, Laboratory, LabPage, Trial, slider_range
from mereo_viewer.result_page import (
    SURE,
    VERTEX,
    Content,
    Probed,
    ResultPage,
    content_of_answer,
    content_of_files,
    probe_html,
    round_length,
)

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")


def toy_content() -> Content:
    """The toy, 150 units in front of a camera; a point is in the box that holds it, or in nothing."""
    T_camera_rest = np.eye(4)
    T_camera_rest[2, 3] = 150.0
    mesh = rest_mesh().transformed(T_camera_rest)
    points = np.concatenate([segment.vertices[::2] for segment in mesh.segments])
    cloud = PointCloud(points[points[:, 2] <= 162.0])

    def ask(points: ndarray) -> Probed:
        label = np.where(np.abs(points[:, 1]) < 6, 1 + np.clip((points[:, 0] + 18) // 12, 0, 2), 0).astype(np.uint8)
        toward = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        return Probed(label, points[:, 2] - 150.0, toward, np.eye(5)[label])

    def by_depth() -> tuple[list[ndarray], ColorScale]:
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


@needs_viser
def test_a_click_on_what_the_camera_saw_has_it_answered_there(server: object, monkeypatch: pytest.MonkeyPatch) -> None:
    around = PointCloud(np.array([[-40.0, 0, 170], [0, 0, 150], [60, 20, 160]]))
    clicked = list[ndarray]()
    contents = [replace(toy_content(), title="again", verdict="as clicked", colorings={}), ValueError("nothing there")]

    def content_of(_: object) -> Content:
        if isinstance(content := contents.pop(0), Exception):
            raise content
        return content

    monkeypatch.setattr(result_page, "content_of_answer", content_of)
    page = ResultPage(server, replace(toy_content(), picks=(around, lambda point: clicked.append(point))))  # type: ignore[arg-type]
    cloud = server.scene._handle_from_node_name  # type: ignore[attr-defined]
    page.coloring.value, page.picking.value = "depth", True
    assert len(cloud["/cloud"].points) == 3, "all that the camera saw"
    ray = page.stage.place(np.zeros(3)), (60.0, 21.0, 161.0)
    page._clicked(SimpleNamespace(ray_origin=ray[0], ray_direction=ray[1]))
    assert clicked[0].tolist() == [60, 20, 160] and "as clicked" in page.verdict.content and not page.picking.value
    assert page.content.title == "again" and "again" in page.heading.content and page.coloring.value == "segment"
    assert len(cloud["/cloud"].points) == len(page.content.cloud.points)  # type: ignore[union-attr]
    page.answer_at(around.points[0])
    assert len(clicked) == 2 and "nothing there" in page.verdict.content and page.content.title == "again"


@needs_viser
def test_one_legend_at_a_time_names_colours_and_hides_segments(server: object) -> None:
    page = ResultPage(server, toy_content())
    buttons = page.controls._buttons
    assert [(button.label, button.color) for button in buttons] == [(s.name, s.color) for s in rest_mesh().segments]
    page.controls.switch(1)
    assert not page.layer.handles[1].visible and page.layer.handles[2].visible and buttons[1].icon == "eye-off"
    page.coloring.value = "depth"
    assert {button.color for button in buttons} == {"gray"} and page.legend.visible


@needs_viser
def test_what_is_around_others_is_seen_through_and_axes_are_of_a_round_length(server: object) -> None:
    inner = ball("inner", 0.0, 0)
    mesh = SegmentedMesh((inner, replace(inner, name="outer", vertices=2 * inner.vertices - [0, 0, 0.5])))
    page = ResultPage(server, replace(toy_content(), mesh=mesh, cloud=None, unit=Unit(1.0)))
    assert page.controls.opacity() == [1.0, 0.4]
    nodes = server.scene._handle_from_node_name  # type: ignore[attr-defined]
    ends = page.stage.back(nodes["/axes"].points[:, 1].astype(float))
    assert_allclose(ends - page.content.bounds[0], 0.1 * np.eye(3), atol=1e-5)
    assert nodes["/axes/y"].text == "y 10 cm" and "x right, y down, z away; each 10 cm long" in page.hint.content
    assert round_length(0.3, UNKNOWN) == (0.2, "0.2 units") and round_length(70, Unit(0.001)) == (50, "50 mm")


@needs_viser
@pytest.mark.parametrize("aspect", [390 / 844, 1.5])
def test_a_page_looks_at_the_middle_of_the_object_from_where_all_of_it_is_seen(server: object, aspect: float) -> None:
    stage = ResultPage(server, toy_content()).stage
    camera = SimpleNamespace()
    bounds = toy_content().bounds
    stage._turn(camera, aspect)
    assert_allclose(camera.look_at, stage.place(bounds.mean(axis=0)), atol=1e-9)
    half_angle = np.arctan(np.tan(np.deg2rad(20)) * min(aspect, 1))
    radius = norm(np.subtract(camera.position, camera.look_at)) * np.sin(half_angle)
    assert radius == pytest.approx(norm(np.ptp(bounds, axis=0)) / 2 * stage.scale), "of the ball around it"


@pytest.mark.slow
@needs_viser
@needs_browser
@pytest.mark.parametrize("width, is_open", [(390, False), (590, False), (640, True)])
def test_a_narrow_page_has_its_hint_and_a_folded_panel(
    tmp_path: Path, server: object, width: int, is_open: bool
) -> None:
    ResultPage(server, toy_content())
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (width, 844)) as browser:  # type: ignore[attr-defined]
        until(lambda: "drag to turn" in browser.text() and "Show" in browser.text())
        time.sleep(2)  # by then a panel is open that stays so
        assert ("Observed points" in browser.text()) is is_open


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
    with urlopen(f"http://127.0.0.1:{port}", timeout=20) as answer:
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
            with urlopen(address[1], timeout=60) as answer:
                assert b"<html" in answer.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
            assert process.stdout.read() == "closed\n"
            progress = process.stderr.read().splitlines()  # of stages that take seconds, on a machine that is busy
            assert [line for line in progress if not line.endswith("so far")] == []
        finally:
            process.kill()


def test_without_viser_one_sentence_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view"]) == 2
    assert "`mereo view` needs it: run pip install 'mereo[view]'" in capsys.readouterr().err


def test_names_cannot_break_the_panels() -> None:
    name = "<script>x</script>"
    answer = Probed(
        np.array([1], np.uint8),
        np.array([-0.002]),
        np.array([[0.0, 1.0, 0.0]]),
        np.array([[0.25, 0.75]]),
        np.array([[4.0, 5.0, 6.0]]),
    )
    place = np.array([0.001, 0.002, 0.003])
    text = probe_html(answer, ("empty", name), ((0, 0, 0), (1, 2, 3)), place, Unit(1.0))
    shown = re.sub(r"<[^>]+>", " ", text)
    assert "<script" not in text + heading(name, name) + message(name) + hint(name)
    for told in (
        "0.75",
        "2 mm inside the nearest surface",
        "towards 0, 1, 0",
        "at 1 2 3 mm",
        "at rest at 4, 5, 6 scene units",
    ):
        assert told in shown
    assert shown.index("0.75") < shown.index("0.25")  # the likeliest first


def test_the_camera_stands_where_its_place_says_and_sees_the_state() -> None:
    laboratory = Laboratory(toy_scene(axis=(0.0, 0.0, 1.0)), None, None)
    played = random_state(laboratory.scene, 2)
    place = CameraPlace(tilt_rad=0.5, azimuth_rad=1.2, distance=140.0)
    view = laboratory.look(played, place)
    world = view.mesh.transformed(view.T_world_camera)
    offset = view.T_world_camera[:3, 3] - world.bounds.mean(axis=0)
    assert norm(offset) == pytest.approx(140.0)
    assert np.arccos(offset[2] / 140.0) == pytest.approx(0.5)
    expected = laboratory.scene.deform(played.deformations).mesh
    for shown, wanted in zip(world.segments, expected.segments, strict=True):
        assert_allclose(shown.vertices, wanted.vertices, atol=1e-9)
    # what was measured lies on the object, within the sensor's noise
    points = transform_points(view.T_world_camera, view.depth.to_points().points)
    low, high = expected.bounds
    assert ((points > low - 1.0) & (points < high + 1.0)).all()


def test_pictures_do_not_flicker_and_follow_a_slider() -> None:
    laboratory = Laboratory(toy_scene(), None, None)
    played = random_state(laboratory.scene, 2)
    place = laboratory.first_place
    first, again = (laboratory.look(played, place).depth.depth for _ in range(2))
    assert_array_equal(first, again)
    moved = set_value(laboratory.scene, played, parameters(played)[-1], 0.5)
    assert (laboratory.look(moved, place).depth.depth != first).any()


def test_what_the_laboratory_cannot_show_is_said_in_one_sentence(rope: Model) -> None:
    laboratory = Laboratory(toy_scene(), None, None)
    with pytest.raises(ValueError, match="the camera sees 0 points of the object; at least .* move the camera"):
        laboratory.look(random_state(laboratory.scene, 0), CameraPlace(0.1, 0.0, 90_000.0))
    with pytest.raises(ValueError, match="the weights know .* the object has .*: name the weights of this object"):
        Laboratory(toy_scene(), rope, None)


@pytest.mark.parametrize(
    "low, high, value, ends",
    [(0.0, 1.0, 0.5, (0.0, 1.0, 0.01)), (-3.14, 31.4, 0.0, (-3.2, 31.4, 0.1)), (-180.0, 180.0, 0.0, (-180, 180, 1.0))],
)
def test_a_slider_has_few_digits_and_a_hundred_steps(low: float, high: float, value: float, ends: Triple) -> None:
    slider = replace(parameters(random_state(toy_scene(), 0))[0], low=low, high=high, value=value)
    assert slider_range(slider) == pytest.approx(ends)
    assert slider_range(replace(slider, low=2.0, high=5.0, whole=True)) == (2.0, 5.0, 1.0)


@needs_viser
def test_sliders_and_buttons_change_what_is_shown(server: object) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None, None))
    page.update()
    assert page.view is not None and page.trial is None and "points seen" in page.status.content
    first = page.shape
    slider = parameters(first)[1]
    page.move((slider.key, slider.index), 0.25)
    assert parameters(page.shape)[1].value == pytest.approx(0.25)
    assert page.sliders._handles[slider.key, slider.index].value == pytest.approx(0.25)
    page.move(((slider.key[0], 99), 0), 0.5)  # of a state that has just gone
    before = page.view.depth.depth
    page._tilt.value = 3.0
    page.update()
    assert (page.view.depth.depth != before).any()
    page.randomize()
    assert page.shape is not first and page.sliders._handles.keys() == {(p.key, p.index) for p in parameters(first)}


@needs_viser
def test_of_many_changes_the_newest_of_each_control_counts(server: object) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None, None))
    asked = []
    with page._working:  # changes come while the page is at work
        for number in range(5):
            page._changes["x"] = lambda shape, number=number: asked.append(number) or shape  # type: ignore[func-returns-value]
    page.update()
    assert asked == [4] and not page._changes


@needs_viser
def test_what_is_found_stands_beside_the_truth_until_something_changes(
    server: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None, None))
    page.update()
    view = page.view
    assert view is not None
    scores = Scores(0.875, 0.75, np.array([0.5, 1.0, 0.75, 0.75]))
    monkeypatch.setattr(Laboratory, "answer", lambda _, seen: Trial(seen.mesh, "found <by> test", scores, 1.5))
    page.reconstruct()
    assert "0.875" in page.scores.content and "0.750" in page.scores.content
    assert "found &lt;by&gt; test; 1.5 s" in page.status.content
    nodes = server.scene._handle_from_node_name  # type: ignore[attr-defined]
    found, true = (np.array(nodes[f"/names/{name}"].position) for name in ("reconstruction", "truth"))
    right = view.T_world_camera[:3, 0]
    assert (true - found) @ right > 1.0 and len(page.answer.handles) == 4
    page.update()
    assert page.trial is None and not page.answer.handles and page.scores.content == ""

    def nothing(_: Laboratory, __: object) -> Trial:
        raise ValueError("nothing is found: move the camera")

    monkeypatch.setattr(Laboratory, "answer", nothing)
    page.reconstruct()
    assert "nothing is found: move the camera" in page.status.content and page.trial is None


@pytest.mark.slow
@needs_viser
@needs_browser
def test_the_laboratory_follows_its_buttons_in_a_browser(tmp_path: Path, server: object) -> None:
    page = LabPage(server, Laboratory(toy_scene(), None, None))
    page.update()
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (1200, 760)) as browser:  # type: ignore[attr-defined]
        until(lambda: "points seen" in browser.text())
        browser.still()
        words = set(browser.text().split("\n"))
        assert {"Camera", "Deformation", "tilt (°)", "shear x", "ball", "Random state"} <= words  # "ball" is a folder
        before = page.view
        browser.evaluate("[...document.querySelectorAll('button')].find(b => b.innerText == 'Random state').click()")
        until(lambda: page.view is not before)
        until(lambda: all(pixels_of(browser.screenshot(), segment.color) > 150 for segment in rest_mesh().segments))


def radii_of(mesh: SegmentedMesh) -> Radii:
    points = np.concatenate([segment.vertices for segment in mesh.segments])
    counts = tuple(len(segment.vertices) for segment in mesh.segments)
    labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
    return Radii(points, labels, np.linspace(0.001, 0.004, len(points)), counts, True)


def found() -> SegmentedMesh:
    return SegmentedMesh((ball("head", -0.1, 0), ball("tail", 0.1, 1)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Result of the network alone, in metres: surfaces, a report with a depth image, no state."""
    cloud, _, summary = example()
    folder = tmp_path / "result"
    folder.mkdir()
    write_segments_glb(folder / "segments.glb", found(), GLTF_CAMERA_ROTATION, 0.001, radii_of(found()))
    told = {**summary, "title": "frame <7>"}
    Report(cloud, found(), told, unit=Unit(0.001), depth=wall(80, 60, 1000.0)).write(folder / "report.html")
    return folder


@pytest.mark.parametrize(
    "old, new",
    [
        ("const DATA = {", "const DATA = ["),
        ('"low": [', '"low": [0, '),
        ('"positions": "', '"positions": "AAA'),
        ("data:image/png;base64,", "https://example.org/"),
        ("data:image/png;base64,iVBOR", "data:image/png;base64,AAAAA"),
        ('"alone"', '"certainly"'),
        ("const DATA", "const NONE"),
    ],
)
def test_a_page_that_is_damaged_or_another_one_is_none(folder: Path, old: str, new: str) -> None:
    page = (folder / "report.html").read_text("utf-8")
    assert old in page
    (folder / "report.html").write_text(page.replace(old, new, 1), "utf-8")
    assert read_report(folder / "report.html") is None
    assert read_report(folder / "gone.html") is None


def test_our_own_glb_is_in_the_frame_of_the_input(folder: Path) -> None:
    scene = read_glb(folder / "segments.glb")
    assert scene.is_ours and scene.unit_m == pytest.approx(0.001) and scene.colors == (None, None)
    assert_allclose(scene.rotation, GLTF_CAMERA_ROTATION, atol=1e-12)
    assert scene.mesh.names == ("head", "tail") and scene.mesh.colors == found().colors
    for shown, segment in zip(scene.mesh.segments, found().segments, strict=True):
        assert_allclose(shown.vertices, segment.vertices, atol=1e-6)
    assert scene.radii is not None and scene.radii.calibrated
    assert_allclose(scene.radii.values, radii_of(found()).values, rtol=1e-5)


def write_strange(path: Path) -> None:
    """GLB file of somebody else: a moved and mirrored box of vertex colours, a plain one twice, a texture, points."""
    scene = trimesh.Scene()
    painted = box((1, 1, 1))
    painted.visual.vertex_colors = np.array([[255, 0, 0, 255]] * 4 + [[0, 0, 255, 255]] * 4, np.uint8)
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[0, 3] = 5.0
    scene.add_geometry(painted, node_name="painted", geom_name="painted", transform=mirrored)
    plain = box((1, 1, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    plain.visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(plain, node_name="plain", geom_name="plain")
    round_one = icosphere(1)
    picture = Image.fromarray(np.full((4, 4, 3), (0, 128, 255), np.uint8))
    round_one.visual = trimesh.visual.TextureVisuals(uv=np.full((len(round_one.vertices), 2), 0.5), image=picture)
    scene.add_geometry(round_one, node_name="round", geom_name="round")
    scene.add_geometry(trimesh.PointCloud(np.eye(3)), node_name="points", geom_name="points")
    path.write_bytes(scene.export(file_type="glb"))


def test_any_glb_is_read_with_its_places_and_colours(tmp_path: Path) -> None:
    write_strange(tmp_path / "s.glb")
    scene = read_glb(tmp_path / "s.glb")
    assert not scene.is_ours and scene.radii is None and scene.unit_m == 1.0
    parts = {segment.name: (segment, colors) for segment, colors in zip(scene.mesh.segments, scene.colors, strict=True)}
    assert set(parts) == {"painted", "plain", "round"}
    painted, colors = parts["painted"]
    assert painted.bounds[:, 0].tolist() == [4.5, 5.5] and painted.volume == pytest.approx(1.0)
    assert colors is not None and {tuple(color) for color in colors.tolist()} == {(255, 0, 0), (0, 0, 255)}
    assert parts["plain"][0].color == (255, 0, 0) and parts["plain"][1] is None
    assert len(parts["plain"][0].vertices) == 8 and parts["round"][0].color == (0, 128, 255)
    content = content_of_files((tmp_path / "s.glb").rename(tmp_path / "s.GLB"))
    assert content.ask is None and content.facts.startswith("3 parts")
    shown, scale = content.colorings[VERTEX]()
    assert scale is None and [len(part) for part in shown] == [len(s.vertices) for s in content.mesh.segments]


def test_a_folder_is_shown_with_all_that_its_files_keep(folder: Path) -> None:
    content = content_of_files(folder)
    assert content.title == "frame <7>" and "2 segments" in content.facts and not content.is_doubtful
    assert content.verdict.startswith("Network alone") and content.unit.metres == pytest.approx(0.001)
    assert content.cloud is not None and content.depth is not None and content.depth[1] == ("500 mm", "700 mm")
    assert_allclose(content.cloud.points, example()[0].points, atol=1e-5)
    assert content.depth[0].shape == (19, 24, 3) and content.verdict.endswith("may be cut off there.")
    assert tuple(content.colorings) == ("distance", SURE)
    colors, scale = content.colorings[SURE]()
    assert [len(part) for part in colors] == [len(s.vertices) for s in content.mesh.segments]
    assert scale is not None and color_bar(scale).count("<span>") == len(scale.stops)
    assert scale.words[-1] == "\N{GREATER-THAN OR EQUAL TO} 0.0039 mm"
    cloud, mesh, summary = example()
    Report(cloud, mesh, summary).write(folder / "report.html")
    assert content_of_files(folder).unit == UNKNOWN
    (folder / "report.html").unlink()
    plain = content_of_files(folder)
    assert plain.title == "result" and plain.cloud is None and plain.verdict == ""
    (folder / STATE).write_text("{}")
    assert content_of_files(folder / STATE).facts == plain.facts


def test_an_inner_segment_is_seen_through_the_outer_one(folder: Path) -> None:
    assert content_of_files(folder).mesh.opaque == (True, True)
    (folder / "summary.json").write_text(json.dumps({"nested": [["head", "tail"]]}))
    assert content_of_files(folder).mesh.opaque == (True, False)
    for damaged in ('{"nested": [["head", "nose"]]}', '{"nested": 3}', "{}", "[]", "{", '{"nested": [[[], {}]]}'):
        (folder / "summary.json").write_text(damaged)
        assert content_of_files(folder).mesh.nested == ()


def test_places_are_asked_of_a_results_surfaces(folder: Path) -> None:
    content = content_of_files(folder)
    head = found().segments[0]
    assert content.ask is not None
    middle = head.vertices.mean(axis=0)
    rim = head.vertices[0]
    inside, outside, on_it = (content.ask(point[None]) for point in (middle, middle + 5.0, rim))
    assert inside.label == 1 and outside.label == 0 and on_it.label == 1
    size = norm(rim - middle)
    assert inside.distance[0] == pytest.approx(-size, rel=0.1) and outside.distance[0] > 4
    assert outside.radius95 is None and on_it.radius95 is not None
    assert on_it.radius95[0] == pytest.approx(0.001, rel=0.01)
    assert_allclose(rim, middle + inside.direction[0] * size, atol=3 * size)


def test_weights_without_a_model_are_asked_alone_and_it_is_said(rope: Model) -> None:
    cloud = load_view("rope").depth.to_points()
    answer = answer_to(cloud, replace(rope, statistical_model=None), None, 24)
    content = content_of_answer(answer)
    assert content.ask is not None
    shown = content.ask(cloud.points[:4])
    assert content.verdict == "network alone: the weights carry no statistical model"
    assert shown.rest is None and shown.probability is not None
    assert tuple(content.colorings) == ("confidence", "distance")
    colors, scale = content.colorings["confidence"]()
    assert [len(part) for part in colors] == [len(s.vertices) for s in content.mesh.segments]
    assert scale is not None and scale.title == "confidence of the surface"


@pytest.mark.parametrize(
    "content, arguments, sentence",
    [
        (None, ("--weights", "lizard"), "none is shipped for 'lizard'; name a depth image or a point cloud"),
        (
            None,
            ("cloud.ply",),
            "cloud.ply is given without its object: name the object's meshes or scene with --object",
        ),
        (None, ("s.glb",), "s.glb does not exist; a GLB file is needed: check the path"),
        (b"glTF but not really", ("s.glb",), "s.glb cannot be read as a GLB file"),
        (b"", ("s.glb",), "s.glb is empty (0 bytes)"),
        (trimesh.Scene([trimesh.PointCloud(np.eye(3))]).export(file_type="glb"), ("s.glb",), "it has no faces"),
        (b"", ("s.glb", "--weights", "rope"), "is shown as it is, and no object is looked for: leave out --object and"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_sentence(
    content: bytes | None,
    arguments: Names,
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.chdir(tmp_path)
    for module in ("mereo_viewer.result_page", "mereo.api.view"):
        monkeypatch.setattr(f"{module}.import_viser", lambda: None)
    if content is not None:
        Path("s.glb").write_bytes(content)
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mereo: error: ") and error.count("\n") == 1 and sentence in error
