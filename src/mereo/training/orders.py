"""Order in which examples are learnt from: a function of the seed and the step, so that resuming needs no state.

Two of them: ``ShuffledOrder`` permutes all examples of a pass, which asks for all of them to be at hand, and
``StreamedOrder`` needs few shards at a time (docs/learning.md).

Notation: s shards, b examples of a batch.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from jaxtyping import Int, Int64
from torch import Tensor

PASS, BLOCK = 1 << 20, 1 << 21
"""Last numbers of the seeds from which passes and blocks are shuffled, by which they differ from those of steps."""

MOST_LANES = 64
"""Streams of shards that a batch reads side by side, unless there are more processes."""

WINDOW = 64
"""Shards, at least, among which examples are shuffled."""


def seed_of(*numbers: int) -> int:
    """One 63-bit seed from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


class ShuffledOrder:
    """One shuffled pass over all examples after another; a batch may straddle two."""

    def __init__(self, examples: int, batch: int, seed: int) -> None:
        self.examples, self.batch, self.seed = examples, batch, seed
        self.passes: dict[int, Tensor] = {}

    def index(self, step: int) -> Int[Tensor, " b"]:
        """Numbers of the examples in the batch of a step."""
        first = step * self.batch
        positions = range(first, first + self.batch)
        return torch.stack([self._pass(p // self.examples)[p % self.examples] for p in positions])

    def _pass(self, number: int) -> Tensor:
        """The shuffled examples of a pass; the two latest are kept."""
        if number not in self.passes:
            order = _permutation(self.examples, self.seed, number, PASS)
            self.passes = {n: kept for n, kept in self.passes.items() if n == number - 1} | {number: order}
        return self.passes[number]


@dataclass(frozen=True, eq=False)
class Block:
    """Examples of a few shards, which a lane draws one after another.

    Attributes:
        lane: that draws them.
        first: draw of the lane with which the block begins, counted over all passes.
        index: their numbers, in the order in which they are drawn.
    """

    lane: int
    first: int
    index: Int64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Pass:
    """Shards of a pass in their order: the number of each, and where its examples end among those of the pass."""

    shards: Int64[np.ndarray, " s"]
    ends: Int64[np.ndarray, " s"]


class StreamedOrder:
    """Passes over shards in a random order, of which each of a batch's lanes reads its own part, block by block.

    A pass is a permutation of the shards, whose examples follow one another; lane j of n has the j-th n-th of them. It
    takes a few shards at a time, a block, whose examples it draws in a random order. A batch has equally many examples
    of each lane, lane by lane, and a process reads the lanes of its rows and no others.

    The order is the same for all numbers of processes that divide ``lanes``.

    Args:
        sizes: number of examples that are learnt from in each shard.
        batch: examples of a step.
        seed: of the training.
        world: number of processes.
    """

    def __init__(self, sizes: Sequence[int] | Int64[np.ndarray, " s"], batch: int, seed: int, world: int = 1) -> None:
        self.sizes = np.asarray(sizes, dtype=np.int64)
        self.starts = np.cumsum(self.sizes) - self.sizes
        self.examples, self.batch, self.seed = int(self.sizes.sum()), batch, seed
        self.lanes = lanes_of(batch, world)
        self.draws = batch // self.lanes
        """Draws of each lane in a step."""
        self.block_shards = -(-WINDOW // self.lanes)
        self.passes: dict[int, _Pass] = {}

    def index(self, step: int) -> Int[Tensor, " b"]:
        """Numbers of the examples in the batch of a step; for messages, because it shuffles whole blocks for it."""
        return torch.from_numpy(np.concatenate([self._drawn(lane, step * self.draws) for lane in range(self.lanes)]))

    def blocks(self, lanes: range, steps: range) -> Iterator[Block]:
        """Blocks of these lanes that these steps need, in the order in which their first examples are needed."""
        first, end = steps.start * self.draws, steps.stop * self.draws

        def needed(block: Block) -> tuple[int, int, int]:
            return max(block.first, first) // self.draws, block.lane, block.first

        return heapq.merge(*(self._blocks(lane, first, end) for lane in lanes), key=needed)

    def _drawn(self, lane: int, first: int) -> Int64[np.ndarray, " n"]:
        """A lane's examples of one step, from its draw ``first`` on."""
        blocks = self._blocks(lane, first, first + self.draws)
        return np.concatenate([b.index[max(first - b.first, 0) : first + self.draws - b.first] for b in blocks])

    def _blocks(self, lane: int, first: int, end: int) -> Iterator[Block]:
        """Blocks of a lane from that of its draw ``first`` to before its draw ``end``."""
        for number in count(self._pass_of(lane, first)):
            begin, length = self._share(number, lane)
            drawn = self._begun(number)[lane]  # in earlier passes
            for order, (low, high) in enumerate(self._cuts(number, lane, begin, begin + length)):
                if drawn >= end:
                    return
                if drawn + high - low > first:
                    yield Block(lane, int(drawn), self._shuffled(number, lane, order, low, high))
                drawn += high - low

    def _begun(self, number: int) -> Int64[np.ndarray, " lanes"]:
        """Draws of each lane before a pass.

        Their sum is that of the passes' examples (Hermite's identity), and no two differ by more than one: so all lanes
        go from one pass to the next together, whatever the number of examples.
        """
        return (number * self.examples + np.arange(self.lanes)) // self.lanes

    def _pass_of(self, lane: int, draw: int) -> int:
        """Pass of a lane's draw: the last one that has begun before or with it."""
        return -(-((draw + 1) * self.lanes - lane) // self.examples) - 1

    def _share(self, number: int, lane: int) -> tuple[int, int]:
        """Where a lane's examples begin in a pass, and how many they are."""
        lengths = self._begun(number + 1) - self._begun(number)
        return int(lengths[:lane].sum()), int(lengths[lane])

    def _cuts(self, number: int, lane: int, begin: int, end: int) -> Iterator[tuple[int, int]]:
        """Where blocks begin and end in a pass: with shards, but for those that lanes share.

        First blocks are of different lengths, so that lanes come to new shards one after another.
        """
        ends = self._pass(number).ends
        last = int(np.searchsorted(ends, end))  # shard that the lane ends in
        shard = int(np.searchsorted(ends, begin, "right")) + lane % self.block_shards
        while begin < end:
            cut = int(ends[shard]) if shard < last else end
            yield begin, cut
            begin, shard = cut, shard + self.block_shards

    def _shuffled(self, number: int, lane: int, order: int, low: int, high: int) -> Int64[np.ndarray, " n"]:
        """Examples of a block, which has the places from ``low`` to before ``high`` of a pass."""
        found, places = self._pass(number), np.arange(low, high)
        shard = np.searchsorted(found.ends, places, "right")
        of = found.shards[shard]
        examples = self.starts[of] + places - (found.ends[shard] - self.sizes[of])
        return examples[_permutation(high - low, self.seed, number, lane, order, BLOCK).numpy()]

    def _pass(self, number: int) -> _Pass:
        """A pass; the two latest are kept."""
        found = self.passes.get(number)
        if found is None:
            used = np.flatnonzero(self.sizes)
            shards = used[_permutation(len(used), self.seed, number, PASS).numpy()]
            found = _Pass(shards, np.cumsum(self.sizes[shards]))
            self.passes = {n: kept for n, kept in self.passes.items() if n == number - 1} | {number: found}
        return found


Order = ShuffledOrder | StreamedOrder
"""Examples of each step."""


def lanes_of(batch: int, world: int) -> int:
    """Lanes of a batch: its largest divisor up to ``MOST_LANES`` that processes can share, or one for each of them."""
    fitting = [n for n in range(1, MOST_LANES + 1) if batch % n == 0 and n % world == 0]
    return max(fitting, default=world)


def _permutation(length: int, *numbers: int) -> Int[Tensor, " n"]:
    return torch.randperm(length, generator=torch.Generator().manual_seed(seed_of(*numbers)))
