"""The lizard's links: each moves rigidly, and knuckles keep their clearance up to the limits."""

from collections.abc import Iterator

import numpy as np
from manifold3d import Manifold

from mereo_objects import lizard
from mereo_objects._hinges import Hinged, follow
from mereo_objects._lizard_parts import SPINE, leg, spine_links


def vertices(solid: Manifold) -> np.ndarray:
    return np.array(solid.to_mesh().vert_properties[:, :3], dtype=float)


def extreme_pose(rng: np.random.Generator) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Every angle at one of its two limits, play included."""
    limits = np.column_stack([np.full((len(SPINE), 2), lizard.SPINE_PLAY_RAD), lizard.SPINE_LIMIT_RAD])
    swing = np.array([[lizard.LEG_PLAY_RAD] * 2 + [limit] for limit in (lizard.SWING_RAD, lizard.FOOT_RAD)])
    legs = {name: rng.choice([-1.0, 1.0], size=(2, 3)) * swing for name in lizard.LEGS}
    return rng.choice([-1.0, 1.0], size=limits.shape) * limits, legs


def neighbours(
    spine: np.ndarray, legs: dict[str, np.ndarray]
) -> Iterator[tuple[Manifold, Manifold, np.ndarray, np.ndarray]]:
    """Every two links that share a knuckle, with their motions: the socket's first."""
    links, motions = spine_links(), lizard.spine_motions(spine)
    yield from zip(links[:-1], links[1:], motions[:-1], motions[1:], strict=True)
    for name, (plan, side, carrier) in lizard.LEGS.items():
        upper, foot = lizard._leg_motions(name, motions, legs[name])
        parts = leg(plan, side)
        yield links[carrier], parts.upper, motions[carrier], upper
        yield parts.upper, parts.foot, upper, foot


def test_links_keep_clear_of_each_other_at_the_limits() -> None:
    rng = np.random.default_rng(1)
    for _ in range(3):
        for socket, knob, before, after in neighbours(*extreme_pose(rng)):
            common = socket.transform(before[:3]) ^ knob.transform(after[:3])
            assert common.volume() < 1e-4 * knob.volume()


def test_a_chain_of_knuckles_moves_every_link_rigidly() -> None:
    vectors, _ = extreme_pose(np.random.default_rng(2))
    chain, motion = Hinged(SPINE, vectors), np.eye(4)
    for number, link in enumerate(spine_links()):
        if number > 0:
            motion = follow(motion, SPINE[number - 1], vectors[number - 1])
        points = vertices(link)
        assert np.allclose(chain(points), points @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)


def test_a_tail_curled_into_a_leg_is_refused() -> None:
    rest = np.stack([np.eye(4)] * (len(SPINE) + 1))
    legs = {name: np.stack([np.eye(4)] * 2) for name in lizard.LEGS}
    assert lizard.is_clear(rest, legs)
    tight = np.column_stack([np.zeros((len(SPINE), 2)), np.linspace(0.0, 0.8, len(SPINE))])  # beyond the limits
    motions = lizard.spine_motions(tight)
    carried = {name: np.stack([motions[carrier]] * 2) for name, (_, _, carrier) in lizard.LEGS.items()}
    assert not lizard.is_clear(motions, carried)
