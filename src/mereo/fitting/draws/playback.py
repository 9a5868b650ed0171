"""Use a scene's own random numbers as coordinates of its states.

Every number that a scene draws is a share of its distribution, uniform in 0..1; as ``z = Phi^-1(share)`` it is standard
normal. Played back in the order of the calls, the same shares give the same state, and others its neighbours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import csr_array
from scipy.special import ndtr, ndtri

from mereo.deformation.maps import Deformation
from mereo.deformation.moving_least_squares import Anchors, PointWeights, spread
from mereo.geometry.transforms import unit_rows
from mereo.scenes.draw_recorder import SMOOTH, Call, OutOfDraws, Place, Recorder, Shares
from mereo.scenes.parameters import play, random_state
from mereo.scenes.random_states import state_points
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel, following

STATES_SEED = 400_000
"""A training seed."""

MOST_DRAWS = 120
"""Scenes with more free numbers are left to the modes."""

LARGEST = 4.0
"""Standard deviations; farther out a share is 0 or 1."""


Numbers = Int[np.ndarray, " _"]
"""Which of some draws."""

Directions = Mapping[Place, Sequence[Numbers]]
"""Which numbers of the calls from a place are a direction each."""

NO_DIRECTIONS: Directions = MappingProxyType({})


class Playback(Recorder):
    """A generator whose draws are given in the order of the calls; more or other ones raise ``OutOfDraws``."""

    def __init__(self, seed: int, shares: Sequence[np.ndarray], checked: bool) -> None:
        super().__init__(seed, {})
        self._shares, self._next, self.checked = shares, 0, checked

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
        z, smooth: all draws in the order of the calls, standard normal, and which of them move the state continuously.
        sizes: how many numbers each call drew.
        directions: draws that are a direction each: how long it is moves nothing (``find_directions``).
    """

    seed: int
    z: Float[np.ndarray, " d"]
    sizes: tuple[int, ...]
    smooth: Bool[np.ndarray, " d"]
    directions: tuple[Numbers, ...] = ()

    @classmethod
    def of(cls, scene: Scene, seed: int, directions: Directions = NO_DIRECTIONS) -> "Drawn":
        """The random state of a seed, without attempts that the scene itself threw away."""
        return cls.recorded(random_state(scene, seed).calls, seed, directions)

    @classmethod
    def recorded(cls, calls: Sequence[Call], seed: int, directions: Directions = NO_DIRECTIONS) -> "Drawn":
        """The state of recorded calls; ``seed`` is that of what is not recorded."""
        sizes = tuple(len(call.shares) for call in calls)
        smooth = np.concatenate([np.full(len(call.shares), call.kind in SMOOTH) for call in calls])
        firsts = np.cumsum(sizes) - sizes
        rows = [
            first + row for call, first in zip(calls, firsts, strict=True) for row in directions.get(call.key[0], ())
        ]
        drawn = cls(seed, ndtri(np.concatenate([call.shares for call in calls])), sizes, smooth, tuple(rows))
        return replace(drawn, z=drawn.normalized(drawn.z))

    def normalized(self, z: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
        """The same state by draws whose directions have one length.

        With it a standard deviation across a direction is, squared, what random directions are off it on average. The
        prior of normal numbers would have each as short as can be, where a small step turns it to any other.
        """
        z = z.copy()
        for each in self.directions:
            z[each] = np.sqrt((len(each) - 1) / 2) * unit_rows(z[each])
        return z

    def deformations(
        self, scene: Scene, z: Float[np.ndarray, " d"], checked: bool = True
    ) -> tuple[Deformation, ...] | None:
        """Deformations of the state with other draws; None where the scene refuses it, ``unchecked`` ones hardly."""
        try:
            return scene.sample_deformations(Playback(self.seed, shares_of(z, self.sizes), checked))
        except (OutOfDraws, ValueError):
            return None


def shares_of(z: Float[np.ndarray, " d"], sizes: tuple[int, ...]) -> list[Shares]:
    """Shares of each call, of standard normal draws, as they are played."""
    return np.split(ndtr(np.clip(z, -LARGEST, LARGEST)), np.cumsum(sizes)[:-1])


def as_sparse(weights: PointWeights, count: int) -> csr_array:
    """Weights of ``count`` points as a matrix."""
    rows = np.repeat(np.arange(len(weights.index)), weights.index.shape[1])
    entries = (weights.weight.ravel().astype(np.float32), (rows, weights.index.ravel()))
    return csr_array(entries, shape=(len(weights.index), count))


@dataclass(frozen=True, eq=False)
class Played:
    """Few material points of each segment: where at rest, which, and how many; all others follow them by ``spread``."""

    points: Float[np.ndarray, "a 3"]
    index: Int[np.ndarray, " a"]
    counts: tuple[int, ...]
    spread: csr_array

    @classmethod
    def of(cls, model: StatisticalModel) -> "Played":
        """Evenly spread points of a model's anchors."""
        each = max(24, 400 // len(model.anchors))
        chosen = [anchors[spread(model.rest_points[anchors], each)] for anchors in model.anchors]
        counts = tuple(len(part) for part in chosen)
        positions = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        few = tuple(Anchors(at, model.rest_points[part]) for at, part in zip(positions, chosen, strict=True))
        follow = as_sparse(following(few, model.rest_points, model.labels), sum(counts))
        index = np.concatenate(chosen)
        return cls(model.rest_points[index], index, counts, follow)

    def moved(self, deformations: tuple[Deformation, ...]) -> Float[np.ndarray, "a 3"]:
        """Positions to which a state moves the points; a map that several segments share is called once."""
        owner = np.repeat([id(deformation) for deformation in deformations], self.counts)
        result = np.empty_like(self.points)
        for deformation in {id(deformation): deformation for deformation in deformations}.values():
            rows = np.flatnonzero(owner == id(deformation))
            if len(rows):
                result[rows] = deformation(self.points[rows])
        return result


@dataclass(frozen=True, eq=False)
class DrawnStates:
    """Random states of a scene by seed: where a fit of draws may start.

    Attributes:
        places: of the played points in each, scene frame.
        played: points whose motion is played for derivatives.
        directions: where draws come from that are directions, and which of a call's numbers.
        recorded: what ``drawn`` has recorded so far.
    """

    scene: Scene
    seeds: tuple[int, ...]
    places: Float32[np.ndarray, "n a 3"]
    played: Played
    directions: Directions
    recorded: dict[int, Drawn] = field(default_factory=dict)

    def drawn(self, seed: int) -> Drawn:
        """``Drawn.of`` one of the seeds, recorded once: frames share their starts."""
        if seed not in self.recorded:
            self.recorded[seed] = Drawn.of(self.scene, seed, self.directions)
        return self.recorded[seed]

    @classmethod
    def of(
        cls, scene: Scene, model: StatisticalModel, count: int = 150, first_seed: int = STATES_SEED
    ) -> "DrawnStates":
        """States of ``count`` seeds from ``first_seed`` on."""
        seeds = tuple(range(first_seed, first_seed + count))
        played = Played.of(model)
        places = []
        calls = []
        for seed in seeds:
            recorder = Recorder(seed, {})
            places.append(played.moved(play(scene, recorder)).astype(np.float32))
            calls.append(recorder.calls)
        return cls(scene, seeds, np.stack(places), played, find_directions(scene, played, calls))

    @cached_property
    def reach(self) -> Mapping[tuple[int, ...], Bool[np.ndarray, "s d"]]:
        """Which segments each draw moves in one of two states, by the sizes of their calls: all where it moves none."""
        reach = dict[tuple[int, ...], Any]()
        for seed in self.seeds[:2]:
            drawn = self.drawn(seed)
            positions = self.played.moved(play(self.scene, Recorder(seed, {})))
            parts = np.split(self._differences(drawn, drawn.z, positions, True), np.cumsum(self.played.counts)[:-1])
            moves = ~np.stack([unmoving(part) for part in parts])
            reach[drawn.sizes] = reach.get(drawn.sizes, False) | moves | ~moves.any(axis=0)
        return reach

    def derivatives(
        self, drawn: Drawn, z: Float[np.ndarray, " d"], positions: Float[np.ndarray, "a 3"]
    ) -> Float32[np.ndarray, "a 3 d"]:
        """Motion of the played points, which are ``positions``, for a standard deviation of each draw."""
        return self._differences(drawn, z, positions, self.reach.get(drawn.sizes, True))

    def _differences(
        self, drawn: Drawn, z: Float[np.ndarray, " d"], positions: Float[np.ndarray, "a 3"], reach: Any
    ) -> Float32[np.ndarray, "a 3 d"]:
        """``derivatives``, where those of draws that reach other segments are played at once.

        Curtis, Powell and Reid, "On the estimation of sparse Jacobian matrices", 1974. Neighbours are played without
        the scene's own test where this state is the same without it: it is not where a scene refuses and draws again in
        a way that ``Drawn`` does not see through.
        """
        reach = np.broadcast_to(reach, (len(self.played.counts), len(z)))
        change = np.zeros((*positions.shape, len(z)), dtype=np.float32)
        untested = drawn.deformations(self.scene, z, checked=False)
        checked = (
            untested is None or float(np.abs(self.played.moved(untested) - positions).max()) > 1e-4
        )  # rest points are in single precision
        step = np.where(z > 0, -0.02, 0.02)
        moves = np.repeat(reach, self.played.counts, axis=0)
        groups = draws_apart(reach, np.flatnonzero(drawn.smooth))
        for numbers in groups:
            other = z.copy()
            other[numbers] += step[numbers]
            moved = drawn.deformations(self.scene, other, checked)
            if moved is None:  # one of several may be why
                groups += [np.array([number]) for number in numbers if len(numbers) > 1]
            else:
                motion = (self.played.moved(moved) - positions)[..., None] / step[numbers]
                change[:, :, numbers] = motion * moves[:, None, numbers]
        return change


def find_directions(scene: Scene, played: Played, states: Sequence[Sequence[Call]]) -> Directions:
    """Find the normal draws that are directions: rows of a call's numbers, and together all that no such row has.

    Half as long a direction moves nothing, with its numbers in another order it does.
    """
    directions = dict[Place, list[Numbers]]()
    for calls in states:
        drawn = Drawn.recorded(calls, 0)
        ends = np.cumsum(drawn.sizes)
        normal = [(call, end) for call, end in zip(calls, ends, strict=True) if call.kind == "normal" and call.shape]
        for call, end in [(call, end) for call, end in normal if call.key[0] not in directions]:
            numbers = np.arange(end - len(call.shares), end)
            row = call.shape[-1]
            parts = [part for part in numbers.reshape(-1, row) if is_direction(scene, played, drawn, part)]
            rest = np.setdiff1d(numbers, parts)
            parts += [part for part in (rest,) if is_direction(scene, played, drawn, part)]
            directions[call.key[0]] = [part - numbers[0] for part in parts]
    return directions


def is_direction(scene: Scene, played: Played, drawn: Drawn, numbers: Numbers) -> bool:
    """Whether some numbers of a state are a direction."""

    def moves(other: Float[np.ndarray, " n"]) -> bool:
        z = drawn.z.copy()
        z[numbers] = other
        states = (drawn.deformations(scene, each, checked=False) for each in (drawn.z, z))
        places = [played.moved(state) for state in states if state is not None]
        return len(places) < 2 or bool(np.ptp(places, axis=0).max() > 1e-3)  # scene units, in single precision

    share = drawn.z[numbers]
    return len(share) > 1 and moves(share[::-1]) and not moves(share / 2)


def unmoving(motion: Float32[np.ndarray, "a 3 d"]) -> Bool[np.ndarray, " d"]:
    """Mark the draws that move nothing."""
    return np.asarray(np.abs(motion).max(axis=(0, 1)) < 1e-9)  # scene units


def draws_apart(reach: Bool[np.ndarray, "s d"], numbers: Numbers) -> list[Numbers]:
    """Put draws that reach no segment together into groups, each into the first that has room for it."""
    taken = np.zeros((len(reach), len(numbers)), dtype=bool)
    group = np.empty(len(numbers), dtype=int)
    for row, number in enumerate(numbers):
        group[row] = np.argmin((taken & reach[:, [number]]).any(axis=0))
        taken[:, group[row]] |= reach[:, number]
    return [numbers[group == each] for each in np.unique(group)]


def material_moved(
    scene: Scene, model: StatisticalModel, deformations: tuple[Deformation, ...]
) -> Float[np.ndarray, "m 3"]:
    """Positions to which all material points go."""
    return state_points(scene.deform(deformations), model.nodes, model.node_labels)
