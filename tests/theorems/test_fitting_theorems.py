"""Theorems on the fit of the modes: what it must find, and what it must say, of frames whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from answers import fit_cloud
from fit_cases import IN_FRONT, shown
from numpy.linalg import norm, solve
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from mereo.fitting.problem.evidence import UNSEEN_PITCHES, Evidence
from mereo.fitting.problem.gauss_newton import amplitudes, pull
from mereo.fitting.problem.residuals import Surface
from mereo.geometry.camera import SharedNoise
from mereo.geometry.transforms import transform_points, unit_rows
from mereo.scenes.statistical_model import StatisticalModel


def test_more_noise_never_makes_the_residual_smaller(toy_model: StatisticalModel) -> None:
    points, material = shown(toy_model, 0.5)
    noise = default_rng(0).normal(size=(len(points), 1)) * points / norm(points, axis=1)[:, None]
    residuals = []
    for std in (0.0, 0.05, 0.1, 0.2, 0.4, 0.8):
        registration = fit_cloud(points + std * noise, toy_model, material)
        assert registration.residual is not None
        residuals.append(registration.residual)
    assert (np.diff(residuals) > 0).all()
    assert residuals[0] < 0.05 and residuals[-1] > 0.3


@pytest.mark.parametrize(("excess", "outside"), [(0.5, False), (1.5, True), (2.0, True)])
def test_a_state_outside_the_bounds_is_said_to_be_outside(
    toy_model: StatisticalModel, excess: float, outside: bool
) -> None:
    points, material = shown(toy_model, excess)
    registration = fit_cloud(points, toy_model, material)
    if outside:
        assert registration.beyond_states > 0.2
    else:
        assert registration.beyond_states == pytest.approx(0.0, abs=0.02)


@pytest.fixture(scope="module")
def at_rest(toy_model: StatisticalModel) -> Surface:
    return Surface.through(toy_model, transform_points(IN_FRONT, toy_model.rest_points))


def test_noise_along_the_lines_of_sight_says_nothing_of_where_the_surface_is(
    toy_model: StatisticalModel, at_rest: Surface
) -> None:
    """By its lines of sight, a cloud lies on a ball as far in front of it as behind; by the nearest places in front."""
    faces = toy_model.faces[at_rest.facing]
    middle = at_rest.material[faces[toy_model.labels[faces[:, 0]] == toy_model.labels.max()]].mean(axis=1)
    _, face, place = at_rest.along_sight(middle, np.inf)
    toward = unit_rows(place)
    slant = -np.einsum("pi,pi->p", at_rest.normals[face], toward)
    points = middle[(norm(middle - place, axis=1) < 1e-3) & (slant > 0.5)]  # seen, and not at the rim
    noise = 0.8 * unit_rows(points)
    noisy = np.concatenate([points - noise, points + noise])
    _, face, place = at_rest.along_sight(noisy, np.inf)
    assert abs(np.einsum("pi,pi->p", noisy - place, at_rest.normals[face]).mean()) < 1e-5
    assert at_rest.offsets(noisy).mean() > 0.01


def test_what_a_line_of_sight_misses_or_meets_far_off_is_compared_with_the_nearest_place(at_rest: Surface) -> None:
    low = at_rest.material.min(axis=0)
    high = at_rest.material.max(axis=0)
    beside, middle = high + np.array([1.0, 1.0, 0.0]), (low + high) / 2 + np.array([0.0, 0.0, 4.0])
    points = np.stack([beside, middle])
    for found, nearest in zip(at_rest.along_sight(points, 0.5), at_rest.nearest(points), strict=True):
        assert_array_equal(found, nearest)
    distance, face, place = at_rest.along_sight(points, 100.0)
    assert_allclose(np.cross(place[1], middle), 0.0, atol=1e-9 * norm(middle) ** 2)
    offset = np.einsum("i,i->", at_rest.normals[face[1]], middle - place[1])
    assert distance[1] == pytest.approx(abs(offset)) and distance[1] > at_rest.nearest(points)[0][1]


def test_residuals_beside_a_nuisance_are_those_of_a_fit_that_has_it() -> None:
    rng = default_rng(0)
    jacobian, nuisance, residual = rng.normal(size=(40, 3)), rng.normal(size=(40, 5)), rng.normal(size=40)
    weight = rng.random(40)
    rows = np.block([[jacobian, nuisance], [np.zeros((5, 3)), np.eye(5)]]) * np.sqrt(np.r_[weight, np.ones(5)])[:, None]
    whole = np.linalg.lstsq(rows, np.r_[residual * np.sqrt(weight), np.zeros(5)])
    pulls = pull(jacobian, weight, nuisance)
    step = solve(jacobian.T @ pulls, pulls.T @ residual)
    assert_allclose(np.r_[step, amplitudes(residual - jacobian @ step, weight, nuisance)], whole[0])
    assert_allclose(pull(jacobian, weight, nuisance[:, :0]).T, jacobian.T * weight)


def test_noise_that_neighbours_share_is_alike_as_far_as_they_share_it() -> None:
    """Along the line of sight by its own size, across it by pixels, and nothing where none is known."""
    across = np.linspace(-1.0, 1.0, 41)
    points = np.stack([*(each.ravel() for each in np.meshgrid(across, across)), np.full(41**2, 100.0)], axis=1)
    evidence = Evidence.of(points)
    assert not evidence.with_errors.shared_errors.amplitudes.size
    evidence = replace(evidence, shared_noise=SharedNoise(0.5, 0.03, 0.001))
    vars(evidence)["roughness"] = 0.0
    errors = evidence.with_errors.shared_errors.rows(np.arange(20 * 41, 21 * 41))
    along, aside = (errors.along(np.tile(np.eye(3)[axis], (41, 1))).astype(float) for axis in (2, 0))
    distance = np.abs(across[:, None] - across) / 100.0
    assert_allclose(along @ along.T, 0.25 * np.exp(-np.pi * (distance / 0.03) ** 2), atol=0.03)
    assert_allclose((aside**2).sum(axis=1), (UNSEEN_PITCHES * 0.001 * 100.0) ** 2, rtol=0.1)
