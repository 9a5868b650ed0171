"""Radii of 95 % between the points that have one, on grids, and in colours."""

import numpy as np
import pytest

from mereo.evaluation.coverage import RadiusRatios
from mereo.evaluation.radius_gauge import LEAST, RadiusGauge
from mereo.geometry.labels import LabelGrid
from mereo.geometry.radii import Radii, rounded_to
from mereo.visualization.vertex_colors import radius_scale


def some_radii() -> Radii:
    points = np.random.default_rng(0).random((30, 3))
    labels = np.repeat(np.array([1, 2, 1], dtype=np.uint8), 10)
    return Radii(points, labels, np.linspace(1, 2, 30), (10, 10), False)


def test_radii_between_points_are_between_theirs() -> None:
    """And at a point they are its own; other segments' points do not count."""
    radii = some_radii()
    np.testing.assert_allclose(radii.at(radii.points[:10], 1), radii.values[:10])
    between = radii.at(np.full((1, 3), 0.5), 2)
    assert radii.values[10:20].min() <= between[0] <= radii.values[10:20].max()
    assert [len(part) for part in radii.vertices] == [10, 10]
    grid = LabelGrid(np.array([[[0, 1, 2]]], dtype=np.uint8), np.zeros(3), np.full(3, 0.4), ("a", "b"))
    on_grid = radii.on_grid(grid)[0, 0]
    assert np.isnan(on_grid[0]) and 1 <= on_grid[1] <= 2 and 1.3 < on_grid[2] < 1.7
    scaled = radii.scaled(1000.0)
    np.testing.assert_allclose(scaled.at(1000.0 * radii.points[:3], 1), 1000.0 * radii.values[:3])


def test_three_digits_are_kept() -> None:
    np.testing.assert_allclose(rounded_to(np.array([0.0123456, 98765.0, 1.0]), 3), [0.0123, 98800.0, 1.0], rtol=1e-9)


def test_the_scale_of_radii_ends_at_all_but_a_twentieth() -> None:
    radii = some_radii()
    scale = radius_scale(radii, " mm")
    assert scale.high == pytest.approx(np.quantile(radii.values[:20], 0.95)) and "not calibrated" in scale.title
    np.testing.assert_array_equal(scale.colors(radii.values), radii.colors(radii.values))
    assert scale.words[1].endswith(" mm")


def test_a_scale_is_measured_on_views_whose_fit_is_in_the_right_state() -> None:
    """One that is elsewhere would decide it alone; of too few views nothing is said."""
    rng = np.random.default_rng(0)
    right = [RadiusRatios(*np.abs(rng.normal(size=(2, 100))), *np.ones((2, 100))) for _ in range(LEAST)]
    elsewhere = RadiusRatios(*(30.0 + rng.random((2, 100))), *np.ones((2, 100)))
    gauge = RadiusGauge()
    gauge.ratios["radius_scale"] = [*right[1:], elsewhere]
    gauge.ratios["noisy_draws_radius_scale"] = [one.by(0.5) for one in right]
    scale = pytest.approx(RadiusRatios.together(right).scale())
    assert list(gauge.fields()) == ["noisy_draws_radius_scale"]
    gauge.ratios["radius_scale"].append(right[0])
    assert gauge.fields() == {"radius_scale": scale, "noisy_draws_radius_scale": 2 * gauge.fields()["radius_scale"]}
    assert gauge.fields()["radius_scale"] == pytest.approx(1.96, abs=0.25)
