"""The benchmark's own parts: its rival gives the model's answers, its floor counts what must be asked."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from mereo.models.weights import load_model
from mereo.synthesis.sample_views import load_view
from mereo_experiments.speed import report
from mereo_experiments.speed.stages import Bench, Machine, Rival, Stage, Work, count_operations, needed_nodes
from mereo_learning.config import PRESETS

MACHINE = Machine(1e11, 1e10)


def test_the_rival_answers_as_the_model() -> None:
    view, model = load_view("rope"), load_model("rope")
    cloud = view.depth.to_points()
    points = view.truth.grid.positions(np.random.default_rng(0).integers(0, 100, (500, 3)))
    ours = model.logits(model.encode(cloud), points)
    theirs = Rival(model, *model.normalized_cloud(cloud)).logits(points)
    np.testing.assert_allclose(theirs, ours, atol=1e-3 * np.abs(ours).max())
    assert len(np.unique(ours.argmax(axis=1))) > 3


def test_needed_nodes_are_the_corners_of_cells_with_a_change() -> None:
    labels = (np.random.default_rng(1).random((6, 5, 4)) < 0.1).astype(np.uint8)
    needed = np.zeros(labels.shape, dtype=bool)
    for cell in np.ndindex(5, 4, 3):
        corners = tuple(np.array([np.add(cell, step) for step in product((0, 1), repeat=3)]).T)
        if len(np.unique(labels[corners])) > 1:
            needed[corners] = True
    np.testing.assert_array_equal(needed_nodes(labels), needed)
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
    facts = {
        "model": "rope",
        "device": "cpu",
        "threads": 2,
        "cores": 2,
        "amx": False,
        "precision": "float32",
        "gigaflops": 200.0,
        "gigabytes_per_second": 10.0,
        "load": 0.25,
    }
    told = report.table([replace(stage, differing=0.0), replace(stage, rival=None)], facts)
    assert "| encoder | 20 | 30 | 5 | 4.0 | 100 | 5.0 | 0.000% |" in told
    assert "load 0.2 before it began" in told


def test_a_stage_says_how_many_labels_the_straightforward_way_gives_otherwise() -> None:
    bench = Bench(load_model("rope"), load_view("rope"), MACHINE, repeats=2, rival=True)
    ours = np.zeros((2, 2, 5), dtype=np.uint8)
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
