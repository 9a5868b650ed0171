"""`mereo weights`: what files of weights and their cards say, without loading a network."""

import json
from hashlib import sha256
from pathlib import Path

import pytest
from analytic import untrained

from mereo import __main__ as command_line
from mereo.evaluation.metrics import format_score
from mereo.models.weights import load_model, save_model
from mereo.models.weights_facts import read_facts
from mereo.models.weights_place import SHIPPED, shipped_names
from mereo.training.model_card import card, card_results


def said(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert command_line.main(["weights", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_every_shipped_file_is_listed_with_the_scores_of_its_card(capsys: pytest.CaptureFixture[str]) -> None:
    rows = {line.split()[1]: line for line in said(capsys, "list").splitlines() if line.startswith("│")}
    assert tuple(rows) == shipped_names()
    for name, row in rows.items():
        results = card_results((SHIPPED / f"{name}.md").read_text("utf-8"))
        assert f"{results[0].scores['IoU']} {results[0].scores['mIoU']}" in row
        assert f"{(SHIPPED / f'{name}.safetensors').stat().st_size / 2**20:.1f} MB" in row
    assert "0.995 0.986" in rows["bunny"], "its four real scans"


@pytest.mark.parametrize("name", ["bunny", "tumor"])
def test_facts_are_those_of_the_loaded_model(name: str) -> None:
    facts, model = read_facts(name), load_model(name)
    assert facts.header.names == model.names and facts.network == model.network.config
    assert facts.parameters == sum(parameter.numel() for parameter in model.network.parameters())
    states = model.statistical_model
    assert states is not None and states.source_frame is not None and facts.states is not None
    assert facts.unit_m == states.source_frame.unit_m
    assert (facts.states.modes, facts.states.states) == (states.count, len(states.library))
    assert facts.states.vertices == sum(states.vertex_counts) and facts.states.residue == states.residue


def test_show_tells_object_unit_network_and_scores(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "show", "tumor")
    for part in (
        "1 tumor, 2 liver, 3 gallbladder",
        "tumor in liver",
        "8.134 mm to a scene unit",
        "PointNet++",
        "160 modes",
    ):
        assert part in text
    assert sha256((SHIPPED / "tumor.safetensors").read_bytes()).hexdigest() in text
    results = card_results((SHIPPED / "tumor.md").read_text("utf-8"))
    assert len(results) == 2 and "structured light" in results[1].title
    for result in results:
        assert all(score in text for score in result.scores.values()) and result.answers in text
    assert "- Not tested on a real sensor." in text


def test_json_has_everything(capsys: pytest.CaptureFixture[str]) -> None:
    found = json.loads(said(capsys, "show", "bunny", "--json"))
    assert found["examples_seen"] == 393_520
    assert [segment["name"] for segment in found["segments"]] == list(load_model("bunny").names)
    assert [result["mIoU"] for result in found["results"]] == ["0.904", "0.986", "0.808", "0.756"]
    assert found["provenance"]["recipe"]["batch"] == 40 and found["network"]["encoder"] == "pointnet2"


def test_weights_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither card nor statistical model, and unknown provenance; a checkpoint beside it is no weights."""
    save_model(untrained(("one", "two")), tmp_path / "mine.safetensors")
    (tmp_path / "checkpoint.safetensors").write_bytes(b"something else")
    listed = [line for line in said(capsys, "list", tmp_path).splitlines() if line.startswith("│")]
    assert len(listed) >= 1 and "checkpoint" not in "".join(listed)
    text = said(capsys, "show", tmp_path / "mine.safetensors")
    assert "none: the network answers alone" in text and "true size not known" in text and "no model card" in text
    assert command_line.main(["weights", "list", str(tmp_path / "checkpoint.safetensors")]) == 2
    assert "is not a safetensors file" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert command_line.main(["weights", "list", str(tmp_path / "empty")]) == 2
    assert "holds no weights" in capsys.readouterr().err


def test_results_of_a_card_are_read_as_they_were_written() -> None:
    test = {"examples": 4, "seed": 1_000_000, "iou": 0.5, "miou": 0.25, "per_segment": {"one": 0.125, "two": None}}
    answers = {name: {"iou": 0.5, "miou": 0.25, "seconds": 1.0} for name in ("network", "modes")}
    text = card("mine", untrained(("one", "two")), [test | answers, test | {"scans": ["a", "b"]}], b"")
    views, scans = card_results(text)
    expected = {"IoU": 0.5, "mIoU": 0.25, "one": 0.125, "two": None}
    assert views.scores == scans.scores == {name: format_score(value) for name, value in expected.items()}
    assert (views.on_scans, scans.on_scans) == (False, True)
    assert views.title == "4 synthetic views, test seed 1000000, noise 0.1 units"
    assert views.answers.startswith("By who answers") and not scans.answers
