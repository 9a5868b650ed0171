"""Who finds the object: the network at once where it can, a search where the network's fit explains too little."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from answers import answer_to

from mereo.fitting.problem import correspondences
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import (
    ASTRAY,
    answer_frame,
    is_astray,
    misfit_in,
    more_evident,
    rival_distance,
    search_modes,
)
from mereo.fitting.registration.register import Registrar
from mereo.geometry.camera import PointCloud, SightLines
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.seeds import example_rng
from mereo.synthesis.config import SENSORS, GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo.synthesis.sample_views import load_view

HYPOTHESES = "mereo.fitting.registration.answer_frame"


@pytest.fixture(scope="module")
def liver() -> Model:
    return replace(load_model("liver"), provenance={"scene": "mine"})  # whose draws nobody fits


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return load_view("liver").depth.to_points()


@pytest.fixture
def confused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that takes each place of the object for another one."""
    honest = correspondences.find_correspondences

    def lying(*given: Any) -> Any:
        found = honest(*given)
        assert found is not None
        return replace(found, rest=np.random.default_rng(0).permutation(found.rest))

    monkeypatch.setattr("mereo.fitting.registration.register.find_correspondences", lying)


def answer(liver: Model, cloud: PointCloud, method: Any = "auto") -> Answer:
    return answer_to(cloud, liver, Registrar.of(liver, method), 24)


def test_a_network_that_understands_is_not_doubted(
    liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{HYPOTHESES}.search_modes", None)
    assert answer(liver, cloud).located_by == "network"


@pytest.mark.usefixtures("confused", "without_turns")
def test_a_search_is_asked_too_where_the_network_is_lost(liver: Model, cloud: PointCloud) -> None:
    found = answer(liver, cloud)
    assert found.located_by == "search" and found.taken and found.registration is not None
    assert found.registration.accepted and found.recognition.known is True
    assert all(0 < segment.confidence <= 1 for segment in found.reconstruction.segments)  # the network's, all the same


def test_the_network_is_left_out_on_request(liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mereo.fitting.registration.register.find_correspondences", None)
    found = answer(liver, cloud, "search")
    assert found.located_by == "search" and found.taken


def test_the_state_with_the_greater_evidence_is_taken_whatever_its_unit(liver: Model, cloud: PointCloud) -> None:
    model = liver.statistical_model
    assert model is not None
    by_network = answer(liver, cloud).candidate
    assert by_network is not None and by_network.modes is not None
    right = by_network.modes
    astray = replace(right, posed=replace(right.posed, translation=right.posed.translation + 3.0))
    wrong = replace(by_network, modes=astray, located_by="search")
    assert misfit_in(right, astray) > misfit_in(right, right)
    assert more_evident(by_network, wrong) is by_network and more_evident(wrong, by_network) is by_network
    assert more_evident(replace(by_network, modes=None), wrong) is wrong
    halved = replace(
        right, unit=2 * right.unit, posed=replace(right.posed, log_scale=right.posed.log_scale - np.log(2.0))
    )
    halved = replace(halved, posed=replace(halved.posed, translation=right.posed.translation / 2))
    assert misfit_in(right, halved) == pytest.approx(misfit_in(right, right), rel=1e-6)


def test_a_network_far_from_what_it_starts_is_no_start(liver: Model, cloud: PointCloud) -> None:
    """Weights after a minute of training explain a frame by chance, with the object turned end for end."""
    by_network = answer(liver, cloud).candidate
    assert by_network is not None and by_network.modes is not None
    assert not is_astray(by_network)
    found = by_network.modes.correspondences
    guessed = replace(found, rest=np.random.default_rng(0).permutation(found.rest))
    lucky = replace(by_network, modes=replace(by_network.modes, correspondences=guessed))
    assert lucky.is_accepted and is_astray(lucky)
    displaced = lucky.displaced(by_network.modes.registration())
    assert displaced is not None and displaced > ASTRAY


def test_a_search_is_asked_too_where_a_part_is_hidden(
    liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    across = cloud.points[:, 0] / cloud.points[:, 2]
    kept = cloud.points[across > np.quantile(across, 0.2)]
    asked = []
    honest = search_modes

    def searched(*given: Any) -> Any:
        asked.append(given)
        return honest(*given)

    monkeypatch.setattr(f"{HYPOTHESES}.search_modes", searched)
    registrar = Registrar.of(liver)
    cut = cloud.points[across <= np.quantile(across, 0.2)]
    lines = SightLines(np.empty((0, 3)), 0.5 * cut, "past")
    seen = observe(PointCloud(kept))
    vars(seen)["lines"] = lines
    assert answer_frame(seen, liver, registrar, resolution=24).taken and asked
    asked.clear()
    assert answer_frame(observe(cloud), liver, registrar, resolution=24).taken and not asked


def test_a_noisy_frame_that_two_fits_explain_apart_is_not_known(liver: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = GenerateConfig(sensor=SENSORS["time-of-flight"])
    view = sample_view(load_scene("liver").for_seed(1000), settings, example_rng(1000, 1))
    answer = answer_frame(observe(view.depth.to_points()), liver, Registrar.of(liver), scene_unit=1.0, resolution=24)
    candidate = answer.candidate
    assert candidate is not None and candidate.is_noisy and candidate.modes is not None
    assert candidate.rival is not None and candidate.rival < 0.2 and answer.recognition.known is True
    # a search that ends beside it, where a distance of 50 units is an explanation, and its misfit is stated
    modes, posed = candidate.modes, candidate.modes.posed
    for tolerance, misfit in ((50.0, 1.2), (50.0, 1.3), (1e-3, 1.0)):
        is_rival = tolerance > 1 and misfit < 1.25
        monkeypatch.setattr(f"{HYPOTHESES}.misfit_in", lambda frame, fit, m=misfit: 1.0 if frame is fit else m)
        config = replace(modes.problem.config, tolerance=tolerance)
        lax = replace(candidate, modes=replace(modes, problem=replace(modes.problem, config=config)))
        beside = posed.translation + np.array([0.25 * modes.problem.model.half, 0.0, 0.0])
        best = SimpleNamespace(posed=replace(posed, translation=beside))
        monkeypatch.setattr(f"{HYPOTHESES}.search", lambda _, best=best: SimpleNamespace(best=best))
        rival = rival_distance(lax)
        assert rival == (pytest.approx(0.25, rel=1e-3) if is_rival else None)
        doubted = answer.recognition.with_rival(rival)
        assert doubted.known == ("unsure" if is_rival else True) and doubted.facts()["rival"] == rival
    doubted = answer.recognition.with_rival(0.2)
    assert "two fits explain this noisy frame, and the places of the object are 20% of" in str(doubted.reason)


@pytest.mark.usefixtures("confused", "without_turns")
def test_other_methods_ask_nobody_else(liver: Model, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{HYPOTHESES}.search_modes", None)
    assert answer(liver, cloud, "modes").located_by == "network"
