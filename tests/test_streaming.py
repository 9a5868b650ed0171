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
from mereo.training.processes import Process
from mereo.training.streaming import KEPT, StreamingDataset

pytestmark = pytest.mark.usefixtures("without_curves")

BRIEF = replace(SMALL, epochs=0.6, data="stream")
FULL = AugmentConfig(keep_points=(0.4, 0.9), hole_probability=0.5, jitter_std=0.01, roll=True)
CPU = torch.device("cpu")


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
    """To rounding, but for batch normalization, which sees each part by itself: it is held fixed for this.

    Sums of other lengths round otherwise, most where the network is steep: 7e-5 on a processor with SSE alone.
    """
    data = Dataset.load(dataset)
    config = replace(SMALL, precision="float32", compile="off")
    whole, found = (gradients(data, replace(config, accumulate=count), tmp_path) for count in (1, parts))
    assert (found - whole).abs().max() < 1e-3 * whole.abs().max()


def test_a_batch_that_has_no_equal_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="accumulate is 3 and batch 8; a batch is learnt in equal parts"):
        replace(SMALL, accumulate=3)
    with pytest.raises(ValueError, match="a part of a batch has one query"):
        replace(SMALL, accumulate=8, queries=1)
