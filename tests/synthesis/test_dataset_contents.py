"""`mereo dataset check` and `show`: which files of a dataset are not good, and what it is."""

import re
import shutil
from pathlib import Path

import pytest
from folder_contents import contents
from toy_data import SMALL, small_shards, whole
from toy_scene import toy_scene

from mereo.__main__ import main
from mereo.api.generate import generate
from mereo.scenes.seeds import TEST_SEED_START

__all__ = ["small_shards", "whole"]  # fixtures

TOY = toy_scene()


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


# --- the commands -----------------------------------------------------------------------------------------------------


def test_a_whole_dataset_passes(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(whole)
    assert main(["dataset", "check", str(whole)]) == 0
    assert "all 4 files are whole, 4 examples" in capsys.readouterr().out
    assert contents(whole) == before


def test_every_bad_file_is_named_with_its_reason(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (data / "template.safetensors").unlink()
    (data / "statistical_model.safetensors").write_bytes((data / "statistical_model.safetensors").read_bytes()[:-1])
    shutil.copy(data / "shard-00001.safetensors", data / "shard-00000.safetensors")
    shutil.copy(data / "shard-00001.safetensors", data / "shard-00002.safetensors")
    assert main(["dataset", "check", str(data)]) == 2
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert "template.safetensors: it is missing" in lines
    assert any(line.startswith("statistical_model.safetensors: ") for line in lines)
    assert "shard-00000.safetensors: it begins with example 2 instead of 0" in lines
    assert "shard-00002.safetensors: it is no part of this dataset, which ends before it" in lines
    assert not any(line.startswith("shard-00001") for line in lines)
    assert (
        said.err.count("\n") == 2 and "3 of 4 files are not good; the `mereo generate` command that made it" in said.err
    )


def test_a_test_set_has_no_statistical_model(tmp_path: Path) -> None:
    generate(TOY, tmp_path / "data", SMALL, examples=2, seed=TEST_SEED_START, test=True)
    assert not (tmp_path / "data" / "statistical_model.safetensors").exists()
    assert main(["dataset", "check", str(tmp_path / "data")]) == 0


def test_show_says_what_a_dataset_is(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (data / "shard-00001.safetensors").unlink()
    assert main(["dataset", "show", str(data)]) == 0
    rows = dict(re.split(r"\s+", line, maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert rows["files"] == "3 of 4 are there" and rows["examples"].startswith("4, 0.0") and rows["image_size"] == "48"
    assert main(["dataset", "show", str(data / "nowhere")]) == 2
    assert "has no manifest.json; a dataset is a directory made by mereo generate" in capsys.readouterr().err
