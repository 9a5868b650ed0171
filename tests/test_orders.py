"""Order in which examples are streamed: each equally often, well mixed, few at a time, and by the step alone."""

import numpy as np
import pytest
import torch

from mereo.training.orders import MOST_LANES, WINDOW, ShuffledOrder, StreamedOrder, lanes_of
from mereo.training.read_ahead import ReadAhead

UNEVEN = (64, 1, 7, 64, 64, 30, 64, 0, 2, 64, 19)


def drawn(order: StreamedOrder, steps: int) -> np.ndarray:
    """Examples of the first steps, a row each, by the blocks that are read for them."""
    draws = np.full((order.lanes, steps * order.draws), -1)
    for block in order.blocks(range(order.lanes), range(steps)):
        row = draws[block.lane, block.first : block.first + len(block.index)]
        row[:] = block.index[: len(row)]
    return draws.reshape(order.lanes, steps, order.draws).swapaxes(0, 1).reshape(steps, -1)


@pytest.mark.parametrize(
    ("sizes", "batch"), [(UNEVEN, 6), (UNEVEN, 40), (UNEVEN, 1), ((5, 5), 16), ((3,), 8), ((64,) * 40, 128)]
)
def test_every_example_comes_equally_often(sizes: tuple[int, ...], batch: int) -> None:
    """Exactly, after whole passes; and never is one more than two ahead, while lanes go from one pass to the next."""
    order, counts = StreamedOrder(sizes, batch, seed=3), np.zeros(sum(sizes), dtype=int)
    whole = np.lcm(batch, sum(sizes)) // batch  # steps after which passes and steps end together
    for step, row in enumerate(drawn(order, min(whole, 400)), 1):
        counts += np.bincount(row, minlength=len(counts))
        assert np.ptp(counts) <= (0 if step * batch % len(counts) == 0 else 2)
    assert whole > 400 or counts.min() == whole * batch // len(counts)


def test_a_step_has_the_examples_that_are_read_for_it() -> None:
    order = StreamedOrder(UNEVEN, 40, seed=3)
    rows = drawn(order, 60)
    assert all(np.array_equal(order.index(step), rows[step]) for step in (0, 7, 8, 59))


def test_passes_and_seeds_differ() -> None:
    order, other = StreamedOrder((8,) * 16, 8, seed=3), StreamedOrder((8,) * 16, 8, seed=4)
    first, second, another = (
        torch.cat([o.index(s + at) for s in range(16)]) for o, at in ((order, 0), (order, 16), (other, 0))
    )
    assert torch.equal(first.sort().values, torch.arange(128)) and torch.equal(second.sort().values, torch.arange(128))
    assert not torch.equal(first, second) and not torch.equal(first, another)


@pytest.mark.parametrize("batch", [6, 40, 96, 256])
def test_the_order_is_the_same_for_every_number_of_processes_that_divides_the_lanes(batch: int) -> None:
    lanes = lanes_of(batch, 1)
    for world in range(2, lanes + 1):
        if lanes % world == 0:
            assert lanes_of(batch, world) == lanes
    assert lanes == max(n for n in range(1, MOST_LANES + 1) if batch % n == 0)
    assert lanes_of(960, 96) == 96, "more processes than lanes: one for each"


@pytest.mark.parametrize(("batch", "world", "start"), [(40, 4, 0), (40, 5, 13), (6, 2, 101), (128, 2, 3)])
def test_processes_read_their_rows_of_the_batches_and_a_resumed_run_the_same(
    batch: int, world: int, start: int
) -> None:
    sizes = UNEVEN * 3
    order, steps = StreamedOrder(sizes, batch, seed=1), range(start, start + 40)
    whole, share = [order.index(step) for step in steps], batch // world
    for rank in range(world):
        lanes = range(rank * share // order.draws, (rank + 1) * share // order.draws)
        ahead = ReadAhead(
            StreamedOrder(sizes, batch, 1, world).blocks(lanes, steps),
            lambda index: {"n": torch.from_numpy(index)},
            lanes,
        )
        for step, expected in zip(steps, whole, strict=True):
            taken = [ahead.take(lane, step * order.draws, order.draws) for lane in lanes]
            assert np.array_equal(np.concatenate([numbers for numbers, _ in taken]), expected[rank * share :][:share])
            assert torch.equal(torch.cat([read["n"] for _, read in taken]), expected[rank * share :][:share])
        ahead.close()
        assert not ahead.thread.is_alive()


@pytest.mark.parametrize("batch", [6, 40, 256])
def test_a_batch_is_mixed_as_if_all_were_shuffled(batch: int) -> None:
    """Pairs of one shard in a batch are no more frequent, and neighbouring steps share few of a window's shards."""
    shard, shards, steps = 64, 512, 300
    order = StreamedOrder((shard,) * shards, batch, seed=0)
    numbers = drawn(order, steps) // shard
    equal = sum((np.bincount(row) * (np.bincount(row) - 1)).sum() for row in numbers) / (steps * batch * (batch - 1))
    full = (shard - 1) / (shard * shards - 1)
    # lanes draw from shards of their own; where a lane has several draws, they are of one window of its shards
    per_lane = (order.draws - 1) / (batch - 1) / order.block_shards
    assert equal <= full + 1.2 * per_lane
    centered = (numbers - numbers.mean()) / numbers.std()
    correlation = np.mean([(row.sum() ** 2 - (row**2).sum()) / (batch * (batch - 1)) for row in centered])
    assert abs(correlation) < 0.05
    assert order.lanes * order.block_shards >= WINDOW


def test_the_window_is_a_few_shards() -> None:
    """Blocks of at most so many whole shards, and the two that lanes share."""
    order = StreamedOrder((16,) * 4000, 40, seed=0)
    for block in order.blocks(range(40), range(200)):
        assert len(np.unique(block.index // 16)) <= order.block_shards + 2 and len(block.index) <= 16 * (
            order.block_shards + 1
        )


def test_few_shards_are_in_memory() -> None:
    """Half as many blocks wait as lanes are read."""
    order, held, most = StreamedOrder((8,) * 400, 8, seed=0), 0, 0

    class Counted(dict[str, torch.Tensor]):
        def __del__(self) -> None:
            nonlocal held
            held -= 1

    def gather(index: np.ndarray) -> dict[str, torch.Tensor]:
        nonlocal held, most
        held += 1
        most = max(most, held)
        return Counted(n=torch.from_numpy(index))

    ahead = ReadAhead(order.blocks(range(8), range(300)), gather, range(8))
    for step in range(300):
        for lane in range(8):
            ahead.take(lane, step, 1)
    ahead.close()
    assert 8 <= most <= 8 + 4


def test_a_shuffled_order_is_one_pass_after_another() -> None:
    seen = torch.cat([ShuffledOrder(10, 4, 0).index(step) for step in range(5)])
    assert torch.equal(seen[:10].sort().values, torch.arange(10)) and torch.equal(seen.bincount(), torch.full((10,), 2))
