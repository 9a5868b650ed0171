"""Places by URL: which are local paths, storages, or refused; what a folder of objects does, in memory and in S3."""

import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from folder_contents import refusal
from fsspec.implementations.memory import MemoryFileSystem
from toy_data import SMALL, contents, make_small_datasets
from toy_scene import toy_scene

from mereo.__main__ import main
from mereo.api.generate import generate
from mereo.io.atomic_files import check_place
from mereo.io.object_storage import ObjectPath, StorageError, claim, names_in, place_of, write_whole
from mereo_learning.dataset import Dataset


@pytest.fixture
def folder(request: pytest.FixtureRequest) -> ObjectPath:
    return ObjectPath(f"memory://storage/{request.node.name.replace('[', '-').replace(']', '')}")


# --- texts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, url",
    [
        ("s3://bucket/data/", "s3://bucket/data"),
        ("S3://bucket/a b/ü", "s3://bucket/a b/ü"),
        ("memory://x", "memory://x"),
    ],
)
def test_urls_keep_what_a_path_would_lose(text: str, url: str) -> None:
    assert [place_of(local) for local in ("data/bunny", "./s3:/b/x")] == [Path("data/bunny"), Path("./s3:/b/x")]
    place = place_of(text)
    assert isinstance(place, ObjectPath) and str(place) == url and place_of(place) is place
    assert str(place / "a.safetensors") == f"{url}/a.safetensors" and (place / "b" / "a.npy").name == "a.npy"


@pytest.mark.parametrize(
    "text",
    ["ftp://host/x", "s3://bucket", "memory://", "s3:///x", "s3://b/../x", "s3://b/x?versionId=1", "s3://b/x\ny"],
)
def test_other_urls_are_one_sentence(text: str) -> None:
    sentence = "names no folder of a storage, s3 or gs, which is needed: write for example s3://bucket/data"
    with refusal(sentence):
        place_of(text)


def test_credentials_in_a_url_are_refused_and_not_repeated() -> None:
    refused_with = r"s3://\.\.\.@\.\.\. has credentials in it: set them in the environment"
    with pytest.raises(ValueError, match=refused_with) as refused:
        place_of("s3://AKIA123:geheim/x@bucket/data".replace("/x@", "x@"))
    assert "geheim" not in str(refused.value) and "AKIA" not in str(refused.value)


def test_outputs_that_cannot_be_objects_refuse_a_url(working_folder: Path) -> None:
    with pytest.raises(ValueError, match="the output s3://bucket/run is a URL, and a local path is needed here; only"):
        check_place(Path("s3://bucket/run"))
    (working_folder / "s3:").mkdir()
    check_place(Path("s3:/bucket/run"))


# --- folders of objects -----------------------------------------------------------------------------------------------


def test_a_folder_of_objects_is_as_one_of_files(folder: ObjectPath) -> None:
    assert names_in(folder) == [] and not (folder / "a").is_file()
    with pytest.raises(FileNotFoundError, match="a does not exist: check the URL"):
        (folder / "a").read_bytes()
    write_whole(folder / "a", b"1")
    write_whole(folder / "b/c", b"2")
    assert names_in(folder) == ["a", "b"]
    assert (folder / "a").is_file() and not (folder / "b").is_file()
    write_whole(folder / "a", b"3")
    assert (folder / "a").read_bytes() == b"3" and (folder / "a").read_text("utf-8") == "3"
    with pytest.raises(FileExistsError, match="a exists; it is not overwritten"):
        (folder / "a").write_bytes(b"4", force=False)
    assert (folder / "a").read_bytes() == b"3"


@pytest.mark.parametrize("kind", ["folder", "s3"])
def test_one_of_many_claims_a_folder(
    kind: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = request.getfixturevalue(kind)
    assert claim(folder, "m.json", {"a": [1, 2.5]}, "a dataset") is None
    assert claim(folder, "m.json", {"a": 3}, "a dataset") == {"a": [1, 2.5]}
    # another machine, whose manifest came between our look and our put
    monkeypatch.setattr(ObjectPath, "names", lambda _: [])
    assert claim(folder, "m.json", {"a": 3}, "a dataset") == {"a": [1, 2.5]}


def test_without_a_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    for url, extra in (("s3://b/x", "storage"), ("gs://b/x", "gcs")):
        with pytest.raises(ImportError, match=rf"{url} needs .*: pip install 'mereo\[{extra}\]'"):
            place_of(url).is_file()


@pytest.mark.parametrize("answer", ["AccessDenied", "timed out", "no route to http://me:secret@host/x"])
def test_what_a_storage_refuses_is_no_missing_file_but_a_sentence(answer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor do credentials show."""

    def fails(*_: object, **__: object) -> bytes:
        raise OSError(answer)

    place = ObjectPath("memory://b/x")
    for name, look in (("cat_file", place.read_bytes), ("info", place.is_file), ("ls", place.names)):
        monkeypatch.setattr(MemoryFileSystem, name, fails)
        with pytest.raises(StorageError, match=r"b/x cannot be used \(.*\): check the bucket 'b', your") as caught:
            look()
        assert "secret" not in str(caught.value)


# --- S3, as a server on this machine speaks it ------------------------------------------------------------------------


AWS = {
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
    "AWS_ACCESS_KEY_ID": "testing-id",
    "AWS_SECRET_ACCESS_KEY": "testing-secret",
    **dict.fromkeys(("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"), "/none"),
}
"""What a user sets; nothing of this machine's user is read."""


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Address of a server with a bucket."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    yield f"http://127.0.0.1:{server.get_host_and_port()[1]}"
    server.stop()


@pytest.fixture
def s3(endpoint: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[ObjectPath]:
    """A folder of a test's in the bucket."""
    make_small_datasets(monkeypatch)
    systems = pytest.importorskip("s3fs").S3FileSystem
    for name in {name for name in os.environ if name.startswith("AWS_")} - AWS.keys():
        monkeypatch.delenv(name)
    for name, value in (AWS | {"AWS_ENDPOINT_URL": endpoint}).items():
        monkeypatch.setenv(name, value)
    systems.clear_instance_cache()
    systems().makedirs("bucket", exist_ok=True)
    yield ObjectPath(f"s3://bucket/sets/{abs(hash(request.node.name))}")
    systems.clear_instance_cache()


def test_a_dataset_is_shared_and_made_again(s3: ObjectPath, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    make = partial(generate, toy_scene(), settings=SMALL, examples=4, seed=3)
    make(tmp_path / "data")
    whole = contents(tmp_path / "data")
    for part in (1, 0):
        make(s3, shard=(part, 2))
    assert contents(s3) == whole
    write_whole(s3 / "shard-00001.safetensors", whole["shard-00000.safetensors"])
    assert main(["dataset", "check", str(s3)]) == 2
    assert "shard-00001.safetensors: it begins with example 0 instead of 2" in capsys.readouterr().out
    make(s3, resume=True)
    assert contents(s3) == whole and len(Dataset.load(s3)) == 4


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
    s3: ObjectPath,
    change: dict[str, str | None],
    text: str,
    sentence: str,
    working_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    for name, value in change.items():
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    pytest.importorskip("s3fs").S3FileSystem.clear_instance_cache()
    assert main(text.split()) == 2
    said = capsys.readouterr()
    assert said.err.startswith("mereo: error: s3://") and sentence in said.err and said.err.count("\n") == 1
    assert "testing-" not in said.err + said.out
    assert not any(working_folder.iterdir())
