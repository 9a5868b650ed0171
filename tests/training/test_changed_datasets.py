"""Datasets whose files have changed since, or come from elsewhere: generation makes them again, training refuses."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import contents
from safetensors.numpy import load_file, save_file
from toy_data import SMALL, make_small_datasets, read_all, small_shards
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.training.dataset import Dataset

__all__ = ["small_shards"]  # a fixture

TOY = toy_scene()
FILES = ("shard-00001.safetensors", "template.safetensors", "statistical_model.safetensors")


def make(output: Path, seed: int = 3, resume: bool = False) -> Path:
    generate(TOY, output, SMALL, examples=4, seed=seed, resume=resume)
    return output


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two datasets of the same scene with other seeds."""
    with pytest.MonkeyPatch.context() as patch:
        make_small_datasets(patch)
        folder = tmp_path_factory.mktemp("originals")
        return make(folder / "a"), make(folder / "b", seed=4)


@pytest.fixture
def data(originals: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(originals[0], tmp_path / "data"))


def refused_and_made_again(data: Path, whole: Path, name: str, reason: str) -> str:
    """What generation prints of it."""
    with pytest.raises(ValueError, match=rf"{name} .*\({reason}.*\); delete it and run .?mereo generate"):
        Dataset.load(data)
    make(data, resume=True)
    assert contents(data) == contents(whole)
    return f"{name} is damaged and is made again"


@pytest.mark.parametrize("name", FILES)
def test_a_flipped_bit_is_noticed(
    data: Path, originals: tuple[Path, Path], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray((data / name).read_bytes())
    content[-100] ^= 1
    (data / name).write_bytes(content)
    said = refused_and_made_again(data, originals[0], name, "its checksum is another")
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_dataset_is_noticed(data: Path, originals: tuple[Path, Path], name: str) -> None:
    shutil.copy(originals[1] / name, data / name)
    refused_and_made_again(data, originals[0], name, "it is of another dataset")


def test_a_shard_in_the_place_of_another_is_noticed(data: Path, originals: tuple[Path, Path]) -> None:
    shutil.copy(data / "shard-00000.safetensors", data / FILES[0])
    refused_and_made_again(data, originals[0], FILES[0], "it begins with example 0 instead of 2")


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_noticed(data: Path, originals: tuple[Path, Path], name: str) -> None:
    (data / name).write_bytes((data / name).read_bytes()[:200])
    refused_and_made_again(data, originals[0], name, "")


# --- datasets of earlier versions, without checksums ------------------------------------------------------------------


def without_checksums(data: Path) -> Path:
    for path in (*data.glob("shard-*"), data / "template.safetensors"):
        save_file(load_file(path), path)
    return data


@pytest.mark.parametrize("tensor, reason", [(None, "it has no tensor 'rest'"), ((2, 5, 3), "its tensor 'rest' has")])
def test_a_shard_without_one_of_its_tensors_is_noticed(
    data: Path, tensor: tuple[int, ...] | None, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = without_checksums(data) / FILES[0]
    tensors = load_file(path)
    kept = np.array(tensors.pop("rest"))
    save_file(tensors | ({} if tensor is None else {"rest": np.zeros(tensor, np.float16)}), path)
    with pytest.raises(ValueError, match=rf"shard-00001\.safetensors cannot be read \({reason}"):
        Dataset.load(data)
    make(data, resume=True)
    assert f"{FILES[0]} is damaged and is made again" in capsys.readouterr().out
    assert torch.equal(read_all(Dataset.load(data)).rest[2:].isnan(), torch.from_numpy(np.isnan(kept)))


def test_a_template_of_another_object_is_noticed(data: Path) -> None:
    for tensors in ({"distance": np.zeros((1, 4, 4, 4), np.float16)}, {"other": np.zeros(3)}):
        save_file(tensors, data / "template.safetensors")
        with pytest.raises(ValueError, match=r"template\.safetensors cannot be read \(it(s| has no) tensor"):
            Dataset.load(data)


@pytest.mark.parametrize("content", [b"[]", b'{"scene": "toy"}', b"{", b"\xff\xfe"])
def test_a_manifest_that_is_none_is_one_sentence(data: Path, content: bytes) -> None:
    (data / "manifest.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"manifest\.json is not .*; generate the dataset again"):
        Dataset.load(data)


def test_a_manifest_that_was_changed_does_not_fit_its_files(data: Path) -> None:
    manifest = json.loads((data / "manifest.json").read_text())
    for change in ({"seed": 4}, {"any_roll": True}, {"segments": manifest["segments"][::-1]}):
        (data / "manifest.json").write_text(json.dumps(manifest | change))
        with pytest.raises(ValueError, match="it is of another dataset"):
            Dataset.load(data)
    (data / "manifest.json").write_text(json.dumps(manifest | {"unit_m": 0.01}))
    assert Dataset.load(data).visible_m is not None, "the unit may be said afterwards"


def test_more_examples_than_the_disk_has_room_for_are_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"examples=10000000000 needs .* GB at .* kB each and .* would fit: ask"):
        generate(TOY, tmp_path / "data", SMALL, examples=10**10, seed=3)
    assert not (tmp_path / "data").exists()
