"""`mereo view` of what is on disk: a folder of results with all that its report shows, and any GLB file."""

import json
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from answers import answer_to
from browser import BROWSER
from PIL import Image
from reported_scenes import ball, example, wall

import mereo
from mereo.__main__ import main
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.state import STATE
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.mesh_formats import read_glb
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION, write_segments_glb
from mereo.models.model import Model
from mereo.synthesis.sample_views import load_view
from mereo.visualization.reconstruction_report import Report, read_report
from mereo.visualization.units import UNKNOWN, Unit
from mereo_viewer.result_page import (
    SURE,
    VERTEX,
    Probed,
    ask_network,
    content_of_answer,
    content_of_files,
)

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)


def radii_of(mesh: SegmentedMesh) -> Radii:
    points = np.concatenate([segment.vertices for segment in mesh.segments])
    counts = tuple(len(segment.vertices) for segment in mesh.segments)
    labels = np.repeat(np.arange(1, len(counts) + 1), counts).astype(np.uint8)
    return Radii(points, labels, np.linspace(0.001, 0.004, len(points)), counts, True)


def found() -> SegmentedMesh:
    return SegmentedMesh((ball("head", -0.1, PALETTE[0]), ball("tail", 0.1, PALETTE[1])))


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


@pytest.fixture
def opened() -> Iterator[list[Any]]:
    pages: list[Any] = []
    yield pages
    for page in pages:
        page.close()


def test_a_report_is_read_again(folder: Path) -> None:
    cloud, *_ = example()
    report = read_report(folder / "report.html")
    assert report is not None and report.cloud is not None and report.depth is not None
    np.testing.assert_allclose(report.cloud.points, cloud.points, atol=1e-5)
    assert (report.title, report.level, report.count, report.unit_known) == ("frame <7>", "alone", len(cloud), True)
    assert report.verdict.startswith("Network alone: nothing says whether this is the object. The object reaches")
    assert report.depth.shape == (19, 24, 3) and report.ends == ("500 mm", "700 mm")


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
    np.testing.assert_allclose(scene.rotation, GLTF_CAMERA_ROTATION, atol=1e-12)
    assert scene.mesh.names == ("head", "tail") and scene.mesh.colors == found().colors
    for shown, segment in zip(scene.mesh.segments, found().segments, strict=True):
        np.testing.assert_allclose(shown.vertices, segment.vertices, atol=1e-6)
    assert scene.radii is not None and scene.radii.calibrated
    np.testing.assert_allclose(scene.radii.values, radii_of(found()).values, rtol=1e-5)


def write_strange(path: Path) -> None:
    """GLB file of somebody else: a moved and mirrored box of vertex colours, a plain one twice, a texture, points."""
    scene = trimesh.Scene()
    painted = trimesh.creation.box((1, 1, 1))
    painted.visual.vertex_colors = np.array([[255, 0, 0, 255]] * 4 + [[0, 0, 255, 255]] * 4, dtype=np.uint8)
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[0, 3] = 5.0
    scene.add_geometry(painted, node_name="painted", geom_name="painted", transform=mirrored)
    plain = trimesh.creation.box((1, 1, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    plain.visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(plain, node_name="plain", geom_name="plain")
    round_one = trimesh.creation.icosphere(1)
    picture = Image.fromarray(np.full((4, 4, 3), (0, 128, 255), dtype=np.uint8))
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


def test_a_folder_is_shown_with_all_that_its_files_keep(folder: Path) -> None:
    content = content_of_files(folder)
    assert content.title == "frame <7>" and "2 segments" in content.facts and not content.is_doubtful
    assert content.verdict.startswith("Network alone") and content.unit.metres == pytest.approx(0.001)
    assert content.cloud is not None and content.depth is not None and content.depth[1] == ("500 mm", "700 mm")
    assert tuple(content.colorings) == ("distance", SURE)
    colors, scale = content.colorings[SURE]()
    assert [len(part) for part in colors] == [len(s.vertices) for s in content.mesh.segments] and scale is not None
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
    content, head = content_of_files(folder), found().segments[0]
    assert content.ask is not None
    middle, rim = head.vertices.mean(axis=0), head.vertices[0]
    inside, outside, on_it = (content.ask(point[None]) for point in (middle, middle + 5.0, rim))
    assert inside.label == 1 and outside.label == 0 and on_it.label == 1
    size = np.linalg.norm(rim - middle)
    assert inside.distance[0] == pytest.approx(-size, rel=0.1) and outside.distance[0] > 4
    assert outside.radius95 is None and on_it.radius95 is not None
    assert on_it.radius95[0] == pytest.approx(0.001, rel=0.01)
    np.testing.assert_allclose(rim, middle + inside.direction[0] * size, atol=3 * size)


def test_any_glb_has_its_own_colours_and_no_probe(tmp_path: Path) -> None:
    write_strange(tmp_path / "s.GLB")
    content = content_of_files(tmp_path / "s.GLB")
    assert content.ask is None and content.first_view == "front" and content.facts.startswith("3 parts")
    colors, scale = content.colorings[VERTEX]()
    assert scale is None and [len(part) for part in colors] == [len(s.vertices) for s in content.mesh.segments]


def seen_as(answer: Answer, points: np.ndarray) -> Probed:
    content = content_of_answer(answer)
    assert content.ask is not None
    return content.ask(points)


@pytest.mark.slow
def test_places_are_asked_of_the_default_answer(rope: Model) -> None:
    cloud = load_view("rope").depth.to_points()
    answer = answer_to(cloud, rope, Registrar.of(rope, "modes"), 24)
    assert answer.registered is not None
    assert f"registered model (modes) explains {answer.registered.explained:.1%}" in content_of_answer(answer).verdict
    points = np.concatenate([cloud.points[:5] + np.array([0, 0, 1]), cloud.points[:2] - np.array([0, 0, 10])])
    shown, wanted = seen_as(answer, points), answer.registered.query(points)
    np.testing.assert_array_equal(shown.label, wanted.label)
    np.testing.assert_allclose(shown.distance, wanted.distance)
    np.testing.assert_allclose(shown.direction, wanted.direction)
    assert shown.rest is not None and shown.probability is not None and shown.label[:5].any()
    np.testing.assert_allclose(shown.rest, wanted.rest)
    np.testing.assert_allclose(shown.probability, ask_network(answer, points).probability)
    base = answer.registered.mesh.segments[0]
    places = base.vertices[base.faces[::7]].mean(axis=1)  # rounding puts some of them outside
    assert seen_as(answer, places).label.all()


def test_weights_without_a_model_are_asked_alone_and_it_is_said(rope: Model) -> None:
    cloud = load_view("rope").depth.to_points()
    answer = answer_to(cloud, replace(rope, statistical_model=None), None, 24)
    content, shown = content_of_answer(answer), seen_as(answer, cloud.points[:4])
    assert content.verdict == "network alone: the weights carry no statistical model"
    assert shown.rest is None and shown.probability is not None
    assert tuple(content.colorings) == ("confidence", "distance")
    colors, scale = content.colorings["confidence"]()
    assert [len(part) for part in colors] == [len(s.vertices) for s in content.mesh.segments]
    assert scale is not None and scale.title == "confidence of the surface"


@needs_viser
def test_the_command_opens_the_page_of_a_folder(folder: Path, opened: list[Any]) -> None:
    opened.append(mereo.view(folder, port=0, block=False))
    with urllib.request.urlopen(opened[-1].address, timeout=20) as answer:
        assert b"<html" in answer.read()


@pytest.mark.parametrize(
    "content, options, sentence",
    [
        (None, (), "s.glb does not exist; a GLB file is needed: check the path"),
        (b"glTF but not really", (), "s.glb cannot be read as a GLB file"),
        (b"", (), "s.glb is empty (0 bytes)"),
        (trimesh.Scene([trimesh.PointCloud(np.eye(3))]).export(file_type="glb"), (), "it has no faces"),
        (
            b"",
            ("--weights", "rope"),
            "is shown as it is, and no object is looked for: leave out --object and",
        ),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_sentence(
    content: bytes | None,
    options: tuple[str, ...],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for module in ("mereo_viewer.result_page", "mereo.api.view"):
        monkeypatch.setattr(f"{module}.import_viser", lambda: None)
    if content is not None:
        (tmp_path / "s.glb").write_bytes(content)
    assert main(["view", str(tmp_path / "s.glb"), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mereo: error: ") and error.count("\n") == 1 and sentence in error
