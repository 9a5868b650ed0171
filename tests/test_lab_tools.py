"""The laboratory's camera gives what a sensor would; what is recorded and saved is what is shown."""

import io
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import until
from PIL import Image
from shapes import ball, box
from toy_scene import toy_scene

import mereo
from mereo.fitting.registration.state import STATE
from mereo.geometry.camera import Camera
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.solids import Solids
from mereo.io.config import InputConfig
from mereo.io.output_folders import unexpected_files
from mereo.io.sensor_frame import read_frame
from mereo.models.weights import load_model
from mereo.scenes.parameters import random_state
from mereo.scenes.registry import load_scene
from mereo.visualization.renderer import Viewpoint, shade
from mereo.visualization.viewer import display, film
from mereo.visualization.viewer.film import MOST_FRAMES, SIZE, Film, picture, viewpoint
from mereo.visualization.viewer.lab_page import LabPage
from mereo.visualization.viewer.laboratory import Laboratory
from mereo.visualization.viewer.saving import file_name, frame_archive, result_archive
from mereo.visualization.viewer.sight import Sensing, see

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")


# --- the sensor -------------------------------------------------------------------------------------------------------


def solids() -> Solids:
    return Solids(SegmentedMesh((ball((0.0, 0.0, 150.0), 20.0, "ball", 0, level=3),)))


@pytest.mark.parametrize(("front", "shares"), [("tool", (0.03, 0.1)), ("hand", (0.1, 0.3, 0.5))])
def test_what_stands_in_front_hides_about_what_was_asked(front: Any, shares: tuple[float, ...]) -> None:
    camera = Camera.from_fov(96, 96, np.deg2rad(35))
    free = see(solids(), camera, Sensing())[0].object_points
    for share in shares:
        seen, hidden = see(solids(), camera, Sensing(front=front, hidden=share))
        assert hidden == pytest.approx(share, abs=0.04)
        assert seen.object_points == pytest.approx((1 - hidden) * free, abs=1), "the share is that of the image"
        assert seen.image.valid.sum() == seen.object_points, "the paper's mask is the object's"


def test_sensor_size_and_noise_are_those_of_the_frame() -> None:
    laboratory = Laboratory(toy_scene(), None)
    shape, place = random_state(laboratory.scene, 2), laboratory.first_place()
    plain = laboratory.look(shape, place)
    assert plain.hidden == 0.0 and plain.depth.depth.shape == (96, 96)
    clean, noisy = (laboratory.look(shape, place, Sensing(noise_std=std)).depth for std in (0.0, 1.0))
    both = clean.valid & noisy.valid
    assert np.std((noisy.depth - clean.depth)[both]) == pytest.approx(1.0, rel=0.15)
    assert laboratory.look(shape, place, Sensing(image_size=160)).depth.depth.shape == (160, 160)
    real = laboratory.look(shape, place, Sensing(sensor="structured-light"))
    assert (real.depth.valid != plain.depth.valid).any(), "a mask that is off, and missing pixels"
    again = laboratory.look(shape, place, Sensing(sensor="structured-light"))
    np.testing.assert_array_equal(again.depth.depth, real.depth.depth)


def test_what_leaves_too_little_of_a_small_object_is_not_taken() -> None:
    camera = Camera.from_fov(32, 32, np.deg2rad(35))
    for share in (0.05, 1.0):
        seen, _ = see(solids(), camera, Sensing(front="hand", hidden=share))
        assert seen.object_points >= 16


# --- films ------------------------------------------------------------------------------------------------------------


def test_a_picture_is_from_where_the_browser_looks() -> None:
    mesh = SegmentedMesh((box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), "box", 0),))
    view = viewpoint(np.array([0.0, -4.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.deg2rad(40))
    depth = np.full((96, 96, 3), 7, dtype=np.uint8)
    shown = picture(view, [mesh], np.zeros((0, 3)), depth)
    assert shown.shape == (SIZE[1], SIZE[0], 3) and (shown[-60:, :60] == 7).all()
    rows, columns = np.nonzero((shown < 250).any(axis=-1)[: SIZE[1] // 2 + 100, 120:])
    # the near face, 3.8 away: 0.4 wide under 40 degrees of height
    wide = 0.4 / 3.8 * SIZE[1] / (2 * np.tan(np.deg2rad(20)))
    assert np.ptp(columns) == pytest.approx(wide, abs=2) and np.ptp(rows) == pytest.approx(wide, abs=2)
    assert columns.mean() + 120 == pytest.approx(SIZE[0] / 2, abs=1.5)


def test_a_film_is_bounded_in_length_and_size(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = Film(Viewpoint(np.eye(4)))
    with pytest.raises(ValueError, match="nothing has moved while it was recorded: move a slider or walk, then stop"):
        taken.gif()
    rng = np.random.default_rng(0)
    for _ in range(12):
        taken.add(rng.integers(0, 255, size=(40, 60, 3), dtype=np.uint8))
    whole = taken.gif()
    shown = Image.open(io.BytesIO(whole))
    assert shown.format == "GIF" and shown.n_frames == 12 and shown.info["duration"] == film.FRAME_MS
    assert shown.info["loop"] == 0
    monkeypatch.setattr(film, "MOST_BYTES", len(whole) // 3)
    less = taken.gif()
    shown = Image.open(io.BytesIO(less))
    assert len(less) <= len(whole) // 3 and shown.n_frames == 3 and shown.info["duration"] == 4 * film.FRAME_MS
    monkeypatch.setattr(film, "MOST_FRAMES", 13)
    for _ in range(5):
        taken.add(np.zeros((40, 60, 3), dtype=np.uint8))
    assert len(taken) == 13 and taken.is_full and MOST_FRAMES * film.FRAME_MS < 20_000


def test_two_meshes_of_a_picture_hide_each_other() -> None:
    view = Viewpoint.along(np.array([[-1.0, -1, -1], [1, 1, 1]]), (0, 0, 1), (0, -1, 0))
    near, far = (box((-0.5, -0.5, z), (0.5, 0.5, z + 0.2), "a", k) for k, z in enumerate((-0.8, 0.6)))
    alone = shade(SegmentedMesh((near,)), view, SIZE)
    for order in ((near, far), (far, near)):
        shown = picture(view, [SegmentedMesh((part,)) for part in order], np.zeros((0, 3)), alone[:1, :1])
        np.testing.assert_array_equal(shown[: SIZE[1] // 2], alone[: SIZE[1] // 2])


# --- downloads --------------------------------------------------------------------------------------------------------


def unpacked(content: bytes, folder: Path) -> Path:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)
    (only,) = folder.iterdir()
    return only


@pytest.mark.parametrize("unit_m", [None, 0.002])
def test_a_saved_frame_is_read_as_it_was_seen(unit_m: float | None, tmp_path: Path) -> None:
    scene = replace(toy_scene(), unit_m=unit_m, name="my toy: 2/3")
    laboratory = Laboratory(scene, None)
    view = laboratory.look(random_state(scene, 2), laboratory.first_place())
    folder = unpacked(frame_archive(scene, view), tmp_path)
    assert folder.name == "my-toy-2-3-frame"
    frame = read_frame(folder / "depth.npy", InputConfig(intrinsics=folder / "camera.json"))
    scale = unit_m or 0.01
    assert frame.depth is not None and frame.depth.camera == view.depth.camera
    np.testing.assert_allclose(frame.depth.depth, view.depth.depth * scale, rtol=1e-6)
    cloud = read_frame(folder / "cloud.ply", InputConfig())
    np.testing.assert_allclose(cloud.cloud.points, view.depth.to_points().points * scale, rtol=1e-5, atol=1e-7)
    told = (folder / "README.txt").read_text("utf-8")
    assert f"A scene unit is {scale:g} m ({'of the true size' if unit_m else 'a guess'}" in told


@pytest.mark.slow
def test_a_saved_result_is_what_reconstruct_writes(tmp_path: Path) -> None:
    scene, model = load_scene("rope"), load_model("rope")
    laboratory = Laboratory(scene, replace(model, statistical_model=None))
    view = laboratory.look(random_state(scene, 3), laboratory.first_place())
    result = laboratory.answer(view, 16)
    folder = unpacked(result_archive(scene, result), tmp_path)
    assert folder.name == "rope-result" and not unexpected_files(folder)
    plain = mereo.reconstruct(view.depth, replace(model, statistical_model=None), "network", resolution=16)
    plain.save(tmp_path / "plain")
    names = {file.name for file in (tmp_path / "plain").iterdir()}
    assert {file.name for file in folder.iterdir()} == names and STATE not in names
    ours, theirs = (np.load(place / "labels.npz") for place in (folder, tmp_path / "plain"))
    np.testing.assert_array_equal(ours["labels"], theirs["labels"])
    assert '"title": "rope, laboratory"' in (folder / "summary.json").read_text("utf-8")


def test_names_of_files_hold_letters_digits_and_dashes() -> None:
    for name, wanted in (("../../x", "x-frame"), ("Öhr chen", "hr-chen-frame"), ("??", "scene-frame")):
        assert file_name(replace(toy_scene(), name=name), "frame") == wanted


# --- the page ---------------------------------------------------------------------------------------------------------


class Browser:
    """What a page hands out."""

    def __init__(self, server: Any) -> None:
        first = server.initial_camera
        self.files: dict[str, bytes] = {}
        self.camera = type("Camera", (), {"position": first.position, "look_at": first.look_at, "fov": first.fov})()
        self.camera.up_direction = first.up

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        self.files[name] = content


@pytest.fixture
def page() -> Iterator[LabPage]:
    server = display.start_server(0, "mereo")
    opened = LabPage(server, Laboratory(toy_scene(), None), "toy", "no weights")
    until(lambda: opened.moment is not None)
    yield opened
    opened.close()
    display.stop_server(server)


@needs_viser
def test_the_page_records_saves_and_takes_a_pasted_state(page: LabPage) -> None:
    client, tools = Browser(page.server), page.tools
    tools.switch_recording(client)
    page.wish(page.wishes.walk)
    until(lambda: tools.film is not None and len(tools.film) >= 4)
    text = tools.text.value
    page.wish(page.wishes.anew)
    until(lambda: tools.text.value != text and not page.wishes.is_walking)
    tools.switch_recording(client)
    with Image.open(io.BytesIO(client.files["toy-film.gif"])) as shown:
        assert shown.n_frames >= 4 and shown.size == SIZE
    assert tools.film is None
    tools.save_frame(client)
    assert client.files["toy-frame.zip"][:2] == b"PK"
    shape = page.wishes.shape
    tools.text.value = text
    tools._try(tools._take)
    until(lambda: page.wishes.shape is not shape)
    assert page.laboratory.freedom.text(page.wishes.shape) == text
    tools.text.value = "{}"
    tools._try(tools._take)
    assert "the text is no state: `scene` is missing: paste the whole text" in page._status.content
    assert page.laboratory.freedom.text(page.wishes.shape) == text, "what is shown stays"


@needs_viser
def test_the_sensors_controls_make_the_frame(page: LabPage) -> None:
    before, sensor = page.moment, page.sensor
    sensor._size.value, sensor._front.value, sensor._hidden.value = 128, "hand", 30
    page.wish()
    until(lambda: page.moment is not before)
    assert page.moment is not None and page.moment.view.depth.camera.width == 128
    assert page.moment.view.hidden == pytest.approx(0.3, abs=0.1)
    until(lambda: f"the hand hides {page.moment.view.hidden:.0%} of the object" in sensor._told.content)  # type: ignore[union-attr]
    assert sensor._hidden.visible
