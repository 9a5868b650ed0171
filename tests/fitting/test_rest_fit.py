"""The object at rest: found exactly where it is at rest, never believed where it is bent."""

from dataclasses import replace

import numpy as np
import pytest
from answers import fit_correspondences
from fit_cases import IN_FRONT, SCENE, said, seen, shown

from mereo.fitting.config import FitConfig
from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.modes import narrowing
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.gauss_newton import NormalEquations, Posed
from mereo.fitting.problem.problem import KNOWN_SCALE_STD, Problem
from mereo.fitting.registration.register import CloudToFit, ModesFit
from mereo.geometry.transforms import transform_points
from mereo.scenes.statistical_model import StatisticalModel


@pytest.fixture(scope="module")
def model(toy_model: StatisticalModel) -> StatisticalModel:
    return toy_model


@pytest.mark.parametrize(("noise", "unit"), [(0.0, 1.0), (0.1, 1.0), (0.1, 0.004)])
def test_an_object_at_rest_is_found_to_be_at_rest(model: StatisticalModel, noise: float, unit: float) -> None:
    material = transform_points(IN_FRONT, model.rest_points)
    points = seen(model.rest.transformed(IN_FRONT))
    points = points + np.random.default_rng(0).normal(scale=noise, size=points.shape)
    found = fit_correspondences(unit * points, said(model, material).scaled(unit), model, unit)
    assert found.method == "rest" and found.accepted
    # a rigid motion of the rest model, and the right one
    apart = [np.linalg.norm(np.diff(places[::50], axis=0), axis=1) for places in (found.material / unit, material)]
    np.testing.assert_allclose(*apart, atol=1e-6)
    assert np.linalg.norm(found.material / unit - material, axis=1).max() < 0.05 + noise / 2
    np.testing.assert_allclose(found.z, model.rest_z)


@pytest.mark.parametrize("excess", [0.1, 0.3, 1.0])
def test_a_bent_object_is_not(model: StatisticalModel, excess: float) -> None:
    points, material = shown(model, excess)
    assert fit_correspondences(points, said(model, material), model, 1.0).method == "modes"


def test_under_noise_draws_are_asked_too_and_an_object_at_rest_stays_at_rest(model: StatisticalModel) -> None:
    points, material = seen(model.rest.transformed(IN_FRONT)), transform_points(IN_FRONT, model.rest_points)
    clean = ModesFit.of(CloudToFit(points, 1.0), said(model, material), model)
    noisy = replace(clean, problem=replace(clean.problem, noisy=True))
    assert noisy.may_take_draws and not clean.may_take_draws
    found = noisy.with_draws(DrawnStates.of(SCENE, model, 30))
    assert found.method == "rest" and found.seconds > clean.seconds


def test_what_the_frame_does_not_show_narrows_nothing(model: StatisticalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without evidence the coefficients' posterior is their prior; with more evidence it only narrows."""
    points, material = shown(model, 0.5)
    problem = Problem.of(model, said(model, material), Evidence.of(points), KNOWN_SCALE_STD, FitConfig())
    posed = Posed(IN_FRONT[:3, :3], IN_FRONT[:3, 3], np.zeros(model.count))
    assert narrowing(problem, posed) > 1.0

    def nothing(self: Problem, normal: NormalEquations, *rest: object) -> NormalEquations:
        return NormalEquations(normal.matrix + 1e-9 * np.eye(len(normal.matrix)), normal.gradient)

    monkeypatch.setattr(Problem, "seen", nothing)
    monkeypatch.setattr(
        Problem, "known", lambda self, p, prior, slack: NormalEquations.prior(p.z, *vars(prior).values(), 0.0, 1.0)
    )
    assert narrowing(problem, posed) == pytest.approx(0.0, abs=1e-6)
