"""``mereo learn``: the plan is arithmetic, each stage leaves something whole; it trains what a search cannot answer."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from angle import write_angle
from folder_contents import read_json
from numpy.linalg import norm
from safetensors.torch import load_file
from scene_files import HEAD, write_bar
from scipy.spatial.transform import Rotation

import mereo
from mereo import __main__ as command_line
from mereo.cli.answers import StreamCommand
from mereo.cli.options import loaded_object
from mereo.fitting.draws.playback import DrawnStates
from mereo.geometry.transforms import rigid, transform_points
from mereo.io.atomic_files import JsonObject
from mereo.io.config import InputConfig
from mereo.io.sensor_frame import read_frame
from mereo.models.weights import load_model
from mereo.reconstruction.config import IsolationConfig
from mereo.reconstruction.observation import find_object, size_warning
from mereo.scenes.files import check
from mereo.scenes.files.object_files import scene_of_folder
from mereo.scenes.random_states import CACHE_VARIABLE, scene_model
from mereo.scenes.registry import load_scene
from mereo_learning import calibrate as calibration
from mereo_learning import learn as learning
from mereo_learning import search_stage, shards
from mereo_learning.cases import nearest_truth
from mereo_learning.config import PRESETS
from mereo_learning.learn import LearnConfig, Plan, Rates, learn, plan_for
from mereo_learning.search_stage import SearchScores, best_method, is_to_train, shortcomings
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
    steps = plan.epochs * (plan.examples - learning.holdout(plan.examples)) / 6
    assert steps == pytest.approx(round(steps))
    # the tail is in it: what is expected of training is its steps and its scores, and some more
    scores_s = (20 * learning.holdout(plan.examples) + min(learning.OFFSET_EXAMPLES, plan.examples)) * rates.score_s
    assert learning.MARGIN * plan.training_s == pytest.approx(6 * steps * rates.train_s + scores_s)


def test_no_time_gives_the_least_and_late_examples_leave_less_training() -> None:
    plan = plan_for(-5.0, RATES, "rope", 6)
    assert plan.evaluation_s == 0
    assert plan.examples == learning.LEAST_EXAMPLES and plan.epochs * (plan.examples - 6) >= plan.examples - 6
    on_time, late = (learning.epochs_for(left_s, RATES, "rope", 1000, 6) for left_s in (300, 150))
    assert 1 <= late.epochs < on_time.epochs
    assert [learning.views_for(100, 2.0), learning.views_for(0, 2.0), learning.views_for(1e9, 2.0)] == [50, 4, 64]


# --- the object -------------------------------------------------------------------------------------------------------


def test_meshes_get_a_scene_file_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_bar(tmp_path)
    meshes = [tmp_path / "left.stl", tmp_path / "right.stl"]
    (tmp_path / "out").mkdir()
    path = Path(learning.scene_for(meshes, tmp_path / "out", "mm"))
    assert "as a soft elastic solid, for its parts touch in planes alone" in capsys.readouterr().out
    scene = load_scene(path)
    assert scene.name == "left" and scene.rest.names == ("left", "right")
    path.write_text(re.sub(r"motion: \S+", "motion: 0.1", path.read_text()))  # a user's change is kept
    changed = path.read_text()
    assert learning.scene_for(meshes, tmp_path / "out", "mm") == str(path) and path.read_text() == changed
    assert learning.scene_for([tmp_path / "bar.yaml"], tmp_path, None) == str(tmp_path / "bar.yaml")
    for files, units, message in (
        ([], None, "no object is given; name a scene file, or its meshes"),
        ([tmp_path / "bar.yaml"], "mm", "--units is mm, but .* says its own"),
    ):
        with pytest.raises(ValueError, match=message):
            learning.scene_for(files, tmp_path, units)


def test_what_hardly_deforms_is_said(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for text, hardly in (("deformations:\n  - {type: squash, factor: [0.999, 1.001]}\n", True), ("", False)):
        scene = write_bar(tmp_path, text)
        learning.check_object([scene], None)
        assert ("warning: bar hardly deforms: by 0.0" in capsys.readouterr().out) == hardly
        assert (learning.deformation(load_scene(scene)) < 0.001) == hardly


def test_a_faulty_object_is_refused_with_what_may_mend_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "STATES", 3)
    path = write_bar(tmp_path)
    meshes = [tmp_path / "left.stl", tmp_path / "right.stl"]
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
    scene = write_bar(tmp_path)
    out = tmp_path / "out"
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


# --- the frame, and what is said --------------------------------------------------------------------------------------


def test_the_example_frame_is_as_long_as_the_object(tmp_path: Path) -> None:
    scene = load_scene(write_bar(tmp_path))
    text = learning.write_example_frame(scene, tmp_path / "frame.ply")
    assert "in metres" in text and b"comment unit: metres" in (tmp_path / "frame.ply").read_bytes()
    seen = find_object(read_frame(tmp_path / "frame.ply", InputConfig(unit_m=1.0)), IsolationConfig())
    assert 0.01 < max(seen.size_m) < 0.06  # 40 mm at rest
    assert size_warning(seen, {"visible_m": [0.02, 0.05]}) is None


def test_bad_scores_come_with_advice_and_good_ones_without_and_a_command_names_what_is_not_built_in() -> None:
    bad, each = {"iou": 0.5, "miou": 0.1, "miou_up_to_symmetry": 0.1}, {"left": 0.1, "right": None}
    lines = "\n".join(learning.advice_after_training(bad, each, 10.0))
    assert "0.10 is too low to rely on" in lines and "right is the weakest" in lines and "--minutes 30" in lines
    assert not learning.advice_after_training({**bad, "miou_up_to_symmetry": 0.8}, each, 10.0)
    assert learning.advice_after_training({**bad, "miou": None, "iou": 0.9}, each, 10.0) == []
    built_in = "mereo reconstruct out/frame.ply --weights out/weights.safetensors --output out/result"
    assert learning.command(Path("out"), "rope") == built_in
    assert "--scene 'my lamp.yaml' --method search" in learning.command(Path("out"), "my lamp.yaml", method="search")


# --- the whole --------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """So little of everything that a run takes seconds."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path_factory.getbasetemp() / "models"))
    for module, name, value in (
        (check, "STATES", 3),
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
    small: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_bar(tmp_path)
    out = tmp_path / "out"
    config = LearnConfig(minutes=0.05, init="rope", train="always")
    scores = learn([scene], out, config)
    printed = capsys.readouterr()
    said = printed.out
    assert re.findall(r"\[(\d)/6\]", said) == list("123456")
    assert f"measure: {learning.trial_steps(compared=False)} steps in" in printed.err
    assert "the least that can be learnt from takes" in said
    assert f"mereo reconstruct {out}/frame.ply --weights {out}/weights.safetensors --scene {scene}" in said
    files = "config.json data frame.ply metrics.json plan.json run search.json test weights.safetensors"
    assert sorted(place.name for place in out.iterdir()) == files.split()
    plan = Plan(**read_json(out / "plan.json")["plan"])
    assert plan.examples == 30 and plan.init == "rope"
    kept = [*(out / "data").glob("shard-*"), out / "weights.safetensors"]
    before = [path.stat().st_mtime_ns for path in kept]
    found = load_model(out / "weights.safetensors").calibration
    assert found is not None and found.temperature is not None and found.views == 4
    monkeypatch.setattr(learning, "evaluate_weights", None)  # all is there
    assert learn([scene], out, config) == scores
    assert [path.stat().st_mtime_ns for path in kept] == before
    for minutes, init, message in (
        (1.0, "rope", r"was begun with minutes = 0.05, not 1.0; .* repeat those, or choose another --output"),
        (0.05, "skull", "was begun with init = 'rope', not 'skull'"),
    ):
        with pytest.raises(ValueError, match=message):
            learn([scene], out, LearnConfig(minutes=minutes, init=init))


@pytest.mark.slow
def test_the_nearest_weights_are_those_that_adapt_fastest(
    small: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "shipped_names", lambda: ("rope", "skull"))
    _, name = learning.measure(str(write_bar(tmp_path)), tmp_path, LIGHT, init="", workers=1)
    printed = capsys.readouterr()
    assert f"measure: {learning.trial_steps(compared=True)} steps in" in printed.err
    losses = re.findall(r"(rope|skull) (\d+\.\d+)", printed.out)
    assert len(losses) == 2 and float(losses[0][1]) <= float(losses[1][1]) and name == losses[0][0]


@pytest.mark.slow
def test_killed_at_any_stage_it_ends_with_the_same_weights(small: None, tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    whole = tmp_path / "whole"
    parts = tmp_path / "parts"
    config = LearnConfig(minutes=0.05, init="rope", train="always")
    learn([scene], whole, config)
    stages = "search_scores measure generate save evaluate_weights scores_of_views write_example_frame"
    for name in stages.split():
        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Trainer if name == "save" else learning, name, Mock(side_effect=KeyboardInterrupt))
            learn([scene], parts, config)
        assert not [place for place in parts.rglob(".*") if place.name.endswith(".mereo")]
    learn([scene], parts, config)
    ours, theirs = (load_file(folder / "weights.safetensors") for folder in (whole, parts))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


# --- trained is only what the search does not answer well -------------------------------------------------------------


GOOD = {"examples": 16, "iou": 0.96, "miou_up_to_symmetry": 0.92, "lowest_miou": 0.8, "explained": 1.0, "seconds": 1.5}

SEARCH = {"iou": 0.96, "miou_up_to_symmetry": 0.90, "explained": 1.0, "seconds": 1.5}
BOTH = {"iou": 0.96, "miou_up_to_symmetry": 0.905, "explained": 1.0, "seconds": 0.8}


def scores_of(hits: list[int], explained: list[bool]) -> SearchScores:
    """Scores of views of an object in two segments, of which so many of 100 cells each are answered rightly."""
    confusions = [[[500, 0, 0], [100 - hit, hit, 0], [100 - hit, 0, hit]] for hit in hits]
    views = zip(confusions, explained, strict=True)
    return SearchScores(("a", "b"), [{"confusion": c, "explained": e, "seconds": 0.5} for c, e in views])


@pytest.mark.parametrize(
    "changed, reasons",
    [
        ({}, []),
        ({"miou_up_to_symmetry": 0.85, "lowest_miou": 0.5}, []),
        ({"explained": 15 / 16}, ["1 of 16 views are not explained"]),
        ({"miou_up_to_symmetry": 0.849}, ["mIoU 0.849 is below 0.85"]),
        ({"lowest_miou": 0.2}, ["mIoU of the worst view, 0.200, is below 0.5"]),
    ],
)
def test_the_search_is_good_enough_by_stated_numbers(changed: dict[str, float], reasons: list[str]) -> None:
    assert shortcomings({**GOOD, **changed}) == reasons
    assert [is_to_train(choice, reasons) for choice in ("auto", "always", "never")] == [bool(reasons), True, False]


@pytest.mark.parametrize(
    "search, both, reason",
    [
        ({}, {}, "both: as good as the search alone, and faster, 0.80 s a frame with both, 1.50 s with the search"),
        ({}, {"seconds": 2.0}, "the search alone: as good as both, and faster, 2.00 s a frame with both, 1.50 s with"),
        ({}, {"miou_up_to_symmetry": 0.95}, "both: mIoU 0.950, not 0.900 of the search alone"),
        ({}, {"miou_up_to_symmetry": 0.85}, "the search alone: mIoU 0.900, not 0.850 of both"),
        ({"explained": 0.5}, {}, "both: it explains more, 100% of the views by both, 50% by the search"),
        ({}, {"explained": 0.75}, "the search alone: it explains more, 75% of the views by both, 100% by the search"),
        ({"miou_up_to_symmetry": None}, {"miou_up_to_symmetry": None}, "both: as good as the search alone"),
    ],
)
def test_the_best_answer_is_the_fastest_of_equals(search: JsonObject, both: JsonObject, reason: str) -> None:
    method, sentence = best_method(SEARCH | search, BOTH | both)
    assert method == ("auto" if reason.startswith("both") else "search") and sentence.startswith(f"use {reason}")


def test_scores_are_of_all_views_together() -> None:
    scores = scores_of([100, 60], [True, False])
    means = dict.fromkeys(("iou", "miou", "miou_up_to_symmetry"), 0.8)
    assert scores.summary() == {"examples": 2, **means, "lowest_miou": 0.6, "explained": 0.5, "seconds": 0.5}
    assert search_stage.search_line(scores) == (
        "search alone, without training: IoU 0.800, mIoU 0.800 on 2 test views, 1 of them explained, 0.50 s a frame"
    )


def test_segments_that_no_frame_tells_apart_are_right_either_way() -> None:
    right, exchanged = [[500, 0, 0], [4, 96, 0], [4, 0, 96]], [[500, 0, 0], [4, 0, 96], [4, 96, 0]]
    views = [{"confusion": each, "explained": True, "seconds": 0.5} for each in (right, exchanged)]
    summary = SearchScores(("a", "b"), views, ((1, 0),)).summary()
    assert (summary["miou_up_to_symmetry"], summary["lowest_miou"]) == (0.96, 0.96) and summary["miou"] < 0.5
    assert shortcomings(summary) == [] and shortcomings(SearchScores(("a", "b"), views).summary())
    assert "(0.960 up to symmetry)" in search_stage.search_line(SearchScores(("a", "b"), views, ((1, 0),)))


def test_time_ends_the_views_but_not_before_the_least_and_begun_ones_are_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    made = []

    def scored(scene: object, registrar: object, cells: int, index: int) -> JsonObject:
        made.append(index)
        return {"confusion": np.eye(9, dtype=int).tolist(), "explained": True, "seconds": 0.1}

    monkeypatch.setattr(search_stage, "_scored", scored)
    monkeypatch.setattr(search_stage, "kept_model", lambda scene: mereo.load_model("rope").statistical_model)
    scene = mereo.load_scene("rope")
    begun = search_stage.score_search(scene, views=5, least=2, budget_s=-1.0)
    assert len(begun.views) == 2 and made == [0, 1]
    assert len(search_stage.score_search(scene, views=4, begun=begun).views) == 4 and made == [0, 1, 2, 3]
    assert "score the search: 2 views in" in capsys.readouterr().err


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch) -> list[SearchScores]:
    given = [scores_of([100, 90], [True, True])]
    monkeypatch.setattr(search_stage, "score_search", lambda scene, **_: given[-1])
    monkeypatch.setattr(learning, "check_object", lambda files, units: None)
    return given


def test_the_scores_decide_whether_anything_is_trained(
    scored: list[SearchScores], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(learning, "_train", Mock(side_effect=InterruptedError))
    scene = write_bar(tmp_path)
    out = tmp_path / "out"
    metrics = learn([scene], out)
    said = capsys.readouterr().out
    assert metrics["method"] == "search" and not metrics["trained"] and metrics["miou"] == 0.95
    assert read_json(out / "metrics.json") == metrics
    assert "nothing is trained: the search alone is good enough (every view is explained, mIoU is 0.85 or more" in said
    assert f"A network may still be faster: mereo learn {scene} --output {out} --train always" in said
    assert f"mereo reconstruct {out}/frame.ply --object {out} --output {out}/result" in said
    assert {path.name for path in out.iterdir()} == {"config.json", "search.json", "metrics.json", "frame.ply"}
    scored.append(scores_of([100, 10], [True, False]))
    assert learn([scene], out) == metrics  # what was scored is kept
    with pytest.raises(InterruptedError):
        learn([scene], out, LearnConfig(train="always"))
    assert "it is trained: --train is always" in capsys.readouterr().out
    with pytest.raises(InterruptedError):
        learn([scene], tmp_path / "bad")
    assert "the search alone is not good enough, 1 of 2 views are not explained, mIoU 0.5" in capsys.readouterr().out
    assert not learn([scene], tmp_path / "bad", LearnConfig(train="never"))["trained"]
    said = capsys.readouterr().out
    assert "nothing is trained, as --train is never; the search alone is not good enough: 1 of 2 views" in said
    assert "A network may help: mereo learn" in said


def test_what_is_begun_with_other_words_is_refused(scored: list[SearchScores], tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    out = tmp_path / "out"
    learn([scene], out)
    (out / "plan.json").write_text("{}")
    with pytest.raises(ValueError, match=r"was trained, or begun to be, but --train is never: leave it out"):
        learn([scene], out, LearnConfig(train="never"))
    (out / "plan.json").unlink()
    write_bar(tmp_path, "deformations:\n  - {type: squash, factor: [0.5, 0.9]}\n")
    with pytest.raises(ValueError, match=r"was begun with another object or other deformations than bar has now"):
        learn([scene], out)
    write_bar(tmp_path)
    (out / "search.json").write_text("[]")
    with pytest.raises(ValueError, match=r"search.json holds no scores; remove it, and they are made again"):
        learn([scene], out)


def test_a_folder_knows_its_scene(scored: list[SearchScores], tmp_path: Path) -> None:
    scene = write_bar(tmp_path)
    out = tmp_path / "out"
    learn([scene], out)
    assert scene_of_folder(out) == str(scene) and scene_of_folder(tmp_path) is None
    content = read_json(out / "search.json")
    (out / "search.json").write_text(json.dumps({**content, "scene": "mine.py"}))  # never run by a folder's word
    assert scene_of_folder(out) is None
    assert "--object mine.py" in learning.command(out, "mine.py", is_trained=False)


def test_a_folder_is_an_object(small: None, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    meshes = [str(path) for path in write_angle(tmp_path)]
    command = ["learn", *meshes, "--units", "mm", "--train", "never", "--output", str(out)]
    assert command_line.main(command) == 0
    said = capsys.readouterr().out
    scores = (out / "search.json").read_bytes()
    assert re.findall(r"\[(\d)/6\]", said) == ["1", "2"]
    assert "1 test views, which training has not seen" in said and "nothing is trained" in said
    assert f"--object {out} --output" in said
    assert command_line.main(command) == 0
    assert (out / "search.json").read_bytes() == scores
    assert 0.5 < read_json(out / "metrics.json")["iou"] <= 1
    angle = loaded_object(StreamCommand("-", object=(str(out),)))  # as every command with --object has it
    assert angle.network is None and angle.names == ("long", "short")


def test_radii_are_measured_against_the_nearest_of_the_truths_that_no_frame_tells_apart(tmp_path: Path) -> None:
    scene = load_scene(str(write_bar(tmp_path, "deformations: stiff\n")))
    model = scene_model(scene, 12)
    assert model.swaps == ((1, 0),)
    T = rigid(np.eye(3), np.array([0.0, 0.0, 150.0]))
    truth = transform_points(T, model.rest_points)
    over_end = next(each for each in model.symmetries if each.swaps)
    turned = transform_points(T @ over_end.turn, model.rest_points)  # the answer has taken each half for the other
    for material in (truth, turned):
        nearest = nearest_truth(model, material, truth)
        assert norm(nearest - material, axis=1).max() < 0.5, "as much as the turn that was settled is off"
    part = truth[:10]
    assert nearest_truth(model, turned, part) is part


def test_radii_of_what_is_round_are_measured_by_the_nearest_angle(tmp_path: Path) -> None:
    for name, radius, low in (("left", 30.0, 0.0), ("right", 12.0, 60.0)):  # a bottle and its neck
        part = trimesh.creation.cylinder(radius, segment=[[0, 0, low], [0, 0, low + 60.0]], sections=90)
        part.subdivide().export(tmp_path / f"{name}.stl")
    path = tmp_path / "bottle.yaml"
    path.write_text(HEAD + "deformations: stiff\n", encoding="utf-8")
    model = scene_model(load_scene(str(path)), 4)
    (symmetry,) = model.symmetries
    assert symmetry.angle is None and symmetry.axis is not None
    truth = transform_points(rigid(np.eye(3), np.array([0.0, 0.0, 150.0])), model.rest_points)
    spin = rigid(Rotation.from_rotvec(2.345 * symmetry.axis).as_matrix(), np.zeros(3))
    center = truth.mean(axis=0)
    spun = transform_points(spin, truth - center) + center
    assert norm(spun - truth, axis=1).max() > 0.5 * model.half
    assert norm(nearest_truth(model, spun, truth) - spun, axis=1).max() < 0.5
