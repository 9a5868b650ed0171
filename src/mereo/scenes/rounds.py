"""Ways from a played state: a smooth round of all its draws that comes back to where it began, and rest."""

from collections.abc import Iterator

import numpy as np

from mereo.deformation.maps import Identity
from mereo.scenes.draw_recorder import SMOOTH, Call, Shares
from mereo.scenes.given_draws import played_back
from mereo.scenes.parameters import Played, Refused, turned
from mereo.scenes.scene import Scene


def smooth_round(scene: Scene, start: Played, seed: int, count: int) -> Iterator[Played]:
    """States of one round, ``count`` of them at most, the last one the start again.

    All smooth draws go round a circle at once (``parameters.turned``), so every state is as random as the scene's own.
    Those that the scene refuses are left out.
    """
    for step in range(1, count + 1):
        try:
            shares = [_share(call, step / count, (seed, number)) for number, call in enumerate(start.calls)]
            yield played_back(scene, start.seed, shares)
        except Refused:
            continue


def _share(call: Call, turn: float, seed: tuple[int, int]) -> Shares:
    return turned(call.shares, turn, seed) if call.kind in SMOOTH else call.shares


def at_rest(scene: Scene, before: Played) -> Played:
    """The object at rest. Few scenes have draws that lead there, so these stay as they were, for the next move."""
    return Played(before.seed, before.calls, (Identity(),) * len(scene.rest.names), before.remembered, before.turns)


def is_at_rest(played: Played) -> bool:
    """Whether a state is that of ``at_rest``."""
    return all(isinstance(deformation, Identity) for deformation in played.deformations)


def blend(count: int) -> np.ndarray:
    """Shares of another state on a way there and back in ``count`` steps, slow at both ends."""
    return (1 - np.cos(2 * np.pi * np.arange(1, count + 1) / count)) / 2
