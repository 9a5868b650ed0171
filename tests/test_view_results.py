"""`mereo view` of what is on disk: a folder of results with all that its report shows, and any GLB file."""

import gzip
import urllib.request
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from browser import BROWSER, Page, pixels_of, until
from PIL import Image
from test_report import ball, example, wall
from test_view_states import by_modes

from mereo.__main__ import main
from mereo.fitting.registration.state import STATE, save_state, state_of
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import PALETTE, SegmentedMesh
from mereo.geometry.radii import Radii
from mereo.io.glb_scene import MOST_PARTS, read_glb
from mereo.io.writers.glb import GLTF_CAMERA_ROTATION, write_segments_glb
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.visualization.reconstruction_report import write_report
from mereo.visualization.units import UNKNOWN, Unit
from mereo.visualization.viewer import serve
from mereo.visualization.viewer.kept_result import KeptResult
from mereo.visualization.written_report import read_report

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)


def radii_of(mesh: SegmentedMesh) -> Radii:
    """Radii that grow from vertex to vertex."""
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
    write_report(folder / "report.html", cloud, found(), told, unit=Unit(0.001), depth=wall(80, 60, 1000.0))
    return folder


@pytest.fixture
def opened() -> Iterator[list[Any]]:
    """Pages that a test opens; closed at its end."""
    pages: list[Any] = []
    yield pages
    for page in pages:
        page.close()


# --- what is read -----------------------------------------------------------------------------------------------------


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
    assert scene.is_own and scene.unit_m == pytest.approx(0.001) and scene.colors == (None, None)
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
    assert not scene.is_own and scene.radii is None and scene.unit_m == 1.0
    parts = {segment.name: (segment, colors) for segment, colors in zip(scene.mesh.segments, scene.colors, strict=True)}
    assert set(parts) == {"painted", "plain", "round"}
    painted, colors = parts["painted"]
    assert painted.bounds[:, 0].tolist() == [4.5, 5.5] and painted.volume == pytest.approx(1.0)
    assert colors is not None and {tuple(color) for color in colors.tolist()} == {(255, 0, 0), (0, 0, 255)}
    assert parts["plain"][0].color == (255, 0, 0) and parts["plain"][1] is None
    assert len(parts["plain"][0].vertices) == 8 and parts["round"][0].color == (0, 128, 255)


def test_many_parts_become_few_and_names_are_their_own(tmp_path: Path) -> None:
    scene, box = trimesh.Scene(), trimesh.creation.box((1, 1, 1))
    for number in range(MOST_PARTS + 3):
        move = trimesh.transformations.translation_matrix([2.0 * number, 0, 0])
        scene.add_geometry(box, node_name=f"node {number}", geom_name="box", transform=move)
    (tmp_path / "many.glb").write_bytes(scene.export(file_type="glb"))
    mesh = read_glb(tmp_path / "many.glb").mesh
    assert len(mesh.segments) == MOST_PARTS + 1 and mesh.names[-1] == "3 more"
    assert sum(segment.volume for segment in mesh.segments) == pytest.approx(MOST_PARTS + 3)


def test_radii_of_a_folder_are_those_of_its_mesh_alone(folder: Path) -> None:
    kept = KeptResult.of(folder)
    radii = kept.radii(found())
    assert radii is not None and kept.unit is not None and kept.unit.metres == pytest.approx(0.001)
    np.testing.assert_allclose(radii.values, radii_of(found()).values, rtol=1e-5)
    moved = found().transformed(trimesh.transformations.translation_matrix([0.01, 0, 0]))
    assert kept.radii(moved) is None and kept.radii(SegmentedMesh(found().segments[:1])) is None
    assert KeptResult.of(folder / "other.json").report is None
    cloud, mesh, summary = example()
    write_report(folder / "report.html", cloud, mesh, summary)
    assert KeptResult.of(folder).unit == UNKNOWN


# --- pages ------------------------------------------------------------------------------------------------------------


def test_a_state_is_shown_with_all_that_its_folder_keeps(
    rope: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[Any, ...]] = []
    titles: list[str] = []
    monkeypatch.setattr(serve, "start_server", lambda port, title, entry: titles.append(title))
    monkeypatch.setattr(serve, "FramePage", lambda *given: shown.append(given))
    monkeypatch.setattr(serve.OpenPage, "__init__", lambda *_: None)
    monkeypatch.setattr(serve.OpenPage, "stay", lambda page, _: page)
    save_model(rope, tmp_path / "rope.safetensors")
    states = load_model(tmp_path / "rope.safetensors").statistical_model
    assert states is not None
    registration = by_modes(states)
    folder, mesh = tmp_path / "result", registration.mesh
    save_state(folder / STATE, state_of(registration, "rope", weights=str(tmp_path / "rope.safetensors")))
    radii = radii_of(mesh)
    write_segments_glb(folder / "segments.glb", mesh, radii=radii)
    cloud = PointCloud(np.concatenate([segment.vertices[::3] for segment in mesh.segments]))
    recognition = {"known": False, "reason": "it is too long: cut it", "signs": {"size": 1.0}}
    told = {"title": "a rope", "recognition": recognition, "registration": {"answer": "registration"}}
    write_report(folder / "report.html", cloud, mesh, told, depth=wall(40, 30))
    for path in (folder, folder / STATE):
        assert main(["view", str(path)]) == 0
        _, inspection, title, _, unit, depth = shown.pop()
        assert inspection.source == "Do not trust it: it is too long. Cut it."
        assert (title, titles.pop(), unit) == ("a rope", "a rope · mereo", UNKNOWN)
        assert depth is not None and len(inspection.cloud) == len(cloud) and inspection.code is not None
        np.testing.assert_allclose(inspection.sure.values, radii.values, rtol=1e-4)


def page_of(address: str, encoding: str) -> str:
    request = urllib.request.Request(address, headers={"Accept-Encoding": encoding})
    with urllib.request.urlopen(request, timeout=20) as answer:
        content = answer.read()
    return (gzip.decompress(content) if encoding == "gzip" else content).decode("utf-8")


@needs_viser
def test_the_tab_is_called_after_what_it_shows(folder: Path, tmp_path: Path, opened: list[Any]) -> None:
    write_strange(tmp_path / "part.GLB")
    for path, title in ((tmp_path / "part.GLB", "part.GLB"), (folder, "frame &lt;7&gt;")):
        opened.append(serve.view(path, port=0, block=False))
        for encoding in ("identity", "gzip", "gzip"):
            page = page_of(opened[-1].address, encoding)
            assert page.count("<title>") == 1 and f"<title>{title} · mereo</title>" in page and len(page) > 100_000


@pytest.mark.parametrize(
    "content, options, sentence",
    [
        (None, (), "s.glb does not exist; a GLB file is needed: check the path"),
        (b"glTF but not really", (), "s.glb cannot be read as a GLB file"),
        (b"", (), "s.glb is empty (0 bytes)"),
        (trimesh.Scene([trimesh.PointCloud(np.eye(3))]).export(file_type="glb"), (), "it has no faces"),
        (b"", ("--weights", "rope"), "is shown as it is, and --weights rope are not asked: leave them out"),
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
    monkeypatch.setattr("mereo.visualization.viewer.mesh_page.import_viser", lambda: None)
    if content is not None:
        (tmp_path / "s.glb").write_bytes(content)
    assert main(["view", str(tmp_path / "s.glb"), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mereo: error: ") and error.count("\n") == 1 and sentence in error


@pytest.mark.slow
@needs_viser
@needs_browser
def test_a_result_of_the_network_alone_is_seen_with_points_and_depth(
    folder: Path, tmp_path: Path, opened: list[Any]
) -> None:
    opened.append(serve.view(folder, port=0, block=False))
    with Page(tmp_path, opened[-1].address, (900, 900)) as browser:
        until(lambda: "Network alone" in browser.text())
        browser.still()
        words = browser.text()
        for told in ("frame <7>", "Observed points", "Depth image", "bright: 500 mm; dark: 700 mm", "2 segments"):
            assert told in words
        assert browser.evaluate("document.title") == "frame <7> · mereo"
        colors = [segment.color for segment in found().segments]
        until(lambda: all(pixels_of(browser.screenshot()[:, :560], color, 0.97) > 150 for color in colors))
