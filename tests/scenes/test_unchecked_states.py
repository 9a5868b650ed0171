"""States beside a tested one are played without the scene's own test: the same states, and those it refuses too."""

import numpy as np
import pytest

from mereo.fitting.draws.playback import Drawn
from mereo.scenes.registry import load_scene

REFUSES = {"human": 7, "robot": 3, "rope": 1, "sheet": 5}
"""A seed of each scene beside whose state are some that it refuses."""


@pytest.mark.parametrize("name", [*REFUSES, "lizard"])
def test_a_scene_that_tests_its_states_plays_their_neighbours_without(name: str) -> None:
    scene = load_scene(name)
    drawn, rng, refused = Drawn.of(scene, REFUSES.get(name, 7)), np.random.default_rng(0), 0
    points = [segment.vertices[::50] for segment in scene.rest.segments]
    for _ in range(15):
        z = np.where(drawn.smooth, drawn.z + 3.0 * rng.normal(size=len(drawn.z)), drawn.z)
        tested, untested = drawn.deformations(scene, z), drawn.deformations(scene, z, checked=False)
        if tested is None:
            refused += untested is not None
            continue
        assert untested is not None
        for one, other, part in zip(tested, untested, points, strict=True):
            assert np.array_equal(one(part), other(part))
    assert (refused > 0) == (name in REFUSES)


@pytest.mark.parametrize(("name", "calls"), [("robot", {(6, 1)}), ("rope", {(1, 8, 8, 1), (1,) * 6})])
def test_draws_of_refused_attempts_are_not_part_of_a_state(name: str, calls: set[tuple[int, ...]]) -> None:
    scene = load_scene(name)
    assert {Drawn.of(scene, seed).sizes for seed in range(10)} <= calls
