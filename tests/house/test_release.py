"""How mereo reaches others: weights and their cards, the image, the workflows, and that a tag is a version."""

import json
import re
import runpy
import tomllib
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from folder_contents import run_mereo
from numpy.random import default_rng
from safetensors.torch import load_file

from mereo.models.weights import PACKED, _pack, _unpack, load_model, save_model
from mereo.models.weights_place import find_weights, shipped_names
from mereo.synthesis.config import SENSORS, SensorConfig
from mereo_learning.model_card import card, release
from mereo_learning.run_directory import describe_seen, seen_by
from mereo_learning.tables import read_metrics

TEST = {
    "seed": 1_000_000,
    "noise_std": 0.1,
    "examples": 128,
    "iou": 0.923,
    "miou": 0.798,
    "per_segment": {"body": 0.93, "head": 0.878, "ear_left": 0.685, "ear_right": 0.719, "tail": None},
}


def evaluation(folder: Path, **changes: object) -> Path:
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps({**TEST, **changes}))
    return folder


def test_the_file_answers_as_the_weights_and_the_card_knows_it(tmp_path: Path) -> None:
    model = load_model("bunny")
    recipe = {**model.provenance["recipe"], "init": "/home/someone/runs/first/weights.safetensors"}  # type: ignore[dict-item]
    save_model(replace(model, provenance={**model.provenance, "recipe": recipe}), tmp_path / "w.safetensors")
    scans = evaluation(tmp_path / "scans", scans=["bun000", "chin"])
    path = release(tmp_path / "w.safetensors", "bunny-2", tmp_path / "out", [evaluation(tmp_path / "test"), scans])
    assert path == tmp_path / "out/bunny-2.safetensors"
    assert path.stat().st_size <= 8_000_000
    released = load_model(path)
    assert released.statistical_model is not None and released.statistical_model.rest.names == model.names
    assert released.statistical_model.source_frame is not None
    points = default_rng(0).normal((0, 0, 0.6), 0.04, (600, 3))
    # float16 weights are read as they were; the template is rounded to bytes
    for key, value in released.network.state_dict().items():
        before = model.network.state_dict()[key]
        assert torch.equal(value, _unpack(_pack(before)) if key == PACKED else before)
    logits, exact = (m.logits(m.encode(points), points) for m in (released, model))
    assert np.abs(logits - exact).max() < 0.5 and np.abs(logits - exact).mean() < 0.02
    assert (logits.argmax(axis=1) == exact.argmax(axis=1)).mean() > 0.995
    assert released.provenance["recipe"]["init"] == "weights.safetensors"  # type: ignore[index]
    text = (tmp_path / "out/bunny-2.md").read_text()
    assert sha256(path.read_bytes()).hexdigest() in text and "/home/someone" not in text
    for words in (
        "- segments: body, head, ear_left, ear_right, tail",
        "- longest side of the visible part in training: 0.12 to 0.254 m",
        "6530 steps of 40 examples, 261,200 examples seen",
        "128 synthetic views, test seed 1000000, noise 0.1 units",
        "| IoU | mIoU | body | head | ear_left | ear_right | tail |",
        "| 0.923 | 0.798 | 0.930 | 0.878 | 0.685 | 0.719 | - |",
        "2 real scans (bun000, chin)",
        "Weakest segment on synthetic views: ear_left, IoU 0.685",
    ):
        assert words in text
    assert "Not tested on a real sensor" not in text


@pytest.mark.parametrize(
    ("sensor", "size", "words"),
    [
        (SENSORS["paper"], 96, "noise 0.1 units"),
        (SENSORS["time-of-flight"], 192, "time of flight, 192 x 192 pixels, noise 0.1 units"),
        (
            replace(SENSORS["structured-light"], tool=0.5),
            96,
            "structured light, a tool in 50% of them, noise 0.1 units",
        ),
        (replace(SENSORS["paper"], axial=2.0), 96, "a camera of its own terms, noise 0.1 units"),
    ],
)
def test_a_test_by_another_camera_says_by_which(sensor: SensorConfig, size: int, words: str, tmp_path: Path) -> None:
    folder = evaluation(tmp_path / "test", sensor=asdict(sensor), image_size=size, network=None)
    text = card("rope", load_model("rope"), [read_metrics(folder / "metrics.json")], b"")
    assert f"\n128 synthetic views, test seed 1000000, {words}:\n" in text


def test_packed_distances_are_fine_at_the_surface_and_stay_what_they_are() -> None:
    distance = torch.linspace(-2.7, 2.7, 20_001)
    packed = _pack(distance)
    found = _unpack(packed)
    assert packed.dtype == torch.int8 and (found.diff() >= 0).all() and torch.equal(_pack(found), packed)
    error = (found - distance).abs()
    assert (error <= 0.5 / 127 * (distance.abs() + 0.1) ** 2 / 0.1 * 1.2).all(), "half a step of d / (|d| + 0.1)"
    assert error[distance.abs() < 0.03].max() < 0.0008 and error[distance.abs() < 0.125].max() < 0.0025
    assert (found.sign() == distance.sign())[distance.abs() > 0.0005].all(), "inside stays inside"


def test_a_card_says_what_each_answer_is_worth_and_what_was_not_tested() -> None:
    test = {**TEST, "seconds": 0.25, "network": {"iou": 0.9, "miou": 0.8, "seconds": 2.0}}
    text = card("bunny", load_model("bunny"), [test], b"")
    assert "Seconds of a frame: 0.25. The network alone (IoU / mIoU): 0.900 / 0.800 in 2.00 s." in text
    assert "network alone (" not in card("bunny", load_model("bunny"), [TEST], b"")
    text = card("rope", load_model("rope"), [], b"")
    assert "Not measured yet" in text and "Not tested on a real sensor" in text and "0.0 MB" in text


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_weights_have_a_true_card(name: str) -> None:
    path = find_weights(name)
    text = path.with_suffix(".md").read_text()
    assert path.stat().st_size < 8 * 2**20
    assert sha256(path.read_bytes()).hexdigest() in text
    model = load_model(name)
    assert f"- segments: {', '.join(model.names)}\n" in text
    assert "synthetic views, test seed 1000000" in text
    states = model.statistical_model
    assert states is not None and f"the mesh at rest and {states.count} modes of deformation" in text
    assert states.source_frame is not None
    assert describe_seen(model.provenance) in text and seen_by(name) is not None
    assert '"/' not in json.dumps(model.provenance), "no folders of the machine that trained"
    network = [tensor for key, tensor in load_file(path).items() if not key.startswith("states.")]
    assert {tensor.dtype for tensor in network if tensor.is_floating_point()} == {torch.float16}


def test_a_shipped_name_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of results named after the object hides nothing; a file of that name is meant."""
    shipped = find_weights("bunny")
    monkeypatch.chdir(tmp_path)
    Path("bunny").mkdir()
    assert find_weights("bunny") == shipped
    Path("rope").write_bytes(b"")
    assert find_weights("rope") == Path("rope")
    with pytest.raises(FileNotFoundError, match="there are no weights 'runs'"):
        Path("runs").mkdir()
        find_weights("runs")
    Path("runs/weights.safetensors").write_bytes(b"")
    assert find_weights("runs") == Path("runs/weights.safetensors")


def test_what_cannot_be_released_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    other = evaluation(tmp_path / "other", per_segment={"base": 1.0})
    for arguments, said in (
        (["--name", "My Bunny"], "the name is 'My Bunny'; weights are named by"),
        (["--name", "b", "--tests", str(other)], "is a test of base, but the weights know body, head"),
        (["--name", "b", "--tests", str(tmp_path)], "has no metrics.json; --tests takes folders that mereo evaluate"),
    ):
        assert run_mereo("release", "bunny", "--output", tmp_path / "out", *arguments) != 0
        assert said in " ".join(capsys.readouterr().err.split())
        assert not (tmp_path / "out").exists()


# --- image, workflows, tags -------------------------------------------------------------------------------------------


TOP = Path(__file__).parents[2]
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((TOP / ".github/workflows").glob("*.yml"))


def instructions() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile with what they are told, continued lines joined."""
    text = re.sub(r"^#.*\n", "", (TOP / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in text.splitlines() if line)]


def test_the_image_is_made_of_what_is_here_and_what_may_be_sent() -> None:
    sent = [line[1:] for line in (TOP / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    copied = [
        word for name, rest in instructions() if name == "COPY" and "--from" not in rest for word in rest.split()[:-1]
    ]
    assert sorted(copied) == sorted(sent)
    assert all((TOP / path).exists() for path in copied)
    needed = {PROJECT["readme"], *PROJECT["license-files"], "pyproject.toml", "src", "weights"}
    assert needed <= set(copied), "the wheel is built of these"


def test_the_image_runs_mereo_as_nobody_special() -> None:
    told = [name for name, _ in instructions()]
    last = dict(instructions())
    assert last["ENTRYPOINT"] == '["mereo"]'
    assert told.count("FROM") == 2 and last["FROM"].partition(" ")[0].startswith("python:3.")
    assert last["USER"].isdigit() and int(last["USER"]) > 0
    assert told.index("USER") > max(number for number, name in enumerate(told) if name == "RUN")
    (extras,) = re.findall(r'"\.\[([\w,]+)\]"', last.get("RUN", "") + "".join(rest for _, rest in instructions()))
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_what_there_is(path: Path) -> None:
    text = path.read_text("utf-8")
    assert all(re.search(r": [\w-]+/[\w-]+@[0-9a-f]{40} # v\d", line) for line in text.splitlines() if "uses:" in line)
    content = yaml.safe_load(text)
    assert content[True], "`on`, which YAML 1.1 takes for a truth value"
    assert content["permissions"] == {"contents": "read"}
    for job in content["jobs"].values():
        assert job["timeout-minutes"] <= 90
        assert set(job.get("needs", "").split()) <= content["jobs"].keys()
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            for script in re.findall(r"(?<!\S)(?:python )?(\./\w+|\.ci/[\w.]+)", step.get("run", "")):
                assert (TOP / script).is_file(), script


@pytest.mark.parametrize(
    ("tag", "heading", "says"),
    [
        ("v1.2.3", "## 1.2.3 - 2026-12-01", ""),
        ("1.2.3", "## 1.2.3 - 2026-12-01", "the tag is 1.2.3 and pyproject.toml states 1.2.3: tag v1.2.3"),
        ("v1.3.0", "## 1.2.3 - 2026-12-01", "the tag is v1.3.0 and pyproject.toml states 1.2.3"),
        ("v1.2.3", "## 1.2.3 - unreleased", "CHANGELOG.md has no dated heading of 1.2.3"),
    ],
)
def test_a_tag_names_the_version(tag: str, heading: str, says: str) -> None:
    disagreement = runpy.run_path(str(TOP / ".ci/version.py"))["disagreement"]
    found = disagreement(tag, '[project]\nversion = "1.2.3"\n', f"# Changelog\n\n{heading}\n")
    assert found.startswith(says) and bool(found) == bool(says)
