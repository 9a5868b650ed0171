"""Calibrated probabilities and radii: scaling finds what made them wrong, labels stay, the file keeps all else."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import untrained
from folder_contents import run_mereo
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from safetensors.torch import load_file

from mereo.geometry.labels import LabelGrid
from mereo.geometry.radii import Radii, rounded_to
from mereo.models.calibration import Calibration, RadiusFactors
from mereo.models.model import scaled_logits
from mereo.models.weights import load_model, save_model, with_calibration
from mereo.reconstruction.pipeline import segment_points
from mereo.scenes.registry import load_scene
from mereo.visualization.color_scales import radius_scale
from mereo_learning import calibrate as calibration
from mereo_learning.cases import BINS, RegistrationErrors, Reliability

NAMES = ("one", "two")
FAVOUR = np.array([0.0, 2.0, -1.0])
SCALED = Calibration(seed=7, views=8, temperature=2.0, biases=(0.0, -1.0, 0.5))


def test_the_error_is_the_distance_of_confidence_from_right_answers() -> None:
    """Nine of ten right at 0.6: 0.3; and half of the answers without any error halve it."""
    counted = Reliability()
    counted.add(np.full(10, 0.6), np.arange(10) > 0)
    assert counted.ece == pytest.approx(0.3)
    counted.add(np.full(10, 1.0), np.ones(10, bool))
    assert counted.ece == pytest.approx(0.15)
    assert [bin["share"] for bin in counted.facts()] == [0.5, 0.5] and counted.bins.shape == (3, BINS)
    assert np.isnan(Reliability().ece)


def test_scaling_finds_what_made_the_probabilities_wrong() -> None:
    """Labels are drawn as likely as the logits say."""
    rng = default_rng(1)
    logits = rng.normal(scale=3.0, size=(40_000, 3))
    truth = (logits + rng.gumbel(size=logits.shape)).argmax(axis=1).astype(np.uint8)
    assert calibration.ece_of(logits, truth) < 0.01
    sharper = calibration.fit_scaling(2.5 * logits, truth)
    assert sharper.biases is None and sharper.temperature == pytest.approx(2.5, rel=0.03)
    favoured = calibration.fit_scaling(2.5 * (logits + FAVOUR), truth)
    assert favoured.biases is not None and favoured.temperature == pytest.approx(2.5, rel=0.03)
    assert_allclose(favoured.biases, [0.0, -2.0, 1.0], atol=0.08)
    before = calibration.ece_of(2.5 * (logits + FAVOUR), truth)
    assert calibration.ece_of(2.5 * (logits + FAVOUR), truth, favoured) < calibration.GOOD_ENOUGH / 2 < before / 5


def test_labels_stay_and_probabilities_are_scaled() -> None:
    plain = untrained(NAMES)
    scaled = replace(plain, calibration=SCALED)
    points = default_rng(2).normal(size=(300, 3)) + np.array([0.0, 0.0, 5.0])
    before, after = (model.query(model.encode(points), points) for model in (plain, scaled))
    assert_array_equal(before.label, after.label)
    logits = plain.logits(plain.encode(points), points).astype(float)
    expected = np.exp(logits / 2.0 + [0.0, -1.0, 0.5])
    assert_allclose(after.probability, expected / expected.sum(axis=1, keepdims=True), atol=1e-5)
    assert scaled.calibrates and not plain.calibrates
    own = torch.tensor([[1.0, 2.0, 3.0]])
    assert scaled_logits(Calibration(seed=0, views=8).scaling, own) is own


def test_observed_points_have_the_calibrated_probability_of_their_own_segment() -> None:
    logits = np.log(np.array([[0.5, 0.4, 0.1], [0.2, 0.3, 0.5]], np.float32))
    of_segments = partial(segment_points, logits, np.zeros((2, 3)), NAMES, ((0, 0, 0), (9, 9, 9)))
    halved = of_segments(Calibration(seed=0, views=8, temperature=0.5))
    assert_array_equal(of_segments().labels, halved.labels)
    assert_allclose(halved.confidence, [16 / 17, 25 / 34], rtol=1e-5)
    given = of_segments(labels=np.array([2, 2], np.uint8))
    assert_allclose(given.confidence, [0.2, 5 / 8], rtol=1e-5)


def test_all_else_of_a_file_stays_and_biases_of_other_classes_are_refused(tmp_path: Path) -> None:
    path, calibrated = tmp_path / "plain.safetensors", tmp_path / "calibrated.safetensors"
    save_model(untrained(NAMES), path, torch.float16)
    calibrated.write_bytes(with_calibration(path, SCALED))
    before, after = load_file(path), load_file(calibrated)
    assert before.keys() == after.keys() and all(torch.equal(value, after[name]) for name, value in before.items())
    assert load_model(calibrated).calibration == SCALED and load_model(path).calibration is None
    calibrated.write_bytes(with_calibration(path, SCALED.model_copy(update={"biases": (0.0, 1.0)})))
    with pytest.raises(ValueError, match="a calibration with 2 biases, and 3 classes; calibrate it again"):
        load_model(calibrated)


def test_the_command_writes_what_was_measured_beside_the_weights(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A network that knows nothing: its probabilities become those of the classes' shares."""
    path, output = tmp_path / "plain.safetensors", tmp_path / "calibrated.safetensors"
    save_model(untrained(load_scene("rope").rest.names), path)
    before = path.read_bytes()
    assert run_mereo("calibrate", path) == 2
    assert "exists; it is not overwritten" in capsys.readouterr().err and path.read_bytes() == before
    assert run_mereo("calibrate", path, "--output", output, "--views", "8") == 0
    told = capsys.readouterr().out
    assert "8 views of the training seed 900000" in told and f"wrote {output}" in told
    found = load_model(output).calibration
    assert found is not None and found.temperature is not None
    assert found.ece is not None and found.ece[1] < min(0.05, found.ece[0])
    assert run_mereo("weights", "show", output, "--json") == 0
    assert json.loads(capsys.readouterr().out)["calibration"]["views"] == 8


def test_test_seeds_and_too_few_views_are_refused() -> None:
    model = untrained(load_scene("rope").rest.names)
    with pytest.raises(ValueError, match="seed is 1000000; calibration is part of training: take one below 1000000"):
        calibration.calibrate(model, seed=1_000_000)
    with pytest.raises(ValueError, match="7 views are asked for; at least 8 tell anything"):
        calibration.calibrate(model, views=7)


def test_radii_between_points_are_between_theirs_and_their_scale_ends_at_all_but_a_twentieth() -> None:
    labels = np.repeat(np.array([1, 2, 1], np.uint8), 10)
    radii = Radii(default_rng(0).random((30, 3)), labels, np.linspace(1, 2, 30), (10, 10), False)
    assert_allclose(radii.at(radii.points[:10], 1), radii.values[:10])
    between = radii.at(np.full((1, 3), 0.5), 2)
    assert radii.values[10:20].min() <= between[0] <= radii.values[10:20].max()
    assert [len(part) for part in radii.vertices] == [10, 10]
    grid = LabelGrid(np.array([[[0, 1, 2]]], np.uint8), np.zeros(3), np.full(3, 0.4), ("a", "b"))
    on_grid = radii.on_grid(grid)[0, 0]
    assert np.isnan(on_grid[0]) and 1 <= on_grid[1] <= 2 and 1.3 < on_grid[2] < 1.7
    scaled = radii.scaled(1000.0)
    assert_allclose(scaled.at(1000.0 * radii.points[:3], 1), 1000.0 * radii.values[:3])
    scale = radius_scale(radii, " mm")
    assert scale.high == pytest.approx(np.quantile(radii.values[:20], 0.95)) and "not calibrated" in scale.title
    assert_array_equal(scale.colors(radii.values), radii.colors(radii.values))
    assert scale.words[-1].endswith(" mm")
    assert_allclose(rounded_to(np.array([0.0123456, 98765.0, 1.0]), 3), [0.0123, 98800.0, 1.0], rtol=1e-9)


def measured(off: np.ndarray, misfit: float = 0.1) -> calibration.MeasuredRadii:
    """A view whose radii are all 1, and whose points are so far off."""
    one = np.ones(len(off))
    errors = RegistrationErrors(np.abs(off), np.abs(off), one, 0 * one, 0 * one, one > 0)
    return calibration.MeasuredRadii(errors, misfit)


def test_a_scale_is_measured_on_all_views() -> None:
    rng = default_rng(0)
    right = [measured(rng.normal(size=200)) for _ in range(20)]
    elsewhere = measured(30.0 + rng.random(200))
    views = calibration.ViewRadii()
    views.views[0].extend(right[: calibration.LEAST - 1])
    assert views.fields() == {}
    alone = RegistrationErrors.together([one.errors for one in right[: calibration.LEAST]]).scale()
    views.views[0].extend([*right[calibration.LEAST - 1 :], elsewhere])
    fields = views.fields()
    assert fields["radius_scale"] > 2.2 > 1.96 > alone - 0.3  # 99 % and more of the right ones
    assert fields["usual_misfit"] == 0.1


def test_a_frame_that_is_misfitted_has_wider_radii() -> None:
    """By how much more than usual; so the lost frame of many does not widen the others' radii."""
    rng = default_rng(0)
    right = [measured(rng.normal(size=400)) for _ in range(18)]
    lost = [measured(4.0 * rng.normal(size=400), misfit=0.2) for _ in range(2)]
    factors = calibration.factors_of([*right, *lost])
    assert factors.scale == pytest.approx(1.96, rel=0.05)
    plain = RegistrationErrors.together([one.errors for one in (*right, *lost)]).scale()
    assert plain > 2.2
    one = replace(factors, scale=1.0)
    assert one.scale_at(0.2) == pytest.approx(4.0) and one.scale_at(0.05) == 1.0
    assert_allclose(lost[1].widened(factors).radii, 4.0)
    assert RadiusFactors(2.0).scale_at(9.9) == 2.0 and RadiusFactors().scale_at(1.0) is None
