"""The viewer shows the default answer and states of registrations: what is behind its pages, and a page itself."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import answer_to
from browser import BROWSER, Page, pixels_of, until
from toy_scene import toy_scene

from mereo.evaluation.sample_views import load_view
from mereo.fitting.draws.playback import Drawn, material_moved
from mereo.fitting.registration.fit import CloudToFit
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.fitting.registration.state import STATE, load_state, save_state, state_of
from mereo.geometry.camera import SCANNER_TO_CAMERA, PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.geometry.transforms import transform_points
from mereo.models.model import Model
from mereo.models.weights import load_model, save_model
from mereo.scenes.parameters import parameters, random_state
from mereo.scenes.registry import load_scene
from mereo.scenes.statistical_model import StatisticalModel
from mereo.visualization.viewer import display, serve
from mereo.visualization.viewer.frame_page import FramePage
from mereo.visualization.viewer.freedom import DrawnShapes, ModeShapes
from mereo.visualization.viewer.laboratory import Laboratory, QuickRegistrar
from mereo.visualization.viewer.probe import ON_SURFACE, Inspection

AWAY = np.array([0.0, 0.0, 150.0])
needs_browser = pytest.mark.skipif(find_spec("viser") is None or BROWSER is None, reason="no viser or no Chromium")


@pytest.fixture(scope="module")
def model(rope: Model) -> Model:
    return rope


@pytest.fixture(scope="module")
def states(model: Model) -> StatisticalModel:
    assert model.statistical_model is not None
    return model.statistical_model


@pytest.fixture(scope="module")
def seen() -> PointCloud:
    return load_view("rope").depth.to_points()


@pytest.fixture(scope="module")
def registrar(model: Model, states: StatisticalModel) -> Registrar:
    """That of the default answer, but for the scene's draws, which take long."""
    return QuickRegistrar(model, states)


def inspected(
    cloud: PointCloud, model: Model, registrar: Registrar | None, resolution: int = 24, axes: CloudAxes = "camera"
) -> Inspection:
    return Inspection.of_answer(answer_to(cloud, model, registrar, resolution, axes))


@pytest.fixture(scope="module")
def inspection(model: Model, seen: PointCloud, registrar: Registrar) -> Inspection:
    return inspected(seen, model, registrar, 32)


def by_modes(states: StatisticalModel, seed: int = 0) -> Registration:
    """A library state, 150 units in front of the camera."""
    z = states.library[seed].astype(np.float64)
    material = states.material(z) + AWAY
    return Registration(states, material, "modes", z, 1.0, True, 0.98, True, 0.1)


def by_draws(states: StatisticalModel, seed: int = 3) -> Registration:
    scene = load_scene("rope")
    drawn = Drawn.of(scene, seed)
    deformations = drawn.deformations(scene, drawn.z)
    assert deformations is not None
    material = material_moved(scene, states, deformations) + AWAY
    return Registration(states, material, "draws", drawn.z, 1.0, True, 0.98, True, 0.1, drawn)


# --- a frame ----------------------------------------------------------------------------------------------------------


def test_a_page_of_a_frame_shows_and_asks_the_default_answer(inspection: Inspection, seen: PointCloud) -> None:
    registration = inspection.registration
    assert registration is not None and registration.explained > 0.9
    assert f"registered model (modes) explains {registration.explained:.1%}" in inspection.source
    np.testing.assert_array_equal(inspection.surfaces.merged()[0], registration.mesh.merged()[0])
    places = np.concatenate([seen.points[:5] + AWAY / 150, seen.points[:2] - AWAY / 15])
    found, wanted = inspection.ask(places), registration.query(places)
    np.testing.assert_array_equal(found.label, wanted.label)
    np.testing.assert_allclose(found.distance, wanted.distance)
    np.testing.assert_allclose(found.direction, wanted.direction)
    assert found.rest is not None and found.probability is not None and found.label[:5].any()
    np.testing.assert_allclose(found.rest, wanted.rest)
    np.testing.assert_allclose(found.probability, inspection.network(places).probability)


def test_a_scanners_frame_is_asked_in_its_own_axes(model: Model, seen: PointCloud, registrar: Registrar) -> None:
    scan = PointCloud(seen.points @ SCANNER_TO_CAMERA.T)
    inspection = inspected(scan, model, registrar, axes="scanner")
    assert inspection.registration is not None
    places = scan.points[:6] - [0.0, 0.0, 2.0]
    found = inspection.ask(places)
    # what the way to the surface leads to lies on it, in the scanner's frame
    ends = transform_points(inspection.T_camera_input, places + np.abs(found.distance)[:, None] * found.direction)
    np.testing.assert_allclose(inspection.registration.solids.nearest(ends).distance, 0.0, atol=1e-6)


def test_weights_without_a_model_are_asked_alone_and_it_is_said(model: Model, seen: PointCloud) -> None:
    inspection = inspected(seen, replace(model, statistical_model=None), None)
    assert inspection.registration is None and inspection.source == (
        "network alone: the weights carry no statistical model"
    )
    found = inspection.ask(seen.points[:4])
    assert found.rest is None and found.probability is not None


@pytest.mark.usefixtures("without_turns")
def test_an_answer_that_is_not_taken_says_why(model: Model, seen: PointCloud, registrar: Registrar) -> None:
    stretched = PointCloud(seen.points * [1.0, 2.5, 1.0])
    inspection = inspected(stretched, model, registrar)
    assert inspection.registration is None
    assert inspection.source.startswith("network alone: the registered model (")
    assert "of the observed points, too few" in inspection.source


# --- states -----------------------------------------------------------------------------------------------------------


def test_a_state_without_its_frame_is_asked_too(states: StatisticalModel, model: Model) -> None:
    registration = by_modes(states)
    inspection = Inspection.of_registration(registration, model, np.eye(4))
    found = inspection.ask(registration.material[-3:])
    assert found.probability is None and found.rest is not None
    np.testing.assert_allclose(found.rest, states.rest_points[-3:], atol=0.01)
    with pytest.raises(ValueError, match="there is no frame that the network has seen"):
        inspection.network(registration.material[-3:])


def test_the_command_shows_a_folder_a_file_and_a_frame_in_a_state(
    states: StatisticalModel, model: Model, seen: PointCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mereo.__main__ import main

    pages: list[tuple[Any, ...]] = []
    monkeypatch.setattr(serve, "start_server", lambda *_: None)
    monkeypatch.setattr(serve, "FramePage", lambda *given: pages.append(given))
    monkeypatch.setattr("mereo.visualization.viewer.lab_page.LabPage", lambda *given: pages.append(given))
    monkeypatch.setattr(serve.OpenPage, "__init__", lambda *_: None)
    monkeypatch.setattr(serve.OpenPage, "stay", lambda page, _: page)
    weights, folder, cloud = tmp_path / "rope.safetensors", tmp_path / "result", tmp_path / "cloud.npy"
    save_model(model, weights)
    np.save(cloud, seen.points)
    saved = load_model(weights).statistical_model
    assert saved is not None
    save_state(folder / STATE, state_of(by_modes(saved), "rope", weights=str(weights)))
    again = load_state(folder, saved)
    for arguments in ([str(folder)], [str(folder / STATE)], [str(cloud), "--state", str(folder)]):
        assert main(["view", *arguments]) == 0
        inspection = pages.pop()[1]
        np.testing.assert_allclose(inspection.surfaces.merged()[0], again.mesh.merged()[0])
        assert (inspection.cloud is None) == (len(arguments) == 1)
    assert main(["view", str(folder), "--scene", "rope"]) == 0
    freedom = pages.pop()[1].freedom
    assert isinstance(freedom, ModeShapes)
    np.testing.assert_array_equal(freedom.first(0), again.z)
    save_state(folder / STATE, state_of(by_draws(saved), load_scene("rope")))  # its weights are the shipped ones
    assert main(["view", "--state", str(folder), "--scene", "rope"]) == 0
    freedom = pages.pop()[1].freedom
    assert isinstance(freedom, DrawnShapes)
    wanted = random_state(load_scene("rope"), 3)
    for one, other in zip(freedom.parameters(freedom.first(0)), parameters(wanted), strict=True):
        assert one.name == other.name and one.value == pytest.approx(other.value, abs=1e-9)


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (("STATE", "--weights", "rope"), "belongs to the statistical model of other weights"),
        (("STATE",), "made with the weights 'gone.safetensors', which are not here: name them with --weights"),
        (("nowhere/state.json",), "nowhere/state.json does not exist; `mereo reconstruct` writes it where"),
        (("STATE", "--weights", "rope", "--scene", "robot"), "other weights"),
        (("CLOUD", "--state", "STATE", "--frame", "scanner", "--weights", "rope"), "the same --frame and --unit-m"),
        (("STATE", "--state", "STATE", "--weights", "rope"), "state.json"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_sentence(
    arguments: tuple[str, ...],
    sentence: str,
    states: StatisticalModel,
    seen: PointCloud,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from mereo.__main__ import main

    monkeypatch.setattr(serve, "import_viser", lambda: None)
    # the shipped weights' own, which may have to be built first
    monkeypatch.setattr(serve, "statistical_model_of", lambda _: replace(states, mean=states.mean + 1.0))
    save_state(tmp_path / STATE, state_of(by_modes(states), "rope", weights="gone.safetensors"))
    np.save(tmp_path / "cloud.npy", seen.points)
    places = {"STATE": str(tmp_path / STATE), "CLOUD": str(tmp_path / "cloud.npy")}
    assert main(["view", *(places.get(argument, argument) for argument in arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mereo: error: ") and error.count("\n") == 1
    assert sentence in error


def test_a_place_on_a_surface_is_its_segments(states: StatisticalModel, model: Model) -> None:
    base = (registration := by_modes(states)).mesh.segments[0]
    places = base.vertices[base.faces[::7]].mean(axis=1)  # rounding puts some of them outside
    found = Inspection.of_registration(registration, model, np.eye(4)).ask(np.concatenate([places, 1.01 * places]))
    met = np.abs(found.distance) <= ON_SURFACE * np.abs(places).max()
    assert met.any() and found.label[met].all() and not found.label[~met].all()


@needs_browser
def test_the_page_of_a_state_shows_its_mesh_and_answers(states: StatisticalModel, model: Model, tmp_path: Path) -> None:
    server = display.start_server(0, "mereo")
    page = FramePage(server, Inspection.of_registration(by_modes(states), model, np.eye(4)), "a state", "rope")
    with Page(tmp_path, f"http://127.0.0.1:{server.get_port()}", (760, 480)) as browser:
        until(lambda: "registered model (modes) explains 98.0%" in browser.text())
        browser.still()
        assert "Observed points" not in browser.text()
        base = page.mesh.segments[0].color
        until(lambda: pixels_of(browser.screenshot()[:, :420], base) > 150)
        page._move_probe(page.mesh.segments[0].vertices[0])
        until(lambda: "at rest at" in browser.text() and "on the surface" in browser.text())
        assert not page.coloring.visible
    server.stop()


# --- the laboratory ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_laboratory_shows_and_scores_the_default_answer(model: Model) -> None:
    laboratory = Laboratory(load_scene("rope"), model)
    view = laboratory.look(random_state(laboratory.scene, 3), laboratory.first_place())
    trial = laboratory.rebuild(view, 24, 24)
    alone = Laboratory(load_scene("rope"), replace(model, statistical_model=None)).rebuild(view, 24, 24)
    assert "registered model" in trial.source and alone.source.startswith("network alone")
    assert trial.scores.miou > alone.scores.miou
    assert laboratory.registrar is not None and laboratory.registrar.method == "auto"
    assert laboratory.registrar is laboratory.registrar  # built once


def test_while_a_slider_moves_the_modes_alone_are_fitted(model: Model) -> None:
    laboratory = Laboratory(load_scene("rope"), model)
    view = laboratory.look(random_state(laboratory.scene, 3), laboratory.first_place())
    quick = laboratory.quick_registrar
    assert isinstance(quick, QuickRegistrar)
    fitted = quick.fit_modes(CloudToFit(view.depth.to_points().points))
    assert quick.finish(fitted).method == "modes" and "states" not in vars(quick)
    assert "registered model (modes)" in laboratory.rebuild(view, 16, 12, quick=True).source


def test_sliders_of_modes_move_the_model(states: StatisticalModel) -> None:
    freedom = ModeShapes("rope", states, np.where(np.arange(states.count) == 1, 4.2, 0.5))
    shape = freedom.first(7)
    sliders = freedom.parameters(shape)
    assert [slider.name for slider in sliders] == [f"mode {number}" for number in range(1, 11)]
    assert (sliders[1].low, sliders[1].high, sliders[1].value) == (-5.0, 5.0, 4.2)
    assert (sliders[0].low, sliders[0].high) == (-3.0, 3.0)
    moved = freedom.moved(shape, sliders[2], -1.5)
    assert moved[2] == -1.5 and shape[2] == 0.5
    np.testing.assert_array_equal(np.delete(moved, 2), np.delete(shape, 2))
    state = freedom.state(moved)
    np.testing.assert_allclose(state.mesh.merged()[0], states.material(moved)[: sum(states.vertex_counts)], atol=1e-9)
    vertices = state.mesh.segments[0].vertices
    np.testing.assert_allclose(state.deformations[0](states.rest.segments[0].vertices), vertices, atol=0.5)
    assert np.abs(freedom.random(1)).max() < 5 and (freedom.random(1) != freedom.random(2)).any()


@pytest.mark.slow
def test_a_modes_state_is_seen_and_rebuilt(states: StatisticalModel, model: Model) -> None:
    freedom = ModeShapes("rope", states, states.library[4].astype(np.float64))
    laboratory = Laboratory(load_scene("rope"), model, shapes=freedom)
    view = laboratory.look(freedom.first(0), laboratory.first_place())
    assert laboratory.rebuild(view, 16, 12).scores.iou > 0.5


def test_the_sliders_of_draws_start_in_their_state() -> None:
    start = random_state(toy_scene(), 5)
    freedom = DrawnShapes(toy_scene(), start)
    assert freedom.first(0) is start and DrawnShapes(toy_scene()).first(5).keys == start.keys
    slider = freedom.parameters(start)[0]
    moved = freedom.moved(start, slider, 0.25)
    assert freedom.parameters(moved)[0].value == pytest.approx(0.25)
    gone = replace(slider, key=(slider.key[0], 99))
    assert freedom.moved(start, gone, 0.5) is start
