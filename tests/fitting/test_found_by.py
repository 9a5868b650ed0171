"""Who finds the object, and how noise and strays are met."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from answers import answer_to
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from scipy.spatial import cKDTree

from mereo.fitting.config import FitConfig
from mereo.fitting.problem.correspondences import find_correspondences
from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import (
    ACCEPTED,
    CLEAN,
    SIGMAS,
    is_normal,
    noise_of,
    shared_variance,
)
from mereo.fitting.problem.residuals import Surface
from mereo.fitting.registration.answer import Candidate
from mereo.fitting.registration.answer_frame import in_registered_unit, search_hypotheses
from mereo.fitting.registration.register import ModesFit, Registrar
from mereo.fitting.search import screen_poses
from mereo.fitting.uncertainty import ModesOptimum
from mereo.geometry.camera import PointCloud, SharedNoise, SightLines
from mereo.geometry.conventions import NoFit
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.synthesis.sample_views import load_view


@pytest.fixture(scope="module")
def liver() -> Model:
    return replace(load_model("liver"), provenance={"scene": "mine"})  # whose draws nobody fits


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return load_view("liver").depth.to_points()


def test_a_networks_guess_is_tried_first(liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    screened = Mock(wraps=screen_poses)
    monkeypatch.setattr("mereo.fitting.search.screen_poses", screened)
    assert answer_to(cloud, liver, Registrar.of(liver), 24).recognition.known is True and not screened.called
    assert answer_to(cloud, liver, Registrar.of(liver, "search"), 24).recognition.known is True and screened.called


@pytest.mark.parametrize("unit", [1.0, None])
def test_a_network_that_is_lost_does_no_harm(
    liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch, unit: float | None
) -> None:
    """One that takes each place of the object for another one."""

    def lying(*given: Any) -> Any:
        found = find_correspondences(*given)
        assert found is not None
        return replace(found, rest=default_rng(0).permutation(found.rest))

    right = answer_to(cloud, liver, Registrar.of(liver), 24, scene_unit=unit)
    monkeypatch.setattr("mereo.fitting.registration.register.find_correspondences", lying)
    found = answer_to(cloud, liver, Registrar.of(liver), 24, scene_unit=unit)
    assert found.recognition.known is True
    assert np.median(norm(found.registration.material - right.registration.material, axis=1)) < 1.0


def test_the_size_of_another_object_says_nothing_of_the_unit(liver: Model, cloud: PointCloud) -> None:
    registrar = Registrar.of(liver)
    seen = observe(cloud)
    found = answer_to(cloud, liver, registrar, 24)
    assert found.seen.frame.unit_m == registrar.unit_of(found.registration)
    other = replace(found.recognition, known=False)
    assert in_registered_unit(seen, registrar, found.registration, other).frame.unit_m is None


def test_what_a_network_says_is_evidence(liver: Model, cloud: PointCloud) -> None:
    """It speaks against a state that is elsewhere by as many points as it is worth, and of nothing else."""
    modes = answer_to(cloud, liver, Registrar.of(liver), 24, scene_unit=1.0).candidate.modes
    problem = modes.problem
    surface = modes.surface
    elsewhere = Surface.through(problem.model, surface.material[::-1])
    assert 0 < problem.network_misfit(surface) < 0.2 * problem.network_misfit(elsewhere)
    deaf = problem.changed(network=None)
    for each in (surface, elsewhere):
        more = problem.misfit(modes.posed, each).total - deaf.misfit(modes.posed, each).total
        assert more == pytest.approx(problem.network_misfit(each)) and deaf.network_misfit(each) == 0.0


def test_weights_calibrate_what_a_search_finds_and_say_how_sure_they_are(liver: Model, cloud: PointCloud) -> None:
    found = answer_to(cloud, liver, Registrar.of(liver), 24)
    assert found.located_by == "search" and found.registration is not None
    assert found.registration.accepted and found.recognition.known is True
    assert found.registration.radius_scale is not None
    assert all(0 < segment.confidence <= 1 for segment in found.reconstruction.segments)  # the network's
    alone = answer_to(cloud, liver, None, 24)
    assert alone.located_by == "network" and alone.registration is None and alone.recognition.known == "unsure"


def test_the_parameters_of_a_scene_are_fitted_to_what_the_modes_explain(
    liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = Mock(side_effect=lambda modes: modes.registration)
    monkeypatch.setattr(ModesFit, "with_draws", lambda modes, states: draw(modes))
    monkeypatch.setattr(Registrar, "states_or_none", object())
    registrar = Registrar.of(liver)
    assert answer_to(cloud, liver, registrar, 24).recognition.known is True and draw.call_count == 1
    noise = PointCloud(cloud.points.mean(axis=0) + default_rng(0).uniform(-40, 40, cloud.points.shape))
    assert answer_to(noise, liver, registrar, 24).recognition.known is False and draw.call_count == 1


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    return Registrar.of(load_model("liver"), "modes")


@pytest.fixture(scope="module")
def points(cloud: PointCloud) -> ndarray:
    return cloud.points


def with_rim(points: ndarray) -> ndarray:
    """The points and pieces of a wall behind, as a mask lets them in that is two pixels too wide in six places."""
    slopes = points[:, :2] / points[:, 2:]
    pitch = np.sqrt(np.ptp(slopes, axis=0).prod() / len(slopes))
    middle = slopes.mean(axis=0)
    far = slopes[np.argsort(-norm(slopes - middle, axis=1))[:: len(slopes) // 6][:6]]
    pieces = [far + (far - middle) / norm(far - middle, axis=1)[:, None] * pitch * step for step in (1.5, 2.5)]
    rim = np.concatenate(pieces)
    return np.concatenate([points, np.column_stack([rim, np.ones(len(rim))]) * (1.4 * points[:, 2].max())])


def fitted(registrar: Registrar, points: ndarray, keep_all: bool = False, unit: float = 1.0) -> Candidate:
    return search_hypotheses(observe(PointCloud(points)), registrar, keep_all, unit)


def test_strays_are_left_out_and_all_else_is_kept(registrar: Registrar, points: ndarray) -> None:
    clean, found = fitted(registrar, points), fitted(registrar, with_rim(points))
    assert clean.hypothesis.dropped == 0
    assert not found.hypothesis.keep[len(points) :].any() and found.hypothesis.keep[: len(points)].mean() > 0.99
    moved = norm(found.modes.registration.material - clean.modes.registration.material, axis=1)
    assert np.median(moved) < 0.2
    with pytest.raises(NoFit, match="or leave out of the cloud what is not the object"):
        fitted(registrar, with_rim(points), keep_all=True)


def test_an_answer_says_which_points_it_is_of(registrar: Registrar, points: ndarray) -> None:
    found = answer_to(with_rim(points), registrar.network, registrar, 24, label_points=True, scene_unit=1.0)
    assert found.reconstruction.observed is not None
    assert len(found.reconstruction.observed.labels) == len(found.reconstruction.reading.cloud) < len(with_rim(points))
    assert found.seen.cloud is found.reconstruction.reading.cloud and found.seen.steps[-1].name == "strays"


def noisy(points: ndarray, std: float) -> ndarray:
    noise = default_rng(0).normal(scale=std, size=(len(points), 1))
    return points + noise * points / norm(points, axis=1)[:, None]


@pytest.mark.slow
def test_a_noisy_frame_is_fitted_by_its_own_noise(registrar: Registrar, points: ndarray) -> None:
    clean, found = (fitted(registrar, cloud).modes for cloud in (points, noisy(points, 0.4)))
    assert clean.problem.cloud_sigma == FitConfig.cloud_sigma and not clean.problem.is_noisy
    before, after = (each.problem.evidence.points for each in (clean, found))
    normals = clean.surface.normals[clean.surface.nearest(before)[1]]
    across = noise_of(((after - before) * normals).sum(axis=1))  # the surface, not along the lines of sight
    assert found.problem.noise == pytest.approx(across, rel=0.1)
    assert len(found.problem.evidence.observed_samples) > len(clean.problem.evidence.observed_samples)
    assert found.registration.accepted
    metres = fitted(registrar, noisy(points, 0.4) * 0.005, unit=0.005).modes
    assert metres is not None and metres.problem.noise == pytest.approx(found.problem.noise, rel=0.02)


def test_the_noise_left_is_what_points_have_alone_and_as_much_as_neighbours_share_around_the_object(
    registrar: Registrar, points: ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a wrong state leaves over beside that is none: its neighbours share it."""
    modes = fitted(registrar, points).modes
    rng = default_rng(1)
    surface = modes.surface
    own = rng.normal(scale=0.3, size=len(modes.problem.evidence.points))
    for share, off_by, expected in ((np.inf, 2.0, 0.3), (0.4, 2.0, 0.5), (0.4, 0.0, 0.3)):
        monkeypatch.setattr(Surface, "offsets", lambda *_, offset=own + off_by: offset)
        problem = replace(modes.problem, evidence=replace(modes.problem.evidence, shared_noise=SharedNoise(share)))
        assert problem.left_noise(surface) == pytest.approx(expected, rel=0.1)


def test_the_first_noise_is_what_the_cloud_shows(points: ndarray) -> None:
    calm, rough = (Evidence.of(cloud) for cloud in (points, noisy(points, 0.4)))
    assert calm.noise < CLEAN and 0.3 < rough.noise < 0.5
    assert replace(rough, shared_noise=SharedNoise(0.3)).noise == pytest.approx(np.hypot(rough.noise, 0.3))


def test_what_neighbours_share_is_no_noise_of_points(points: ndarray) -> None:
    """An offset of all points, or of half of them, is the fit's; what each has for itself is the camera's."""
    around = Evidence.of(points).around
    rng = default_rng(0)
    own = rng.normal(scale=0.3, size=len(points))
    half = np.where(points[:, 0] > np.median(points[:, 0]), 2.0, 0.0)
    assert noise_of(own, around) == pytest.approx(0.3, rel=0.1)
    assert noise_of(own + 1.0, around) == pytest.approx(0.3, rel=0.1)
    assert noise_of(half, around) == 0.0


def test_noise_that_neighbours_share_is_spread_evenly_and_a_wrong_state_is_not() -> None:
    rng = default_rng(0)
    windows = 0.1 * np.repeat(rng.normal(size=300), 9)
    assert is_normal(windows)
    assert not is_normal(np.where(rng.random(2700) < 0.1, 0.6, windows))


def plate(pixels: int = 64) -> ndarray:
    """Points of a plate, a pixel each, row by row."""
    line = 0.3 * (np.arange(pixels) - pixels / 2)
    u, v = np.meshgrid(line, line)
    return np.stack([u.ravel(), v.ravel(), np.full(pixels**2, 100.0)], axis=1)


def test_what_neighbours_share_leaves_a_fit_as_unsure_as_fewer_points() -> None:
    """Of windows of 4 x 4 pixels, off by as much as each pixel is besides, and twice that for what a fit has bent."""
    rng = default_rng(0)
    evidence = Evidence.of(plate())
    pixel = cKDTree(plate()).query(evidence.points)[1]
    for window, expected in ((1, 2.0), (4, 2 * (16.0 + 1.0))):
        off = [np.kron(rng.normal(size=(64 // window,) * 2), np.ones((window, window))) for _ in range(8)]
        off = [each + rng.normal(size=each.shape) for each in off]
        found = [shared_variance(each.ravel()[pixel], evidence, 40) for each in off]
        assert np.median(found) == pytest.approx(expected, rel=0.5)
        flying = [np.where(rng.random(len(pixel)) < 0.05, 50.0, each.ravel()[pixel]) for each in off]
        assert np.median([shared_variance(each, evidence, 40) for each in flying]) < 2 * np.median(found)


def test_a_noisy_cloud_is_worth_no_more_than_its_points_and_less_where_they_share_their_errors(
    registrar: Registrar, points: ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    modes = fitted(registrar, points).modes
    problem = modes.problem.with_noise(0.4)
    rng = default_rng(0)
    count = len(problem.evidence.points)
    own = rng.normal(scale=0.4, size=count)
    common = np.full(count, 0.4) * np.sign(problem.evidence.points[:, 0])
    weights = list[float]()
    for offset in (own, own + common):
        monkeypatch.setattr(Surface, "offsets", lambda *_, offset=offset: offset)
        config = problem.worth(modes.surface).config
        assert config.silhouette_weight == 0.2 * min(config.cloud_weight / 3000.0, 1.0)
        weights.append(config.cloud_weight)
    assert 0.3 * count < weights[0] <= 2.25 * count * (1 + 1e-9) and weights[1] < 0.3 * weights[0]


def test_what_neighbours_share_is_told_from_what_points_have_alone(registrar: Registrar, points: ndarray) -> None:
    """A smooth error that is known around the object is no noise of points, and leaves the object as unsure."""
    modes = fitted(registrar, points).modes
    evidence = replace(modes.problem.evidence, shared_noise=SharedNoise(0.4, 0.05, 0.001))
    errors = evidence.with_errors.shared_errors
    off = replace(errors, amplitudes=default_rng(0).normal(size=len(errors.amplitudes))).offsets
    problem = modes.problem.changed(evidence=replace(evidence, points=evidence.points + off)).with_noise(0.4)
    known = problem.worth(modes.surface)
    assert (known.evidence.shared_errors.offsets - off)[:, 2].std() < 0.4 * off[:, 2].std()
    assert known.noise < 0.5 * noise_of(problem.offsets(modes.surface))
    forward = ModesOptimum(known, modes.posed, 1.0).posterior.factor[5]  # a shift along the line of sight
    assert 0.1 < norm(forward) < 0.6


def test_a_cloud_is_explained_where_only_noise_is_left(registrar: Registrar, points: ndarray) -> None:
    """Noise of a camera leaves a few points far off; of a clean frame no point is."""
    for noise in (0.0, 0.4):
        found = fitted(registrar, noisy(points, noise)).modes
        problem, evidence = found.problem, found.problem.evidence
        x = evidence.points[:, :1]  # half of them, and a few, are below
        for off, is_explained in ((1.0, False), (x < 0.0, False), (x % 1.0 < 0.03, noise > 0.0), (0.0, True)):
            seen = replace(evidence, points=evidence.points + off)
            assert problem.changed(evidence=seen).explained(found.surface) == is_explained
    assert not problem.with_noise(0.0).explained(found.surface)


def test_constants_follow_the_noise_and_end(registrar: Registrar, points: ndarray) -> None:
    problem = fitted(registrar, points).modes.problem
    config = problem.config

    def constants(noise: float) -> tuple[float, float, float]:
        of = problem.with_noise(noise)
        return of.cloud_sigma, of.tolerance, of.accepted

    clean = (config.cloud_sigma, config.tolerance, config.accepted)
    assert constants(0.0) == constants(CLEAN) == clean and not problem.with_noise(CLEAN).is_noisy
    assert constants(0.2) == pytest.approx((0.3, 0.6, ACCEPTED)) and problem.with_noise(0.2).is_noisy
    largest = 0.01 * np.median(norm(points, axis=1))  # of a camera, whatever the object's size
    assert constants(99.0)[0] == pytest.approx(SIGMAS * largest, rel=0.02)


def test_doubtful_points_rule_nothing_out(points: ndarray) -> None:
    """A vertex along the line of sight of a dropped point is neither outside the silhouette nor in free space."""
    slopes = points[:, :2] / points[:, 2:]
    corner = np.append(slopes.max(axis=0) + 0.2, 1.0)
    vertices = np.array([corner * 50.0, corner * 150.0])
    unknown = SightLines.of_cloud().with_unknown(corner[None] * 300.0)
    assert (Evidence.of(points).violations(vertices, 0.5)[1] > 0).all()
    assert (Evidence.of(points, lines=unknown).violations(vertices, 0.5)[1] == 0).all()
