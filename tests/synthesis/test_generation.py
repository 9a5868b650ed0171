"""Generation: the same bits however the work is shared or interrupted, and never a test seed by accident."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from folder_contents import contents
from safetensors.numpy import load_file
from scene_code import CODE
from scene_files import write_bar, write_mesh
from shapes import ball
from toy_data import SMALL
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import Example, synthesize
from mereo_learning import shards
from mereo_learning.shards import example_bytes

TOY = toy_scene()


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "SHARD_SIZE", 4)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten examples, made in one go: shards of 4, 4 and 2."""
    output = tmp_path_factory.mktemp("whole") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "SHARD_SIZE", 4)
        generate(TOY, output, SMALL, examples=10, seed=3)
    return output


@pytest.mark.parametrize("calls", [0, 5, 9])
def test_killed_and_resumed_equals_uninterrupted(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    made = 0

    def stops(scene: Scene, settings: GenerateConfig, rng: np.random.Generator) -> Example:
        nonlocal made
        if made == calls:
            raise KeyboardInterrupt
        made += 1
        return synthesize(scene, settings, rng)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shards, "synthesize", stops)
        generate(TOY, tmp_path / "data", SMALL, examples=10, seed=3)
    complete = contents(tmp_path / "data")
    assert len(complete) == 3 + calls // 4  # manifest, template and statistical model come first
    assert complete.items() <= contents(whole).items()
    generate(TOY, tmp_path / "data", SMALL, examples=10, seed=3, resume=True)
    assert contents(tmp_path / "data") == contents(whole)


def test_tensors_are_as_documented_and_a_paper_size_dataset_fits_in_2_5_gigabytes(whole: Path) -> None:
    shard = load_file(whole / "shard-00000.safetensors")
    queries = SMALL.sampling.total(4)
    assert {key: (value.dtype.name, value.shape) for key, value in shard.items()} == {
        "cloud": ("float32", (4, 128, 3)),
        "cloud_count": ("int32", (4,)),
        "center": ("float64", (4, 3)),
        "scale": ("float64", (4,)),
        "positions": ("float32", (4, queries, 3)),
        "labels": ("uint8", (4, queries)),
        "distances": ("float32", (4, queries)),
        "directions": ("float16", (4, queries, 3)),
        "rest": ("float16", (4, queries, 3)),
    }
    assert np.array_equal(np.isnan(shard["rest"]).any(axis=-1), shard["labels"] == 0)
    stored = sum(value.nbytes for value in load_file(whole / "shard-00000.safetensors").values())
    assert stored == 4 * example_bytes(SMALL, segments=4)
    file = (whole / "shard-00000.safetensors").stat().st_size
    assert file - stored < 2000  # the header, once per 64 examples
    assert 28_800 * example_bytes(GenerateConfig(), segments=5) + 450 * 2000 < 1.65e9 < 2.5e9


def test_manifest_tells_how_to_make_it_again_and_files_have_the_users_permissions(whole: Path) -> None:
    manifest = json.loads((whole / "manifest.json").read_text())
    assert (manifest["scene"], manifest["seed"], manifest["examples"]) == ("toy", 3, 10)
    assert manifest["settings"]["sampling"]["per_segment"] == 16
    assert [part["name"] for part in manifest["segments"]] == list(TOY.rest.names)
    assert [tuple(part["color"]) for part in manifest["segments"]] == list(TOY.rest.colors)
    assert len(manifest["rest_sha256"]) == 64 and manifest["any_roll"] is False
    assert manifest["bytes"] == 10 * example_bytes(SMALL, 4)
    assert manifest["libraries"]["numpy"] == np.__version__
    mask = os.umask(0)
    os.umask(mask)
    assert all(path.stat().st_mode & 0o777 == 0o666 & ~mask for path in whole.iterdir())


def test_test_seeds_and_training_seeds_never_meet(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="seeds from 1000000 up are for testing and never for training"):
        generate(TOY, tmp_path / "data", SMALL, examples=4, seed=TEST_SEED_START)
    with pytest.raises(ValueError, match="a test set needs one from 1000000 up"):
        generate(TOY, tmp_path / "data", SMALL, examples=4, seed=TEST_SEED_START - 1, test=True)
    assert not (tmp_path / "data").exists()
    generate(TOY, tmp_path / "data", SMALL, examples=1, seed=TEST_SEED_START, test=True)


def test_resuming_names_the_setting_that_differs(whole: Path, tmp_path: Path) -> None:
    before = contents(whole)
    sampling = replace(SMALL.sampling, oversample=2)
    cases = [
        (SMALL, 4, 10, "seed = 3, not 4"),
        (SMALL, 3, 11, "examples = 10, not 11"),
        (replace(SMALL, noise_std=0.5), 3, 10, "settings.noise_std = 0.1, not 0.5"),
        (replace(SMALL, sampling=sampling), 3, 10, "settings.sampling.oversample = 1, not 2"),
    ]
    for settings, seed, examples, difference in cases:
        message = rf"was made with {re.escape(difference)}; resuming needs equal settings: use them, or choose another"
        with pytest.raises(ValueError, match=message):
            generate(TOY, whole, settings, examples=examples, seed=seed, resume=True)
    with pytest.raises(ValueError, match="was made with scene = 'toy', not 'rope'"):
        generate("rope", whole, SMALL, examples=10, seed=3, resume=True)
    assert contents(whole) == before


def test_a_broken_manifest_cannot_be_resumed(tmp_path: Path) -> None:
    for text in ("{", "[]"):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(ValueError, match="holds no settings; what it belongs to cannot be continued: choose"):
            generate(TOY, tmp_path, SMALL, examples=4, seed=1, resume=True)


@pytest.mark.parametrize("resume", [False, True])
def test_an_existing_directory_is_left_alone(tmp_path: Path, resume: bool) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(FileExistsError, match=r"is not empty and holds no manifest\.json; choose another output"):
        generate(TOY, tmp_path, SMALL, examples=4, seed=1, resume=resume)
    with pytest.raises(FileExistsError, match="is a file; a dataset is a directory: choose another output"):
        generate(TOY, tmp_path / "notes.txt", SMALL, examples=4, seed=1, resume=resume)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "examples, seed, workers, shard, message",
    [
        (0, 1, 1, (0, 1), "examples is 0; it must be at least 1"),
        (4, -1, 1, (0, 1), "seed is -1; it must not be negative"),
        (4, 1, -1, (0, 1), "the number of workers is -1; it must be at least 1"),
        (4, 1, 1, (2, 2), "the shard is 2/2; i/n needs i from 0 to n - 1"),
    ],
)
def test_wrong_numbers_are_named(
    tmp_path: Path, examples: int, seed: int, workers: int, shard: tuple[int, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        generate(TOY, tmp_path / "data", SMALL, examples=examples, seed=seed, workers=workers, shard=shard)
    assert not (tmp_path / "data").exists()


def made(scene: Path, output: Path, workers: int = 1, examples: int = 2, resume: bool = False) -> dict[str, bytes]:
    generate(str(scene), output, SMALL, examples=examples, seed=0, workers=workers, resume=resume)
    return {file.name: file.read_bytes() for file in output.iterdir()}


def test_an_edited_scene_is_not_resumed_but_an_edited_comment_is(tmp_path: Path) -> None:
    scene = write_bar(tmp_path, "deformations:\n  - type: lattice\n    strength: 0.5\n")
    first = made(scene, tmp_path / "data")
    manifest = json.loads(first["manifest.json"])
    assert manifest["scene"] == "bar" and len(manifest["scene_file_sha256"]) == 64
    assert manifest["unit_m"] == pytest.approx(0.0005)
    scene.write_text("# a comment\n" + scene.read_text())
    assert made(scene, tmp_path / "data", resume=True) == first
    scene.write_text(scene.read_text().replace("0.5", "0.4"))
    # the deformation decides how long faces are divided, so the rest mesh is another one, too, and is compared first
    with pytest.raises(ValueError, match="was made with (rest|scene_file)_sha256 = .*resuming needs equal settings"):
        made(scene, tmp_path / "data", resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["yaml", "py"])
def test_two_workers_make_the_same_files_as_one(kind: str, tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    if kind == "py":
        scene = tmp_path / "mine.py"
        file = write_mesh(ball((0, 0, 0), 10.0, level=2), tmp_path / "ball.ply")
        scene.write_text(CODE.format(name="mine", file=str(file)))
    one = made(scene, tmp_path / "one", 1, examples=70)
    assert made(scene, tmp_path / "two", 2, examples=70) == one
