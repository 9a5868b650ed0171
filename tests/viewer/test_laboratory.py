"""The laboratory shows what the scene and its camera say, and scores what is found; with weights and without."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, Page, pixels_of, until
from toy_scene import rest_mesh, toy_scene

from mereo.fitting.registration.register import Registrar
from mereo.geometry.metrics import Scores, labels_on, truth_grid
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.scenes.parameters import parameters, random_state, set_value
from mereo.scenes.statistical_model import StatisticalModel
from mereo_viewer.laboratory import CELLS, CameraPlace, Laboratory, LabPage, Trial, slider_range

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra `view`) is not installed")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no chromium or chrome in PATH: install one (Debian: apt-get install chromium)"
)


def test_the_camera_stands_where_its_place_says_and_sees_the_state() -> None:
    laboratory = Laboratory(toy_scene(axis=(0.0, 0.0, 1.0)), None, None)
    played = random_state(laboratory.scene, 2)
    place = CameraPlace(tilt_rad=0.5, azimuth_rad=1.2, distance=140.0)
    view = laboratory.look(played, place)
    world = view.mesh.transformed(view.T_world_camera)
    offset = view.T_world_camera[:3, 3] - world.bounds.mean(axis=0)
    assert np.linalg.norm(offset) == pytest.approx(140.0)
    assert np.arccos(offset[2] / 140.0) == pytest.approx(0.5)
    expected = laboratory.scene.deform(played.deformations).mesh
    for shown, wanted in zip(world.segments, expected.segments, strict=True):
        np.testing.assert_allclose(shown.vertices, wanted.vertices, atol=1e-9)
    # what was measured lies on the object, within the sensor's noise
    points = transform_points(view.T_world_camera, view.depth.to_points().points)
    low, high = expected.bounds
    assert ((points > low - 1.0) & (points < high + 1.0)).all()


def test_pictures_do_not_flicker_and_follow_a_slider() -> None:
    laboratory = Laboratory(toy_scene(), None, None)
    played, place = random_state(laboratory.scene, 2), laboratory.first_place
    first, again = (laboratory.look(played, place).depth.depth for _ in range(2))
    np.testing.assert_array_equal(first, again)
    moved = set_value(laboratory.scene, played, parameters(played)[-1], 0.5)
    assert (laboratory.look(moved, place).depth.depth != first).any()


def test_what_cannot_be_shown_is_said_in_one_sentence(rope: Model) -> None:
    laboratory = Laboratory(toy_scene(), None, None)
    with pytest.raises(ValueError, match="the camera sees 0 points of the object; at least .* move the camera"):
        laboratory.look(random_state(laboratory.scene, 0), CameraPlace(0.1, 0.0, 90_000.0))
    with pytest.raises(ValueError, match="the weights know .* the object has .*: name the weights of this object"):
        Laboratory(toy_scene(), rope, None)


@pytest.mark.slow
def test_an_object_without_weights_is_searched(toy_model: StatisticalModel) -> None:
    scene = replace(toy_scene(), unit_m=0.005)
    laboratory = Laboratory(scene, None, Registrar(None, toy_model, "modes", scene))
    view = laboratory.look(random_state(scene, 3), laboratory.first_place)
    trial = laboratory.answer(view)
    assert "registered model (modes)" in trial.source and trial.scores.iou > 0.8 and trial.seconds > 0
    truth = truth_grid(view.mesh, CELLS)
    found = (labels_on(trial.surfaces, truth.grid) > 0)[truth.kept]
    true = (truth.grid.labels > 0)[truth.kept]
    assert trial.scores.iou == pytest.approx((found & true).sum() / (found | true).sum())


@pytest.mark.parametrize(
    "low, high, value, ends",
    [(0.0, 1.0, 0.5, (0.0, 1.0, 0.01)), (-3.14, 31.4, 0.0, (-3.2, 31.4, 0.1)), (-180.0, 180.0, 0.0, (-180, 180, 1.0))],
)
def test_a_slider_has_few_digits_and_a_hundred_steps(
    low: float, high: float, value: float, ends: tuple[float, float, float]
) -> None:
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
    asked: list[int] = []
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
