"""States beyond those of a scene: its own draws, each farther from its middle than its bound is.

For trials of what is said of states that a network has not learned. Draws are known by their methods, so a scene needs
no change; what is a choice, a count or an order stays within what there is.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from mereo.deformation.maps import Deformation
from mereo.scenes.draw_recorder import OutOfDraws, Recorder
from mereo.scenes.scene import Scene

ATTEMPTS = 50
"""States that are drawn before giving up on a scene that refuses what is beyond its bounds."""

MOST_CALLS = 20_000
"""Calls of the generator after which a scene that draws again and again has refused."""


FULL_TURN = 2 * np.pi
"""Width of an interval of angles that has no end."""


class FartherDraws(Recorder):
    """Generator whose numbers lie beyond what they are drawn from.

    A uniform or triangular number lies farther from the middle (the mode) than its bound does, by a factor: on the side
    on which it was drawn, or, of an interval on one side of zero, on that which is away from zero. A normal one is the
    factor times as far from the mean. Directions of a full turn stay.
    """

    def __init__(self, seed: int, factor: float) -> None:
        super().__init__(seed, {}, MOST_CALLS)
        self.factor = factor

    def _beyond(self, values: Any, low: Any, middle: Any, high: Any) -> Any:
        drawn, low, middle, high = (np.asarray(value, dtype=float) for value in (values, low, middle, high))
        upwards = np.where(low >= 0, True, np.where(high <= 0, False, drawn >= middle))
        return middle + self.factor * (np.where(upwards, high, low) - middle)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Numbers beyond an interval."""
        drawn = super().uniform(low, high, size)
        low, high = np.minimum(low, high), np.maximum(low, high)
        beyond = self._beyond(drawn, low, (low + high) / 2, high)
        return _plain(np.where(np.isclose(high - low, FULL_TURN), drawn, beyond))

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers of a greater standard deviation."""
        middle = np.asarray(loc, dtype=float)
        return _plain(middle + self.factor * (np.asarray(super().normal(loc, scale, size)) - middle))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Normal numbers of mean 0 and the factor as their standard deviation."""
        return _plain(self.factor * np.asarray(super().standard_normal(size, dtype, out)))

    def triangular(self, left: Any, mode: Any, right: Any, size: Any = None) -> Any:
        """Numbers beyond the bounds of a triangular distribution."""
        return _plain(self._beyond(super().triangular(left, mode, right, size), left, mode, right))


def _plain(values: Any) -> Any:
    """A single number as numpy's generators return it."""
    return values if np.ndim(values) else float(values)


def with_farther_states(scene: Scene, factor: float) -> Scene:
    """The scene with all its draws ``factor`` times as far from their middle as their bounds.

    Its ``sample_deformations`` raises ``ValueError`` where the scene refuses ``ATTEMPTS`` such states.
    """
    return replace(scene, sample_deformations=_farther_sampler(scene, factor))


def _farther_sampler(scene: Scene, factor: float) -> Callable[[np.random.Generator], tuple[Deformation, ...]]:
    def sample(rng: np.random.Generator) -> tuple[Deformation, ...]:
        for _ in range(ATTEMPTS):
            try:
                return scene.sample_deformations(FartherDraws(int(rng.integers(2**31)), factor))
            except (OutOfDraws, ValueError):
                continue
        raise ValueError(
            f"the scene {scene.name!r} allows no state with its draws {factor:g} times as far from their middle as "
            "their bounds: take a smaller factor"
        )

    return sample
