"""What belongs to the object is told by what a fit explains, and how noisy a frame is by what a fit leaves over."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from answers import answer_to

from mereo.fitting.config import FitConfig
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import (
    ACCEPTED,
    CLEAN,
    LARGEST,
    SHARED,
    constants_for,
    is_noise,
    noise_of,
    shared,
)
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration.answer import Candidate
from mereo.fitting.registration.answer_frame import fit_hypotheses
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.isolation import Reading
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import EncodedFrame
from mereo.synthesis.sample_views import load_view


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model("liver")


@pytest.fixture(scope="module")
def registrar(model: Model) -> Registrar:
    return Registrar.of(model, "modes")


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return load_view("liver").depth.to_points().points


def with_rim(points: np.ndarray) -> np.ndarray:
    """The points and pieces of a wall behind, as a mask lets them in that is two pixels too wide in six places."""
    slopes = points[:, :2] / points[:, 2:]
    pitch = np.sqrt(np.ptp(slopes, axis=0).prod() / len(slopes))
    middle = slopes.mean(axis=0)
    far = slopes[np.argsort(-np.linalg.norm(slopes - middle, axis=1))[:: len(slopes) // 6][:6]]
    pieces = [
        far + (far - middle) / np.linalg.norm(far - middle, axis=1)[:, None] * pitch * step for step in (1.5, 2.5)
    ]
    rim = np.concatenate(pieces)
    return np.concatenate([points, np.column_stack([rim, np.ones(len(rim))]) * (1.4 * points[:, 2].max())])


def candidates(
    model: Model, registrar: Registrar | None, points: np.ndarray, keep_all: bool = False, unit: float | None = 1.0
) -> tuple[Candidate, EncodedFrame]:
    return fit_hypotheses(observe(PointCloud(points)), model, registrar, keep_all, unit)


def fitted(model: Model, registrar: Registrar, points: np.ndarray, **options: Any) -> Candidate:
    return candidates(model, registrar, points, **options)[0]


@pytest.mark.usefixtures("without_turns")
def test_strays_are_left_out_and_all_else_is_kept(model: Model, registrar: Registrar, points: np.ndarray) -> None:
    (clean, likelier), found = candidates(model, registrar, points), fitted(model, registrar, with_rim(points))
    assert clean.hypothesis.dropped == 0 and clean.encoded is likelier
    assert not found.hypothesis.keep[len(points) :].any() and found.hypothesis.keep[: len(points)].mean() > 0.99
    assert found.modes is not None and clean.modes is not None
    moved = np.linalg.norm(found.modes.registration().material - clean.modes.registration().material, axis=1)
    assert np.median(moved) < 0.2
    asked = fitted(model, registrar, with_rim(points), keep_all=True)
    assert asked.hypothesis.dropped == 0


def test_points_that_a_fit_explains_are_given_back_beside_strays(
    model: Model, registrar: Registrar, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    contaminated = with_rim(points)
    lost = np.random.default_rng(0).choice(len(points), 10, replace=False)

    def hasty(cloud: PointCloud, axes: str, keep_all: bool) -> tuple[Reading, Reading]:
        keep = np.arange(len(cloud)) < len(points)
        keep[lost] = False
        return Reading(cloud, keep), Reading.of_all(cloud)

    monkeypatch.setattr("mereo.fitting.registration.answer_frame.readings", hasty)
    keep = fitted(model, registrar, contaminated).hypothesis.keep
    assert keep[lost].all() and not keep[len(points) :].any()


def test_an_answer_says_which_points_it_is_of(model: Model, registrar: Registrar, points: np.ndarray) -> None:
    found = answer_to(with_rim(points), model, registrar, 24, label_points=True, scene_unit=1.0)
    assert found.taken and found.reconstruction.observed is not None
    assert len(found.reconstruction.observed.labels) == len(found.reconstruction.reading.cloud) < len(with_rim(points))
    assert found.seen.cloud is found.reconstruction.reading.cloud and found.seen.steps[-1].name == "strays"


def noisy(points: np.ndarray, std: float) -> np.ndarray:
    noise = np.random.default_rng(0).normal(scale=std, size=(len(points), 1))
    return points + noise * points / np.linalg.norm(points, axis=1)[:, None]


@pytest.mark.slow
def test_a_noisy_frame_is_fitted_by_its_own_noise(model: Model, registrar: Registrar, points: np.ndarray) -> None:
    clean, found = (fitted(model, registrar, cloud).modes for cloud in (points, noisy(points, 0.4)))
    assert clean is not None and found is not None
    assert clean.problem.config == FitConfig()
    config = found.problem.config
    assert 0.3 < config.cloud_sigma <= LARGEST and config.tolerance == pytest.approx(4.5 * config.cloud_sigma, rel=0.5)
    assert len(found.problem.evidence.observed_samples) > len(clean.problem.evidence.observed_samples)
    assert found.registration().accepted
    metres = fitted(model, registrar, noisy(points, 0.4) * 0.005, unit=0.005).modes
    assert metres is not None and metres.problem.config.cloud_sigma == pytest.approx(config.cloud_sigma, rel=0.02)


def test_what_neighbours_share_is_no_noise(points: np.ndarray) -> None:
    """An offset of all points, or of half of them, is the fit's; what each has for itself is the camera's."""
    around, rng = Evidence.of(points).around, np.random.default_rng(0)
    own = rng.normal(scale=0.3, size=len(points))
    half = np.where(points[:, 0] > np.median(points[:, 0]), 2.0, 0.0)
    assert noise_of(own, around) == pytest.approx(0.3, rel=0.1) and is_noise(own, around)
    assert noise_of(own + 1.0, around) == pytest.approx(0.3, rel=0.1)
    assert not is_noise(own + 1.0, around)
    assert noise_of(half, around) == 0.0
    assert 0.97 < shared(own, around, 0.45) < SHARED
    assert shared(own + 0.5, around, 0.45) > 1.3 and shared(own + half, around, 0.45) > 1.3


def test_noise_that_neighbours_share_is_spread_evenly_and_a_wrong_state_is_not() -> None:
    rng, around = np.random.default_rng(0), np.zeros((2700, 8), dtype=int)
    windows = 0.1 * np.repeat(rng.normal(size=300), 9)
    assert is_noise(windows, around, is_shared=True) and not is_noise(10 * windows, around, is_shared=True)
    assert not is_noise(np.where(rng.random(2700) < 0.1, 0.6, windows), around, is_shared=True)


def test_a_noisy_cloud_is_explained_where_only_noise_is_left(
    model: Model, registrar: Registrar, points: np.ndarray
) -> None:
    found = fitted(model, registrar, noisy(points, 0.4)).modes
    assert found is not None and found.problem.noisy
    problem, aside = found.problem, found.surface.material + np.array([0.0, 0.0, 1.0])
    assert problem.explained(9.0, found.surface, 0.1)
    assert not problem.explained(9.0, Surface.through(problem.model, aside), 0.1)
    assert not replace(problem, noisy=False).explained(9.0, found.surface, 0.1)


def test_constants_follow_the_noise_and_end() -> None:
    config = FitConfig()
    assert constants_for(CLEAN, config) is config
    found = constants_for(0.2, config)
    assert (found.cloud_sigma, found.tolerance, found.accepted) == pytest.approx((0.3, 1.35, ACCEPTED))
    clean = replace(found, cloud_sigma=config.cloud_sigma, tolerance=config.tolerance, accepted=config.accepted)
    assert clean == config
    assert constants_for(0.2, replace(config, accepted=0.5)).accepted == 0.5
    assert constants_for(9.0, config).cloud_sigma == LARGEST


def test_doubtful_points_rule_nothing_out(points: np.ndarray) -> None:
    """A vertex along the line of sight of a dropped point is neither outside the silhouette nor in free space."""
    slopes = points[:, :2] / points[:, 2:]
    corner = np.append(slopes.max(axis=0) + 0.2, 1.0)
    vertices = np.array([corner * 50.0, corner * 150.0])
    assert (Evidence.of(points).violations(vertices, 0.5)[1] > 0).all()
    assert (Evidence.of(points, corner[None] * 300.0).violations(vertices, 0.5)[1] == 0).all()
