"""Examples that are streamed: the same ones as in memory, each equally often, well mixed, and few at a time."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from test_training import SMALL
from test_training_on_observations import observed
from toy_data import write_toy_dataset
from training_runs import assert_resumes_exactly

import mereo.__main__ as command_line
from mereo.training import data_source, trainer
from mereo.training.batches import Batch, Draws
from mereo.training.config import AugmentConfig, TrainConfig
from mereo.training.data_source import choose_place
from mereo.training.dataset import Dataset
from mereo.training.going_nowhere import EXAMPLES
from mereo.training.orders import MOST_LANES, WINDOW, ShuffledOrder, StreamedOrder, lanes_of
from mereo.training.processes import Process
from mereo.training.read_ahead import ReadAhead
from mereo.training.streaming import KEPT, StreamingDataset

pytestmark = pytest.mark.usefixtures("without_curves")

BRIEF = replace(SMALL, epochs=0.6, data="stream")
FULL = AugmentConfig(keep_points=(0.4, 0.9), hole_probability=0.5, jitter_std=0.01, roll=True)
CPU = torch.device("cpu")
UNEVEN = (64, 1, 7, 64, 64, 30, 64, 0, 2, 64, 19)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of 70 examples in shards of 32, 32 and 6, with further observations and a unit."""
    directory = write_toy_dataset(tmp_path_factory.mktemp("toy") / "data", examples=70, example=observed)
    path = directory / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "unit_m": 0.01}))
    return directory


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("plain") / "data")


@pytest.fixture
def both(directory: Path, tmp_path: Path) -> tuple[Dataset, StreamingDataset]:
    return Dataset.load(directory), StreamingDataset.open(directory).surveyed(tmp_path, Process())


def assert_same(one: Batch, other: Batch) -> None:
    for item in fields(Batch):
        left, right = getattr(one, item.name), getattr(other, item.name)
        assert left is right is None or torch.equal(left.nan_to_num(7), right.nan_to_num(7)), item.name


def drawn(order: StreamedOrder, steps: int) -> np.ndarray:
    """Examples of the first steps, a row each, by the blocks that are read for them."""
    draws = np.full((order.lanes, steps * order.draws), -1)
    for block in order.blocks(range(order.lanes), range(steps)):
        row = draws[block.lane, block.first : block.first + len(block.index)]
        row[:] = block.index[: len(row)]
    return draws.reshape(order.lanes, steps, order.draws).swapaxes(0, 1).reshape(steps, -1)


# --- the order --------------------------------------------------------------------------------------------------------


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


# --- the dataset ------------------------------------------------------------------------------------------------------


def test_it_tells_what_the_dataset_in_memory_tells(both: tuple[Dataset, StreamingDataset]) -> None:
    memory, stream = both
    assert len(stream) == len(memory) == 70
    for name in ("further", "uniform_queries", "visible_m", "manifest", "device"):
        assert getattr(stream, name) == getattr(memory, name), name
    assert stream.domain() == memory.domain() and stream.visible_m is not None
    assert stream.template is not None and memory.template is not None and torch.equal(stream.template, memory.template)
    for one, other in zip(stream.first_queries(EXAMPLES), memory.first_queries(EXAMPLES), strict=True):
        assert np.array_equal(one, other)
    assert stream.found.sizes.tolist() == [32, 32, 6]


def test_its_batches_are_those_of_the_dataset_in_memory(both: tuple[Dataset, StreamingDataset]) -> None:
    memory, stream = both
    for index in (torch.arange(8), torch.tensor([69, 0, 33, 31, 5]), torch.arange(60, 70)):
        assert_same(*(data.batch(index, 48, 32, FULL, Draws.of(3)) for data in both))
    assert len(stream.recent) == KEPT
    order = stream.order(62, 12, 7, 2)
    for rows in (slice(0, 6), slice(6, 12)):
        for step, (piece, index) in enumerate(stream.pieces(order, range(12), rows)):
            draws = [Draws.of(step, 12, rows) for _ in both]
            read = piece.batch(index, 48, 32, FULL, draws[0])
            assert_same(read, memory.batch(order.index(step)[rows], 48, 32, FULL, draws[1]))


def test_a_share_of_a_batch_meets_the_changes_of_the_whole(both: tuple[Dataset, StreamingDataset]) -> None:
    memory, index = both[0], torch.arange(12)
    whole = memory.batch(index, 48, 32, FULL, Draws.of(5))
    for rows in (slice(0, 4), slice(4, 12)):
        share = memory.batch(index[rows], 48, 32, FULL, Draws.of(5, 12, rows))
        assert torch.allclose(share.cloud, whole.cloud[rows], atol=1e-6)
        assert torch.equal(share.labels, whole.labels[rows]) and torch.equal(share.index, index[rows])


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


# --- runs -------------------------------------------------------------------------------------------------------------


def test_killed_and_resumed_equals_uninterrupted(dataset: Path, tmp_path: Path) -> None:
    assert_resumes_exactly(dataset, tmp_path, replace(BRIEF, epochs=0.4), steps=2)
    assert json.loads((tmp_path / "parts" / "config.json").read_text())["train"]["data"] == "stream"


def test_a_run_is_continued_as_it_began(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever memory is free by then; and an explicit wish for the other way is refused."""
    monkeypatch.setattr(data_source, "free_bytes", lambda: 1000)
    auto = replace(BRIEF, data="auto", epochs=0.2)
    first = trainer.train(dataset, tmp_path / "run", auto).read_bytes()
    (tmp_path / "run" / "weights.safetensors").unlink()
    monkeypatch.setattr(data_source, "free_bytes", lambda: None)
    assert trainer.train(dataset, tmp_path / "run", auto).read_bytes() == first
    with pytest.raises(ValueError, match=r"another train setting data \('stream' instead of 'memory'\)"):
        trainer.train(dataset, tmp_path / "run", replace(auto, data="memory"))


def test_examples_are_streamed_where_they_would_take_half_of_the_memory(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = sum(value.nbytes for value in load_file(dataset / "shard-00000.safetensors").values()) * 2
    for free, place in ((2 * needed, "memory"), (2 * needed - 2, "stream"), (None, "memory")):
        monkeypatch.setattr(data_source, "free_bytes", lambda free=free: free)
        assert choose_place(dataset, tmp_path, "auto", CPU) == place
    assert capsys.readouterr().out.count("GB of examples are streamed") == 1
    monkeypatch.setattr(data_source, "free_bytes", lambda: 3 * needed)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert choose_place(dataset, tmp_path, "auto", CPU) == "stream", "each process of a machine would hold all"
    assert choose_place(dataset, tmp_path, "memory", CPU) == "memory"


def test_a_damaged_shard_is_named_before_the_first_step(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(dataset, tmp_path / "data")
    shard = data / "shard-00001.safetensors"
    shard.write_bytes(shard.read_bytes()[:-9])
    assert (
        command_line.main(
            ["train", str(data), "--output", str(tmp_path / "run"), "--preset", "tiny", "--data", "stream"]
        )
        == 2
    )
    said = capsys.readouterr().err
    assert f"{shard} cannot be read" in said and "delete it and run mereo generate" in said
    assert not (tmp_path / "run" / "survey.json").exists()
    shutil.rmtree(tmp_path / "run")
    shard.unlink()
    with pytest.raises(ValueError, match="holds 32 of 64 examples; training needs all of them"):
        trainer.train(data, tmp_path / "run", replace(SMALL, data="stream"))


def test_a_shard_that_is_damaged_later_ends_the_run_with_its_name(dataset: Path, tmp_path: Path) -> None:
    data = StreamingDataset.open(shutil.copytree(dataset, tmp_path / "data")).surveyed(tmp_path, Process())
    shard = tmp_path / "data" / "shard-00001.safetensors"
    shard.write_bytes(b"")
    order = data.order(64, 8, 0, 1)
    with pytest.raises(ValueError, match=r"shard-00001\.safetensors cannot be read"):
        list(data.pieces(order, range(8), slice(0, 8)))


def test_shards_that_differ_are_refused(dataset: Path, tmp_path: Path) -> None:
    data = shutil.copytree(dataset, tmp_path / "data")
    path = data / "shard-00001.safetensors"
    queries = ("positions", "labels", "distances", "directions", "rest")
    save_file({k: v[:, :9].contiguous() if k in queries else v for k, v in load_file(path).items()}, path)
    with pytest.raises(ValueError, match=r"00001.* has 96 points, 9 queries .*, the first shard 96, 128 and 0"):
        StreamingDataset.open(data).surveyed(tmp_path, Process())


def test_a_survey_is_read_again_and_one_of_other_data_is_not(dataset: Path, tmp_path: Path) -> None:
    data = StreamingDataset.open(dataset)
    first = data.surveyed(tmp_path, Process()).found
    path = tmp_path / "survey.json"
    path.write_text(path.read_text().replace('"scale": [', '"scale": [\n'))
    written = path.read_bytes()
    assert data.surveyed(tmp_path, Process()).found == first and path.read_bytes() == written
    for damage in (b"", b"[]", written.replace(b'"runs"', b'"walks"'), written.replace(data.key.encode(), b"another")):
        path.write_bytes(damage)
        assert data.surveyed(tmp_path, Process()).found == first


# --- batches in parts -------------------------------------------------------------------------------------------------


def gradients(data: Dataset, config: TrainConfig, folder: Path) -> torch.Tensor:
    """All gradients of the first step side by side, and its loss, with the statistics of normalization held fixed."""
    loop = trainer.Trainer(config, data, trainer.start_network(config, data), folder, Process(), CPU)
    loop.network.train()
    for module in loop.network.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.eval()
    loss = loop._gradients(next(loop.batches()))["loss"]
    return torch.cat([p.grad.flatten() for p in loop.network.parameters() if p.grad is not None] + [loss[None]])


@pytest.mark.parametrize("parts", [2, 4])
def test_a_batch_in_parts_has_the_gradient_of_the_whole(dataset: Path, tmp_path: Path, parts: int) -> None:
    """To rounding, but for batch normalization, which sees each part by itself: it is held fixed for this."""
    data = Dataset.load(dataset)
    config = replace(SMALL, precision="float32", compile="off")
    whole, found = (gradients(data, replace(config, accumulate=count), tmp_path) for count in (1, parts))
    assert (found - whole).abs().max() < 1e-5 * whole.abs().max()


def test_a_batch_that_has_no_equal_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="accumulate is 3 and batch 8; a batch is learnt in equal parts"):
        replace(SMALL, accumulate=3)
    with pytest.raises(ValueError, match="a part of a batch has one query"):
        replace(SMALL, accumulate=8, queries=1)


def test_a_shuffled_order_is_one_pass_after_another() -> None:
    seen = torch.cat([ShuffledOrder(10, 4, 0).index(step) for step in range(5)])
    assert torch.equal(seen[:10].sort().values, torch.arange(10)) and torch.equal(seen.bincount(), torch.full((10,), 2))
