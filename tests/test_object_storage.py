"""Places by URL: which texts are local paths, storages, or refused; and what a storage's folder does."""

import random
import subprocess
import sys
from pathlib import Path

import pytest

from mereo.io import object_storage
from mereo.io.atomic_files import check_place
from mereo.io.object_cache import CACHE_VARIABLE, read_cached
from mereo.io.object_storage import ObjectPath, StorageError, place_of
from mereo.io.places import claim, names_in, sha256, write_whole


@pytest.fixture
def folder(request: pytest.FixtureRequest) -> ObjectPath:
    return ObjectPath(f"memory://storage/{request.node.name.replace('[', '-').replace(']', '')}")


# --- texts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, path",
    [
        ("data/bunny", "data/bunny"),
        ("a:b", "a:b"),
        ("file:///tmp/a%20b", "/tmp/a b"),
        ("file://localhost/tmp/x/", "/tmp/x"),
        ("./s3:/b/x", "s3:/b/x"),
    ],
)
def test_texts_without_a_storage_are_local_paths(text: str, path: str) -> None:
    assert place_of(text) == Path(path)


@pytest.mark.parametrize(
    "text, url",
    [
        ("s3://bucket/data/", "s3://bucket/data"),
        ("S3://bucket/a b/ü", "s3://bucket/a b/ü"),
        ("gs://b/x.y", "gs://b/x.y"),
        ("memory://x", "memory://x"),
    ],
)
def test_urls_keep_what_a_path_would_lose(text: str, url: str) -> None:
    place = place_of(text)
    assert isinstance(place, ObjectPath) and str(place) == url and place_of(place) is place
    assert str(place / "a.safetensors") == f"{url}/a.safetensors"
    assert ((place / "shard-1.safetensors").name, (place / "shard-1.safetensors").stem) == (
        "shard-1.safetensors",
        "shard-1",
    )


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("ftp://host/x", "ftp://host/x has the protocol 'ftp'; it must be s3, gs or file: correct it, or name a local"),
        ("s3://bucket", "names no folder in a bucket, which is needed: write for example s3://bucket/data"),
        ("s3://", "names no folder"),
        ("memory://", "names no folder"),
        ("s3:///x", "has a part that no folder of a storage should have"),
        ("s3://b/../x", "has a part that no folder"),
        ("s3://b/x?versionId=1", "has a part that no folder"),
        ("s3://b/x\ny", r"s3://b/x\\ny has a part that no folder"),
        ("s3://b/" + "x" * 901, "has more than 900 bytes, which leaves none for files: choose a shorter name"),
        ("file://host/x", "names another machine; a file URL has three slashes"),
    ],
)
def test_other_urls_are_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        place_of(text)


def test_credentials_in_a_url_are_refused_and_not_repeated() -> None:
    with pytest.raises(ValueError, match=r"the URL s3://\.\.\.@bucket has credentials in it; they do not") as refused:
        place_of("s3://AKIA123:geheim/x@bucket/data".replace("/x@", "x@"))
    assert "geheim" not in str(refused.value) and "AKIA" not in str(refused.value)


def test_any_text_is_a_place_or_one_sentence() -> None:
    rng = random.Random(7)
    pieces = [
        "s3",
        "gs",
        "file",
        "memory",
        "x",
        ":",
        "//",
        "/",
        "..",
        ".",
        "@",
        "?",
        "#",
        "%2F",
        "ä",
        "\0",
        "\n",
        " ",
        "\udc80",
    ]
    for _ in range(3000):
        text = "".join(rng.choices(pieces, k=rng.randrange(1, 9)))
        try:
            place = place_of(text)
        except ValueError as error:
            said = str(error)
            assert said.isprintable() and len(said) < 400 and ": " in said, repr(text)
        else:
            assert isinstance(place, Path) or place_of(str(place)) == place, repr(text)


def test_outputs_that_cannot_be_objects_refuse_a_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="the output s3://bucket/run is a URL, and a local path is needed here; only"):
        check_place(Path("s3://bucket/run"))
    (tmp_path / "s3:").mkdir()
    check_place(Path("s3:/bucket/run"))


# --- folders of objects -----------------------------------------------------------------------------------------------


def test_a_folder_of_objects_is_as_one_of_files(folder: ObjectPath) -> None:
    assert names_in(folder) == [] and not (folder / "a").exists()
    with pytest.raises(FileNotFoundError, match="a does not exist: check the URL"):
        (folder / "a").read_bytes()
    assert write_whole(folder / "a", b"1") == sha256(b"1")
    write_whole(folder / "b/c", b"2")
    assert names_in(folder) == ["a", "b"]
    assert (folder / "a").exists() and not (folder / "b").exists()
    write_whole(folder / "a", b"3")
    assert (folder / "a").read_bytes() == b"3" and (folder / "a").read_text("utf-8") == "3"
    with pytest.raises(FileExistsError, match="a exists; it is not overwritten"):
        (folder / "a").write_new(b"4")
    assert (folder / "a").read_bytes() == b"3"


def test_one_of_several_claims_a_folder(folder: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    assert claim(folder, "m.json", {"a": [1, 2.5]}, "a dataset") is None
    assert claim(folder, "m.json", {"a": 3}, "a dataset") == {"a": [1, 2.5]}
    with pytest.raises(FileExistsError, match="is not empty and holds no other.json; choose another --output"):
        claim(folder, "other.json", {}, "a dataset")
    # another machine, whose manifest came between our look and our put
    monkeypatch.setattr(ObjectPath, "names", lambda _: [])
    assert claim(folder, "m.json", {"a": 3}, "a dataset") == {"a": [1, 2.5]}
    # a storage that does not know the condition, where another's came after ours
    monkeypatch.setattr(ObjectPath, "write_new", lambda path, _: path.write_bytes(b'{"a": 9}'))
    assert claim(folder, "m.json", {"a": 3}, "a dataset") == {"a": 9}
    monkeypatch.setattr(ObjectPath, "write_new", ObjectPath.write_bytes)
    assert claim(folder, "m.json", {"a": 3}, "a dataset") is None


def test_a_copy_is_known_by_its_content(folder: ObjectPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    write_whole(folder / "a", b"first")
    assert read_cached(folder / "a", sha256(b"first")) == b"first"
    (copy,) = (path for path in (tmp_path / "cache").rglob("*") if path.is_file())
    write_whole(folder / "a", b"second")
    assert read_cached(folder / "a", sha256(b"first")) == b"first", "not fetched again"
    copy.write_bytes(b"fir")
    assert read_cached(folder / "a", sha256(b"second")) == b"second"
    write_whole(folder / "a", b"first")
    assert read_cached(folder / "a", sha256(b"first")) == b"first" == copy.read_bytes(), (
        "a damaged copy is fetched again"
    )
    assert read_cached(folder / "a", sha256(b"other")) == b"first"
    assert len([path for path in (tmp_path / "cache").rglob("*") if path.is_file()]) == 2, "what is wrong is not kept"


def test_without_a_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    for url, extra in (("s3://b/x", "storage"), ("gs://b/x", "gcs")):
        with pytest.raises(ImportError, match=rf"is needed for {url[:2]}:// places: pip install 'mereo\[{extra}\]'"):
            place_of(url).exists()


class Answer(Exception):
    """What botocore raises where a storage has answered."""

    def __init__(self, code: str) -> None:
        super().__init__(f"An error occurred ({code})")
        self.response = {"Error": {"Code": code}}


class NoCredentialsError(Exception):
    """As botocore calls it."""


@pytest.mark.parametrize(
    "error, sentence",
    [
        (Answer("NoSuchBucket"), "there is no bucket 'b'; make it, or correct the URL"),
        (Answer("AccessDenied"), r"refuses the credentials that it was given \(AccessDenied\); check them, and what"),
        (Answer("SlowDown"), "the storage says An error occurred"),
        (NoCredentialsError(), "no credentials were found .*; set AWS_ACCESS_KEY_ID"),
        (TimeoutError("timed out"), r"cannot be reached \(timed out\); check the network, AWS_ENDPOINT_URL and"),
        (OSError("no route to http://me:secret@host/x"), r"\(no route to http://\.\.\.@host/x\)"),
        (PermissionError("Forbidden"), r"refuses the credentials that it was given \(PermissionError\)"),
    ],
)
def test_what_a_storage_says_is_one_sentence(error: Exception, sentence: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: str) -> bytes:
        raise error

    monkeypatch.setattr(ObjectPath, "_system", lambda _: type("System", (), {"cat_file": staticmethod(fails)}))
    with pytest.raises(StorageError, match=f"s3://b/x cannot be read: .*{sentence}"):
        ObjectPath("s3://b/x").read_bytes()


def test_the_libraries_are_loaded_where_they_are_needed_alone() -> None:
    code = "import mereo.__main__, sys; print([name for name in ('fsspec', 's3fs', 'pydantic') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_every_protocol_names_its_library() -> None:
    assert set(object_storage.LIBRARIES) == {"s3", "gs", "memory"}
