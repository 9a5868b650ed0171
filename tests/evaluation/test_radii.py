"""Radii of 95 % between the points that have one, on grids, and in colours."""

import numpy as np
import pytest

from mereo.evaluation.calibrate import LEAST, MeasuredRadii, ViewRadii, factors_of
from mereo.evaluation.cases import RegistrationErrors
from mereo.geometry.labels import LabelGrid
from mereo.geometry.radii import Radii, rounded_to
from mereo.models.calibration import RadiusFactors
from mereo.visualization.color_scales import radius_scale


def some_radii() -> Radii:
    points = np.random.default_rng(0).random((30, 3))
    labels = np.repeat(np.array([1, 2, 1], dtype=np.uint8), 10)
    return Radii(points, labels, np.linspace(1, 2, 30), (10, 10), False)


def test_radii_between_points_are_between_theirs_and_their_scale_ends_at_all_but_a_twentieth() -> None:
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
    scale = radius_scale(radii, " mm")
    assert scale.high == pytest.approx(np.quantile(radii.values[:20], 0.95)) and "not calibrated" in scale.title
    np.testing.assert_array_equal(scale.colors(radii.values), radii.colors(radii.values))
    assert scale.words[1].endswith(" mm")
    np.testing.assert_allclose(rounded_to(np.array([0.0123456, 98765.0, 1.0]), 3), [0.0123, 98800.0, 1.0], rtol=1e-9)


def measured(off: np.ndarray, misfit: float = 0.1, displaced: float = 0.04) -> MeasuredRadii:
    """A view whose radii are all 1, and whose points are so far off."""
    one = np.ones(len(off))
    errors = RegistrationErrors(np.abs(off), np.abs(off), one, 0 * one, one > 0)
    return MeasuredRadii(errors, misfit, displaced, half=20.0)


def test_a_scale_is_measured_on_all_clean_views() -> None:
    """Those that are elsewhere too; of noisy ones only on those that are not, and on too few views not at all."""
    rng = np.random.default_rng(0)
    right = [measured(rng.normal(size=200)) for _ in range(20)]
    elsewhere = measured(30.0 + rng.random(200))
    views = ViewRadii()
    views.clean[0].extend(right[: LEAST - 1])
    views.noisy[1].extend([*right[:LEAST], elsewhere])
    alone = RegistrationErrors.together([one.errors for one in right[:LEAST]]).scale()
    assert views.fields() == {"noisy_draws_radius_scale": pytest.approx(alone)}
    views.clean[0].extend([*right[LEAST - 1 :], elsewhere])
    fields = views.fields()
    assert fields["radius_scale"] > 2.2 > 1.96 > alone - 0.3  # 99 % and more of the right ones
    assert (fields["usual_misfit"], fields["usual_displaced"]) == (0.1, 0.04)


def test_a_frame_that_is_misfitted_or_where_the_network_is_elsewhere_has_wider_radii() -> None:
    """By how much more than usual; so the lost frame of many does not widen the others' radii."""
    rng = np.random.default_rng(0)
    right = [measured(rng.normal(size=400)) for _ in range(18)]
    lost = [measured(3.0 * rng.normal(size=400), misfit=0.2), measured(4.0 + rng.random(400), displaced=0.4)]
    factors = factors_of([*right, *lost])
    assert factors.scale == pytest.approx(1.96, rel=0.05)
    plain = RegistrationErrors.together([one.errors for one in (*right, *lost)]).scale()
    assert plain > 4.0
    assert factors.widening(0.2) == pytest.approx(4.0) and factors.widening(0.05) == 1.0
    assert factors.extra_radius(0.04) == factors.extra_radius(None) == 0.0
    assert factors.extra_radius(0.4) == pytest.approx(0.398, 1e-2)
    widened = lost[1].widened(factors)
    assert (widened.radii > 5.0).all() and (widened.ratios == 0.0).all()
    assert RadiusFactors(2.0).scale_at(9.9) == 2.0 and RadiusFactors().scale_at(1.0) is None
