"""Datasets in a folder or an object storage: made, continued, checked and shown; what has changed is refused."""

import json
import re
import shutil
from itertools import count
from pathlib import Path

import pytest
import torch
from folder_contents import read_json
from toy_data import SMALL, contents, make_small_datasets, read_all, small_shards
from toy_scene import toy_scene

from mereo.__main__ import main, parse
from mereo.api.generate import generate
from mereo.cli.training import Train
from mereo.io.object_storage import ObjectPath, Place, StorageError, names_in, write_whole
from mereo.scenes.seeds import TEST_SEED_START
from mereo_learning.dataset import Dataset

__all__ = ["small_shards"]  # a fixture

TOY = toy_scene()
NUMBERS = count()

Folders = tuple[Path, Path]


def make(output: Place, seed: int = 3, **options: object) -> Place:
    generate(TOY, output, SMALL, examples=4, seed=seed, **options)  # type: ignore[arg-type]
    return output


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Two datasets of the same scene with other seeds, each of four examples in two shards."""
    with pytest.MonkeyPatch.context() as patch:
        make_small_datasets(patch)
        folder = tmp_path_factory.mktemp("originals")
        make(folder / "a"), make(folder / "b", seed=4)
        return folder / "a", folder / "b"


@pytest.fixture
def whole(originals: Folders) -> Path:
    return originals[0]


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


@pytest.fixture(params=["folder", "storage"])
def empty(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    return tmp_path / "data" if request.param == "folder" else ObjectPath(f"memory://datasets/{next(NUMBERS)}")


@pytest.fixture
def stored(whole: Path, empty: Place) -> Place:
    for name in names_in(whole):
        write_whole(empty / name, (whole / name).read_bytes())
    return empty


# --- made and continued -----------------------------------------------------------------------------------------------


def test_a_storage_gets_the_bytes_that_a_folder_gets(whole: Path, empty: Place) -> None:
    assert contents(make(empty)) == contents(whole)
    one, other = Dataset.load(empty), Dataset.load(whole)
    assert one.manifest == other.manifest and torch.equal(one.template, other.template)
    first, second = (vars(read_all(data)) for data in (one, other))
    torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)


def test_machines_share_a_place(whole: Path, empty: Place) -> None:
    for part in (1, 0):
        make(empty, shard=(part, 2))
    assert contents(empty) == contents(whole)
    with pytest.raises(FileExistsError, match=rf"{empty} holds a dataset; continue it with resume, or"):
        make(empty, shard=(0, 2))


def test_another_dataset_or_other_objects_are_left_alone(stored: Place) -> None:
    before = contents(stored)
    with pytest.raises(FileExistsError, match="holds a dataset; continue it with resume, or choose another output"):
        make(stored)
    above = stored.parent if isinstance(stored, Path) else ObjectPath("memory://datasets")
    with pytest.raises(FileExistsError, match=r"is not empty and holds no manifest.json; choose another output"):
        make(above)
    assert contents(stored) == before


@pytest.mark.parametrize("empty", ["storage"], indirect=True)
def test_a_lost_network_is_no_damage(whole: Path, stored: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    read = ObjectPath.read_bytes

    def lost(path: ObjectPath) -> bytes:
        if path.name.startswith("shard-"):
            raise StorageError(f"{path} cannot be read: the storage cannot be reached (timed out); check the network")
        return read(path)

    with monkeypatch.context() as patch:
        patch.setattr(ObjectPath, "read_bytes", lost)
        for fails in (lambda: Dataset.load(stored), lambda: make(stored, resume=True)):
            with pytest.raises(StorageError, match="shard-00000.safetensors cannot be read: the storage cannot be"):
                fails()
    assert contents(stored) == contents(whole)


# --- changed files ----------------------------------------------------------------------------------------------------


DAMAGE = {
    "its checksum is another": lambda content, _: content[:-100] + bytes([content[-100] ^ 1]) + content[-99:],
    "it is of another dataset": lambda _, other: other,
    "": lambda content, _: content[:200],
}


@pytest.mark.parametrize("name", ["shard-00001.safetensors", "template.safetensors", "statistical_model.safetensors"])
@pytest.mark.parametrize("reason", DAMAGE)
def test_a_damaged_file_is_named_and_made_again(
    stored: Place, originals: Folders, name: str, reason: str, capsys: pytest.CaptureFixture
) -> None:
    write_whole(stored / name, DAMAGE[reason](*((folder / name).read_bytes() for folder in originals)))
    with pytest.raises(ValueError, match=rf"{name} .*\({reason}.*\); delete it and run .?mereo generate"):
        Dataset.load(stored)
    assert main(["dataset", "check", str(stored)]) == 2
    assert f"{name}: {reason}" in capsys.readouterr().out
    make(stored, resume=True)
    assert f"{name} is damaged and is made again" in capsys.readouterr().out
    assert contents(stored) == contents(originals[0])


def test_a_manifest_that_was_changed_does_not_fit_its_files(data: Path) -> None:
    place = data / "manifest.json"
    manifest = read_json(place)
    for change in ({"seed": 4}, {"any_roll": True}, {"segments": manifest["segments"][::-1]}):
        place.write_text(json.dumps(manifest | change))
        with pytest.raises(ValueError, match="it is of another dataset"):
            Dataset.load(data)
    place.write_text(json.dumps(manifest | {"unit_m": 0.01}))
    assert Dataset.load(data).visible_m is not None, "the unit may be said afterwards"
    for content in (b'{"scene": "toy"}', b"\xff\xfe"):
        place.write_bytes(content)
        with pytest.raises(ValueError, match=r"manifest\.json is not .*; generate the dataset again"):
            Dataset.load(data)


# --- `mereo dataset check` and `show` ---------------------------------------------------------------------------------


def test_a_whole_dataset_passes(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    before = contents(whole)
    assert main(["dataset", "check", str(whole)]) == 0
    assert "all 4 files are whole, 4 examples" in capsys.readouterr().out
    assert contents(whole) == before
    make(tmp_path / "test", TEST_SEED_START, test=True)
    assert not (tmp_path / "test/statistical_model.safetensors").exists(), "a test set has none"
    assert main(["dataset", "check", str(tmp_path / "test")]) == 0


def test_every_bad_file_is_named_with_its_reason(data: Path, capsys: pytest.CaptureFixture) -> None:
    (data / "template.safetensors").unlink()
    (data / "statistical_model.safetensors").write_bytes((data / "statistical_model.safetensors").read_bytes()[:-1])
    for number in (0, 2):
        shutil.copy(data / "shard-00001.safetensors", data / f"shard-0000{number}.safetensors")
    assert main(["dataset", "check", str(data)]) == 2
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert "template.safetensors: it is missing" in lines
    assert any(line.startswith("statistical_model.safetensors: ") for line in lines)
    assert "shard-00000.safetensors: it begins with example 2 instead of 0" in lines
    assert "shard-00002.safetensors: it is no part of this dataset, which ends before it" in lines
    assert not any(line.startswith("shard-00001") for line in lines)
    assert "3 of 4 files are not good; the `mereo generate` command that made it" in said.err
    assert said.err.count("\n") == 2


def test_show_says_what_a_dataset_is(data: Path, capsys: pytest.CaptureFixture) -> None:
    (data / "shard-00001.safetensors").unlink()
    assert main(["dataset", "show", str(data)]) == 0
    rows = dict(re.split(r"\s+", line, maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert rows["files"] == "3 of 4 are there" and rows["examples"].startswith("4, 0.0") and rows["image_size"] == "48"
    assert main(["dataset", "show", str(data / "nowhere")]) == 2
    assert "has no manifest.json; a dataset is a directory made by mereo generate" in capsys.readouterr().err


# --- URLs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("generate rope --examples 2 --output ftp://h/x", "names no folder of a storage, s3 or gs"),
        ("train s3://bucket --output run", "names no folder of a storage"),
        ("dataset check nowhere", "nowhere has no manifest.json"),
        ("dataset check memory://nowhere", "memory://nowhere has no manifest.json"),
        ("train memory://nowhere/x --output s3://b/run", "the output s3://b/run is a URL, and a local path is"),
    ],
)
def test_what_is_no_place_is_one_sentence(text: str, sentence: str, capsys: pytest.CaptureFixture) -> None:
    assert main(text.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("mereo: error: ") and sentence in said and said.count("\n") == 1
    trained = parse(["train", "gs://bucket/data", "--output", "run"])
    assert isinstance(trained, Train) and trained.dataset == ObjectPath("gs://bucket/data")
