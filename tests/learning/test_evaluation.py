"""The paper's scores: against closed forms, slow references and an oracle."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticModel, oracle, untrained
from folder_contents import read_json
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from shapes import box, one

from mereo.api.objects import Object
from mereo.api.reconstruct import load_frame
from mereo.cli import demo
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import format_score, grid_confusion, intersection_over_union, truth_grid
from mereo.geometry.solids import Solids
from mereo.geometry.transforms import rigid
from mereo.models.weights import save_model
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import AssetUnavailable
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.synthesis.sample_views import SHIPPED, load_view
from mereo_learning.cases import PICTURE_MARGIN, Evaluation, TestCase
from mereo_learning.evaluation_report import evaluate_weights
from mereo_learning.scoring import EvaluationConfig, evaluate, grid_scores, predict_grid, score_cases, trained_scene
from mereo_learning.tables import markdown_table
from mereo_objects import assets

pytestmark = pytest.mark.usefixtures("small_previews")

NAMES = ("left", "right")


def two_cuboids() -> SegmentedMesh:
    """Side by side along x, 1 x 1 x 1 each."""
    return SegmentedMesh((box((0, 0, 5), (1, 1, 6), "left"), box((1, 0, 5), (2, 1, 6), "right", 1)))


def cloud() -> PointCloud:
    return PointCloud(default_rng(0).uniform([0, 0, 5], [2, 1, 5.001], size=(200, 3)))


def test_the_truth_scores_one_and_a_shifted_answer_its_closed_form() -> None:
    """A shift by 0.25 along x, on the joint box [0, 2]: what is predicted outside the true box is not counted."""
    for shift, per_segment, iou in ((0.0, [1.0, 1.0], 1.0), (0.25, [0.6, 0.75], 1.75 / 2)):
        scores = grid_scores(oracle(two_cuboids(), (shift, 0.0, 0.0)), cloud(), two_cuboids(), cells=40)
        assert_allclose(scores.per_segment, per_segment)
        assert (scores.iou, scores.miou) == (pytest.approx(iou), pytest.approx(np.mean(per_segment)))


def test_scores_have_three_decimals_and_the_table_agrees_with_the_matrix() -> None:
    shown = [format_score(score) for score in (0.0, 0.12349, 1.0, None, float("nan"))]
    assert shown == ["0.000", "0.123", "1.000", "-", "-"] and format_score(None, "") == ""
    confusion = np.array([[50, 5, 0], [5, 20, 0], [0, 0, 20]])
    each = intersection_over_union(confusion)
    rows = markdown_table(Evaluation(NAMES, confusion, {"a": each, "b": each})).splitlines()
    assert rows[2].split("|")[1:-1] == [f" {cell} " for cell in ("whole set", "0.800", "0.833", "0.667", "1.000")]
    assert {row.count("|") for row in rows} == {6}


def test_truth_grid_against_point_by_point() -> None:
    mesh = sample_view(load_scene("rope"), GenerateConfig(), example_rng(1_000_000, 3)).mesh
    truth = truth_grid(mesh, 16)
    low, high = mesh.bounds
    index = np.indices((16, 16, 16)).reshape(3, -1).T
    points = low + (index + 0.5) / 16 * (high - low)
    assert_allclose(truth.grid.positions(index), points)
    kept = np.zeros(len(points), bool)
    for segment in mesh.segments:
        center = segment.bounds.mean(axis=0)
        size = np.ptp(segment.bounds, axis=0)
        kept |= (np.abs(points - center) <= 0.75 * size).all(axis=1)
    assert_array_equal(truth.kept.ravel(), kept)
    assert (truth.grid.labels.ravel() == Solids(mesh).label(points)).mean() > 0.999
    assert 0.02 < kept.mean() < 1.0 and not truth.grid.labels[~truth.kept].any()


def test_one_confusion_matrix_over_the_whole_set() -> None:
    """Not the mean over examples: a hard case weighs by its points."""
    mesh = two_cuboids()
    truth = truth_grid(two_cuboids(), 20)
    models = [oracle(mesh), oracle(mesh, (0.25, 0.0, 0.0))]
    alone = [grid_confusion(truth, predict_grid(model, cloud(), truth), 2) for model in models]

    def case(index: int) -> TestCase:
        shifted = mesh.transformed(rigid(np.eye(3), np.array([0.25 * index, 0.0, 0.0])))
        return TestCase(str(index), cloud(), truth_grid(shifted, 20))

    # truth moved by 0.25 against the fixed oracle is the mirror image of the oracle moved
    result = score_cases(models[0], case, 2, progress=False)
    assert result.confusion.sum() == alone[0].sum() + alone[1].sum()
    whole = result.scores
    each = [scores.miou for scores in result.examples.values()]
    assert each[0] == 1.0 and each[1] < 0.8
    assert whole.miou != pytest.approx(np.mean(each), abs=1e-3)
    assert result.example_mean[1] == pytest.approx(np.mean(each))
    assert [len(result.views), result.views[0].name] == [2, "0"]


def test_pictures_show_what_lies_beside_the_box_of_the_truth() -> None:
    mesh = two_cuboids()
    truth = truth_grid(mesh, 20)
    shift = 2.0 * truth.grid.spacing[0]
    result = score_cases(oracle(mesh, (shift, 0.0, 0.0)), lambda _: TestCase("0", cloud(), truth), 1, progress=False)
    shown = result.views[0]
    inner = (slice(PICTURE_MARGIN, -PICTURE_MARGIN),) * 3
    assert_array_equal(shown.reference[inner], truth.grid.labels)
    assert (shown.reference > 0).sum() == (truth.grid.labels > 0).sum()
    assert_allclose(shown.origin + PICTURE_MARGIN * shown.spacing, truth.grid.origin)
    assert (shown.predicted > 0).sum() == (shown.reference > 0).sum()  # all of it, though two cells are outside
    assert (shown.predicted[inner] > 0).sum() < (shown.reference > 0).sum()


def test_a_model_of_distances_is_scored_on_the_whole() -> None:
    whole = one(box((0, 0, 5), (2, 1, 6)))
    solids = Solids(whole)
    base = oracle(two_cuboids())
    model = AnalyticModel(base.network, NAMES, base.colors, loss="l1", field=lambda p: 5.0 * np.eye(2)[solids.label(p)])
    result = score_cases(model, lambda _: TestCase("x", cloud(), truth_grid(two_cuboids(), 20)), 1, progress=False)
    assert result.names == ("object",) and result.scores.iou == 1.0
    assert np.isnan(result.scores.miou) and np.isnan(result.example_mean[1]) and result.example_mean[0] == 1.0
    assert "| whole set | 1.000 | - | 1.000 |" in markdown_table(result)
    assert np.isnan(grid_scores(model, cloud(), two_cuboids(), cells=20).miou)


@pytest.fixture(scope="module")
def rope() -> AnalyticModel:
    """An answer of planes: quick to evaluate, right nowhere in particular."""
    names = load_scene("rope").rest.names
    planes = default_rng(1).normal(size=(3, len(names) + 1))
    return replace(AnalyticModel.of(lambda points: points @ planes, names), provenance={"scene": "rope"})


def test_example_i_is_made_from_seed_and_i_alone_and_of_the_weights_own_object(rope: AnalyticModel) -> None:
    three, two = (evaluate(rope, EvaluationConfig(None, n, 1_000_005, cells=16)) for n in (3, 2))
    assert list(three.examples) == ["rope 0", "rope 1", "rope 2"]
    for name, scores in two.examples.items():
        assert_array_equal(scores.per_segment, three.examples[name].per_segment)
    other = evaluate(rope, EvaluationConfig(load_scene("rope"), 2, 1_000_006, cells=16))
    assert (other.confusion != two.confusion).any()
    with pytest.raises(ValueError, match="the weights know the segments left, right but the truth has"):
        evaluate(untrained(NAMES), EvaluationConfig("rope"))
    with pytest.raises(ValueError, match="do not say which scene they were trained on; name it with --scene"):
        trained_scene(AnalyticModel.of(lambda p: p, NAMES))


@pytest.mark.parametrize(
    "options, text",
    [
        ({"seed": 7}, "the seed is 7; training may have seen it: take a test seed, 1000000 or more"),
        ({"examples": 0}, "0 examples are asked for; at least 1"),
        ({"scene": "teapot"}, "scene 'teapot' is unknown"),
    ],
)
def test_impossible_evaluations(rope: AnalyticModel, options: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        evaluate(rope, EvaluationConfig(**options))  # type: ignore[arg-type]


def test_written_results(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    save_model(untrained(load_scene("rope").rest.names), tmp_path / "w.safetensors")
    result = evaluate_weights(tmp_path / "w.safetensors", tmp_path / "out", EvaluationConfig(examples=2, cells=12))
    names = {place.name for place in (tmp_path / "out").glob("[!.]*")}
    assert names == {"errors.png", "metrics.json", "report.html", "table.md"}
    stored = read_json(tmp_path / "out/metrics.json")
    assert stored["iou"] == pytest.approx(result.scores.iou) and stored["seed"] == 1_000_000
    assert stored["confusion"] == result.confusion.tolist()
    assert stored["scene"] == "rope" and stored["examples"] == 2 and len(stored["per_example"]) == 2
    first, second = stored["per_example"].values()
    assert first["answered_by"] == "network" and first["known"] is None
    low, high = sorted((first["miou"], second["miou"]))
    assert stored["network"]["miou_tenth"] == pytest.approx(low + 0.1 * (high - low))
    assert (tmp_path / "out/table.md").read_text() == markdown_table(result)
    assert "whole set" in capsys.readouterr().out
    with pytest.raises(FileExistsError):
        evaluate_weights(tmp_path / "w.safetensors", tmp_path / "out", EvaluationConfig(examples=1))


def test_a_shipped_view_shows_its_truth(tmp_path: Path) -> None:
    view = load_view("rope")
    stored = np.load(SHIPPED / "rope.npz")
    assert_allclose(view.depth.depth, stored["depth"] * 0.005)
    assert (view.scene, view.seed, view.unit_m) == ("rope", 1_000_000, None)
    grid, points = view.truth.grid, view.depth.to_points().points
    cells = np.rint((points - grid.origin) / grid.spacing).astype(int)
    near = np.stack([np.roll(grid.labels > 0, step, axis) for axis in range(3) for step in (-1, 0, 1)]).any(axis=0)
    assert near[tuple(cells.T)].mean() > 0.95, "what was seen lies in the true segments, within a cell"
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04")
    for name in ("other.npz", "broken.npz"):
        with pytest.raises(ValueError, match="is not a sample view of mereo"):
            load_view(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="there is no sample view 'teapot'"):
        load_view("teapot")


def test_the_demo_scores_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    mesh = two_cuboids()
    case = "cuboids", "two cuboids", Object(oracle(mesh)), load_frame(cloud()), truth_grid(mesh, 20)
    monkeypatch.setattr(demo, "_inputs", lambda _: iter([case]))
    monkeypatch.setattr(demo, "RESOLUTION", 64)
    scores = demo.Demo(tmp_path).run().facts["cuboids"]
    assert min(scores["iou"], scores["miou"]) > 0.97, "but for the steps of the surfaces"
    out = capsys.readouterr().out
    assert "mean of segments (mIoU)" in out and f"look at {tmp_path / 'cuboids/report.html'}" in out
    assert "mereo reconstruct cloud.ply --object PART.stl PART.stl --output result" in out
    assert (tmp_path / "cuboids/report.html").is_file()
    (tmp_path / "cuboids/notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="notes.txt"):
        demo.Demo(tmp_path).run()


@pytest.mark.slow
def test_the_demo_needs_no_assets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def missing(name: str) -> Path:
        raise AssetUnavailable(f"{name} is not here")

    monkeypatch.setattr(assets, "get", missing)
    demo.Demo(tmp_path).run()
    out = capsys.readouterr().out
    assert out.count("mIoU") >= 3 and "real range scan" in out
    assert {path.parent.name for path in tmp_path.rglob("segments.glb")} == {"bun000-meshes", "bun000", "liver", "rope"}
