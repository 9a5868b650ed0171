"""A scene's own random numbers as coordinates of its states.

Every number that a scene draws is a share of its distribution, uniform in 0..1; as ``z = Phi^-1(share)`` it is standard
normal. Played back in the order of the calls, the same shares give the same state, and others its neighbours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.special import ndtr, ndtri

from mereo.deformation.maps import Deformation
from mereo.scenes.draw_recorder import OutOfDraws, Recorder, Shares
from mereo.scenes.parameters import random_state
from mereo.scenes.random_states import state_points
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel

SMOOTH = ("uniform", "normal", "triangular")
"""Kinds of draws that move the state continuously; the others stay as they are."""

LARGEST = 4.0
"""Standard deviations; farther out a share is 0 or 1."""


class Playback(Recorder):
    """A generator whose draws are given in the order of the calls; more or other ones raise ``OutOfDraws``."""

    def __init__(self, seed: int, shares: Sequence[Shares]) -> None:
        super().__init__(seed, {})
        self._shares, self._next = shares, 0

    def _take(self, kind: str, shape: tuple[int, ...], low: Any, high: Any) -> Shares:
        if self._next >= len(self._shares) or len(self._shares[self._next]) != int(np.prod(shape)):
            raise OutOfDraws
        self._next += 1
        return self._shares[self._next - 1]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A state of a scene by its draws.

    Attributes:
        seed: of what is not recorded.
        z: all draws in the order of the calls, standard normal.
        sizes: how many numbers each call drew.
        smooth: which of them move the state continuously.
    """

    seed: int
    z: Float[np.ndarray, " d"]
    sizes: tuple[int, ...]
    smooth: Bool[np.ndarray, " d"]

    @classmethod
    def of(cls, scene: Scene, seed: int) -> "Drawn":
        """The random state of a seed, without attempts that the scene itself threw away."""
        calls = random_state(scene, seed).calls
        sizes = tuple(len(call.shares) for call in calls)
        smooth = np.concatenate([np.full(len(call.shares), call.kind in SMOOTH) for call in calls])
        return cls(seed, ndtri(np.concatenate([call.shares for call in calls])), sizes, smooth)

    def deformations(self, scene: Scene, z: Float[np.ndarray, " d"]) -> tuple[Deformation, ...] | None:
        """Of the state with other draws; None where the scene refuses it."""
        shares = np.split(ndtr(np.clip(z, -LARGEST, LARGEST)), np.cumsum(self.sizes)[:-1])
        try:
            return scene.sample_deformations(Playback(self.seed, shares))
        except (OutOfDraws, ValueError):
            return None


@dataclass(frozen=True, eq=False)
class DrawnStates:
    """Random states of a scene by seed, with their material points: where a fit of draws may start."""

    scene: Scene
    seeds: tuple[int, ...]
    material: Float32[np.ndarray, "n m 3"]

    @classmethod
    def of(cls, scene: Scene, model: StatisticalModel, count: int, first_seed: int) -> "DrawnStates":
        """States of ``count`` seeds from ``first_seed`` on."""
        seeds = tuple(range(first_seed, first_seed + count))
        states = (scene.deform(scene.sample_deformations(Recorder(seed, {}))) for seed in seeds)
        material = [state_points(state, model.nodes, model.node_labels).astype(np.float32) for state in states]
        return cls(scene, seeds, np.stack(material))


def anchors_moved(
    model: StatisticalModel, deformations: tuple[Deformation, ...]
) -> Float[np.ndarray, "a 3"]:
    """Where the anchors of all segments go, one segment after the other."""
    pairs = zip(deformations, model.anchors, strict=True)
    return np.concatenate([deformation(model.rest_points[index]) for deformation, index in pairs])


def material_moved(
    scene: Scene, model: StatisticalModel, deformations: tuple[Deformation, ...]
) -> Float[np.ndarray, "m 3"]:
    """Where all material points go."""
    return state_points(scene.deform(deformations), model.nodes, model.node_labels)
