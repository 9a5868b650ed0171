"""Files of weights: what `mereo weights` says of them, and of a damaged one the sentence that names what is wrong."""

import json
import sys
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import untrained
from folder_contents import run_mereo
from numpy.random import default_rng
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import mereo
from mereo.io.checked_tensors import pack_tensors, unpack_tensors
from mereo.models.weights import load_model, save_model, trained_steps, weights_bytes
from mereo.models.weights_place import NOT_SHIPPED, find_weights, shipped_names
from mereo_learning.learn import learn

WITH_STATES = find_weights("rope")
BIAS = "decoder.head.bias"


Change = Callable[[Any, dict[str, torch.Tensor]], Any]
"""Change to a header and tensors, which may return another header."""


def changed(folder: Path, change: Change, with_states: bool = False) -> Path:
    """Weights after a change."""
    path = folder / "changed.safetensors"
    path.write_bytes(WITH_STATES.read_bytes() if with_states else weights_bytes(untrained(("a", "b"))))
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["mereo"])
        tensors = load_file(path)
    other = change(header, tensors)
    save_file(tensors, path, metadata={"mereo": json.dumps(header if other is None else other)})
    return path


WRONG = {
    "has weights format None": lambda h, t: [],
    "a header with a wrong 'names'": lambda h, t: h.update(names="ab"),
    "and nested segments disagree": lambda h, t: h.update(nested=[["a", "c"]]),
    "1 colours": lambda h, t: h.update(colors=[[1, 2, 3]]),
    "a header with a wrong 'provenance.visible_m": lambda h, t: h.update(provenance={"visible_m": [1]}),
    "a header with a wrong 'calibration.radius_scale'": lambda h, t: h.update(
        calibration={"seed": 3, "views": 8, "radius_scale": -1.0}
    ),
    "network.width is '64'; it must be a whole number": lambda h, t: h["network"].update(width="64"),
    "network.skip_after is 4000, of": lambda h, t: h["network"].update(skip_after=4000),
    "the network settings differ in 'heads'": lambda h, t: h["network"].update(heads=3),
    "a header of no possible network": lambda h, t: h["network"].update(width=10**15),
    "lacks the tensor decoder.head.bias": lambda h, t: t.pop(BIAS) is None or None,
    "has a tensor decoder.tail, which": lambda h, t: t.update({"decoder.tail": torch.zeros(1)}),
    "decoder.head.bias of shape [1], and its header says [7]": lambda h, t: t.update({BIAS: torch.zeros(1)}),
    "NaN or infinity in the tensor decoder.head.bias": lambda h, t: t.update({BIAS: torch.ones(7) / 0}),
}

WRONG_STATES = {
    "nothing is called 'pair_index'": lambda h, t: t.pop("states.pair_index") is None or None,
    "nothing is called": lambda h, t: h.pop("states") and None,
    "there is NaN or infinity in states.mean": lambda h, t: t["states.mean"].fill_(float("nan")) is None or None,
    "a statistical model that cannot be read": lambda h, t: h["states"].update(vertices=5),
}


@pytest.mark.parametrize("text", [*WRONG, *WRONG_STATES])
def test_what_is_wrong_with_weights_is_one_sentence(text: str, tmp_path: Path) -> None:
    path = changed(tmp_path, (WRONG | WRONG_STATES)[text], text in WRONG_STATES)
    with pytest.raises(ValueError) as caught:
        load_model(path)
    assert str(caught.value).startswith(str(path)) and text in str(caught.value)
    assert "\n" not in str(caught.value) and "again" in str(caught.value)
    assert trained_steps(path) is None or text in WRONG_STATES


@pytest.mark.slow
def test_names_that_look_like_markup_are_printed_unchanged(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    weights = changed(tmp_path, lambda h, t: h.update(names=["[/x]", ":heart:[red]"]))
    cloud = tmp_path / "[red] [y].npy"
    np.save(cloud, default_rng(0).normal((0, 0, 20), 1, (200, 3)))
    options = ["--output", str(tmp_path / "out"), "--resolution", "8", "--method", "network"]
    assert run_mereo("reconstruct", cloud, "--weights", weights, *options) == 4, "the network alone"
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("[red] [y].npy", "[/x]", ":heart:[red]"))


def said(capsys: pytest.CaptureFixture, *arguments: str | Path) -> str:
    assert run_mereo("weights", *arguments) == 0
    return capsys.readouterr().out


def test_every_shipped_file_is_listed_with_the_scores_of_its_card(capsys: pytest.CaptureFixture) -> None:
    rows = {line.split()[1]: line for line in said(capsys, "list").splitlines() if line.startswith("│")}
    assert tuple(rows) == shipped_names()
    for name, row in rows.items():
        assert f"{find_weights(name).stat().st_size / 2**20:.1f} MB" in row
    assert "0.973 0.904" in rows["bunny"]


def test_show_prints_the_unit_and_the_card_or_all_as_json(capsys: pytest.CaptureFixture) -> None:
    text = said(capsys, "show", "tumor")
    tumor = find_weights("tumor")
    assert "8.134 mm to a scene unit" in text and tumor.with_suffix(".md").read_text("utf-8") in text
    assert sha256(tumor.read_bytes()).hexdigest() in text.split("# tumor")[0]
    facts = json.loads(said(capsys, "show", "bunny", "--json"))
    assert facts["names"] == list(load_model("bunny").names) and facts["unit_m"] == pytest.approx(0.00604, rel=1e-3)
    assert facts["provenance"]["recipe"]["batch"] == 40 and facts["network"]["points"] == 1024
    assert facts["card"] == find_weights("bunny").with_suffix(".md").read_text("utf-8")


def test_where_none_are_shipped_their_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "mereo_weights", None)  # as if it were not installed
    cure = r"mereo-weights: pip install 'mereo\[network\]', in a checkout pip install ./weights$"
    with pytest.raises(FileNotFoundError, match=rf"^there are no weights 'rope'; give .*{cure}"):
        load_model("rope")
    with pytest.raises(FileNotFoundError, match=rf"^there are no weights to start from: .*{cure}"):
        learn([Path("rope")], tmp_path)
    assert said(capsys, "list") == f"no weights are shipped here: {NOT_SHIPPED}\n"


def test_what_mereo_has_of_the_bunny_is_what_its_weights_have(tmp_path: Path) -> None:
    tensors, header = unpack_tensors(find_weights("bunny").read_bytes())
    states = {name: value for name, value in tensors.items() if name.startswith("states.")}
    wanted, kept = tmp_path / "bunny.safetensors", Path(mereo.__file__).parent / "states/bunny.safetensors"
    wanted.write_bytes(pack_tensors(states, {"states": header["states"]}))
    assert pack_tensors(*unpack_tensors(kept.read_bytes())) == wanted.read_bytes(), f"copy {wanted} to {kept}"


def test_weights_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Neither card nor statistical model, and unknown provenance; a checkpoint beside it is no weights."""
    save_model(untrained(("one", "two")), tmp_path / "mine.safetensors")
    (tmp_path / "checkpoint.safetensors").write_bytes(b"something else")
    listed = [line for line in said(capsys, "list", tmp_path).splitlines() if line.startswith("│")]
    assert len(listed) >= 1 and "checkpoint" not in "".join(listed)
    text = said(capsys, "show", tmp_path / "mine.safetensors")
    assert "none: the network answers alone" in text and "true size not known" in text and "Not measured yet" in text
    (tmp_path / "empty").mkdir()
    for name, sentence in (("checkpoint.safetensors", "is not a safetensors file"), ("empty", "holds no weights")):
        assert run_mereo("weights", "list", tmp_path / name) == 2
        assert sentence in capsys.readouterr().err
