"""States of the laboratory: at rest, on a walk, as text, and back again."""

import json
from typing import Any

import numpy as np
import pytest
from toy_scene import toy_scene

from mereo.fitting.draws.playback import Drawn, material_moved
from mereo.fitting.registration.registration import Registration
from mereo.fitting.registration.state import state_of
from mereo.scenes.parameters import Played, parameters, random_state
from mereo.scenes.random_states import scene_model
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel
from mereo.scenes.walks import blend, smooth_round
from mereo.visualization.viewer.freedom import DrawnShapes, ModeShapes
from mereo.visualization.viewer.wishes import STEPS, Wishes

SCENE = toy_scene()


@pytest.fixture(scope="module")
def states() -> StatisticalModel:
    return scene_model(SCENE, 40)


def places(scene: Scene, played: Played) -> np.ndarray:
    return scene.deform(played.deformations).mesh.merged()[0]


# --- rest -------------------------------------------------------------------------------------------------------------


def test_at_rest_is_the_rest_mesh_and_a_slider_goes_on_from_its_own_draws() -> None:
    freedom = DrawnShapes(SCENE)
    before = freedom.random(3)
    rest = freedom.rest(before)
    np.testing.assert_array_equal(freedom.state(rest).mesh.merged()[0], SCENE.rest.merged()[0])
    assert freedom.parameters(rest) == freedom.parameters(before)
    slider = freedom.parameters(before)[1]
    moved, wanted = (freedom.moved(shape, slider, 0.1) for shape in (rest, before))
    np.testing.assert_array_equal(places(SCENE, moved), places(SCENE, wanted))


def test_at_rest_by_modes_is_near_the_rest_mesh(states: StatisticalModel) -> None:
    freedom = ModeShapes("toy", states, states.library[0].astype(float))
    found = states.material(freedom.rest(freedom.first(0)))
    T, _ = states.project(states.rest_points)
    aligned = found @ T[:3, :3].T + T[:3, 3]
    assert np.sqrt(((aligned - states.rest_points) ** 2).sum(axis=1).mean()) < 0.05 * states.half


# --- walks ------------------------------------------------------------------------------------------------------------


def test_a_walk_is_smooth_and_comes_back() -> None:
    start = random_state(SCENE, 5)
    path = [places(SCENE, played) for played in smooth_round(SCENE, start, 11, 96)]
    assert len(path) == 96
    np.testing.assert_allclose(path[-1], places(SCENE, start), atol=1e-6)
    steps = [np.abs(b - a).max() for a, b in zip([places(SCENE, start), *path[:-1]], path, strict=True)]
    assert max(steps) < 0.15 * max(np.abs(place - path[-1]).max() for place in path) + 1e-9
    other = [places(SCENE, played) for played in smooth_round(SCENE, start, 12, 4)]
    assert np.abs(other[0] - path[23]).max() > 1.0, "another seed, another way"


def test_a_walk_leaves_out_what_the_scene_refuses_and_keeps_choices() -> None:
    def fussy(rng: np.random.Generator) -> Any:
        kind, bend = int(rng.integers(0, 5)), float(rng.uniform(0, 1))
        if bend > 0.5:
            raise ValueError("too far")
        seen.append(kind)
        return SCENE.sample_deformations(np.random.default_rng(kind))

    seen: list[int] = []
    scene = Scene("fussy", SCENE.rest, fussy)
    start = next(random_state(scene, seed) for seed in range(20) if _plays(scene, seed))
    seen.clear()
    rounds = [list(smooth_round(scene, start, seed, 40)) for seed in range(4)]
    assert all(len(states) > 5 for states in rounds) and any(len(states) < 40 for states in rounds)
    assert len(set(seen)) == 1


def _plays(scene: Scene, seed: int) -> bool:
    try:
        random_state(scene, seed)
    except ValueError:
        return False
    return True


def test_the_way_between_modes_ends_where_it_began(states: StatisticalModel) -> None:
    freedom = ModeShapes("toy", states, states.library[0].astype(float))
    path = list(freedom.walk(freedom.first(0), 4, 24))
    np.testing.assert_allclose(path[-1], freedom.first(0), atol=1e-12)
    np.testing.assert_allclose(path[11], freedom.random(4), atol=1e-12)
    assert (np.diff(blend(24)[:12]) > 0).all()


def test_any_other_wish_ends_a_walk_which_is_one_change() -> None:
    wishes: Wishes[Played] = Wishes(DrawnShapes(SCENE))
    assert wishes.fulfil() is None
    first = wishes.shape
    assert first is not None and not wishes.can_go_back
    wishes.walk()
    passed = []
    for _ in range(STEPS + 2):
        wishes.fulfil()
        passed.append(wishes.shape)
    assert not wishes.is_walking and len(set(map(id, passed))) == STEPS + 1
    wishes.back()
    wishes.fulfil()
    assert wishes.shape is first and not wishes.can_go_back
    wishes.walk()
    wishes.fulfil()
    assert wishes.is_walking
    slider = parameters(first)[0]
    wishes.move(slider, 0.3)
    wishes.fulfil()
    assert not wishes.is_walking and wishes.shape is not None
    assert parameters(wishes.shape)[0].value == pytest.approx(0.3)


# --- text -------------------------------------------------------------------------------------------------------------


def test_a_copied_state_is_the_same_when_it_is_pasted(states: StatisticalModel) -> None:
    freedom = DrawnShapes(SCENE)
    for shape in (freedom.random(8), freedom.rest(freedom.random(8))):
        back = freedom.read(freedom.text(shape))
        np.testing.assert_allclose(places(SCENE, back), places(SCENE, shape), atol=1e-6)
        np.testing.assert_allclose([s.value for s in parameters(back)], [s.value for s in parameters(shape)], atol=1e-6)
    modes = ModeShapes("toy", states, states.library[1].astype(float))
    np.testing.assert_allclose(modes.read(modes.text(modes.start)), modes.start, atol=1e-8)


def registered(states: StatisticalModel, seed: int, draws: bool) -> Registration:
    if not draws:
        z = states.library[seed].astype(np.float64)
        return Registration(states, states.material(z), "modes", z, 1.0, True, 0.98, True, 0.1)
    drawn = Drawn.of(SCENE, seed)
    deformations = drawn.deformations(SCENE, drawn.z)
    assert deformations is not None
    material = material_moved(SCENE, states, deformations)
    return Registration(states, material, "draws", drawn.z, 1.0, True, 0.98, True, 0.1, drawn)


def test_the_content_of_a_state_file_can_be_pasted(states: StatisticalModel) -> None:
    text = state_of(registered(states, 4, draws=True), SCENE).model_dump_json()
    found = DrawnShapes(SCENE).read(text)
    np.testing.assert_allclose(places(SCENE, found), places(SCENE, random_state(SCENE, 4)), atol=1e-6)
    text = state_of(registered(states, 2, draws=False), "toy").model_dump_json()
    np.testing.assert_array_equal(ModeShapes("toy", states, states.library[0]).read(text), states.library[2])


PASTED = "paste the whole text that the box has shown for a state, or the content of a state.json"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text[:-5], f"^the text is no state: it is not JSON: {PASTED}$"),
        (lambda _: "", "^the text is no state: it is not JSON"),
        (lambda _: "[1, 2]", "^the text is no state: it must be .*object"),
        (lambda _: "[" * 100_000, "^the text is no state: it is not JSON"),
        (lambda _: "x" * 2_000_000, "^the text has 2,000,000 characters, and a state a few thousand"),
        (
            lambda text: text.replace('"shares": [', '"shares": [2.5, '),
            "`shares.0` is 2.5; it must be less than or equal",
        ),
        (lambda text: text.replace('"shares": [', '"shares": [NaN, '), "`shares.0` is nan; it must be a finite number"),
        (lambda text: text.replace('"sizes": [3', '"sizes": [4'), "it has 4 `shares`, but its `sizes` add up to 5"),
        (lambda text: text.replace('"seed"', '"sead"'), "`seed` is missing"),
        (
            lambda text: text.replace('"toy"', '"rope"'),
            "state of the scene 'rope', and 'toy' is shown: open that scene",
        ),
        (
            lambda text: text.replace("[3, 1]", "[1, 3]"),
            "the scene 'toy' does not take these 2 draws; .*: paste the whole",
        ),
    ],
)
def test_what_is_wrong_with_a_pasted_text_is_said_in_one_sentence(change: Any, sentence: str) -> None:
    freedom = DrawnShapes(SCENE)
    text = freedom.text(freedom.random(1))
    assert json.loads(text)["sizes"] == [3, 1]
    with pytest.raises(ValueError, match=sentence) as told:
        freedom.read(change(text))
    assert "\n" not in str(told.value) and len(str(told.value)) < 300


def test_a_state_of_the_other_kind_is_said(states: StatisticalModel) -> None:
    draws, modes = DrawnShapes(SCENE), ModeShapes("toy", states, states.library[0].astype(float))
    with pytest.raises(ValueError, match="a state of the modes of 'toy', and the sliders here are the scene's draws"):
        draws.read(modes.text(modes.start))
    with pytest.raises(ValueError, match="a state of the draws of 'toy', and the sliders here are modes"):
        modes.read(draws.text(draws.random(0)))
    with pytest.raises(ValueError, match="a state of another statistical model; .* with those --weights"):
        modes.read(_other(modes))


def _other(modes: ModeShapes) -> str:
    found = json.loads(modes.text(modes.start))
    return json.dumps(found | {"model": "0" * 64})
