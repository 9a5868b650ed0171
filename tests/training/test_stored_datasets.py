"""Datasets in an object storage are those of a folder, byte by byte: made, continued, checked, trained on."""

from itertools import count
from pathlib import Path

import pytest
import torch
from toy_data import SMALL, read_all, small_shards, whole
from toy_scene import toy_scene

import mereo
from mereo.__main__ import main, parse
from mereo.api.generate import generate
from mereo.cli.training import Generate, Train
from mereo.io.object_storage import ObjectPath, StorageError, names_in, write_whole
from mereo.training import trainer
from mereo.training.dataset import Dataset

__all__ = ["small_shards", "whole"]  # fixtures

TOY = toy_scene()
NUMBERS = count()


@pytest.fixture
def empty() -> ObjectPath:
    return ObjectPath(f"memory://datasets/{next(NUMBERS)}")


@pytest.fixture
def stored(whole: Path, empty: ObjectPath) -> ObjectPath:
    """The same in a storage."""
    for name in names_in(whole):
        write_whole(empty / name, (whole / name).read_bytes())
    return empty


def contents(folder: Path | ObjectPath) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names_in(folder)}


def assert_equal(one: Dataset, other: Dataset) -> None:
    first, second = (
        vars(read_all(one)) | {"template": one.template},
        vars(read_all(other)) | {"template": other.template},
    )
    assert first.keys() == second.keys() and one.manifest == other.manifest
    for name, values in first.items():
        assert values.dtype == second[name].dtype and torch.equal(values.isnan(), second[name].isnan())
        assert torch.equal(values.nan_to_num(), second[name].nan_to_num()), name


def test_a_storage_gets_the_bytes_that_a_folder_gets(whole: Path, empty: ObjectPath) -> None:
    generate(TOY, empty, SMALL, examples=4, seed=3)
    assert contents(empty) == contents(whole)
    assert_equal(Dataset.load(empty), Dataset.load(whole))


def test_machines_share_a_storage(whole: Path, empty: ObjectPath) -> None:
    for part in (1, 0):
        generate(TOY, empty, SMALL, examples=4, seed=3, shard=(part, 2))
    assert contents(empty) == contents(whole)
    with pytest.raises(FileExistsError, match=r"memory://datasets/\d+ holds a dataset; continue it with resume, or"):
        generate(TOY, empty, SMALL, examples=4, seed=3, shard=(0, 2))


def test_killed_in_the_middle_of_a_put_and_resumed(
    whole: Path, empty: ObjectPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = ObjectPath.write_bytes

    def killed(path: ObjectPath, content: bytes, force: bool = True) -> None:
        if path.name == "shard-00001.safetensors":
            raise KeyboardInterrupt  # a storage drops a put that is not finished
        put(path, content, force=force)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ObjectPath, "write_bytes", killed)
        generate(TOY, empty, SMALL, examples=4, seed=3)
    assert "shard-00001.safetensors" not in names_in(empty)
    with pytest.raises(ValueError, match="holds 2 of 4 examples; training needs all of them: finish it with mereo"):
        Dataset.load(empty)
    generate(TOY, empty, SMALL, examples=4, seed=3, resume=True)
    assert contents(empty) == contents(whole)


def test_another_dataset_or_other_objects_are_left_alone(stored: ObjectPath, empty: ObjectPath) -> None:
    before = contents(stored)
    with pytest.raises(FileExistsError, match="holds a dataset; continue it with resume, or choose another output"):
        generate(TOY, stored, SMALL, examples=4, seed=3)
    with pytest.raises(ValueError, match="was made with seed = 3, not 4; resuming needs equal settings"):
        generate(TOY, stored, SMALL, examples=4, seed=4, resume=True)
    with pytest.raises(FileExistsError, match=r"is not empty and holds no manifest.json; choose another output"):
        generate(TOY, ObjectPath("memory://datasets"), SMALL, examples=4, seed=3)
    assert contents(stored) == before


@pytest.mark.parametrize("name", ["shard-00001.safetensors", "template.safetensors", "statistical_model.safetensors"])
def test_a_damaged_object_is_named_and_made_again(
    stored: ObjectPath, whole: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray((stored / name).read_bytes())
    content[-100] ^= 1
    write_whole(stored / name, bytes(content))
    with pytest.raises(
        ValueError, match=rf"{name} .*\(its checksum is another.*\); delete it and run .?mereo generate"
    ):
        Dataset.load(stored)
    assert main(["dataset", "check", str(stored)]) == 2
    assert f"{name}: its checksum is another: its bytes have changed" in capsys.readouterr().out
    generate(TOY, stored, SMALL, examples=4, seed=3, resume=True)
    assert f"{name} is damaged and is made again" in capsys.readouterr().out
    assert contents(stored) == contents(whole)


def test_a_lost_network_is_no_damage(stored: ObjectPath, whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = ObjectPath.read_bytes

    def lost(path: ObjectPath) -> bytes:
        if path.name.startswith("shard-"):
            raise StorageError(f"{path} cannot be read: the storage cannot be reached (timed out); check the network")
        return read(path)

    with monkeypatch.context() as patch:
        patch.setattr(ObjectPath, "read_bytes", lost)
        for fails in (
            lambda: Dataset.load(stored),
            lambda: generate(TOY, stored, SMALL, examples=4, seed=3, resume=True),
        ):
            with pytest.raises(
                StorageError, match="shard-00000.safetensors cannot be read: the storage cannot be reach"
            ):
                fails()
    assert contents(stored) == contents(whole)


# --- the command line -------------------------------------------------------------------------------------------------


def test_options_keep_urls(tmp_path: Path) -> None:
    made = parse(["generate", "rope", "--examples", "2", "--output", "s3://bucket/data"])
    assert isinstance(made, Generate) and made.output == ObjectPath("s3://bucket/data")
    trained = parse(["train", "gs://bucket/data", "--output", "run"])
    assert isinstance(trained, Train) and (trained.dataset, trained.output) == (
        ObjectPath("gs://bucket/data"),
        Path("run"),
    )
    (tmp_path / "o.yaml").write_text("output: s3://bucket/from-file\nexamples: 3\n")
    from_file = parse(["generate", "rope", "--config", str(tmp_path / "o.yaml")])
    assert isinstance(from_file, Generate) and from_file.output == ObjectPath("s3://bucket/from-file")
    (tmp_path / "o.yaml").write_text("output: local/folder\nexamples: 3\n")
    from_file = parse(["generate", "rope", "--config", str(tmp_path / "o.yaml")])
    assert isinstance(from_file, Generate) and from_file.output == Path("local/folder")


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("generate rope --examples 2 --output ftp://h/x", "has none of the protocols s3, gs and file"),
        ("train s3://bucket --output run", "names no folder in a bucket"),
        ("dataset check nowhere", "nowhere has no manifest.json"),
        ("dataset check memory://nowhere", "memory://nowhere has no manifest.json"),
        (
            "train memory://nowhere/x --output s3://bucket/run",
            "the output s3://bucket/run is a URL, and a local path is",
        ),
    ],
)
def test_what_is_no_place_is_one_sentence(
    text: str, sentence: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(text.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("mereo: error: ") and sentence in said and said.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_functions_take_urls_as_texts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    url = f"memory://datasets/{next(NUMBERS)}"
    made = mereo.generate(TOY, url, SMALL, examples=2, seed=3)
    assert isinstance(made, ObjectPath) and str(made) == url
    asked: list[object] = []
    monkeypatch.setattr(
        trainer, "train", lambda dataset, output, config, device: asked.extend([dataset, output]) or output
    )
    mereo.train(url, tmp_path / "run", "tiny")
    mereo.train("data", "run", "tiny")
    assert asked == [made, tmp_path / "run", Path("data"), Path("run")]


@pytest.mark.slow
def test_a_network_is_trained_without_a_disk(tmp_path: Path) -> None:
    url = f"memory://datasets/{next(NUMBERS)}"
    mereo.generate(TOY, url, SMALL, examples=12, seed=3)
    stored = mereo.train(url, tmp_path / "stored", "tiny", epochs=1.0, batch=4)
    mereo.generate(TOY, tmp_path / "data", SMALL, examples=12, seed=3)
    local = mereo.train(tmp_path / "data", tmp_path / "local", "tiny", epochs=1.0, batch=4)
    assert stored.read_bytes() == local.read_bytes()
