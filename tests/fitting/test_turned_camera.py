"""Camera turned in place: asked only where a fit does not explain the frame, and what is found is turned back."""

import numpy as np
import pytest
from fit_cases import IN_FRONT, SCENE, said, shown

from mereo.fitting.config import FitConfig
from mereo.fitting.modes import turns
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.registration.register import CloudToFit, ModesFit
from mereo.scenes.random_states import scene_model
from mereo.scenes.statistical_model import StatisticalModel

AXIS = np.array([0.3, -0.2, 2.0])


@pytest.fixture(scope="module")
def model() -> StatisticalModel:
    return scene_model(SCENE, count=200)


def confused(found: Correspondences) -> Correspondences:
    """Correspondences as of an object turned by a third of a turn in itself, about an axis that is none of symmetry."""
    center = found.rest.mean(axis=0)
    cyclic = (found.rest - center)[:, [1, 2, 0]] + center
    return Correspondences(found.points, cyclic, found.labels, found.confidence, found.observed)


class Network:
    """A network that understands a frame only when its camera is turned in one way."""

    def __init__(self, points: np.ndarray, right: Correspondences, turn: np.ndarray | None) -> None:
        self.points, self.right, self.turn, self.asked = points, right, turn, 0

    def __call__(self, seen: np.ndarray) -> Correspondences:
        self.asked += 1
        rotation = np.linalg.lstsq(self.points, seen, rcond=None)[0].T  # from its frame to the one that is asked about
        understood = self.turn is not None and np.allclose(rotation, self.turn, atol=1e-6)
        return (self.right if understood else confused(self.right)).turned(rotation)


def test_turns_are_different_rotations_that_keep_the_object_in_front_of_the_camera() -> None:
    found = np.stack(list(turns(AXIS)))
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.broadcast_to(np.eye(3), found.shape), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(np.ones(len(found)))
    away = found @ (AXIS / np.linalg.norm(AXIS)) @ (AXIS / np.linalg.norm(AXIS))
    assert (away > np.cos(np.deg2rad(26.0))).all()
    all_of_them = np.concatenate([np.eye(3)[None], found])
    apart = np.abs(all_of_them[:, None] - all_of_them[None]).max(axis=(2, 3)) + np.eye(len(all_of_them))
    assert apart.min() > 0.15


@pytest.mark.parametrize("number", [2, 12])
def test_a_frame_that_the_network_understands_only_when_it_is_turned_is_found(
    model: StatisticalModel, number: int
) -> None:
    points, material = shown(model, 0.8)
    right = said(model, material)
    turn = list(turns(points.mean(axis=0)))[number]
    network = Network(points, right, turn)
    alone = ModesFit.of(CloudToFit(points, 1.0), confused(right), model)
    turned = ModesFit.of(CloudToFit(points, 1.0), confused(right), model, predict=network)
    off, mended = (np.linalg.norm(one.registration().material - material, axis=1) for one in (alone, turned))
    assert np.median(off) > 3.0 and np.median(mended) < 0.3
    assert number < network.asked <= 8 * (number // 8 + 1)  # no more than its round


def test_a_frame_that_is_explained_is_asked_about_once(model: StatisticalModel) -> None:
    points, material = shown(model, 0.5)
    network = Network(points, said(model, material), None)
    ModesFit.of(CloudToFit(points, 1.0), said(model, material), model, predict=network)
    assert network.asked == 0


def test_noise_that_hides_how_wrong_a_fit_is_hides_it_from_a_last_try_no_more(model: StatisticalModel) -> None:
    points, material = shown(model, 0.8)
    points = points * (1 + np.random.default_rng(0).normal(scale=0.4, size=(len(points), 1)) / IN_FRONT[2, 3])
    right = said(model, material)
    network = Network(points, right, list(turns(points.mean(axis=0)))[2])
    first = ModesFit.of(CloudToFit(points, 1.0), confused(right), model, FitConfig(turned=False), predict=network)
    last = ModesFit.of(CloudToFit(points, 1.0), confused(right), model, FitConfig(turned_anyway=True), predict=network)
    off, mended = (np.linalg.norm(one.registration().material - material, axis=1) for one in (first, last))
    assert not first.registration().accepted and np.median(off) > 3.0
    assert last.registration().accepted and np.median(mended) < 0.5
