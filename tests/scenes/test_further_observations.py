"""Further observations: the same example seen by other sensors, with its own cloud and queries untouched."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from folder_contents import contents, read_json
from safetensors.numpy import load_file
from toy_data import SMALL, make_small_datasets, small_shards
from toy_scene import toy_scene

from mereo.api.generate import generate
from mereo.geometry.surface_patches import without_strays
from mereo.scenes.seeds import example_rng
from mereo.synthesis import examples
from mereo.synthesis.config import OBSERVATIONS, SENSORS, GenerateConfig
from mereo.synthesis.depth_sensor import SimulatedView, observe
from mereo.synthesis.examples import Example, synthesize
from mereo_learning.shards import example_bytes, pack

__all__ = ["small_shards"]  # a fixture

SEEN = replace(SMALL, observations=("all",))
TOY = toy_scene()
SEED, EXAMPLES = 3, 5

Folders = tuple[Path, Path]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """The same examples without and with further observations."""
    with pytest.MonkeyPatch.context() as patch:
        make_small_datasets(patch)
        folder = tmp_path_factory.mktemp("observed")
        for name, settings in (("plain", SMALL), ("seen", SEEN)):
            generate(TOY, folder / name, settings, examples=EXAMPLES, seed=SEED)
    return folder / "plain", folder / "seen"


def example(settings: GenerateConfig, index: int = 0) -> Example:
    return synthesize(TOY, settings, example_rng(SEED, index))


def test_all_are_those_that_differ_from_the_examples_own_sensor_and_an_unknown_one_is_answered_with_these() -> None:
    assert not SMALL.further
    assert SEEN.further == {name: sensor for name, sensor in OBSERVATIONS.items() if name != "paper"}
    other = replace(SEEN, sensor=SENSORS["structured-light"]).further
    assert set(other) == set(OBSERVATIONS) - {"structured-light"}
    assert list(replace(SMALL, observations=("tool", "paper", "tool")).further) == ["tool", "paper"]
    settings = GenerateConfig()
    object.__setattr__(settings, "observations", ("tool", "lidar"))  # which the type checker of the tests would refuse
    with pytest.raises(ValueError, match="observations has 'lidar'; known are paper, .*mask and all: name some"):
        settings.__post_init__()


def test_state_first_cloud_and_queries_are_those_without_and_the_manifest_has_sensors(data: Folders) -> None:
    for shard in data[0].glob("shard-*"):
        plain, seen = (load_file(directory / shard.name) for directory in data)
        assert seen.keys() - plain.keys() == {"seen", "seen_count"}
        assert all(seen[key].tobytes() == value.tobytes() for key, value in plain.items())
    plain, seen = (read_json(directory / "manifest.json")["settings"] for directory in data)
    assert not plain.keys() & {"observations", "sensors"} and seen["observations"] == list(SEEN.further)
    assert seen["sensors"] == {name: asdict(sensor) for name, sensor in SEEN.further.items()}


def test_an_observation_is_the_same_whichever_others_there_are_and_its_size_is_known_beforehand() -> None:
    every, alone = example(SEEN).observations, example(replace(SMALL, observations=("tool",))).observations
    assert np.array_equal(every[list(SEEN.further).index("tool")], alone[0])
    for settings in (SMALL, SEEN):
        size = sum(value.nbytes for value in pack(example(settings), settings.points).values())
        assert size == example_bytes(settings, len(TOY.rest.segments))


def test_resuming_needs_the_same_observations(data: Folders) -> None:
    before = [contents(directory) for directory in data]
    for directory, right, wrong in zip(data, (SMALL, SEEN), (SEEN, SMALL), strict=True):
        generate(TOY, directory, right, examples=EXAMPLES, seed=SEED, resume=True)
        with pytest.raises(ValueError, match=r"was made with settings\.observations = \[.*resuming needs equal"):
            generate(TOY, directory, wrong, examples=EXAMPLES, seed=SEED, resume=True)
    assert [contents(directory) for directory in data] == before


def test_half_precision_moves_no_point_by_more_than_its_noise(data: Folders) -> None:
    found = example(SEEN, 0)
    stored = load_file(data[1] / "shard-00000.safetensors")
    for number, cloud in enumerate(found.observations):
        assert stored["seen_count"][0, number] == len(cloud)
        off = stored["seen"][0, number, : len(cloud)].astype(float) - cloud
        near = np.abs(cloud).max(axis=1) < 2
        assert near.mean() > 0.8 and np.abs(off[near]).max() / found.normalizer.scale < 0.2 * SMALL.noise_std


def test_one_that_hardly_sees_the_object_is_the_first_cloud(monkeypatch: pytest.MonkeyPatch) -> None:
    views = []

    def blind(*arguments: object) -> SimulatedView:
        view = observe(*arguments)  # type: ignore[arg-type]
        views.append(view)
        if len(views) == 1:  # the example's own
            return view
        return replace(view, mask=view.mask & (view.mask.cumsum().reshape(view.mask.shape) < 20))

    monkeypatch.setattr(examples, "observe", blind)
    found = example(SEEN)
    assert all(np.array_equal(cloud, found.cloud) for cloud in found.observations)


def test_an_observation_keeps_its_strays_or_loses_those_found_or_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = replace(SMALL, image_size=96, points=4096, observations=("mask",))

    def clouds(uncleaned: float, by_rule: float) -> list[np.ndarray]:
        monkeypatch.setattr(examples, "UNCLEANED", uncleaned)
        monkeypatch.setattr(examples, "BY_RULE", by_rule)
        found = [example(settings, index) for index in range(4)]
        return [item.normalizer.invert(item.observations[0]) for item in found]

    whole, by_rule, right = clouds(1.0, 0.0), clouds(0.0, 1.0), clouds(0.0, 0.0)
    assert [len(cloud) for cloud in by_rule] == [int(without_strays(cloud).sum()) for cloud in whole]
    assert sum(map(len, by_rule)) < sum(map(len, whole)) and sum(map(len, right)) < sum(map(len, whole))
    for cloud, seen in zip(right, whole, strict=True):
        assert (np.abs(seen[:, None] - cloud).max(axis=2).min(axis=0) < 1e-9).all(), "points of the same cloud"
    sides = [max(np.ptp(cloud, axis=0).max() for cloud in clouds) for clouds in (right, whole)]
    assert sides[0] < sides[1], "the background is far behind"
