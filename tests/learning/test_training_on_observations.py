"""Training on further observations: which one a step sees, and what a run says about it."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from observed_views import observed, rng
from small_training import SMALL
from toy_data import read_all, write_toy_dataset

from mereo.models.weights import load_model
from mereo_learning import trainer
from mereo_learning.config import PRESETS, AugmentConfig
from mereo_learning.dataset import Batch, Dataset, draw_observations
from mereo_learning.metrics_log import FIELDS, SENSOR_FIELDS
from mereo_learning.run_directory import fit_config
from mereo_learning.validation import choose_offsets, held_out, validate

pytestmark = pytest.mark.usefixtures("without_curves")

KINDS = 3
FIRST = torch.zeros(8, dtype=torch.long)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same examples without and with further observations."""
    folder = tmp_path_factory.mktemp("toy")
    seen = write_toy_dataset(folder / "seen", example=observed)
    return write_toy_dataset(folder / "plain"), seen


@pytest.fixture(scope="module")
def data(folders: tuple[Path, Path]) -> tuple[Dataset, Dataset]:
    return Dataset.load(folders[0]), Dataset.load(folders[1])


def batch(data: Dataset, probability: float, observation: torch.Tensor | None = None, seed: int = 0) -> Batch:
    augment = AugmentConfig(observations=probability, keep_points=(0.7, 1.0), jitter_std=0.003)
    return data.batch(torch.arange(8), 48, 32, augment, rng(seed), observation)


def assert_same(one: Batch, other: Batch) -> None:
    for name in ("cloud", "viewpoint", "positions", "labels", "distances", "directions"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_a_batch_depends_on_its_generator_alone_and_with_probability_0_on_no_further_one(
    data: tuple[Dataset, Dataset],
) -> None:
    plain, seen = data
    assert (plain.further, seen.further) == (0, KINDS)
    for seed in range(3):
        assert_same(batch(seen, 0.0, seed=seed), batch(plain, 0.5, seed=seed))
    assert_same(batch(seen, 1.0, FIRST), batch(plain, 1.0))
    assert_same(batch(data[1], 0.5, seed=4), batch(data[1], 0.5, seed=4))
    assert not torch.equal(batch(data[1], 0.5, seed=4).cloud, batch(data[1], 0.5, seed=5).cloud)


def test_further_ones_are_seen_as_often_as_asked_and_by_default_in_half_of_the_draws() -> None:
    drawn = draw_observations(300, KINDS, 1.0, rng())
    assert set(drawn.tolist()) == {1, 2, 3} and torch.bincount(drawn)[1:].min() > 70
    counts = torch.bincount(draw_observations(3000, KINDS, AugmentConfig().observations, rng()))
    assert abs(counts[0] / 3000 - 0.5) < 0.05 and counts[1:].min() > 400


@pytest.mark.parametrize("number", [1, 2, 3])
def test_queries_and_cloud_stay_in_one_frame(data: tuple[Dataset, Dataset], number: int) -> None:
    """The box is normalized anew, so distances between queries, cloud and camera keep their ratios to the stored."""
    seen = read_all(data[1])
    found = data[1].batch(torch.arange(8), 96, 0, AugmentConfig(), rng(), FIRST + number)
    assert torch.allclose((found.cloud.amax(dim=1) - found.cloud.amin(dim=1)).amax(dim=1), torch.full((8,), 2.0))
    count = int(seen.seen_count[0, number - 1])
    stored = seen.seen[:8, number - 1, :count].float()
    scale = (found.positions[:, 0] - found.positions[:, 1]).norm(dim=-1) / (
        seen.positions[:8, 0] - seen.positions[:8, 1]
    ).norm(dim=-1)
    for now, then in (
        (found.positions[:, :5] - found.viewpoint[:, None], seen.positions[:8, :5] - seen.viewpoint[:8, None]),
        (found.cloud[:, :count] - found.viewpoint[:, None], stored - seen.viewpoint[:8, None]),
        (found.distances, seen.distances[:8]),
    ):
        assert torch.allclose(now, then * scale.view(-1, *[1] * (then.dim() - 1)), rtol=1e-4, atol=1e-3)


def test_a_run_scores_sensors_apart_and_says_what_it_saw(folders: tuple[Path, Path], tmp_path: Path) -> None:
    headers, models = [], []
    for folder in folders:
        run = tmp_path / folder.name
        models.append(load_model(trainer.train(folder, run, replace(SMALL, epochs=0.3))))
        with (run / "metrics.csv").open() as file:
            reader = csv.DictReader(file)
            rows = list(reader)
        headers.append(tuple(reader.fieldnames or ()))
        recipe = json.loads((run / "config.json").read_text())["train"]
        assert recipe["augment"].get("observations") == (0.5 if folder.name == "seen" else None)
    assert headers == [FIELDS, FIELDS + SENSOR_FIELDS]
    assert 0 <= float(rows[-1]["sensor_iou"]) <= 1 and 0 <= float(rows[-1]["sensor_miou"]) <= 1
    assert models[1].provenance["recipe"]["augment"]["observations"] == 0.5  # type: ignore[index]


def test_held_out_scores_and_offsets_are_of_the_first_cloud(data: tuple[Dataset, Dataset]) -> None:
    plain, seen = data
    config = fit_config(replace(SMALL, offset_examples=8), seen)
    network = trainer.start_network(config, seen)
    manifest = {**seen.manifest, "settings": {"sampling": {"per_segment": 32}}}
    plain, seen = (replace(item, manifest=manifest) for item in (plain, seen))
    assert validate(network, seen, config).iou == validate(network, plain, config).iou
    first, other = (choose_offsets(network, item, config) for item in (seen, plain))
    assert first is not None and other is not None and torch.equal(first, other)
    assert len(held_out(seen, config)) > KINDS
    assert validate(network, seen, config, further=True).iou != validate(network, seen, config).iou


def test_an_autodecoder_sees_every_example_as_it_is(data: tuple[Dataset, Dataset]) -> None:
    """Its codes are of examples, not of clouds."""
    assert fit_config(PRESETS["paper-autodecoder"], data[1]).augment.observations == 0.0
    assert fit_config(PRESETS["paper"], data[1]).augment.observations == 0.5
    assert fit_config(PRESETS["paper"], data[0]).augment.observations == 0.0
