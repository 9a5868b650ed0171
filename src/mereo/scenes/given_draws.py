"""States of a scene from draws that are given in the order of its calls, and what each of the numbers is called.

    seed, shares -played_back-> Played -draw_names-> names

A key says where in the scene's code a draw comes from, and so belongs to one version of it; an order may be written to
a file.
"""

from collections.abc import Sequence

import numpy as np

from mereo.scenes.draw_recorder import Key, OutOfDraws, Recorder, Shares
from mereo.scenes.parameters import Played, Refused, parameters, play
from mereo.scenes.scene import Scene


class InOrder(Recorder):
    """Recorder that is given its draws in the order of the calls; more or other ones raise ``OutOfDraws``."""

    def __init__(self, seed: int, shares: Sequence[np.ndarray]) -> None:
        super().__init__(seed, {})
        self._shares = shares

    def _chosen(self, key: Key, size: int) -> Shares:
        number = len(self.calls)
        if number >= len(self._shares) or len(self._shares[number]) != size:
            raise OutOfDraws
        return self._shares[number]


def played_back(
    scene: Scene, seed: int, shares: Sequence[np.ndarray], cure: str = "register the frame again"
) -> Played:
    """State of a scene by the shares of each call; raises ``Refused``, with a ``cure``, where it does not take them."""
    recorder = InOrder(seed, shares)
    try:
        deformations = play(scene, recorder)
    except (OutOfDraws, ValueError):
        raise Refused(
            f"the scene {scene.name!r} does not take these {len(shares)} draws; they are of another scene, or of "
            f"another version of it: {cure}"
        ) from None
    calls = tuple(recorder.calls)
    return Played(seed, calls, deformations, {call.key: call.shares for call in calls}, {})


def draw_names(played: Played) -> tuple[str, ...]:
    """Name of each number in the order of the draws, as its slider is called; "" for one that cannot vary."""
    sliders = {(slider.key, slider.index): f"{slider.group}: {slider.name}" for slider in parameters(played)}

    def name(key: Key, index: int) -> str:
        if (key, None) in sliders:
            return f"{sliders[key, None]} {index + 1}"
        return sliders.get((key, index), "")

    return tuple(name(call.key, index) for call in played.calls for index in range(len(call.shares)))
