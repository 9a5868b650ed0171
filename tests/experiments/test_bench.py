"""The benchmark's own parts: its rival gives the model's answers, its floor counts what must be asked."""

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from mereo.cli import tools
from mereo.geometry.downsampling import farthest_point_order
from mereo.models.weights import load_model
from mereo.synthesis.sample_views import load_view
from mereo_experiments.speed import fitted_model
from mereo_experiments.speed.baseline import Rival, farthest_points
from mereo_experiments.speed.busy import LIMIT, Share, busy_processes, fair_share, measure_under_load, shares_table
from mereo_experiments.speed.report import table
from mereo_experiments.speed.roofline import Machine, Work, count_operations
from mereo_experiments.speed.stages import Bench, Stage, needed_nodes
from mereo_learning.config import PRESETS

MACHINE = Machine(1e11, 1e10)


def children() -> set[str]:
    """Numbers of the processes that this one has started and that run."""
    lists = Path("/proc/self/task").glob("*/children")
    return {number for path in lists for number in path.read_text().split()}


def test_the_rival_answers_as_the_model() -> None:
    view, model = load_view("rope"), load_model("rope")
    cloud = view.depth.to_points()
    points = view.truth.grid.positions(np.random.default_rng(0).integers(0, 100, (500, 3)))
    ours = model.logits(model.encode(cloud), points)
    theirs = Rival(model, *model.normalized_cloud(cloud)).logits(points)
    np.testing.assert_allclose(theirs, ours, atol=1e-3 * np.abs(ours).max())
    assert len(np.unique(ours.argmax(axis=1))) > 3


def test_the_rivals_points_are_the_farthest() -> None:
    points = np.random.default_rng(0).normal(size=(80, 3)).astype(np.float32)
    order = farthest_point_order(points, 80)
    found = farthest_points(torch.from_numpy(points[order]), 40)
    assert torch.equal(found, torch.arange(40))
    repeated = torch.from_numpy(points[order][:30]).repeat(3, 1)
    assert torch.equal(farthest_points(repeated, 70), torch.arange(70))


def test_different_labels_are_an_error() -> None:
    ours = np.array([[5.0, 0.0], [0.0, 5.0]], dtype=np.float32)
    with pytest.raises(RuntimeError, match="1 of 2 labels differ"):
        Bench._compare(ours, np.array([[5.0, 0.0], [5.0, 0.0]], dtype=np.float32))
    Bench._compare(ours, ours)


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
    monkeypatch.setattr(fitted_model, "STEPS", 60)
    monkeypatch.setattr(fitted_model, "QUERIES", 512)
    view = load_view("rope")
    model = fitted_model.fitted_model("tiny", view)
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
    told = table([replace(stage, differing=0.0), replace(stage, rival=None)], facts)
    assert "| encoder | 20 | 30 | 5 | 4.0 | 100 | 5.0 | 0.000% |" in told
    assert "load 0.2 before it began" in told


def test_a_stage_says_how_many_labels_the_straightforward_way_gives_otherwise() -> None:
    bench = Bench(load_model("rope"), load_view("rope"), MACHINE, repeats=2, rival=True)
    ours = np.zeros((2, 2, 5), dtype=np.uint8)
    theirs = ours.copy()
    theirs[0, 0, 0] = 1
    stage = bench._grid_stage("labels", Work(1.0, 1.0), lambda: ours, lambda: theirs)
    assert stage.differing == 0.05 and stage.ratio is not None
    assert bench._grid_stage("labels", Work(1.0, 1.0), lambda: ours, lambda: theirs[:1]).differing is None


def test_the_fair_share_is_what_an_even_division_of_the_cores_gives() -> None:
    assert fair_share(1.0, 2, 1, 2) == 1.5 and fair_share(1.0, 1, 1, 2) == 1.0 and fair_share(2.0, 2, 4, 2) == 6.0
    chosen = Share("as many as are free", 1, 0.5, 0.6, 1, 2)
    assert chosen.fair == 0.75 and chosen.times == pytest.approx(0.8)
    table = shares_table([chosen, replace(chosen, rule="one per core", threads=2, busy=9.0)], "40,000 queries")
    assert "| as many as are free | 1 | 500 | 750 | 600 | 0.80 |" in table and "must be" not in table
    assert f"must be at most {LIMIT}" in shares_table([replace(chosen, busy=9.0)], "40,000 queries")


def test_work_beside_busy_processes_takes_the_threads_that_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo_experiments.speed.busy.cores", lambda: 2)
    before, used = torch.get_num_threads(), []
    shares = measure_under_load(lambda: used.append(torch.get_num_threads()), processes=1, rounds=2)
    assert used == 2 * [2, 1, 2] and torch.get_num_threads() == before
    assert [(one.rule, one.threads, one.processes) for one in shares] == [
        ("as many as are free", 1, 1),
        ("one per core", 2, 1),
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists the children of a process")
def test_busy_processes_run_meanwhile_and_end() -> None:
    before = children()
    with busy_processes(2):
        assert len(children() - before) == 2
    assert children() <= before


def test_bad_options_are_refused() -> None:
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="torch sees no CUDA device"):
            tools.BenchCommand(device="cuda").run()


@pytest.mark.slow
def test_every_stage_is_timed() -> None:
    stages = Bench(load_model("rope"), load_view("rope"), MACHINE, repeats=1).run()
    assert len(stages) == 6
    assert all(stage.floor > 0 and 0 < stage.median <= stage.slowest for stage in stages)
