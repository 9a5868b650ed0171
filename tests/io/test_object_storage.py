"""Places by URL: which texts are local paths, storages, or refused; and what a storage's folder does."""

import subprocess
import sys
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from mereo.io.atomic_files import check_place
from mereo.io.object_storage import ObjectPath, StorageError, claim, names_in, place_of, write_whole


@pytest.fixture
def folder(request: pytest.FixtureRequest) -> ObjectPath:
    return ObjectPath(f"memory://storage/{request.node.name.replace('[', '-').replace(']', '')}")


# --- texts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["data/bunny", "a:b", "./s3:/b/x"])
def test_texts_without_a_storage_are_local_paths(text: str) -> None:
    assert place_of(text) == Path(text)


@pytest.mark.parametrize(
    "text, url",
    [
        ("s3://bucket/data/", "s3://bucket/data"),
        ("S3://bucket/a b/ü", "s3://bucket/a b/ü"),
        ("memory://x", "memory://x"),
    ],
)
def test_urls_keep_what_a_path_would_lose(text: str, url: str) -> None:
    place = place_of(text)
    assert isinstance(place, ObjectPath) and str(place) == url and place_of(place) is place
    assert str(place / "a.safetensors") == f"{url}/a.safetensors" and (place / "b" / "a.npy").name == "a.npy"


@pytest.mark.parametrize(
    "text",
    ["ftp://host/x", "s3://bucket", "memory://", "s3:///x", "s3://b/../x", "s3://b/x?versionId=1", "s3://b/x\ny"],
)
def test_other_urls_are_one_sentence(text: str) -> None:
    sentence = "names no folder of a storage, s3 or gs, which is needed: write for example s3://bucket/data"
    with pytest.raises(ValueError, match=sentence) as caught:
        place_of(text)
    assert "\n" not in str(caught.value)


def test_credentials_in_a_url_are_refused_and_not_repeated() -> None:
    refused_with = r"s3://\.\.\.@\.\.\. has credentials in it: set them in the environment"
    with pytest.raises(ValueError, match=refused_with) as refused:
        place_of("s3://AKIA123:geheim/x@bucket/data".replace("/x@", "x@"))
    assert "geheim" not in str(refused.value) and "AKIA" not in str(refused.value)


def test_outputs_that_cannot_be_objects_refuse_a_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="the output s3://bucket/run is a URL, and a local path is needed here; only"):
        check_place(Path("s3://bucket/run"))
    (tmp_path / "s3:").mkdir()
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


def test_one_of_several_claims_a_folder(folder: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_what_a_storage_refuses_is_no_missing_file_and_one_sentence(
    answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor do credentials show."""

    def fails(*_: object, **__: object) -> bytes:
        raise OSError(answer)

    place = ObjectPath("memory://b/x")
    for name, look in (("cat_file", place.read_bytes), ("info", place.is_file), ("ls", place.names)):
        monkeypatch.setattr(MemoryFileSystem, name, fails)
        with pytest.raises(StorageError, match=r"b/x cannot be used \(.*\): check the bucket 'b', your") as caught:
            look()
        assert "secret" not in str(caught.value)


def test_the_libraries_are_loaded_where_they_are_needed_alone() -> None:
    code = "import mereo.__main__, sys; print([name for name in ('fsspec', 's3fs', 'pydantic') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
