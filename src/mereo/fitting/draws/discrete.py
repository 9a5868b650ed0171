"""States that differ from another in discrete draws: how many corners of a sheet are folded, and which.

Derivatives do not reach across them, and random states hold one combination too seldom to be near everything else.
So a state that is right but for such a choice keeps all that it has drawn; the choice, and what it asks for, is drawn
anew.
"""

from collections.abc import Sequence

import numpy as np

from mereo.fitting.draws.playback import Drawn, shares_of
from mereo.scenes.draw_recorder import SMOOTH, Call, OutOfDraws, Recorder
from mereo.scenes.given_draws import played_back
from mereo.scenes.parameters import play
from mereo.scenes.scene import Scene

MORE_CALLS = 12
"""Calls that another choice may ask for in addition; a scene that asks for more has thrown its first attempt away."""


def chosen_otherwise(scene: Scene, drawn: Drawn, count: int) -> list[Drawn]:
    """States with some of the discrete draws, and what they ask for, drawn anew; fewer than ``count`` where refused.

    Nothing where the scene has no discrete draws. The same state gives the same ones.
    """
    calls = played_back(scene, drawn.seed, shares_of(drawn.z, drawn.sizes)).calls
    discrete = [number for number, call in enumerate(calls) if call.kind not in SMOOTH]
    if not discrete:
        return []
    rng = np.random.default_rng(drawn.seed)
    found = [_drawn_anew(scene, calls, _some(discrete, rng), int(rng.integers(2**31))) for _ in range(count)]
    return [one for one in found if one is not None]


def _some(numbers: Sequence[int], rng: np.random.Generator) -> set[int]:
    """At least one of them, each with probability one half or more."""
    taken = rng.random(len(numbers)) < 0.5
    taken[rng.integers(len(numbers))] = True
    return {number for number, take in zip(numbers, taken, strict=True) if take}


def _drawn_anew(scene: Scene, calls: Sequence[Call], left_out: set[int], seed: int) -> Drawn | None:
    given = {call.key: call.shares for number, call in enumerate(calls) if number not in left_out}
    recorder = Recorder(seed, given, len(calls) + MORE_CALLS)
    try:
        play(scene, recorder)
    except (OutOfDraws, ValueError):
        return None
    return Drawn.recorded(recorder.calls, seed)
