"""``mereo learn``: the plan is arithmetic, each stage leaves something whole, and the same command continues it."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from scene_files import write_bar

from mereo.fitting.draws.playback import DrawnStates
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object, size_warning
from mereo.scenes.files import check as checks
from mereo.scenes.random_states import CACHE_VARIABLE
from mereo.scenes.registry import load_scene
from mereo_learning import calibrate as calibration
from mereo_learning import learn as learning
from mereo_learning import search_stage, shards
from mereo_learning.config import PRESETS
from mereo_learning.learn import (
    LearnConfig,
    Plan,
    Rates,
    check_object,
    deformation,
    epochs_for,
    holdout,
    learn,
    plan_for,
    scene_for,
    views_for,
    write_example_frame,
)
from mereo_learning.trainer import Trainer

BASE = PRESETS["base"]
LIGHT = replace(
    BASE, network=BASE.network.changed(points=96, neighbors=8, align_points=64), batch=3, queries=64, compile="off"
)
"""The recipe with less to look at, which shipped weights fit all the same."""

RATES = Rates(generate_s=0.05, train_s=0.04, score_s=0.02)


# --- the plan ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left_s", [300.0, 600.0, 3600.0])
@pytest.mark.parametrize("generate_s", [0.01, 0.05, 0.5])
def test_stages_fill_the_time_that_is_left(left_s: float, generate_s: float) -> None:
    rates = Rates(generate_s, RATES.train_s, RATES.score_s)
    plan = plan_for(left_s, rates, "rope", 6)
    assert plan.generation_s + plan.training_s + plan.evaluation_s == pytest.approx(left_s, rel=0.02)
    assert plan.evaluation_s == pytest.approx(learning.EVALUATION_SHARE * left_s)
    steps = plan.epochs * (plan.examples - holdout(plan.examples)) / 6
    assert steps == pytest.approx(round(steps))
    # the tail is in it: what is expected of training is its steps and its scores, and some more
    scores_s = (20 * holdout(plan.examples) + min(learning.OFFSET_EXAMPLES, plan.examples)) * rates.score_s
    assert learning.MARGIN * plan.training_s == pytest.approx(6 * steps * rates.train_s + scores_s)


def test_no_time_gives_the_least_and_late_examples_leave_less_training() -> None:
    plan = plan_for(-5.0, RATES, "rope", 6)
    assert plan.evaluation_s == 0
    assert plan.examples == learning.LEAST_EXAMPLES and plan.epochs * (plan.examples - 6) >= plan.examples - 6
    on_time, late = (epochs_for(left_s, RATES, "rope", 1000, 6) for left_s in (300, 150))
    assert 1 <= late.epochs < on_time.epochs
    assert [views_for(100, 2.0), views_for(0, 2.0), views_for(1e9, 2.0)] == [50, 4, 64]


# --- the object -------------------------------------------------------------------------------------------------------


def test_meshes_get_a_scene_file_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bar(tmp_path)
    meshes = [tmp_path / "left.stl", tmp_path / "right.stl"]
    (tmp_path / "out").mkdir()
    path = Path(scene_for(meshes, tmp_path / "out", "mm"))
    assert "as a soft elastic solid, for its parts touch in planes alone" in capsys.readouterr().out
    scene = load_scene(path)
    assert scene.name == "left" and scene.rest.names == ("left", "right")
    path.write_text(re.sub(r"motion: \S+", "motion: 0.1", path.read_text()))  # a user's change is kept
    changed = path.read_text()
    assert scene_for(meshes, tmp_path / "out", "mm") == str(path) and path.read_text() == changed
    assert scene_for([tmp_path / "bar.yaml"], tmp_path, None) == str(tmp_path / "bar.yaml")
    for files, units, message in (
        ([], None, "no object is given; name a scene file, or its meshes"),
        ([tmp_path / "bar.yaml"], "mm", "--units is mm, but .* says its own"),
    ):
        with pytest.raises(ValueError, match=message):
            scene_for(files, tmp_path, units)


def test_what_hardly_deforms_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_bar(tmp_path, "deformations:\n  - {type: squash, factor: [0.999, 1.001]}\n")
    check_object([scene], None)
    assert "warning: bar hardly deforms: by 0.0" in capsys.readouterr().out
    assert deformation(load_scene(scene)) < 0.001 and deformation(load_scene(write_bar(tmp_path))) > 0.006


def test_a_faulty_object_is_refused_with_what_may_mend_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "STATES", 3)
    path, meshes = write_bar(tmp_path), [tmp_path / "left.stl", tmp_path / "right.stl"]
    meshes[1].write_bytes(meshes[0].read_bytes())
    for files, message in (
        ([path], r"bar.yaml --repair` try, and learn .*bar-repaired.yaml"),
        (meshes, r"let `mereo scene new .*right.stl --output left.yaml` and `mereo scene check"),
        ([tmp_path / "none.stl"], "none.stl does not exist"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            learn(files, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_arguments_bind_once_something_is_made_of_them(tmp_path: Path) -> None:
    scene, out = write_bar(tmp_path), tmp_path / "out"
    with pytest.raises(FileNotFoundError, match="there are no weights 'bunnny'"):
        learn([scene], out, LearnConfig(init="bunnny"))
    assert not out.exists()
    learning._claim(out, {"object": "a", "minutes": 1.0})
    learning._claim(out, {"object": "b", "minutes": 2.0})
    (out / "scene.yaml").write_text("of b")
    learning._claim(out, {"object": "b", "minutes": 3.0})
    with pytest.raises(ValueError, match="was begun with object = 'b', not 'a'"):
        learning._claim(out, {"object": "a", "minutes": 3.0})
    (out / "plan.json").write_text("of 3 minutes")
    with pytest.raises(ValueError, match=r"plan.json holds no plan; remove it"):
        learning._decided(out)


# --- the frame --------------------------------------------------------------------------------------------------------


def test_the_example_frame_is_as_long_as_the_object(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path))
    text = write_example_frame(scene, tmp_path / "frame.ply")
    assert "in metres" in text and b"comment unit: metres" in (tmp_path / "frame.ply").read_bytes()
    seen = find_object(read_frame(tmp_path / "frame.ply", InputConfig(unit_m=1.0)), IsolationConfig())
    assert 0.01 < max(seen.size_m) < 0.06  # 40 mm at rest
    assert size_warning(seen, {"visible_m": [0.02, 0.05]}) is None


# --- what is said -----------------------------------------------------------------------------------------------------


def test_bad_scores_come_with_advice_and_good_ones_without() -> None:
    bad, each = {"iou": 0.5, "miou": 0.1, "miou_up_to_symmetry": 0.1}, {"left": 0.1, "right": None}
    lines = "\n".join(learning.advice_after_training(bad, each, 10.0))
    assert "0.10 is too low to rely on" in lines and "right is the weakest" in lines and "--minutes 30" in lines
    assert not learning.advice_after_training({**bad, "miou_up_to_symmetry": 0.8}, each, 10.0)
    assert learning.advice_after_training({**bad, "miou": None, "iou": 0.9}, each, 10.0) == []


def test_the_command_names_the_scene_where_it_is_not_built_in() -> None:
    built_in = "mereo reconstruct out/frame.ply --weights out/weights.safetensors --output out/result"
    assert learning.command(Path("out"), "rope") == built_in
    assert "--scene 'my lamp.yaml' --method search" in learning.command(Path("out"), "my lamp.yaml", method="search")


# --- the whole --------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, without_turns: None, tmp_path_factory: pytest.TempPathFactory) -> None:
    """So little of everything that a run takes seconds."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path_factory.getbasetemp() / "models"))
    for module, name, value in (
        (checks, "STATES", 3),
        (learning, "EXAMPLES", 12),
        (shards, "states_for", lambda _: 12),
        (DrawnStates, "of", partial(DrawnStates.of, count=30)),
        (learning, "STEPS", 2),
        (learning, "SCORED", 4),
        (learning, "shipped_names", lambda: ("rope",)),
        (learning, "LEAST_EXAMPLES", 30),
        (learning, "MOST_EXAMPLES", 30),
        (learning, "LEAST_TESTS", 1),
        (learning, "MOST_TESTS", 1),
        (learning, "TIMED", 1),
        (calibration, "LEAST_VIEWS", 4),
        (learning, "LEAST_VIEWS", 4),
        (learning, "VIEWS", 4),
        (learning, "recipe_for", lambda minutes: LIGHT),
        (learning, "EvaluationConfig", partial(learning.EvaluationConfig, cells=16)),
        (learning, "search_scores", partial(learning.search_scores, cells=16)),
        (learning, "scores_of_views", partial(learning.scores_of_views, cells=16)),
        (search_stage, "VIEWS", 1),
        (search_stage, "LEAST_VIEWS", 1),
    ):
        monkeypatch.setattr(module, name, value)


def test_one_command_and_the_same_again(
    small: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, out = write_bar(tmp_path), tmp_path / "out"
    scores = learn([scene], out, LearnConfig(minutes=0.05, init="rope", train="always"))
    printed = capsys.readouterr()
    said = printed.out
    assert re.findall(r"\[(\d)/6\]", said) == list("123456")
    assert f"measure: {learning.trial_steps(compared=False)} steps in" in printed.err
    assert "the least that can be learnt from takes" in said
    assert f"mereo reconstruct {out}/frame.ply --weights {out}/weights.safetensors --scene {scene}" in said
    assert {place.name for place in out.iterdir()} == {
        *("config.json", "search.json", "plan.json", "data", "run", "test", "weights.safetensors"),
        *("metrics.json", "frame.ply"),
    }  # fmt: skip
    plan = Plan(**json.loads((out / "plan.json").read_text())["plan"])
    assert plan.examples == 30 and plan.init == "rope"
    before = {path: path.stat().st_mtime_ns for path in (out / "data").glob("shard-*")}
    calibrated = (out / "weights.safetensors").read_bytes()
    found = load_model(out / "weights.safetensors").calibration
    assert found is not None and found.temperature is not None and found.views == 4
    monkeypatch.setattr(learning, "evaluate_weights", None)  # all is there
    assert learn([scene], out, LearnConfig(minutes=0.05, init="rope", train="always")) == scores
    assert (out / "weights.safetensors").read_bytes() == calibrated
    assert before == {path: path.stat().st_mtime_ns for path in (out / "data").glob("shard-*")}
    for minutes, init, message in (
        (1.0, "rope", r"was begun with minutes = 0.05, not 1.0; .* repeat those, or choose another --output"),
        (0.05, "skull", "was begun with init = 'rope', not 'skull'"),
    ):
        with pytest.raises(ValueError, match=message):
            learn([scene], out, LearnConfig(minutes=minutes, init=init))


@pytest.mark.slow
def test_the_nearest_weights_are_those_that_adapt_fastest(
    small: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "shipped_names", lambda: ("rope", "skull"))
    _, name = learning.measure(str(write_bar(tmp_path)), tmp_path, LIGHT, init="", workers=1)
    printed = capsys.readouterr()
    assert f"measure: {learning.trial_steps(compared=True)} steps in" in printed.err
    losses = re.findall(r"(rope|skull) (\d+\.\d+)", printed.out)
    assert len(losses) == 2 and float(losses[0][1]) <= float(losses[1][1]) and name == losses[0][0]


@pytest.mark.slow
def test_killed_at_any_stage_it_ends_with_the_same_weights(small: None, tmp_path: Path) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    scene, whole, parts = write_bar(tmp_path), tmp_path / "whole", tmp_path / "parts"
    config = LearnConfig(minutes=0.05, init="rope", train="always")
    learn([scene], whole, config)
    stages = "search_scores measure generate save evaluate_weights scores_of_views write_example_frame"
    for name in stages.split():
        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Trainer if name == "save" else learning, name, stop)
            learn([scene], parts, config)
        assert not [place for place in parts.rglob(".*") if place.name.endswith(".mereo")]
    learn([scene], parts, config)
    ours, theirs = (load_file(folder / "weights.safetensors") for folder in (whole, parts))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
