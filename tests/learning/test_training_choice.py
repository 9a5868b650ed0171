"""``mereo learn`` trains an object only where the search alone is not good enough, and says which answers to use."""

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from angle import write_angle
from scene_files import write_bar

import mereo
from mereo import __main__ as command_line
from mereo.cli.options import loaded_object
from mereo.geometry.transforms import rigid, transform_points
from mereo.scenes.files import check
from mereo.scenes.files.object_files import scene_of_folder
from mereo.scenes.random_states import CACHE_VARIABLE, scene_model
from mereo.scenes.registry import load_scene
from mereo_learning import learn as learning
from mereo_learning import search_stage
from mereo_learning.cases import nearest_truth
from mereo_learning.learn import LearnConfig, learn
from mereo_learning.search_stage import SearchScores, best_method, is_to_train, shortcomings

GOOD = {"examples": 16, "iou": 0.96, "miou_up_to_symmetry": 0.92, "lowest_miou": 0.8, "explained": 1.0, "seconds": 1.5}

ROWS: dict[str, dict[str, Any]] = {
    "search": {"iou": 0.96, "miou_up_to_symmetry": 0.90, "explained": 1.0, "seconds": 1.5},
    "network": {"iou": 0.80, "miou_up_to_symmetry": 0.70, "seconds": 0.5},
    "both": {"iou": 0.96, "miou_up_to_symmetry": 0.905, "explained": 1.0, "seconds": 0.8},
}


def scores_of(hits: list[int], explained: list[bool]) -> SearchScores:
    """Scores of views of an object in two segments, of which so many of 100 cells each are answered rightly."""
    confusions = [[[500, 0, 0], [100 - hit, hit, 0], [100 - hit, 0, hit]] for hit in hits]
    views = zip(confusions, explained, strict=True)
    return SearchScores(("a", "b"), [{"confusion": c, "explained": e, "seconds": 0.5} for c, e in views])


# --- the decision -----------------------------------------------------------------------------------------------------


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
    "changed, method, reason",
    [
        ({}, "auto", "as good as the search alone, and faster, 0.80 s a frame with both, 1.50 s with the search alone"),
        ({"both": {"seconds": 2.0}}, "search", "as good as both, and faster, 2.00 s a frame with both, 1.50 s with"),
        ({"both": {"miou_up_to_symmetry": 0.95}}, "auto", "mIoU 0.950, not 0.900 of the search alone"),
        ({"both": {"miou_up_to_symmetry": 0.85}}, "search", "mIoU 0.900, not 0.850 of both"),
        ({"search": {"explained": 0.5}}, "auto", "it explains more, 100% of the views by both, 50% by the search"),
        ({"both": {"explained": 0.75}}, "search", "it explains more, 75% of the views by both, 100% by the search"),
        ({"network": {"miou_up_to_symmetry": 0.98}}, "network", "mIoU 0.980, not 0.905 of both"),
        ({"network": {"miou_up_to_symmetry": 0.91}}, "auto", "as good as the search alone"),
        ({name: {"miou_up_to_symmetry": None} for name in ROWS}, "auto", "as good as the search alone"),
    ],
)
def test_the_best_answer_is_the_fastest_of_those_alike(
    changed: dict[str, dict[str, Any]], method: str, reason: str
) -> None:
    best, sentence = best_method({name: {**row, **changed.get(name, {})} for name, row in ROWS.items()})
    titles = {"auto": "both", "search": "the search alone", "network": "the network alone"}
    assert best == method and sentence.startswith(f"use {titles[method]}: {reason}")


# --- the scores -------------------------------------------------------------------------------------------------------


def test_scores_are_of_all_views_together() -> None:
    scores = scores_of([100, 60], [True, False])
    facts = {"examples": 2, "iou": 0.8, "miou": 0.8, "lowest_miou": 0.6, "explained": 0.5, "seconds": 0.5}
    assert scores.summary() == {**facts, "miou_up_to_symmetry": 0.8}
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
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[int] = []

    def scored(scene: object, registrar: object, cells: int, index: int) -> dict[str, Any]:
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


def _trained(*_: object) -> None:
    raise InterruptedError


def test_the_scores_decide_whether_anything_is_trained(
    scored: list[SearchScores], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learning, "_train", _trained)
    scene, out = write_bar(tmp_path), tmp_path / "out"
    metrics = learn([scene], out)
    said = capsys.readouterr().out
    assert metrics["method"] == "search" and not metrics["trained"] and metrics["miou"] == 0.95
    assert json.loads((out / "metrics.json").read_text()) == metrics
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
    scene, out = write_bar(tmp_path), tmp_path / "out"
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
    scene, out = write_bar(tmp_path), tmp_path / "out"
    learn([scene], out)
    assert scene_of_folder(out) == str(scene) and scene_of_folder(tmp_path) is None
    content = json.loads((out / "search.json").read_text())
    (out / "search.json").write_text(json.dumps({**content, "scene": "mine.py"}))  # never run by a folder's word
    assert scene_of_folder(out) is None
    assert "--object mine.py" in learning.command(out, "mine.py", is_trained=False)


def test_a_folder_without_weights_is_an_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    for module, name, value in (
        (search_stage, "LEAST_VIEWS", 1),
        (search_stage, "VIEWS", 1),
        (learning, "search_scores", partial(search_stage.search_scores, cells=24)),
        (check, "STATES", 3),
    ):
        monkeypatch.setattr(module, name, value)
    out, meshes = tmp_path / "out", [str(path) for path in write_angle(tmp_path)]
    command = ["learn", *meshes, "--units", "mm", "--train", "never", "--output", str(out)]
    assert command_line.main(command) == 0
    said, scores = capsys.readouterr().out, (out / "search.json").read_bytes()
    assert re.findall(r"\[(\d)/6\]", said) == ["1", "2"]
    assert "1 test views, which training has not seen" in said and "nothing is trained" in said
    assert f"--object {out} --output" in said
    assert command_line.main(command) == 0
    assert (out / "search.json").read_bytes() == scores
    assert 0.5 < json.loads((out / "metrics.json").read_text())["iou"] <= 1
    angle = loaded_object([str(out)], None)  # as every command with --object has it
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
        assert np.linalg.norm(nearest - material, axis=1).max() < 0.5, "as much as the turn that was settled is off"
    part = truth[:10]
    assert nearest_truth(model, turned, part) is part
