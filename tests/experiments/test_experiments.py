"""Experiments: what is shared, what is written, and that a claim can fail; what an answer costs."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import read_json, run_mereo
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from mereo.geometry.camera import PointCloud
from mereo.models.weights import load_model
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.sample_views import load_view
from mereo_experiments.paper.encoders_losses import ENCODERS, lacks, recipe
from mereo_experiments.paper.registry import EXPERIMENTS, experiment, run_experiment
from mereo_experiments.paper.result import Claim, Result, Row, markdown, published, write_result
from mereo_experiments.paper.scales import SCALES
from mereo_experiments.paper.store import Score, Store
from mereo_experiments.speed import report
from mereo_experiments.speed.stages import Bench, Machine, Rival, Stage, Work, count_operations, needed_nodes
from mereo_learning.cases import EvaluatedView
from mereo_learning.config import PRESETS, TrainConfig
from mereo_learning.error_maps import comparison_picture

NAN = float("nan")


def score(iou: float, miou: float) -> Score:
    return Score(iou, miou, iou, miou, {"a": miou})


def test_published_figures_are_the_papers() -> None:
    figures = published()
    assert set(EXPERIMENTS) - {"encoders"} <= set(figures), "whose figures are bars of encoders-losses"
    assert len(figures["reconstruction"]) == 10
    assert figures["reconstruction"]["rope"] == {"iou": 0.815, "miou": 0.375}
    assert figures["noise"]["0.1"]["2.0"] == {"iou": 0.346, "miou": 0.289}
    assert figures["sampling"]["lizard"]["label-uniform"] == {"iou": 0.679, "miou": 0.681}
    bars = figures["encoders-losses"]
    assert bars["rope"]["pointnet2"]["ce+l1"] == {"iou": 0.841, "miou": 0.422}
    assert "miou" not in bars["rope"]["pointnet2"]["l1"]


def test_the_table_shows_both_figures_and_the_verdict() -> None:
    rows = (Row("rope", "on", score(0.8, 0.6), {"miou": 0.375}), Row("rope", "off", score(0.7, NAN)))
    claim = Claim("On is better.", {"rope": True, "shapes": False})
    text = markdown(Result("positional-encoding", "Positional encoding", "smoke", rows, (claim,)))
    assert "| rope | on | 0.800 | 0.600 | 0.800 | 0.600 |  | 0.375 |" in text
    assert "| rope | off | 0.700 |  | 0.700 |  |  |  |" in text
    assert "- On is better. We agree for rope, not for shapes." in text
    assert "paper's scene: IoU" in text and "are no measure for ours" in text and "lacks" not in text
    other = replace(rows[1], lacks="local features, lines of sight")
    text = markdown(Result("encoders", "Encoders", "cpu", (rows[0], other), ()))
    assert "| mIoU | lacks |" in text and "|  |  | local features, lines of sight |" in text
    assert "| 0.375 |  |" in text, "who lacks nothing has an empty cell"


def test_results_are_three_files(tmp_path: Path) -> None:
    result = Result("noise", "Noise", "cpu", (Row("rope", "x", score(0.5, NAN)),), (Claim("c", {"rope": True}),))
    write_result(result, tmp_path / "noise")
    write_result(result, tmp_path / "noise")  # again, over the old ones
    assert {path.name for path in (tmp_path / "noise").glob("[!.]*")} == {"table.md", "results.json", "figure.png"}
    found = read_json(tmp_path / "noise" / "results.json")
    assert found["rows"][0]["score"]["miou"] is None
    assert found["claims"][0]["verdict"] == "We agree (rope)."


def test_objects_can_be_asked_for_by_name(tmp_path: Path) -> None:
    asked = replace(SCALES["cpu"], chosen=("engine", "robot"))
    assert asked.choose(("lizard", "human", "engine")) == ("engine",)
    result = experiment("sampling").run(ToyStore(tmp_path), asked)
    assert {row.object for row in result.rows} == {"engine"} and len(result.comparisons["samplers.png"].rows) == 1
    assert {row.object for row in experiment("encoders-losses").run(ToyStore(tmp_path), asked).rows} == {"robot"}
    with pytest.raises(ValueError, match="'noise' has no object 'engine'; it has robot, rope: name some of these"):
        run_experiment("noise", "cpu", tmp_path, objects=["engine"])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name, scale", [("nose", "smoke"), ("noise", "huge")])
def test_unknown_names_are_refused(name: str, scale: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is unknown; it must be one of"):
        run_experiment(name, scale, tmp_path)
    assert not any(tmp_path.iterdir())


def test_an_encoder_is_compared_like_for_like_or_the_table_says_what_it_lacks() -> None:
    cpu = SCALES["cpu"]
    assert [lacks(cpu, encoder, "ce+l1") for encoder in ("pointnet2", "point-transformer")] == ["", ""]
    missing = lacks(cpu, "autodecoder", "ce+l1")
    assert missing == "local features, lines of sight, augmentation, weight decay"
    for encoder in ENCODERS:
        assert lacks(SCALES["paper"], encoder, "ce+l1") == "", "as published none has what is ours"
        for scale in SCALES.values():
            config = recipe(scale, encoder, "ce+l1")
            assert config is not None and config.learned_box == scale.recipe.learned_box
            assert config.network.encoder == encoder and config.loss == "ce+l1"
    assert all(recipe(scale, "autodecoder", "ce") is None for scale in SCALES.values())
    assert recipe(SCALES["paper"], "autodecoder", "ce+l1") == PRESETS["paper-autodecoder"]


def test_the_list_says_which_results_are_here(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    result = Result("noise", "Noise", "cpu", (Row("rope", "x", score(0.5, NAN)),), ())
    for folder in ("noise-cpu", "noise-smoke-rope"):
        write_result(result, tmp_path / "results" / folder)
    (tmp_path / "runs" / "rope-1").mkdir(parents=True)
    (tmp_path / "runs" / "rope-1" / "finished.json").write_text("{}")
    assert run_mereo("experiment", "list", "--output", tmp_path) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("results here: none") == len(EXPERIMENTS) - 1 and "results here: cpu, smoke-rope" in said
    assert "1 finished training there" in said
    assert all(f"{name}: " in said for name in EXPERIMENTS) and said.count("?") == len(EXPERIMENTS)
    assert {path.name for path in tmp_path.iterdir()} == {"results", "runs"}, "nothing is made"


def toy_view(name: str) -> EvaluatedView:
    truth = np.zeros((12, 12, 12), np.uint8)
    truth[3:9, 3:6, 3:9], truth[3:9, 6:9, 3:9] = 1, 2
    cloud = PointCloud(np.argwhere(truth)[::5].astype(float))
    return EvaluatedView(name, cloud, truth, np.roll(truth, 1, axis=2), np.zeros(3), np.ones(3), [(255, 0, 0)] * 2)


class ToyStore(Store):
    """Store that makes nothing, and whose every network scores and answers alike."""

    def dataset(self, scene: str, settings: GenerateConfig, examples: int) -> Path:
        return Path(f"{scene}-{settings.noise_std}")

    def run(self, dataset: Path, config: TrainConfig) -> Path:
        return dataset / "weights.safetensors"

    def score(self, weights: Path, settings: GenerateConfig, examples: int, cells: int) -> Score:
        return score(0.8, 0.6)

    def view(self, weights: Path, settings: GenerateConfig, cells: int) -> EvaluatedView:
        return toy_view(weights.parent.name.partition("-")[0])


@pytest.mark.parametrize("name, picture, columns", [("encoders", "encoders.png", 4), ("sampling", "samplers.png", 6)])
def test_answers_side_by_side_are_drawn_from_results(name: str, picture: str, columns: int, tmp_path: Path) -> None:
    """Lizard and Human by three encoders and by all samplers, the reference before them."""
    result = experiment(name).run(ToyStore(tmp_path), SCALES["cpu"])
    comparison = result.comparisons[picture]
    assert [len(row) for row in comparison.rows] == [columns - 1] * 2
    assert [row[0].name for row in comparison.rows] == ["lizard", "human"]
    assert all(words.endswith(": IoU 0.800, mIoU 0.600") for row in comparison.captions for words in row)
    comparison_picture(tmp_path / picture, comparison, size=40)
    drawn = np.asarray(Image.open(tmp_path / picture))
    assert drawn.shape[1] == 12 + columns * 52 and drawn.shape[0] >= 12 + 2 * 76


@pytest.mark.slow
def test_a_store_makes_each_thing_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    store = Store(tmp_path)
    recipe = replace(SCALES["smoke"].recipe, epochs=0.1)
    settings = replace(GenerateConfig(), noise_std=0.5)
    for _ in range(2):
        dataset = store.dataset("rope", settings, 64)
        weights = store.run(dataset, recipe)
        found = store.score(weights, settings, 1, 16)
        assert 0 <= found.iou <= 1
        other = store.run(dataset, replace(recipe, loss="l1"))
    assert weights != other
    assert [len(list((tmp_path / kind).iterdir())) for kind in ("datasets", "runs", "scores")] == [1, 2, 1]
    assert capsys.readouterr().err.count("generate: 64 examples in") == 1


@pytest.mark.slow
def test_an_experiment_runs_and_runs_again_from_its_store(tmp_path: Path) -> None:
    first = (run_experiment("positional-encoding", "smoke", tmp_path) / "table.md").read_text()
    again = (run_experiment("positional-encoding", "smoke", tmp_path) / "table.md").read_text()
    assert first == again and "| rope | off |" in first
    assert "We agree" not in first and "Not tried here." in first


# --- what an answer costs ---------------------------------------------------------------------------------------------


MACHINE = Machine(1e11, 1e10)


def test_the_rival_answers_as_the_model() -> None:
    view = load_view("rope")
    model = load_model("rope")
    cloud = view.depth.to_points()
    points = view.truth.grid.positions(default_rng(0).integers(0, 100, (500, 3)))
    ours = model.logits(model.encode(cloud), points)
    theirs = Rival(model, *model.normalized_cloud(cloud)).logits(points)
    assert_allclose(theirs, ours, atol=1e-3 * np.abs(ours).max())
    assert len(np.unique(ours.argmax(axis=1))) > 3


def test_needed_nodes_are_the_corners_of_cells_with_a_change() -> None:
    labels = (default_rng(1).random((6, 5, 4)) < 0.1).astype(np.uint8)
    needed = np.zeros(labels.shape, bool)
    for cell in np.ndindex(5, 4, 3):
        corners = tuple(np.array([np.add(cell, step) for step in product((0, 1), repeat=3)]).T)
        if len(np.unique(labels[corners])) > 1:
            needed[corners] = True
    assert_array_equal(needed_nodes(labels), needed)
    assert 0 < needed.sum() < needed.size


def test_work_is_bound_by_operations_or_bytes() -> None:
    assert Work(2e11, 1e9).seconds(MACHINE) == 2.0
    assert Work(1e9, 4e10).seconds(MACHINE) == 4.0
    ones = torch.ones(10, 20)
    assert count_operations(lambda: ones @ ones.T) == 2 * 10 * 20 * 10


def test_a_fitted_network_knows_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "STEPS", 60)
    monkeypatch.setattr(report, "BATCH", 512)
    view = load_view("rope")
    model = report.fitted_model("tiny", view)
    grid, kept = view.truth.grid, view.truth.kept
    cells = np.argwhere(kept & (grid.labels > 0))[::50]
    labels = model.query(model.encode(view.depth.to_points()), grid.positions(cells)).label
    assert (labels > 0).mean() > 0.5
    assert model.network.config == PRESETS["tiny"].network.changed(dropout=0.0)


def test_the_table_names_ratio_and_floor() -> None:
    stage = Stage("encoder", 0.020, 0.030, 0.005, rival=0.1)
    facts = {"model": "rope", "device": "cpu", "threads": 2, "cores": 2, "amx": False, "precision": "float32"}
    facts |= {"gigaflops": 200.0, "gigabytes_per_second": 10.0, "load": 0.25}
    told = report.table([replace(stage, differing=0.0), replace(stage, rival=None)], facts)
    assert "| encoder | 20 | 30 | 5 | 4.0 | 100 | 5.0 | 0.000% |" in told and "load 0.2 before it began" in told


def test_a_stage_says_how_many_labels_the_straightforward_way_gives_otherwise() -> None:
    bench = Bench(load_model("rope"), load_view("rope"), MACHINE, repeats=2, rival=True)
    ours = np.zeros((2, 2, 5), np.uint8)
    theirs = ours.copy()
    theirs[0, 0, 0] = 1
    stage = bench._stage("labels", Work(1.0, 1.0), lambda: ours, lambda: theirs, once=True)
    assert stage.differing == 0.05 and stage.ratio is not None
    assert bench._stage("labels", Work(1.0, 1.0), lambda: ours, lambda: theirs[:1]).differing is None
    logits = np.eye(4)
    assert bench._stage("queries", Work(1.0, 1.0), lambda: logits, lambda: logits[[0, 1, 2, 2]]).differing == 0.25


@pytest.mark.slow
def test_every_stage_is_timed() -> None:
    stages = Bench(load_model("rope"), load_view("rope"), MACHINE, repeats=1).run()
    assert len(stages) == 6
    assert all(stage.floor > 0 and 0 < stage.median <= stage.slowest for stage in stages)
