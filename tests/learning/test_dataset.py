"""Batches depend on their generator alone; augmentation moves all together; further observations and their training."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import read_json
from numpy.random import Generator
from safetensors.torch import load_file
from small_training import SMALL
from torch import Tensor
from toy_data import half_balls, read_all, write_toy_dataset

from mereo.models.weights import load_model
from mereo_learning import trainer
from mereo_learning.config import PRESETS, AugmentConfig
from mereo_learning.dataset import (
    Batch,
    Dataset,
    Draws,
    augment_batch,
    choose_points,
    draw_observations,
    shuffled_index,
)
from mereo_learning.metrics_log import FIELDS, SENSOR_FIELDS
from mereo_learning.run_directory import fit_config
from mereo_learning.validation import choose_offsets, held_out, validate

pytestmark = pytest.mark.usefixtures("without_curves")

Datasets = tuple[Dataset, Dataset]

NONE = AugmentConfig()
FULL = AugmentConfig(keep_points=(0.4, 0.9), hole_probability=1.0, jitter_std=0.01, roll=True)


@pytest.fixture(scope="module")
def data(pair: Datasets) -> Dataset:
    return pair[0]


def test_the_size_of_what_is_seen_is_known_where_the_unit_is(tmp_path: Path) -> None:
    """Half balls of radius 5 to 10 are 10 to 20 wide, seen by points that nearly reach the rim."""
    directory = write_toy_dataset(tmp_path / "data")
    assert Dataset.load(directory).visible_m is None
    manifest = read_json(directory / "manifest.json")
    (directory / "manifest.json").write_text(json.dumps({**manifest, "unit_m": 0.01}))
    visible_m = Dataset.load(directory).visible_m
    assert visible_m is not None
    assert visible_m == (pytest.approx(0.1, rel=0.1), pytest.approx(0.2, rel=0.1))


def observed(generator: Generator, points: int, queries: int) -> dict[str, np.ndarray]:
    """Half balls, and three halves of their cloud, of which the last has fewer points."""
    row = half_balls(generator, points, queries)
    cloud = row["cloud"]
    half = points // 2
    parts = [cloud[:half], cloud[-half:], cloud[10:40]]
    seen = np.stack([part[np.arange(points) % len(part)] for part in parts]).astype(np.float16)
    return row | {"seen": seen, "seen_count": np.array([len(part) for part in parts], np.int32)}


def test_without_augmentation_a_batch_is_the_stored_data(data: Dataset) -> None:
    batch = data.batch(torch.arange(4), 96, 0, NONE, Draws.of(0))
    stored = data.read(torch.arange(4))
    assert torch.allclose(batch.cloud, stored["cloud"], atol=1e-5)
    assert torch.allclose(batch.positions, stored["positions"], atol=1e-5)
    viewpoint = -stored["center"] * stored["scale"][:, None]
    assert torch.allclose(batch.viewpoint, viewpoint.float(), atol=1e-4)
    assert torch.equal(batch.labels, stored["labels"].long())


def test_examples_are_read_in_any_order_from_shards_of_other_sizes(tmp_path: Path) -> None:
    directory = write_toy_dataset(tmp_path / "data", examples=70, example=observed)
    files = [load_file(path) for path in sorted(directory.glob("shard-*"))]
    index = torch.tensor([69, 0, 33, 31, 32, 5])
    for name, values in Dataset.load(directory).read(index).items():
        assert torch.equal(values.nan_to_num(), torch.cat([file[name] for file in files])[index].nan_to_num()), name


def test_a_shuffled_order_is_one_pass_after_another() -> None:
    seen = torch.cat([shuffled_index(step, 10, 4, 0) for step in range(5)])
    assert torch.equal(seen[:10].sort().values, torch.arange(10)) and torch.equal(seen.bincount(), torch.full((10,), 2))
    assert not torch.equal(seen[:10], seen[10:])
    assert torch.equal(shuffled_index(3, 10, 4, 0), seen[12:16]), "by the step alone"


def test_a_share_of_a_batch_meets_the_changes_of_the_whole(data: Dataset) -> None:
    index = torch.arange(12)
    whole = data.batch(index, 48, 32, FULL, Draws.of(5))
    for rows in (slice(0, 4), slice(4, 12)):
        share = data.batch(index[rows], 48, 32, FULL, Draws.of(5, 12, rows))
        assert torch.allclose(share.cloud, whole.cloud[rows], atol=1e-6)
        assert torch.equal(share.labels, whole.labels[rows]) and torch.equal(share.index, index[rows])


def test_query_subset_keeps_labels_with_positions(data: Dataset) -> None:
    index = torch.tensor([2, 5])
    batch = data.batch(index, 96, 16, NONE, Draws.of(0))
    stored = data.read(index)
    assert batch.positions.shape == (2, 16, 3)
    match = torch.cdist(batch.positions, stored["positions"]).argmin(dim=2)
    assert torch.equal(stored["labels"].long().gather(1, match), batch.labels)


def test_augmented_cloud_fills_the_unit_box_and_camera_stays_in_front(data: Dataset) -> None:
    batch = data.batch(torch.arange(16), 64, 0, FULL, Draws.of(0))
    extent = batch.cloud.amax(dim=1) - batch.cloud.amin(dim=1)
    assert torch.allclose(extent.amax(dim=1), torch.full((16,), 2.0), atol=1e-4)
    assert (batch.viewpoint[:, 2] < batch.cloud[..., 2].amin(dim=1)).all()


def test_roll_is_a_rigid_motion_about_the_optical_axis(data: Dataset) -> None:
    plain = data.batch(torch.arange(6), 96, 0, NONE, Draws.of(0))
    rolled = augment_batch(plain, AugmentConfig(roll=True), Draws.of(1))

    def gaps(batch: Batch) -> Tensor:
        everything = torch.cat([batch.positions[:, :20], batch.cloud[:, :20], batch.viewpoint[:, None]], dim=1).double()
        distances = torch.cdist(everything, everything)
        return distances / distances.amax(dim=(1, 2), keepdim=True)

    assert torch.allclose(gaps(plain), gaps(rolled), atol=1e-5)
    assert torch.equal(plain.positions[..., 2].argsort(dim=1), rolled.positions[..., 2].argsort(dim=1))
    assert not torch.allclose(plain.positions, rolled.positions, atol=0.1)
    one, other = (
        torch.cdist(b.positions + b.distances.abs()[..., None] * b.directions, b.cloud)
        / b.distances.abs().amax(dim=1)[:, None, None]
        for b in (plain, rolled)
    )
    assert torch.allclose(one, other, rtol=2e-2, atol=2e-2)


def test_padding_is_chosen_last_and_a_small_cloud_survives_any_hole() -> None:
    cloud = torch.arange(10.0)[None, :, None].repeat(1, 1, 3)
    chosen = choose_points(cloud, torch.tensor([7]), 10, NONE, Draws.of(0))
    assert chosen[0, :, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 0, 1, 2]
    cloud = torch.arange(200.0)[None, :, None].repeat(1, 1, 3)
    kept = choose_points(cloud, torch.tensor([200]), 200, AugmentConfig(keep_points=(0.5, 0.5)), Draws.of(0))[0, :, 0]
    assert 70 < len(kept.unique()) < 130 and (kept[:70].diff() > 0).all(), "in order, and half of them dropped"
    assert kept.max() > 190, "anywhere, not at the end"
    cloud = torch.zeros(1, 40, 3)
    huge = AugmentConfig(hole_probability=1.0, hole_radius=1e6)
    assert choose_points(cloud, torch.tensor([40]), 40, huge, Draws.of(0)).shape == (1, 40, 3)


def test_domain_holds_every_segment_point_with_a_margin(data: Dataset) -> None:
    low, high = (torch.tensor(corner) for corner in data.domain)
    stored = data.read(torch.arange(len(data)))
    occupied = stored["positions"][stored["labels"] > 0]
    extent = occupied.amax(dim=0) - occupied.amin(dim=0)
    assert torch.allclose(occupied.amin(dim=0) - low, 0.15 * extent, atol=1e-5)
    assert torch.allclose(high - occupied.amax(dim=0), 0.15 * extent, atol=1e-5)


# --- further observations ---------------------------------------------------------------------------------------------


KINDS = 3
FIRST = torch.zeros(8, dtype=torch.long)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same examples without and with further observations."""
    folder = tmp_path_factory.mktemp("toy")
    seen = write_toy_dataset(folder / "seen", example=observed)
    return write_toy_dataset(folder / "plain"), seen


@pytest.fixture(scope="module")
def pair(folders: tuple[Path, Path]) -> Datasets:
    return Dataset.load(folders[0]), Dataset.load(folders[1])


def batch_of(data: Dataset, probability: float, observation: Tensor | None = None, seed: int = 0) -> Batch:
    augment = AugmentConfig(observations=probability, keep_points=(0.7, 1.0), jitter_std=0.003)
    return data.batch(torch.arange(8), 48, 32, augment, Draws.of(seed), observation)


def test_a_batch_depends_on_its_generator_and_at_probability_0_on_no_further_one(pair: Datasets) -> None:
    plain, seen = pair
    assert (plain.further, seen.further) == (0, KINDS)
    same = [(batch_of(seen, 0.0, seed=seed), batch_of(plain, 0.5, seed=seed)) for seed in range(3)]
    same.append((batch_of(seen, 1.0, FIRST), batch_of(plain, 1.0)))
    for one, other in (*same, (batch_of(seen, 0.5, seed=4), batch_of(seen, 0.5, seed=4))):
        for name in ("cloud", "viewpoint", "positions", "labels", "distances", "directions"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert not torch.equal(batch_of(seen, 0.5, seed=4).cloud, batch_of(seen, 0.5, seed=5).cloud)


def test_further_ones_are_seen_as_often_as_asked_and_by_default_in_half_of_the_draws() -> None:
    drawn = draw_observations(300, KINDS, 1.0, Draws.of(0))
    assert set(drawn.tolist()) == {1, 2, 3} and torch.bincount(drawn)[1:].min() > 70
    counts = torch.bincount(draw_observations(3000, KINDS, AugmentConfig().observations, Draws.of(0)))
    assert abs(counts[0] / 3000 - 0.5) < 0.05 and counts[1:].min() > 400


@pytest.mark.parametrize("number", [1, 2, 3])
def test_queries_and_cloud_stay_in_one_frame(pair: Datasets, number: int) -> None:
    """The box is normalized anew, so distances between queries, cloud and camera keep their ratios to the stored."""
    seen = read_all(pair[1])
    found = pair[1].batch(torch.arange(8), 96, 0, AugmentConfig(), Draws.of(0), FIRST + number)
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
        recipe = read_json(run / "config.json")["train"]
        assert recipe["augment"].get("observations") == (0.5 if folder.name == "seen" else None)
    assert headers == [FIELDS, FIELDS + SENSOR_FIELDS]
    assert 0 <= float(rows[-1]["sensor_iou"]) <= 1 and 0 <= float(rows[-1]["sensor_miou"]) <= 1
    assert models[1].provenance["recipe"]["augment"]["observations"] == 0.5  # type: ignore[index]


def test_held_out_scores_and_offsets_are_of_the_first_cloud(pair: Datasets) -> None:
    plain, seen = pair
    config = fit_config(replace(SMALL, offset_examples=8), seen)
    network = trainer.start_network(config, seen)
    manifest = {**seen.manifest, "settings": {"sampling": {"per_segment": 32}}}
    plain, seen = (replace(item, manifest=manifest) for item in (plain, seen))
    assert validate(network, seen, config).iou == validate(network, plain, config).iou
    first, other = (choose_offsets(network, item, config) for item in (seen, plain))
    assert first is not None and other is not None and torch.equal(first, other)
    assert len(held_out(seen, config)) > KINDS
    assert validate(network, seen, config, further=True).iou != validate(network, seen, config).iou


def test_an_autodecoder_sees_every_example_as_it_is(pair: Datasets) -> None:
    """Its codes are of examples, not of clouds."""
    for preset, data, share in (("paper-autodecoder", pair[1], 0.0), ("paper", pair[1], 0.5), ("paper", pair[0], 0.0)):
        assert fit_config(PRESETS[preset], data).augment.observations == share
