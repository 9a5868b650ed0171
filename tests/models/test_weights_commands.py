"""`mereo weights`: what files of weights and their cards say, without loading a network."""

import json
from hashlib import sha256
from pathlib import Path

import pytest
from analytic import untrained

from mereo import __main__ as command_line
from mereo.models.weights import load_model, save_model
from mereo.models.weights_place import SHIPPED, shipped_names


def said(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert command_line.main(["weights", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_every_shipped_file_is_listed_with_the_scores_of_its_card(capsys: pytest.CaptureFixture[str]) -> None:
    rows = {line.split()[1]: line for line in said(capsys, "list").splitlines() if line.startswith("│")}
    assert tuple(rows) == shipped_names()
    for name, row in rows.items():
        assert f"{(SHIPPED / f'{name}.safetensors').stat().st_size / 2**20:.1f} MB" in row
    assert "0.973 0.904" in rows["bunny"]


def test_show_prints_the_unit_and_the_card(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "show", "tumor")
    assert "8.134 mm to a scene unit" in text and (SHIPPED / "tumor.md").read_text("utf-8") in text
    assert sha256((SHIPPED / "tumor.safetensors").read_bytes()).hexdigest() in text.split("# tumor")[0]


def test_json_has_the_header_and_the_card(capsys: pytest.CaptureFixture[str]) -> None:
    facts = json.loads(said(capsys, "show", "bunny", "--json"))
    assert facts["names"] == list(load_model("bunny").names) and facts["unit_m"] == pytest.approx(0.00604, rel=1e-3)
    assert facts["provenance"]["recipe"]["batch"] == 40 and facts["network"]["points"] == 1024
    assert facts["card"] == (SHIPPED / "bunny.md").read_text("utf-8")


def test_weights_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither card nor statistical model, and unknown provenance; a checkpoint beside it is no weights."""
    save_model(untrained(("one", "two")), tmp_path / "mine.safetensors")
    (tmp_path / "checkpoint.safetensors").write_bytes(b"something else")
    listed = [line for line in said(capsys, "list", tmp_path).splitlines() if line.startswith("│")]
    assert len(listed) >= 1 and "checkpoint" not in "".join(listed)
    text = said(capsys, "show", tmp_path / "mine.safetensors")
    assert "none: the network answers alone" in text and "true size not known" in text and "Not measured yet" in text
    assert command_line.main(["weights", "list", str(tmp_path / "checkpoint.safetensors")]) == 2
    assert "is not a safetensors file" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert command_line.main(["weights", "list", str(tmp_path / "empty")]) == 2
    assert "holds no weights" in capsys.readouterr().err
