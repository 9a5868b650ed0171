"""A file of options says what the command line says, wins over defaults and presets, and loses to the command line."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folder_contents import run_mereo
from golden_objects import weights_of
from two_balls import scene

from mereo import __main__ as command_line
from mereo.cli.options import options_of
from mereo.io import progress
from mereo.io.atomic_files import JsonObject
from mereo.synthesis.config import SENSORS
from mereo.synthesis.sample_views import load_view
from mereo_learning.config import PRESETS

pytestmark = pytest.mark.usefixtures("small_previews")

LINES = {
    "generate": "generate rope --examples 7 --output out --seed 3 --sensor time-of-flight --sensor.hand 0.5 "
    "--points 512 --sampler nested-sort-sample --observations all",
    "train": "train data --output out --preset tiny --epochs 2 --network.width 64 --augment.keep-points 0.4 0.9 "
    "--network.no-encode-positions --loss ce --init bunny",
    "evaluate": "evaluate bunny --output out --examples 4 --sensor structured-light --noise-std 0.2 --method modes",
    "reconstruct": "reconstruct a.ply b.ply --weights bunny --output out --depth-range 0.4 0.9 --carry p.stl "
    "--carry q.stl --formats glb ply --method network --millimetres --unit-m 0.001",
    "learn": "learn a.stl b.stl --output out --minutes 3 --units mm",
}


def parsed(text: str) -> JsonObject:
    return vars(command_line.parse(text.split()))


def written(folder: Path, content: Any, name: str = "options.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def absolute(value: Any) -> Any:
    return value.absolute() if isinstance(value, Path) else value


@pytest.mark.parametrize("command", LINES)
def test_what_a_command_writes_says_the_same_as_its_line(command: str, tmp_path: Path) -> None:
    before = command_line.parse(LINES[command].split())
    content = json.loads(json.dumps(options_of(before, command)))
    assert content.pop("command") == command
    after = parsed(f"{command} --config {written(tmp_path, content)} --output out")
    for name, value in vars(before).items():
        if name not in ("options_from", "preset", "sensor"):  # the last two are where other options start
            many = tuple(map(absolute, value)) if isinstance(value, tuple) else absolute(value)
            assert after[name] == (value if name == "output" else many), name


def test_the_command_line_wins_over_the_file_and_the_file_over_the_preset(tmp_path: Path) -> None:
    path = written(tmp_path, {"preset": "tiny", "epochs": 3, "network": {"width": 64}, "batch": 5})
    config = parsed(f"train data --output out --config {path} --batch 7 --network.depth 6")["config"]
    assert (config.epochs, config.batch, config.network.decoder.width, config.network.decoder.depth) == (3, 7, 64, 6)
    assert config.learning_rate == PRESETS["tiny"].learning_rate
    config = parsed(f"train data --output out --config={path} --preset paper")["config"]
    assert (config.epochs, config.learning_rate) == (3, PRESETS["paper"].learning_rate)


def test_a_sensor_is_a_word_or_its_terms(tmp_path: Path) -> None:
    path = written(tmp_path, {"sensor": "time-of-flight"})
    assert parsed(f"evaluate bunny --output out --config {path}")["terms"] == SENSORS["time-of-flight"]
    path = written(tmp_path, {"sensor": {"holes": 2.0}})
    assert parsed(f"evaluate bunny --output out --config {path}")["terms"] == replace(SENSORS["paper"], holes=2.0)


def test_yaml_and_names_with_hyphens(tmp_path: Path) -> None:
    path = written(tmp_path, "unit-m: 0.001\nmethod: modes\ndepth-range: [0.4, 0.9]\n", "options.yaml")
    found = parsed(f"reconstruct a.ply --weights bunny --output out --config {path}")
    assert (found["reading"].unit_m, found["method"], found["isolation"].depth_range) == (0.001, "modes", (0.4, 0.9))


def test_a_runs_own_settings_are_such_a_file(tmp_path: Path) -> None:
    recipe = replace(PRESETS["tiny"], epochs=2.0, init="bunny")
    path = written(tmp_path, {"dataset": {"scene": "rope", "seed": 1, "examples": 8}, "train": recipe.to_dict()})
    assert parsed(f"train data --output out --config {path}")["config"] == recipe


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"wieghts": "bunny"}, "has 'wieghts', which is no option of this command: correct it, perhaps to 'weights'"),
        ({"config": "other.json"}, "has 'config', which is no option of this command: "),
        ({"resolution": "many"}, "options.json: resolution is 'many', which cannot be (Input should be a valid int"),
        ({"resolution": 1}, "options.json: resolution is 1; it must be a whole number, from 4 to 4096: give"),
        ({"method": "perhaps"}, "options.json: method is 'perhaps', which cannot be (Input should be 'auto'"),
        ({"weights": {"name": "bunny"}}, "has 'weights.name', which is no option of this command: correct it, perh"),
        ({"command": "train"}, "has options of `mereo train`, not of `mereo reconstruct`"),
        ([1, 2], "is no file of options; it must name each with its value"),
        ("{", "is no file of options (Expecting property name"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_sentence(
    content: Any, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = str(written(tmp_path, content))
    out = tmp_path / "out"
    assert run_mereo("reconstruct", "a", "--weights", "w", "--output", out, "--config", path) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1 and not out.exists(), said


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run_mereo("learn", "a.stl", "--output", "out", "--config", tmp_path / "no.json") == 2
    assert "no.json does not exist; --config takes a file of options" in capsys.readouterr().err


def test_a_result_is_made_again_from_its_own_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("mereo.models.weights.load_for", lambda *_: scene("camera")[1])
    monkeypatch.chdir(tmp_path)
    np.save("cloud.npy", scene("camera")[0])
    line = "reconstruct cloud.npy --weights any --output first --resolution 12 --formats npz --keep-all"
    assert command_line.main(line.split()) == 4, "the network alone"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run_mereo("reconstruct", "--config", "../first/config.json", "--output", "second") == 4
    first, second = tmp_path / "first", tmp_path / "elsewhere/second"
    assert {path.name for path in first.iterdir()} == {path.name for path in second.iterdir()}
    assert (first / "config.json").read_text() == (second / "config.json").read_text()
    assert (first / "labels.npz").read_bytes() == (second / "labels.npz").read_bytes()


LUMP = str(weights_of("lump"))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_previews: None) -> Path:
    """An empty folder that is the working one, with a frame of the rope, two bowls, and what is no frame."""
    monkeypatch.chdir(tmp_path)
    np.save("rope.npy", load_view("rope").depth.to_points().points)
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 20), np.linspace(-0.05, 0.05, 20))
    for name, depth in (("bowl", 20.0), ("deep", 25.0)):
        np.save(f"{name}.npy", np.stack([x, y, 0.5 + depth * (x**2 + y**2)], axis=2))
    np.save("text.npy", np.array(["no frame"]))
    return tmp_path


def mereo(*arguments: str) -> int:
    return run_mereo(*arguments, "--resolution", "12", "--formats", "glb")


def test_one_frame_is_one_object_and_the_rest_goes_elsewhere(here: Path, capfd: pytest.CaptureFixture) -> None:
    assert mereo("reconstruct", "rope.npy", "--weights", "rope", "--method", "network", "--json") == 4
    out, err = capfd.readouterr()
    found = json.loads(out)
    assert found["output"] == "result" and found["unit_m"] is None and found["recognition"]["known"] == "unsure"
    assert found["verdict"] == "alone", "nothing says whether it is the object, so the status is not 0"
    assert [segment["name"] for segment in found["segments"]][:2] == ["base", "segment_1"]
    assert "wrote result in" in err and not Path("result/summary.json").exists()


@pytest.mark.filterwarnings("ignore:the visible part is")
def test_what_is_not_the_object_has_a_status_of_its_own_and_a_failure_outweighs_it(
    here: Path, capfd: pytest.CaptureFixture
) -> None:
    # a lump is no bowl, on any processor
    asked = ("--weights", LUMP, "--unit-m", "2", "--json", "--output")
    assert mereo("reconstruct", "bowl.npy", *asked, "one") == 3
    found = json.loads(capfd.readouterr().out)
    assert found["recognition"]["known"] is False and found["verdict"] == "no"
    assert found["unit_m"] == 2.0
    assert mereo("reconstruct", "bowl.npy", "deep.npy", *asked, "many") == 3
    frames = json.loads(capfd.readouterr().out)["frames"]
    assert [Path(frame["output"]).name for frame in frames] == ["bowl", "deep"]
    assert frames[0]["recognition"] == found["recognition"]
    assert mereo("reconstruct", "rope.npy", "--weights", "rope", "--json", "--output", "known") == 0
    assert json.loads(capfd.readouterr().out)["verdict"] == "yes"
    assert mereo("reconstruct", "bowl.npy", "text.npy", *asked, "more") == 2
    out, err = capfd.readouterr()
    assert out == "" and "text.npy" in err


def test_a_stage_is_shown_once_it_takes_long(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(progress, "STAGE_S", 0.05)
    with progress.stage("nobody asks"):
        time.sleep(0.2)
    with monkeypatch.context() as longer, progress.shown_stages():
        longer.setattr(progress, "STAGE_S", 3600.0)
        with progress.stage("short"):
            pass
    assert capfd.readouterr().err == ""
    with progress.shown_stages(), progress.stage("long"):
        err = ""
        for _ in range(200):
            time.sleep(0.05)
            if (err := err + capfd.readouterr().err).endswith("\n"):
                break
    assert re.match(r"long: \d+ s so far\n", err)
