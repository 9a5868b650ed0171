"""Datasets in S3, as a server on this machine speaks it: the same bytes as on a disk, claims, and what can go wrong."""

import os
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest
import torch
from toy_data import SMALL, read_all, small_shards
from toy_scene import toy_scene

from mereo.__main__ import main
from mereo.api.generate import generate
from mereo.io.object_storage import ObjectPath, claim, names_in, write_whole
from mereo_learning.dataset import Dataset

__all__ = ["small_shards"]  # a fixture

s3fs = pytest.importorskip("s3fs")
moto_server = pytest.importorskip("moto.server")

TOY = toy_scene()
NUMBERS = count()


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Address of a server with a bucket."""
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    yield f"http://127.0.0.1:{server.get_host_and_port()[1]}"
    server.stop()


@pytest.fixture(autouse=True)
def environment(endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """What a user sets; nothing of this machine's user is read."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "testing-id")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "testing-secret")
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    s3fs.S3FileSystem.clear_instance_cache()
    yield
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def folder() -> ObjectPath:
    system = s3fs.S3FileSystem()
    if not system.exists("bucket"):
        system.mkdir("bucket")
    return ObjectPath(f"s3://bucket/sets/{next(NUMBERS)}")


def contents(folder: Path | ObjectPath) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names_in(folder)}


def test_made_shared_damaged_continued_and_read(
    folder: ObjectPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generate(TOY, tmp_path / "data", SMALL, examples=4, seed=3)
    whole = contents(tmp_path / "data")
    for part in (1, 0):
        generate(TOY, folder, SMALL, examples=4, seed=3, shard=(part, 2))
    assert contents(folder) == whole
    assert main(["dataset", "check", str(folder)]) == 0
    write_whole(folder / "shard-00001.safetensors", whole["shard-00000.safetensors"])
    with pytest.raises(ValueError, match=r"s3://bucket/.*/shard-00001.safetensors cannot be read \(it begins with exa"):
        Dataset.load(folder)
    assert main(["dataset", "check", str(folder)]) == 2
    assert "shard-00001.safetensors: it begins with example 0 instead of 2" in capsys.readouterr().out
    with pytest.raises(FileExistsError, match="holds a dataset; continue it with resume"):
        generate(TOY, folder, SMALL, examples=4, seed=3)
    generate(TOY, folder, SMALL, examples=4, seed=3, resume=True)
    assert contents(folder) == whole
    assert torch.equal(*(read_all(Dataset.load(place)).positions for place in (folder, tmp_path / "data")))


def test_the_server_decides_whose_put_is_first(folder: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    assert claim(folder, "manifest.json", {"a": 1}, "a dataset") is None
    monkeypatch.setattr(ObjectPath, "names", lambda _: [])  # as another machine saw it before
    with pytest.raises(FileExistsError, match="manifest.json exists; it is not overwritten"):
        (folder / "manifest.json").write_bytes(b'{"a": 2}', force=False)
    assert claim(folder, "manifest.json", {"a": 2}, "a dataset") == {"a": 1}


NO_NETWORK = {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}
WRONG = [
    ({}, "dataset check s3://nobucket/x", "check the bucket 'nobucket'"),
    ({"AWS_ACCESS_KEY_ID": None}, "dataset check s3://bucket/x", "check the bucket 'bucket', your credentials for it"),
    (NO_NETWORK, "dataset show s3://bucket/x", "your credentials for it and the network"),
    ({"AWS_PROFILE": "none"}, "dataset check s3://bucket/x", "(The config profile (none) could not be found)"),
    ({}, "dataset check s3://bucket/nothing", "s3://bucket/nothing has no manifest.json; a dataset is"),
]


@pytest.mark.parametrize("change, text, sentence", WRONG)
def test_what_goes_wrong_is_one_sentence_without_credentials(
    folder: ObjectPath,
    change: dict[str, str | None],
    text: str,
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in change.items():
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    assert main(text.split()) == 2
    said = capsys.readouterr()
    assert said.err.startswith("mereo: error: s3://") and sentence in said.err and said.err.count("\n") == 1
    assert "testing-" not in said.err + said.out
    assert not any(tmp_path.iterdir())
