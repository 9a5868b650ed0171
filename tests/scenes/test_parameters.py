"""Every number that a scene draws can be moved, within the scene's bounds, and nothing else moves with it."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy import ndarray
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import kstest
from toy_scene import rest_mesh, toy_scene

from mereo.deformation.draw_names import DrawName, named, part
from mereo.deformation.maps import Deformation, Rigid
from mereo.geometry.conventions import WholeNumbers
from mereo.scenes.draw_recorder import Recorder
from mereo.scenes.parameters import (
    Parameter,
    Played,
    Refused,
    draw_names,
    parameters,
    play,
    played_back,
    random_state,
    set_value,
    turned,
)
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene

STILL = np.zeros(3)


def scene_of(sample: Callable[[Generator], tuple[Deformation, ...]]) -> Scene:
    return Scene("drawn", rest_mesh(), sample)


def shifted(*values: float) -> tuple[Deformation, ...]:
    """One rigid shift for all four segments of the toy."""
    return (Rigid(STILL, np.array([*values, 0.0, 0.0, 0.0][:3]), STILL),) * 4


def slider(played: Played, name: str) -> Parameter:
    return next(parameter for parameter in parameters(played) if parameter.name == name)


def shift_of(played: Played) -> ndarray:
    return played.deformations[0](np.zeros((1, 3)))[0]


@pytest.mark.parametrize(
    "draw, cdf",
    [
        (lambda rng: rng.uniform(2.0, [3.0, 5.0], size=(2000, 2))[:, 1], ("uniform", (2.0, 3.0))),
        (lambda rng: rng.random(2000), ("uniform", ())),
        (lambda rng: rng.normal(1.0, 2.0, size=2000), ("norm", (1.0, 2.0))),
        (lambda rng: rng.standard_normal(2000), ("norm", ())),
        (lambda rng: rng.triangular(0.0, 1.0, 4.0, size=2000), ("triang", (0.25, 0.0, 4.0))),
    ],
)
def test_a_recorder_draws_from_the_distribution_that_is_asked_for(draw: Callable, cdf: tuple) -> None:
    name, parameters = cdf
    assert kstest(draw(Recorder(3, {})), name, parameters).pvalue > 0.01


def test_a_recorder_draws_whole_numbers_and_choices_as_numpy_does() -> None:
    recorder = Recorder(0, {})
    assert set(recorder.integers(2, 5, size=200)) == {2, 3, 4}
    assert set(recorder.integers(2, size=200, endpoint=True)) == {0, 1, 2}
    chosen = recorder.choice(["a", "b"], size=2000, p=[0.9, 0.1])
    assert 0.86 < (chosen == "a").mean() < 0.94
    assert sorted(recorder.permutation(5)) == [0, 1, 2, 3, 4]
    assert isinstance(recorder.uniform(), float) and isinstance(recorder.integers(3), int)
    assert recorder.gamma(2.0) > 0  # what is not recorded still works


def test_moving_one_number_moves_nothing_else() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        along = named(rng, "along").uniform(-5.0, 5.0)
        across = named(rng, "across").uniform(1.0, 2.0)
        return shifted(along, across, rng.normal())

    scene = scene_of(sample)
    played = random_state(scene, 4)
    before = shift_of(played)
    moved = set_value(scene, played, slider(played, "along"), 3.25)
    assert_allclose(shift_of(moved), [3.25, *before[1:]], atol=1e-12)
    assert slider(moved, "along").value == pytest.approx(3.25)
    beyond = set_value(scene, moved, slider(moved, "across"), 99.0)
    assert_allclose(shift_of(beyond), [3.25, 2.0, before[2]], atol=1e-8)


def test_draws_that_a_choice_brings_come_and_go_and_come_back_the_same() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        first = rng.uniform(0.0, 1.0) if rng.random() < 0.5 else 7.0 + rng.normal()
        last = rng.uniform(0.0, 1.0)
        return shifted(first, last)

    scene = scene_of(sample)
    played = random_state(scene, 0)
    switch = parameters(played)[0]
    low = set_value(scene, played, switch, 0.2)
    high = set_value(scene, low, parameters(low)[0], 0.8)
    back = set_value(scene, high, parameters(high)[0], 0.3)
    assert low.keys != high.keys
    assert shift_of(low)[0] < 1 < 2 < shift_of(high)[0]
    assert_array_equal(shift_of(back), shift_of(low))
    assert shift_of(high)[1] == shift_of(low)[1]  # drawn after the choice, and not touched by it


def rejecting(rng: Generator) -> tuple[Deformation, ...]:
    while True:
        one = named(rng, "one").uniform(0.0, 1.0)
        other = named(rng, "other").uniform(0.0, 1.0)
        if one + other > 1.5:
            break
    return shifted(one, other, rng.uniform(0.0, 1.0))


def test_attempts_that_the_scene_threw_away_have_no_sliders() -> None:
    scene = scene_of(rejecting)
    attempts = []
    for seed in range(20):
        recorder = Recorder(seed, {})
        play(scene, recorder)
        attempts.append(len(recorder.calls))
        played = random_state(scene, seed)
        assert len(parameters(played)) == 3
        # what is kept leads to the same state at once
        again = Recorder(seed, {c.key: c.shares for c in played.calls})
        deformations = play(scene, again)
        assert len(again.calls) == 3
        assert_array_equal(deformations[0](np.zeros((1, 3)))[0], shift_of(played))
    assert max(attempts) > 9


def test_a_refused_value_is_said_and_an_allowed_one_taken() -> None:
    scene = scene_of(rejecting)
    played = random_state(scene, 1)
    for name, value in (("one", 0.99), ("other", 0.6)):
        played = set_value(scene, played, slider(played, name), value)
    assert_allclose(shift_of(played)[:2], [0.99, 0.6], atol=1e-8)
    with pytest.raises(Refused, match="the scene refuses this value of 'other'"):
        set_value(scene, played, slider(played, "other"), 0.4)


def test_loops_that_keep_what_they_draw_keep_their_sliders() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        steps = [rng.uniform(0.0, 1.0) for _ in range(3)]
        while rng.random() < 0.8:
            steps.append(rng.uniform(0.0, 1.0))
        return shifted(sum(steps))

    scene = scene_of(sample)
    for seed in range(5):
        recorder = Recorder(seed, {})
        deformations = play(scene, recorder)
        played = random_state(scene, seed)
        assert len(played.calls) == len(recorder.calls)
        assert_array_equal(deformations[0](np.zeros((1, 3)))[0], shift_of(played))


def test_many_numbers_move_together_and_stay_as_random_as_they_were() -> None:
    shares = default_rng(0).random(4000)
    for turn in (0.1, 0.3, 0.77):
        assert kstest(turned(shares, turn, 5), "uniform").pvalue > 0.01
    assert_allclose(turned(shares, 1.0, 5), shares, atol=1e-9)
    assert np.abs(turned(shares, 0.01, 5) - shares).max() < 0.1
    assert np.abs(np.corrcoef(turned(shares, 0.25, 5), shares)[0, 1]) < 0.05


def test_an_array_of_many_numbers_has_one_slider() -> None:
    scene = scene_of(lambda rng: shifted(float(rng.normal(size=(4, 3)).sum())))
    played = random_state(scene, 0)
    (whole,) = parameters(played)
    assert (whole.index, whole.low, whole.high, whole.value) == (None, 0.0, 1.0, 0.0)
    moved = set_value(scene, played, whole, 0.2)
    assert shift_of(moved)[0] != shift_of(played)[0]
    home = set_value(scene, moved, parameters(moved)[0], 1.0)
    assert_allclose(shift_of(home), shift_of(played), atol=1e-6)


def test_bounds_in_either_order_are_one_slider() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        return shifted(named(rng, "down").uniform(5.0, -1.0), *named(rng, "mixed").uniform([0.0, 4.0], [2.0, 3.0]))

    scene = scene_of(sample)
    played = random_state(scene, 0)
    assert [(f.low, f.high) for f in parameters(played)] == [(-1.0, 5.0), (0.0, 2.0), (3.0, 4.0)]
    assert_allclose([f.value for f in parameters(played)], shift_of(played), atol=1e-8)
    moved = set_value(scene, set_value(scene, played, slider(played, "down"), 4.5), slider(played, "mixed 2"), 3.1)
    assert_allclose(shift_of(moved)[[0, 2]], [4.5, 3.1], atol=1e-8)
    assert slider(moved, "down").value == pytest.approx(4.5)


def test_a_choice_of_unequal_options_is_the_option_that_its_slider_shows() -> None:
    scene = scene_of(lambda rng: shifted(float(rng.choice(4, p=[0.1, 0.35, 0.25, 0.3]))))
    for seed in range(10):
        played = random_state(scene, seed)
        (option,) = parameters(played)
        assert (option.low, option.high, option.value) == (0.0, 3.0, shift_of(played)[0])
        for wanted in range(4):
            moved = set_value(scene, played, option, wanted)
            assert shift_of(moved)[0] == parameters(moved)[0].value == wanted


def test_a_scene_names_its_draws_and_the_source_names_the_others() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        with part(rng, "arm"):
            with part(rng, "left"):
                first = named(rng, "bend", "rad").uniform(0.0, np.pi)
            first += named(rng, ("swing", "play"), "rad").uniform(0.0, 1.0, size=2).sum()
        offset = rng.uniform(0.0, 1.0)
        return shifted(first, offset, rng.uniform(0.0, 1.0))

    found = parameters(random_state(scene_of(sample), 0))
    names = ["arm/left bend/°", "arm/swing/°", "arm/play/°", "whole/offset/", "whole/sample/"]
    assert ["/".join((f.group, f.name, f.unit)) for f in found] == names
    assert found[0].high == pytest.approx(180.0)


def test_draws_of_one_name_are_counted() -> None:
    def sample(rng: Generator) -> tuple[Deformation, ...]:
        steps = [named(rng, "step").uniform(0.0, 1.0, size=2).sum() for _ in range(3)]
        return shifted(*steps[:2], named(rng, "other").uniform())

    names = [f.name for f in parameters(random_state(scene_of(sample), 0))]
    assert names == ["step 1 1", "step 1 2", "step 2 1", "step 2 2", "step 3 1", "step 3 2", "other"]


def test_names_change_no_number_and_are_taken_once() -> None:
    plain, told = default_rng(5), default_rng(5)
    with part(told, "arm"):
        assert plain.uniform() == named(told, "bend").uniform()
    recorder = Recorder(0, {})
    with pytest.raises(RuntimeError), part(recorder, "arm"):
        named(recorder, "bend").uniform()
        recorder.uniform()
        raise RuntimeError
    recorder.uniform()
    assert [call.name for call in recorder.calls] == [DrawName(("arm",), "bend"), DrawName(("arm",)), DrawName()]


def test_draws_keep_their_values_with_their_names() -> None:
    """Two tools take turns at one line of the source; each is remembered by its name, not by its turn."""

    def sample(rng: Generator) -> tuple[Deformation, ...]:
        order = ("hook", "probe") if named(rng, "probe first above 0.5").random() < 0.5 else ("probe", "hook")
        depth = {}
        for tool in order:
            with part(rng, tool):
                depth[tool] = named(rng, "depth").uniform(0.0, 1.0)
        return shifted(depth["hook"], depth["probe"])

    scene = scene_of(sample)
    played = random_state(scene, 0)
    before = shift_of(played)
    for value in (0.2, 0.8):
        played = set_value(scene, played, parameters(played)[0], value)
        assert_array_equal(shift_of(played), before)


def places(scene: Scene, played: Played) -> ndarray:
    return scene.deform(played.deformations).mesh.merged()[0]


@pytest.mark.parametrize("name", ["toy", "rope", "robot"])
def test_the_same_draws_give_the_same_state_and_sliders_that_move_it(name: str) -> None:
    scene = toy_scene() if name == "toy" else load_scene(name)
    before = random_state(scene, 7)
    again = played_back(scene, 7, [call.shares for call in before.calls])
    assert_array_equal(places(scene, again), places(scene, before))
    assert again.keys == before.keys and parameters(again) == parameters(before)
    first = parameters(again)[0]
    moved = [set_value(scene, played, first, (first.low + first.high) / 2) for played in (again, before)]
    assert_array_equal(*(places(scene, played) for played in moved))


def test_every_number_has_the_name_of_its_slider_and_those_of_one_are_counted() -> None:
    toy = draw_names(random_state(toy_scene(), 0))
    assert toy == ("whole: shear x", "whole: shear y", "whole: shear z", "ball: lift")
    states = (random_state(load_scene("rope"), seed) for seed in range(20))
    swing = next(played for played in states if any(call.name.parts == ("swing",) for call in played.calls))
    names = draw_names(swing)
    assert {f"swing: amplitudes {number}" for number in range(1, 9)} <= set(names)
    assert len(names) == len(set(names)) == sum(len(call.shares) for call in swing.calls)


@pytest.mark.parametrize("sizes", [(3,), (3, 2), (4, 1), ()])
def test_other_draws_than_the_scene_makes_are_refused(sizes: WholeNumbers) -> None:
    with pytest.raises(Refused, match=f"the scene 'toy' does not take these {len(sizes)} draws; .* register the frame"):
        played_back(toy_scene(), 0, [np.full(size, 0.5) for size in sizes])
