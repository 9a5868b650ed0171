"""States beside one: their directions, played without the scene's own test, and with one joint moved."""

from dataclasses import dataclass
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import Generator, default_rng
from numpy.testing import assert_allclose
from scipy.stats import norm as norm_of
from toy_scene import rest_mesh

from mereo.deformation.draw_names import named
from mereo.deformation.maps import Deformation
from mereo.fitting.draws.playback import Drawn, DrawnStates
from mereo.geometry.transforms import unit_rows
from mereo.scenes.random_states import scene_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene, Workspace


@dataclass(frozen=True, eq=False)
class Moved:
    by: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return points + self.by


def sample_moves(rng: Generator) -> tuple[Deformation, ...]:
    """Moves by a direction, by rows and a rest that are directions, and by normal numbers that are none."""
    toward = named(rng, "toward").normal(size=(1, 3))
    wave = named(rng, "waves").normal(size=(4, 3))
    sides = unit_rows(wave[:2])
    shares = wave[2:] / norm(wave[2:])
    amounts = named(rng, "amounts").normal(size=3)
    return tuple(Moved(2 * unit_rows(toward)[0] + sides[i % 2] + 3 * shares[i % 2] + amounts) for i in range(4))


def test_what_is_a_direction_is_seen_by_what_its_length_moves() -> None:
    scene = Scene("moves", rest_mesh(), sample_moves, Workspace())
    states = DrawnStates.of(scene, scene_model(scene, 30, 1000), 4, 1000)
    rows = {place[1].name: [row.tolist() for row in rows] for place, rows in states.directions.items()}
    assert rows == {"toward": [[0, 1, 2]], "waves": [[0, 1, 2], [3, 4, 5], [6, 7, 8, 9, 10, 11]], "amounts": []}
    drawn = states.drawn(1001)
    plain = Drawn.of(scene, 1001)
    assert_allclose([norm(drawn.z[row]) ** 2 for row in drawn.directions], [1, 1, 1, 2.5])
    assert_allclose(drawn.z[-3:], plain.z[-3:])
    before, after = (states.played.moved(plain.deformations(scene, z) or ()) for z in (plain.z, drawn.z))
    assert_allclose(after, before, atol=1e-6)


REFUSED = 2.0 * norm_of.cdf(1e-3 - 0.02) - 1.0
"""Amount one step of differences beside that of 1e-3 standard deviations."""


def sample_apart(rng: Generator) -> tuple[Deformation, ...]:
    """Moves of all segments together and of each alone, which the last one may not do by one amount."""
    whole = rng.normal(size=3)
    alone = rng.uniform(-1.0, 1.0, size=(4, 3))
    if np.isclose(alone[3, 2], REFUSED):
        raise ValueError
    return tuple(Moved(whole + each) for each in alone)


@pytest.mark.parametrize(("last", "plays"), [(1.0, 7), (1e-3, 11)])
def test_draws_of_different_segments_are_played_at_once(last: float, plays: int) -> None:
    scene = Scene("apart", rest_mesh(), sample_apart, Workspace())
    states = DrawnStates.of(scene, scene_model(scene, 30, 1000), 4, 1000)
    drawn = states.drawn(1000)
    assert states.reach[drawn.sizes].sum(axis=0).tolist() == [4] * 3 + [1] * 12
    z = np.append(drawn.z[:-1], last)
    positions = states.played.moved(drawn.deformations(scene, z) or ())
    alone = states._differences(drawn, z, positions, True)
    played = Mock(wraps=drawn.deformations)
    counted = Mock(drawn, sizes=drawn.sizes, smooth=drawn.smooth, deformations=played)
    assert_allclose(states.derivatives(counted, z, positions), alone, atol=1e-6)
    assert played.call_count == plays  # this state, three together, the twelve in fours, and one group one by one


REFUSES = {"human": 7, "robot": 3, "rope": 1, "sheet": 5}
"""A seed of each scene beside whose state are some that it refuses."""


@pytest.mark.parametrize("name", [*REFUSES, "lizard"])
def test_a_scene_that_tests_its_states_plays_their_neighbours_without(name: str) -> None:
    scene = load_scene(name)
    drawn = Drawn.of(scene, REFUSES.get(name, 7))
    rng = default_rng(0)
    refused = 0
    points = [segment.vertices[::50] for segment in scene.rest.segments]
    for _ in range(15):
        z = np.where(drawn.smooth, drawn.z + 3.0 * rng.normal(size=len(drawn.z)), drawn.z)
        tested, untested = drawn.deformations(scene, z), drawn.deformations(scene, z, checked=False)
        if tested is None:
            refused += untested is not None
            continue
        assert untested is not None
        for one, other, places in zip(tested, untested, points, strict=True):
            assert np.array_equal(one(places), other(places))
    assert (refused > 0) == (name in REFUSES)


@pytest.mark.parametrize(("name", "calls"), [("robot", {(1,) * 7}), ("rope", {(1, 8, 8, 1), (1,) * 6})])
def test_draws_of_refused_attempts_are_not_part_of_a_state(name: str, calls: set[tuple[int, ...]]) -> None:
    scene = load_scene(name)
    assert {Drawn.of(scene, seed).sizes for seed in range(10)} <= calls
