"""The SHA-256 of each file in a dataset's manifest, and `mereo dataset check`, which names what is not good."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest
from safetensors import safe_open
from toy_data import SMALL, make_small_datasets, read_all, write_small_dataset, write_toy_dataset
from toy_scene import toy_scene

from mereo.__main__ import main
from mereo.api.generate import generate
from mereo.io.checked_tensors import pack_tensors, unpack_tensors
from mereo.scenes.seeds import TEST_SEED_START
from mereo.training.dataset import Dataset

TOY = toy_scene()
FILES = {"template.safetensors", "statistical_model.safetensors", "shard-00000.safetensors", "shard-00001.safetensors"}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    make_small_datasets(monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four examples in two shards."""
    return write_small_dataset(tmp_path_factory.mktemp("whole") / "data")


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


def manifest_of(data: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads((data / "manifest.json").read_text())
    return found


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


# --- the manifest -----------------------------------------------------------------------------------------------------


def test_the_manifest_has_the_sha256_of_each_file(whole: Path) -> None:
    assert manifest_of(whole)["files"] == {
        name: hashlib.sha256((whole / name).read_bytes()).hexdigest() for name in FILES
    }


def test_whoever_finds_all_done_writes_it_in_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    generate(TOY, tmp_path / "data", SMALL, examples=4, seed=3, shard=(1, 2))
    assert "files" not in manifest_of(tmp_path / "data"), "the other part is missing"
    generate(TOY, tmp_path / "data", SMALL, examples=4, seed=3, shard=(0, 2))
    assert contents(tmp_path / "data") == contents(whole)
    # killed before it was written, or a file system that showed the last file late
    plain = manifest_of(tmp_path / "data")
    del plain["files"]
    (tmp_path / "data" / "manifest.json").write_text(json.dumps(plain, indent=2, ensure_ascii=False) + "\n")
    assert len(Dataset.load(tmp_path / "data")) == 4
    generate(TOY, tmp_path / "data", SMALL, examples=4, seed=3, shard=(0, 2), resume=True)
    assert contents(tmp_path / "data") == contents(whole)


def test_what_another_machine_made_badly_is_named_and_nothing_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    generate(TOY, data, SMALL, examples=4, seed=3, shard=(1, 2))
    (data / "shard-00001.safetensors").write_bytes(b"half")
    generate(TOY, data, SMALL, examples=4, seed=3, shard=(0, 2))
    assert re.search(
        r"shard-00001\.safetensors is damaged \(.*\); run the same command again with --resume", capsys.readouterr().out
    )
    assert "files" not in manifest_of(data)


def exchange(path: Path) -> None:
    """Put a file of the same dataset in its place: whole, with a checksum of its own, but with other values."""
    tensors, facts = unpack_tensors(path.read_bytes())
    path.write_bytes(pack_tensors({name: value * 0 for name, value in tensors.items()}, facts))


def test_an_exchanged_shard_is_refused_by_name_and_made_again(
    data: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exchange(data / "shard-00001.safetensors")
    with safe_open(data / "shard-00001.safetensors", "numpy") as file:
        assert "mereo" in file.metadata()
    with pytest.raises(ValueError, match=r"shard-00001.safetensors cannot be read \(its SHA-256 is not that in mani"):
        Dataset.load(data)
    assert main(["dataset", "check", str(data)]) == 2
    generate(TOY, data, SMALL, examples=4, seed=3, resume=True)
    assert "shard-00001.safetensors is damaged and is made again" in capsys.readouterr().out
    assert contents(data) == contents(whole)


def test_without_the_manifests_hash_nobody_would_notice(data: Path) -> None:
    plain = manifest_of(data)
    del plain["files"]
    (data / "manifest.json").write_text(json.dumps(plain))
    exchange(data / "shard-00001.safetensors")
    assert float(read_all(Dataset.load(data)).cloud[2:].abs().max()) == 0


@pytest.mark.parametrize("files", [{"template.safetensors": "abc"}, ["x"], {"template.safetensors": 3}])
def test_hashes_that_are_none_are_one_sentence(data: Path, files: object) -> None:
    (data / "manifest.json").write_text(json.dumps(manifest_of(data) | {"files": files}))
    with pytest.raises(ValueError, match=r"manifest.json is not the manifest of a dataset \(its 'files"):
        Dataset.load(data)


# --- the commands -----------------------------------------------------------------------------------------------------


def test_a_whole_dataset_passes(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(whole)
    assert main(["dataset", "check", str(whole)]) == 0
    assert "all 4 files are whole, 4 examples; each has the SHA-256 that manifest.json has" in capsys.readouterr().out
    assert contents(whole) == before


def test_every_bad_file_is_named_with_its_reason(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (data / "template.safetensors").unlink()
    (data / "statistical_model.safetensors").write_bytes((data / "statistical_model.safetensors").read_bytes()[:-1])
    exchange(data / "shard-00000.safetensors")
    shutil.copy(data / "shard-00001.safetensors", data / "shard-00002.safetensors")
    assert main(["dataset", "check", str(data)]) == 2
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert "template.safetensors: it is missing" in lines
    assert any(line.startswith("statistical_model.safetensors: ") for line in lines)
    assert any(line.startswith("shard-00000.safetensors: its SHA-256 is not that in manifest.json") for line in lines)
    assert "shard-00002.safetensors: it is no part of this dataset, which ends before it" in lines
    assert not any(line.startswith("shard-00001") for line in lines)
    assert (
        said.err.count("\n") == 2 and "3 of 4 files are not good; the `mereo generate` command that made it" in said.err
    )


def test_write_gives_old_datasets_their_hashes(data: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = manifest_of(data)
    del plain["files"]
    (data / "manifest.json").write_text(json.dumps(plain))
    assert main(["dataset", "check", str(data)]) == 0
    assert "manifest.json has no SHA-256 of them: --write adds them" in capsys.readouterr().out
    assert main(["dataset", "check", str(data), "--write"]) == 0
    assert contents(data) == contents(whole)


def test_a_dataset_of_the_first_version_is_checked_as_far_as_can_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_toy_dataset(tmp_path / "data")
    (data / "shard-00001.safetensors").rename(tmp_path / "shard")
    assert main(["dataset", "check", str(data)]) == 2
    assert "holds 32 of 64 examples; the `mereo generate` command" in capsys.readouterr().err, "it names no shards"
    (tmp_path / "shard").rename(data / "shard-00001.safetensors")
    assert main(["dataset", "check", str(data), "--write"]) == 0
    assert "all 3 files are whole, 64 examples; wrote the SHA-256 of each" in capsys.readouterr().out, "no modes"
    (data / "shard-00001.safetensors").unlink()
    (data / "template.safetensors").unlink()
    assert main(["dataset", "check", str(data)]) == 2
    assert set(capsys.readouterr().out.splitlines()) == {
        f"{name}.safetensors: it is missing" for name in ("template", "shard-00001")
    }


def test_a_test_set_has_no_statistical_model(tmp_path: Path) -> None:
    generate(TOY, tmp_path / "data", SMALL, examples=2, seed=TEST_SEED_START, test=True)
    assert set(manifest_of(tmp_path / "data")["files"]) == {"template.safetensors", "shard-00000.safetensors"}  # type: ignore[call-overload]
    assert main(["dataset", "check", str(tmp_path / "data")]) == 0


def test_show_says_what_a_dataset_is(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (data / "shard-00001.safetensors").unlink()
    assert main(["dataset", "show", str(data)]) == 0
    rows = dict(re.split(r"\s+", line, maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert rows["files"] == "3 of 4 are there" and rows["examples"].startswith("4, 0.0") and rows["image_size"] == "48"
    assert rows["SHA-256"] == "of each file in the manifest"
    assert main(["dataset", "show", str(data / "nowhere")]) == 2
    assert "has no manifest.json; a dataset is a directory made by mereo generate" in capsys.readouterr().err
