"""Draws in the order of the calls lead to the same state again, with the same sliders."""

import numpy as np
import pytest
from toy_scene import toy_scene

from mereo.scenes.parameters import Played, Refused, draw_names, parameters, played_back, random_state, set_value
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene


def places(scene: Scene, played: Played) -> np.ndarray:
    return scene.deform(played.deformations).mesh.merged()[0]


@pytest.mark.parametrize("name", ["toy", "rope", "robot"])
def test_the_same_draws_give_the_same_state_and_sliders_that_move_it(name: str) -> None:
    scene = toy_scene() if name == "toy" else load_scene(name)
    before = random_state(scene, 7)
    again = played_back(scene, 7, [call.shares for call in before.calls])
    np.testing.assert_array_equal(places(scene, again), places(scene, before))
    assert again.keys == before.keys and parameters(again) == parameters(before)
    slider = parameters(again)[0]
    middle = (slider.low + slider.high) / 2
    np.testing.assert_array_equal(
        places(scene, set_value(scene, again, slider, middle)), places(scene, set_value(scene, before, slider, middle))
    )


def test_every_number_has_the_name_of_its_slider() -> None:
    assert draw_names(random_state(toy_scene(), 0)) == (
        *("whole: shear x", "whole: shear y", "whole: shear z"),
        "ball: lift",
    )


def test_many_numbers_with_one_slider_are_counted() -> None:
    rope = load_scene("rope")
    swing = next(
        played
        for played in (random_state(rope, seed) for seed in range(20))
        if any(call.name.parts == ("swing",) for call in played.calls)
    )
    names = draw_names(swing)
    assert {f"swing: amplitudes {number}" for number in range(1, 9)} <= set(names)
    assert len(names) == len(set(names)) == sum(len(call.shares) for call in swing.calls)


@pytest.mark.parametrize("sizes", [(3,), (3, 2), (4, 1), ()])
def test_other_draws_than_the_scene_makes_are_refused(sizes: tuple[int, ...]) -> None:
    with pytest.raises(Refused, match=f"the scene 'toy' does not take these {len(sizes)} draws; .* register the frame"):
        played_back(toy_scene(), 0, [np.full(size, 0.5) for size in sizes])
