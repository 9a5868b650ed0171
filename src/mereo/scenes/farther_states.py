"""States beyond those of a scene: its own draws, each farther from its middle than the scene says.

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


class FartherDraws(Recorder):
    """Generator whose uniform, normal and triangular numbers lie farther from their middle, by a factor."""

    def __init__(self, seed: int, factor: float) -> None:
        super().__init__(seed, {}, MOST_CALLS)
        self.factor = factor

    def _farther(self, values: Any, middle: Any) -> Any:
        moved = middle + self.factor * (np.asarray(values, dtype=float) - middle)
        return moved if np.ndim(moved) else float(moved)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Uniform numbers in an interval that is larger by the factor, about the same middle."""
        middle = (np.asarray(low, dtype=float) + np.asarray(high, dtype=float)) / 2
        return self._farther(super().uniform(low, high, size), middle)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers of a greater standard deviation."""
        return self._farther(super().normal(loc, scale, size), np.asarray(loc, dtype=float))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Normal numbers of mean 0 and the factor as their standard deviation."""
        return self._farther(super().standard_normal(size, dtype, out), 0.0)

    def triangular(self, left: Any, mode: Any, right: Any, size: Any = None) -> Any:
        """Numbers of a triangular distribution that is wider by the factor, about the same mode."""
        return self._farther(super().triangular(left, mode, right, size), np.asarray(mode, dtype=float))


def with_farther_states(scene: Scene, factor: float) -> Scene:
    """The scene with all its draws ``factor`` times as far from their middle.

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
            f"the scene {scene.name!r} allows no state with its draws {factor:g} times as far from their middle"
        )

    return sample
