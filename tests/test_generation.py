"""Generation: the same bits however the work is shared or interrupted, and never a test seed by accident."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from mereo import generation
from mereo.config import PRESETS, TEST_SEED_START, GenerateConfig, SamplingConfig
from mereo.dataset import Dataset
from mereo.generation import generate
from mereo.scene import load_scene
from mereo.synthesis import example_rng, synthesize

SMALL = GenerateConfig(image_size=48, points=128, sampling=SamplingConfig(per_segment=16))


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "SHARD_SIZE", 4)


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


def test_killed_and_resumed_equals_uninterrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    generate("rope", tmp_path / "whole", SMALL, examples=10, seed=3)
    original = generation._make_shard

    def dies_in_the_second(job: generation._Job) -> int:
        if job.first == 4:
            raise KeyboardInterrupt
        return original(job)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(generation, "_make_shard", dies_in_the_second)
        generate("rope", tmp_path / "parts", SMALL, examples=10, seed=3)
    assert sorted(contents(tmp_path / "parts")) == ["manifest.json", "shard-00000.safetensors"]
    generate("rope", tmp_path / "parts", SMALL, examples=10, seed=3, resume=True)
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


def test_machines_that_share_the_work_make_the_same_dataset(tmp_path: Path) -> None:
    generate("rope", tmp_path / "whole", SMALL, examples=10, seed=3)
    for part in range(2):
        generate("rope", tmp_path / "parts", SMALL, examples=10, seed=3, shard=(part, 2), resume=part > 0)
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


@pytest.mark.slow
def test_two_workers_equal_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # spawned workers do not see a patched shard size
    generate("rope", tmp_path / "one", SMALL, examples=130, seed=3, workers=1)
    generate("rope", tmp_path / "two", SMALL, examples=130, seed=3, workers=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_any_example_can_be_remade_alone(tmp_path: Path) -> None:
    generate("rope", tmp_path / "data", SMALL, examples=6, seed=8)
    example = synthesize(load_scene("rope"), SMALL, example_rng(8, 5))
    shard = load_file(tmp_path / "data" / "shard-00001.safetensors")
    assert np.array_equal(shard["positions"][1], example.queries.positions.astype(np.float32))
    assert np.array_equal(shard["labels"][1], example.queries.labels)


def test_training_reads_what_generation_writes(tmp_path: Path) -> None:
    generate("rope", tmp_path / "data", SMALL, examples=6, seed=8)
    data = Dataset.load(tmp_path / "data")
    assert len(data) == 6 and data.cloud.shape == (6, 128, 3)
    assert data.positions.shape == (6, SMALL.sampling.total(9), 3)
    assert (data.viewpoint[:, 2] < data.cloud[..., 2].amin(dim=1)).all()


def test_a_paper_size_dataset_fits_in_2_5_gigabytes(tmp_path: Path) -> None:
    """28,800 examples of a five-segment scene, on disk and in memory, from the bytes of one example."""
    queries, points = SamplingConfig().total(5), GenerateConfig().points
    generate("rope", tmp_path / "data", replace(SMALL, points=points), examples=2, seed=1)
    shard = load_file(tmp_path / "data" / "shard-00000.safetensors")
    per_query = sum(a.nbytes / a.shape[1] for k, a in shard.items() if a.shape[1:2] == (SMALL.sampling.total(9),)) / 2
    rest = sum(a.nbytes for k, a in shard.items() if a.shape[1:2] != (SMALL.sampling.total(9),)) / 2
    assert 28_800 * (per_query * queries + rest) < 2.5e9


def test_test_seeds_and_training_seeds_never_meet(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seeds from 1000000 up are for testing and never for training"):
        generate("rope", tmp_path / "data", SMALL, examples=4, seed=TEST_SEED_START)
    with pytest.raises(ValueError, match="a test set needs one from 1000000 up"):
        generate("rope", tmp_path / "data", SMALL, examples=4, seed=5, test=True)
    assert not (tmp_path / "data").exists()
    generate("rope", tmp_path / "data", SMALL, examples=1, seed=TEST_SEED_START, test=True)


def test_resuming_with_other_settings_is_refused(tmp_path: Path) -> None:
    generate("rope", tmp_path / "data", SMALL, examples=4, seed=1)
    with pytest.raises(ValueError, match=r"was made with seed = 1, not 2; resuming needs equal settings"):
        generate("rope", tmp_path / "data", SMALL, examples=4, seed=2, resume=True)
    with pytest.raises(ValueError, match=r"was made with settings = .*resuming needs equal settings"):
        generate("rope", tmp_path / "data", replace(SMALL, noise_std=0.5), examples=4, seed=1, resume=True)


def test_an_existing_directory_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    for resume, message in ((False, "continue it with --resume"), (True, "is no dataset to resume")):
        with pytest.raises(FileExistsError, match=message):
            generate("rope", tmp_path, SMALL, examples=4, seed=1, resume=resume)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_full_disk_is_one_sentence_and_leaves_no_half_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(tensors: object, path: Path) -> None:
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(generation, "save_file", full)
    with pytest.raises(OSError, match="the disk is full while writing"):
        generate("rope", tmp_path / "data", SMALL, examples=4, seed=1)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["manifest.json"]


@pytest.mark.parametrize(("examples", "seed", "workers"), [(0, 1, 1), (4, -1, 1), (4, 1, 0)])
def test_wrong_numbers_are_named(tmp_path: Path, examples: int, seed: int, workers: int) -> None:
    with pytest.raises(ValueError, match="it must"):
        generate("rope", tmp_path / "data", SMALL, examples=examples, seed=seed, workers=workers)


def test_manifest_tells_how_to_make_it_again(tmp_path: Path) -> None:
    generate("rope", tmp_path / "data", SMALL, examples=2, seed=1)
    manifest = json.loads((tmp_path / "data" / "manifest.json").read_text())
    assert manifest["scene"] == "rope" and manifest["seed"] == 1 and manifest["examples"] == 2
    assert manifest["settings"]["sampling"]["per_segment"] == 16
    assert [s["name"] for s in manifest["segments"]] == list(load_scene("rope").rest.names)
    assert len(manifest["rest_sha256"]) == 64 and manifest["any_roll"] is False


def test_presets_name_only_known_networks() -> None:
    assert set(PRESETS) == {"paper", "base", "large", "tiny"}
