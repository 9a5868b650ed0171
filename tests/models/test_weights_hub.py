"""Weights on a model hub, against a hub on this machine: what travels, what is checked, and what is said."""

import json
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from model_hub import TOKEN, ModelHub, model_hub

import mereo
from mereo import __main__ as command_line
from mereo.cli.weights import _repository

pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=<...>':DeprecationWarning")  # huggingface_hub of httpx2

SHIPPED = Path(mereo.__file__).parent / "weights"
WEIGHTS, CARD = (SHIPPED / "rope.safetensors").read_bytes(), (SHIPPED / "rope.md").read_bytes()


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelHub]:
    pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed: pip install 'mereo[hub]'")
    # the transfer of large files by git LFS: the other, Xet, speaks a protocol of its own
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    with model_hub() as running:
        monkeypatch.setenv("HF_ENDPOINT", running.url)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield running


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one sentence with which a command refuses."""
    assert command_line.main(["weights", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("mereo: error: ") and said.count("\n") == 1, said
    return said.removeprefix("mereo: error: ").rstrip()


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("a/b", ("a/b", None, None)),
        ("a/b@v1.0", ("a/b", "v1.0", None)),
        ("a/b@refs/pr/1", ("a/b", "refs/pr/1", None)),
        ("a/b/x.safetensors", ("a/b", None, "x.safetensors")),
        ("a/b@refs/pr/1/x.safetensors", ("a/b", "refs/pr/1", "x.safetensors")),
        ("a/b.safetensors", ("a/b.safetensors", None, None)),
    ],
)
def test_places(text: str, parts: tuple[str | None, ...]) -> None:
    assert _repository(text) == parts


@pytest.mark.parametrize(
    "text", ["", "a", "a/b/c", "a/b@", "https://hub/a/b", "a/b/../x.safetensors", "a/b/x.pt", "a b/c"]
)
def test_what_names_no_place(text: str) -> None:
    with pytest.raises(ValueError, match="names no repository; write OWNER/NAME"):
        _repository(text)


def test_there_and_back(hub: ModelHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main(["weights", "push", "rope", "lab/rope", "--private"]) == 0
    assert capsys.readouterr().out == (
        "pushed rope.safetensors, rope.md, README.md to lab/rope; anyone who may read it: mereo weights pull lab/rope\n"
    )
    files = hub.repos["lab/rope"]["main"]
    assert hub.private == {"lab/rope"}
    assert files["rope.safetensors"] == WEIGHTS and files["rope.md"] == CARD
    assert files["README.md"].startswith(b"---\nlibrary_name: mereo\n") and files["README.md"].endswith(CARD)
    assert command_line.main(["weights", "pull", "lab/rope", "--output", str(tmp_path / "got")]) == 0
    assert capsys.readouterr().out.startswith(f"wrote {tmp_path}/got/rope.md and {tmp_path}/got/rope.safetensors (lab")
    assert {path.name: path.read_bytes() for path in (tmp_path / "got").iterdir()} == {
        "rope.safetensors": WEIGHTS,
        "rope.md": CARD,
    }


def test_a_page_that_is_there_stays_and_files_may_be_renamed(hub: ModelHub) -> None:
    hub.put("lab/objects", {"README.md": b"ours"})
    assert command_line.main(["weights", "push", "rope", "lab/objects/soft.safetensors"]) == 0
    files = hub.repos["lab/objects"]["main"]
    assert files == {"README.md": b"ours", "soft.safetensors": WEIGHTS, "soft.md": CARD}


def test_an_older_revision(hub: ModelHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = hub.put("lab/rope", {"rope.safetensors": WEIGHTS}, "v1")
    hub.put("lab/rope", {})
    assert refused(capsys, "pull", "lab/rope").startswith("lab/rope holds no such weights; name one")
    for number, revision in enumerate(("v1", first)):
        place = f"lab/rope@{revision}/rope.safetensors"
        assert command_line.main(["weights", "pull", place, "--output", str(tmp_path / str(number))]) == 0
        assert (tmp_path / str(number) / "rope.safetensors").read_bytes() == WEIGHTS
    assert "lab/rope@v2 cannot be reached on its hub (RevisionNotFoundError" in refused(capsys, "pull", "lab/rope@v2")


def test_several_weights_are_named(hub: ModelHub, capsys: pytest.CaptureFixture[str]) -> None:
    hub.put("lab/two", {"b.safetensors": WEIGHTS, "a.safetensors": WEIGHTS, "model.py": b"raise SystemExit"})
    sentence = "lab/two holds a.safetensors, b.safetensors; name one file of the repository: lab/two/FILE.safetensors"
    assert refused(capsys, "pull", "lab/two") == sentence
    assert "lab/two/c.safetensors holds no such weights; name one" in refused(capsys, "pull", "lab/two/c.safetensors")


def test_what_is_no_weights_is_not_put_in_place(
    hub: ModelHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = json.dumps({"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}).encode()
    other = struct.pack("<Q", len(head)) + head + bytes(4)
    for content, says in (
        (b"\x80\x04pickle", "is not a safetensors file"),
        (other, "holds tensors but no mereo header"),
    ):
        hub.put("lab/odd", {"odd.safetensors": content, "odd.md": b"# odd"})
        assert says in refused(capsys, "pull", "lab/odd", "--output", str(tmp_path / "got"))
    assert not (tmp_path / "got").exists()


def test_sizes_are_asked_before_anything_is_fetched(
    hub: ModelHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hub.put("lab/rope", {"rope.safetensors": WEIGHTS, "rope.md": CARD})
    hub.said_sizes = {"rope.safetensors": 10**13}
    assert "takes more than 8 GB of memory to read" in refused(
        capsys, "pull", "lab/rope", "--output", str(tmp_path / "got")
    )
    assert not any("/resolve/" in request for request in hub.requests)
    assert list(tmp_path.iterdir()) == []


def test_existing_files_stay(hub: ModelHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hub.put("lab/rope", {"rope.safetensors": WEIGHTS, "rope.md": CARD})
    (tmp_path / "rope.safetensors").write_text("mine")
    said = refused(capsys, "pull", "lab/rope", "--output", str(tmp_path))
    assert "rope.safetensors exists; it is not overwritten" in said
    assert [path.name for path in tmp_path.iterdir()] == ["rope.safetensors"]
    assert command_line.main(["weights", "pull", "lab/rope", "--output", str(tmp_path), "--force"]) == 0
    assert (tmp_path / "rope.safetensors").read_bytes() == WEIGHTS


def test_a_push_wants_a_login_and_a_card(
    hub: ModelHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.safetensors").write_bytes(WEIGHTS)
    said = refused(capsys, "push", str(tmp_path / "mine.safetensors"), "lab/mine")
    assert "has no card mine.md beside it; write both with `mereo release`" in said
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    said = refused(capsys, "push", "rope", "lab/rope")
    assert "hf auth login" in said and "HF_TOKEN" in said
    assert hub.repos == {}
    assert "lab/rope cannot be reached on its hub (RepositoryNotFoundError" in refused(capsys, "pull", "lab/rope")


@pytest.mark.parametrize("arguments", [("push", "rope", "lab/rope"), ("pull", "lab/rope")])
def test_no_network_is_one_sentence(
    arguments: tuple[str, ...], hub: ModelHub, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")  # the discard port: refused
    assert "lab/rope cannot be reached on its hub (ConnectError" in refused(capsys, *arguments)


def test_without_the_extra_one_sentence_names_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert refused(capsys, "pull", "lab/rope") == "huggingface_hub is needed for model hubs: pip install 'mereo[hub]'"
