"""Is it my object, in a state that I know: each sign has its say, together they decide, and one gives the reason."""

import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from mereo.fitting.problem.evidence import Evidence
from mereo.fitting.problem.problem import ACCEPTED
from mereo.fitting.registration.answer_frame import answer_frame, answer_of
from mereo.fitting.registration.recognition import (
    FEATURELESS,
    FIT,
    NOT_EVALUATED,
    Known,
    Recognition,
    Signs,
    recognize,
)
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.statistical_model import StatisticalModel


@pytest.fixture(scope="module")
def registration(model: StatisticalModel) -> Registration:
    """A registration that nothing speaks against: the mean state."""
    material = model.mean + np.array([0.0, 0.0, 100.0])
    z = np.full(model.count, 0.5)
    found = Registration(model, material, "modes", z, 1.0, unit_known=False, explained=1.0, accepted=True, seconds=0.1)
    return replace(found, residual=0.05, ruled_out=0.0)


@pytest.mark.parametrize(
    ("change", "options", "sentence"),
    [
        ({"explained": 0.2}, {}, "only 20% of the points can be the model's: this is probably another object"),
        ({"explained": 0.6}, {}, "40% of the points are not the model's: look at the result"),
        ({"ruled_out": 0.4}, {}, "40% of the model's surface lies where the frame shows none of it"),
        ({"z": 10.0}, {}, "scene units outside those that were learned, and rigid parts may be bent"),
        ({}, {"stated_scene_unit": 25.4}, "its size differs by a factor of 25.4 from the object's in the frame's unit"),
        ({}, {"stated_scene_unit": 0.001}, "a factor of 1e+03 "),
    ],
)
def test_each_sign_has_its_say(
    registration: Registration, change: dict[str, float], options: dict[str, float], sentence: str
) -> None:
    changes = {name: registration.z + value if name == "z" else value for name, value in change.items()}
    said = recognize(replace(registration, **changes), **options)
    assert said.known is not True and said.reason is not None and sentence in said.reason
    assert said.description is not None and said.description.endswith(said.reason)
    without = recognize(replace(registration, **changes), **options, has_weights=False)
    assert not re.search("weights|learn", str(without.description)) and without.signs == said.signs


def test_the_more_is_wrong_the_less_is_known(registration: Registration) -> None:
    said = [recognize(replace(registration, explained=share)) for share in (1.0, 0.98, 0.9, 0.8, 0.5, 0.1, 0.0)]
    each = [-one.signs.nats for one in said]
    assert each == sorted(each) and [said[0].known, said[-1].known] == [True, False]
    assert "unsure" in [one.known for one in said]
    order = [{True: 0, "unsure": 1, False: 2}[one.known] for one in said]
    assert order == sorted(order)


def test_a_fit_that_is_not_accepted_is_never_known(registration: Registration) -> None:
    """Neither of a noisy frame, nor of a clean one that hardly misses it."""
    for share, needed in ((0.7, 0.75), (0.94, 0.95)):
        fit = replace(registration, explained=share, needed=needed)
        assert recognize(fit).known is True  # by its signs alone
        said = recognize(replace(fit, accepted=False))
        assert said.known == "unsure" and "% of the points " in str(said.reason)


def test_what_should_have_been_seen_of_it_makes_it_doubtful(registration: Registration) -> None:
    said = [recognize(registration, unseen=share) for share in (None, 0.05, 0.5, 0.9)]
    assert [one.known for one in said] == [True, True, "unsure", False]
    assert "90% of what the camera would see of the object was not seen" in str(said[-1].reason)


def test_the_object_at_rest_is_known_whatever_was_learned(registration: Registration) -> None:
    odd = replace(registration, z=registration.z + 10.0)
    assert recognize(odd).known is False and recognize(replace(odd, method="rest")).known is True


def test_what_the_network_alone_answers_is_unsure() -> None:
    assert recognize(None) is NOT_EVALUATED and NOT_EVALUATED.known == "unsure"


@pytest.mark.parametrize("unit, known", [(0.67, False), (0.88, "unsure"), (1.05, True), (1.13, "unsure"), (1.5, False)])
def test_a_size_that_is_not_what_the_unit_says_is_doubted(
    registration: Registration, unit: float, known: Known
) -> None:
    said = recognize(replace(registration, needed=0.75), stated_scene_unit=unit)
    assert said.known == known and (known is True or "its size differs by a factor of" in str(said.reason))


def test_noise_excuses_points_that_are_not_explained(registration: Registration) -> None:
    clean, noisy = (replace(registration, explained=0.88, needed=needed) for needed in (0.95, ACCEPTED))
    assert recognize(noisy).signs.nats > recognize(clean).signs.nats and recognize(noisy).known is True


def test_strangers_are_other_objects_planes_and_heaps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    strangers = import_module("recognition")
    monkeypatch.setattr(strangers, "SCENES", ("rope", "robot", "liver", "tumor"))
    rope: Scene = load_scene("rope")
    load_scene("liver")  # or the test is skipped, where its mesh is missing
    assert [other.name for other in strangers.other_objects(rope)] == ["robot", "liver"]
    assert [other.name for other in strangers.other_objects(load_scene("liver"))] == ["rope", "robot"]
    monkeypatch.setattr(strangers, "SCENES", ("rope", "robot"))
    frames = list(strangers.strange_frames(rope, strangers.other_objects(rope), 1, 710_000))
    assert [kind for kind, _ in frames] == ["other object"] + ["plane or clutter"] * 8
    low, high = rope.rest.bounds
    assert all(len(cloud) > 10 for _, cloud in frames)
    assert all(np.ptp(cloud.points, axis=0).max() < 2 * (high - low).max() for _, cloud in frames[1:])


# --- the whole way ----------------------------------------------------------------------------------------------------


def patch(bend: float) -> PointCloud:
    """A square of 3 units, seen 100 units away, which bends as a paraboloid."""
    x, y = np.meshgrid(*[np.linspace(-1.5, 1.5, 24)] * 2)
    return PointCloud(np.stack([x, y, 100.0 + 0.1 * x + bend * (x * x - x * y)], axis=-1).reshape(-1, 3))


def test_a_smooth_patch_is_not_believed(model: StatisticalModel) -> None:
    """As large a part of the object explains it, and of everything else; the rest of the object was not seen."""
    seen, registrar = observe(patch(0.0)), Registrar(None, model)
    partial, merged = replace(seen, extent="partial"), replace(seen, extent="partial")
    vars(merged)["self_hidden"] = 0.3  # as if another view's points lay behind: nothing believes it, tracked or not
    part, whole = (answer_frame(each, None, registrar) for each in (partial, seen))
    assert part.recognition.known is not True
    assert whole.recognition.known is not True and whole.recognition.signs.unseen > 0.3
    perfect = replace(part.registration, explained=1.0, method="rest")  # which of many states is met first is chance
    said, again = (answer_of(each, None, registrar, part.candidate, perfect).recognition for each in (partial, merged))
    assert said.known == "unsure" and said.reason == FEATURELESS
    assert again.known == "unsure" and again.reason == merged.doubt and "30% of the points lie behind" in again.reason
    refused = Recognition(False, "too small")
    assert refused.doubted(merged.doubt) is refused and said.doubted(None) is said


def test_only_a_patch_is_explained_by_a_patch() -> None:
    smooth = patch(0.05)
    points = patch(0.0).points
    rough = points + [0.0, 0.0, 1.0] * np.where(np.abs(points[:, :1]) < 0.5, 0.4, 0.0)
    assert Evidence.of(smooth.points).patch_share(0.01) == 1.0
    assert Evidence.of(rough).patch_share(0.1) < 0.8


def test_states_are_as_unusual_as_those_bent_farther_are_rare(model: StatisticalModel) -> None:
    z = model.library[np.argsort((model.library**2).mean(axis=1))].astype(np.float64)
    share = [model.unusual(z[round(quantile * len(z))]) for quantile in (0.025, 0.5, 0.975)]
    assert share == pytest.approx([-1.96, 0.0, 1.96], abs=0.15)
    assert model.unusual(2.0 * z[-1]) > model.unusual(1.1 * z[-1]) > model.unusual(z[-1]) > 2.0
    assert replace(model, library=model.library[:1]).unusual(10.0 * z[-1]) == 0.0  # one state tells nothing


def test_signs_add_up() -> None:
    """What is not known takes nothing off, and a state that is more usual than most adds nothing."""
    one, other = Signs(unusual=1.0), Signs(ruled_out=0.03, unexplained=0.5)
    both = Signs(unusual=1.0, ruled_out=0.03, unexplained=0.5)
    assert both.nats == pytest.approx(one.nats + other.nats - FIT) and one.nats > 0 > both.nats
    assert Signs().nats == FIT == Signs(unusual=-2.0).nats
