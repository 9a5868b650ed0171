"""Walks through the states of a scene: its own random numbers, changing smoothly with time.

    scene, seed -walk-> Played, Played, ...

Every number that a scene draws is a standard normal one as ``Phi^-1(share)`` (``scenes.draw_recorder``). A walk lets
each follow a smooth Gaussian process of mean 0 and variance 1, so that at any time the state is distributed as the
scene's own random states are, and never leaves their bounds. What has no way between two values stays as it is at the
start: whole numbers, choices, permutations, and draws on which it depends what else is drawn (``switches``).

Notation: n times, d numbers, k nodes of the process.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from mereo.deformation.maps import Deformation
from mereo.scenes.draw_recorder import SMOOTH, Key, OutOfDraws, Recorder
from mereo.scenes.parameters import Played, play, random_state, replayed
from mereo.scenes.rest_pose import rest_frame
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import example_rng

FASTEST = 9.0
"""Halves of the rest box's longest side a second: a vertex that is faster has jumped."""

TRIES, SHRINK_EVERY, SHRINK = 160, 20, 0.75
"""How often a part of a walk that the scene refuses is drawn again; after so many tries the whole walk shrinks towards
its start, which the scene allows, by this factor."""

EXTREMES = (0.02, 0.98)
"""Shares at which a draw shows whether it is a switch."""

NODE_SUPPORT = 2
"""A node of the process counts up to so many distances between nodes away."""


def walk(scene: Scene, seed: int, times_s: Float[np.ndarray, " n"], change_s: float) -> list[Played]:
    """States of a scene along a smooth walk.

    Args:
        scene: as ``Scene.for_seed`` gives it.
        seed: of the walk; another seed, another walk.
        times_s: at which the states are wanted, rising from 0.
        change_s: time in which a state becomes about an independent one.

    Raises ``ValueError`` for a scene that refuses nearly all states between its own.
    """
    start = random_state(scene, seed)
    path = _Path.of(scene, start, seed, times_s / change_s)
    states: list[Played] = []
    places: list[Float[np.ndarray, "v 3"]] = []
    step = np.diff(times_s, prepend=0.0) * FASTEST * rest_frame(scene.rest)[1]
    tries = 0
    while len(states) < len(times_s):
        i = len(states)
        state = replayed(scene, seed, path.shares(i))
        place = None if state is None else _vertices(scene, state.deformations)
        if place is not None and (i == 0 or np.linalg.norm(place - places[-1], axis=1).max() <= max(step[i], 1e-9)):
            assert state is not None
            states.append(state)
            places.append(place)
            continue
        tries += 1
        if tries > TRIES:
            raise ValueError(
                f"the scene {scene.name!r} refuses the states between its own random ones, {TRIES} times in a row of "
                "other ways: try another --seed, or a slower walk with a larger --change"
            )
        kept = path.redraw(i, shrink=tries % SHRINK_EVERY == 0)
        del states[kept:], places[kept:]
    return states


def process_weights(times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """Weights of independent normal nodes at times, in distances between nodes; their squares sum to 1.

    Cubic B-splines: twice continuously differentiable, and a node is forgotten two distances away.
    """
    nodes = np.arange(int(np.ceil(times.max())) + 2 * NODE_SUPPORT) - NODE_SUPPORT + 1
    away = np.abs(times[:, None] - nodes)
    near, far = 2 / 3 - away**2 + away**3 / 2, np.maximum(2 - away, 0.0) ** 3 / 6
    weights = np.where(away < 1, near, far)
    normalized: Float[np.ndarray, "n k"] = weights / np.linalg.norm(weights, axis=1, keepdims=True)
    return normalized


def switches(scene: Scene, start: Played) -> set[Key]:
    """Draws on which it depends what else is drawn: a corner that is bent or not."""
    keys = set()
    for call in start.calls:
        if call.kind not in SMOOTH or len(call.shares) > 1:
            continue
        for share in EXTREMES:
            given = {**start.remembered, call.key: np.array([share])}
            recorder, whole = Recorder(start.seed, given, 2 * len(start.calls) + 10), False
            with suppress(OutOfDraws, ValueError):
                play(scene, recorder)
                whole = True
            if _draws_others(start.keys, tuple(drawn.key for drawn in recorder.calls), whole):
                keys.add(call.key)
    return keys


def _draws_others(before: tuple[Key, ...], after: tuple[Key, ...], whole: bool) -> bool:
    """Whether other things are drawn than before; ``whole`` is whether a state came out.

    A scene that refuses what it has drawn gives up, or draws once more from places where it has drawn already; neither
    says that it wants anything else.
    """
    differs = (i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b)
    same = next(differs, min(len(before), len(after)))
    if same == len(after):
        return whole and len(after) < len(before)
    return after[same][0] not in {place for place, _ in before[:same]}


@dataclass(eq=False)
class _Path:
    """Values of all draws along a walk, parts of which can be drawn again."""

    start: Played
    moving: list[bool]
    weights: Float[np.ndarray, "n k"]
    first: Float[np.ndarray, " d"]
    nodes: Float[np.ndarray, "k d"]
    rng: np.random.Generator
    reach: float = 1.0

    @classmethod
    def of(cls, scene: Scene, start: Played, seed: int, times: Float[np.ndarray, " n"]) -> "_Path":
        fixed = switches(scene, start)
        moving = [call.kind in SMOOTH and call.key not in fixed for call in start.calls]
        parts = [call.shares for call, moves in zip(start.calls, moving, strict=True) if moves]
        first = ndtri(np.concatenate([np.empty(0), *parts]))
        rng, weights = example_rng(seed, 1), process_weights(times)
        nodes = rng.normal(size=(weights.shape[1], len(first)))
        # the walk begins at the start: the nodes that count at time 0 agree with it
        nodes += np.outer(weights[0], first - weights[0] @ nodes)
        return cls(start, moving, weights, first, nodes, rng)

    def shares(self, i: int) -> dict[Key, Float[np.ndarray, " m"]]:
        """Shares of all draws at time i."""
        z = self.weights[i] @ self.nodes
        z = np.sqrt(1 - self.reach**2) * self.first + self.reach * z if self.reach < 1 else z
        result, at = {}, 0
        for call, moves in zip(self.start.calls, self.moving, strict=True):
            count = len(call.shares)
            result[call.key] = ndtr(z[at : at + count]) if moves else call.shares
            at += count if moves else 0
        return result

    def redraw(self, i: int, shrink: bool) -> int:
        """Draw the nodes anew that count most at time i and after; returns how many first states stay as they were."""
        if shrink:
            self.reach *= SHRINK
            return 0
        first = int(self.weights[i].argmax())
        before = self.nodes.copy()
        self.nodes[first:] = self.rng.normal(size=self.nodes[first:].shape)
        weights = self.weights[0, first:]
        if weights.any():
            self.nodes[first:] += np.outer(weights / (weights @ weights), self.first - self.weights[0] @ self.nodes)
        changed = np.flatnonzero((self.nodes != before).any(axis=1))
        return int(np.flatnonzero((self.weights[:, changed] > 0).any(axis=1))[0]) if len(changed) else 0


def _vertices(scene: Scene, deformations: tuple[Deformation, ...]) -> Float[np.ndarray, "v 3"]:
    mesh = scene.deform(deformations).mesh
    return np.concatenate([segment.vertices for segment in mesh.segments])
