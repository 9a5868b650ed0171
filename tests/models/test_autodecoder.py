"""The autodecoder: codes of training examples, the search for that of a new cloud, what it refuses, its recipes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from answers import reconstruct
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import Generator
from safetensors.torch import load_file
from shapes import ball
from toy_data import example_of, read_all, write_toy_dataset
from training_runs import assert_resumes_exactly

from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import truth_grid
from mereo.geometry.transforms import unit_rows
from mereo.models.config import AutodecoderConfig, NetworkConfig
from mereo.models.encoders import Autodecoder, Encoding
from mereo.models.model import Model
from mereo.models.weights import load_model
from mereo_learning import trainer, validation
from mereo_learning.cases import TestCase
from mereo_learning.config import PRESETS, AugmentConfig, TrainConfig
from mereo_learning.dataset import Dataset
from mereo_learning.run_directory import start_network
from mereo_learning.scoring import score_cases

pytestmark = pytest.mark.usefixtures("without_curves")

SMALL = TrainConfig(
    network=NetworkConfig()
    .changed(encoder="autodecoder", points=64, mlp_global=(32,), highest_exponent=1, search_rate=5e-3)
    .changed(width=64, depth=4, skip_after=2),
    code_rate=5e-3,
    batch=12,
    epochs=250,
    learning_rate=4e-3,
    l1_weight=10.0,
    learned_box=True,
    holdout=0,
    precision="float32",
    compile="off",
)


def ball_pair(rng: Generator, points: int, queries: int) -> dict[str, ndarray]:
    """Two touching balls seen from the front, the second of 0.3 to 1 times the radius of the first."""
    radii = np.array([1.0, rng.uniform(0.3, 1.0)])
    centers = np.array([[0.0, 0.0, 20.0], [radii.sum(), 0.0, 20.0]])
    front = unit_rows(rng.normal(size=(points, 3)))
    front[:, 2] = -np.abs(front[:, 2])
    which = rng.integers(0, 2, size=points)
    cloud = centers[which] + radii[which, None] * front
    places = rng.uniform([-1.4, -1.4, 18.6], [1.4 + 2 * radii[1], 1.4, 21.4], size=(queries, 3))
    to_center = centers - places[:, None]
    reach = norm(to_center, axis=2)
    rows = np.arange(queries)
    nearest = (reach - radii).argmin(axis=1)
    distance = (reach - radii)[rows, nearest]
    outward = np.where(distance < 0, -1, 1)[:, None]
    directions = outward * (to_center / reach[..., None])[rows, nearest]
    labels = np.where(distance < 0, nearest + 1, 0)
    rest = np.full((queries, 3), np.nan)
    return example_of(cloud, places, labels=labels, distances=distance, directions=directions, rest=rest)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("pairs") / "data", 12, 64, 192, ball_pair)


@pytest.fixture(scope="module")
def run(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("pairs") / "run"
    trainer.train(dataset, run, SMALL)
    return run


@pytest.fixture(scope="module")
def model(run: Path) -> Model:
    return load_model(run / "weights.safetensors")


@pytest.fixture(scope="module")
def data(dataset: Path) -> Dataset:
    return Dataset.load(dataset)


def seen(dataset: Path, number: int) -> ndarray:
    shard = load_file(dataset / "shard-00000.safetensors")
    return (shard["cloud"][number] / shard["scale"][number] + shard["center"][number]).double().numpy()


def truth(dataset: Path, number: int) -> SegmentedMesh:
    ratio = 0.5 * np.ptp(seen(dataset, number)[:, 0]) - 1.0  # the pair is 2 (1 + ratio) long
    return SegmentedMesh((ball((0, 0, 20), 1.0, "left"), ball((1 + ratio, 0, 20), ratio, "right", 1)))


# --- codes ------------------------------------------------------------------------------------------------------------


def test_a_code_found_from_the_cloud_explains_the_shape(run: Path, model: Model, data: Dataset) -> None:
    """From the visible half alone: far better than the mean code, short of the code trained with the whole shape."""
    network = model.network
    stored = read_all(data)
    latents = load_file(run / "checkpoint.safetensors")["network/encoder.codes"]
    encodings = (Encoding(latent, ()) for latent in (latents, latents.mean(dim=0).repeat(len(data), 1)))
    codes = [network.decoder.prepare(encoding, stored.cloud, stored.viewpoint) for encoding in encodings]
    codes.append(network.encode(stored.cloud, stored.viewpoint))
    with torch.inference_mode():
        answers = (network.query(code, stored.positions).distance for code in codes)
        trained, average, found = (float((answer - stored.distances).abs().mean()) for answer in answers)
    assert trained < 0.02 and trained < found < 0.8 * average


def test_the_search_is_deterministic_and_by_cloud(model: Model, data: Dataset) -> None:
    network = model.network
    stored = read_all(data)
    together = network.encode(stored.cloud, stored.viewpoint).latent1
    with torch.inference_mode():
        again = network.encode(stored.cloud.clone(), stored.viewpoint.clone()).latent1
        alone = network.encode(stored.cloud[3:4].clone(), stored.viewpoint[3:4].clone()).latent1
    assert torch.equal(together, again)
    assert torch.allclose(together[3:4], alone, atol=1e-2)  # 75 steps along signs let rounding grow
    assert not together.requires_grad and all(p.grad is None for p in network.parameters())
    assert (together[3] - together[4]).abs().max() > 0.1


def test_only_the_codes_of_a_batch_move_and_at_their_own_rate(dataset: Path, data: Dataset, tmp_path: Path) -> None:
    """Adam's first step moves every coordinate by the rate."""
    config = replace(SMALL, batch=5, code_rate=0.01, learning_rate=1e-5)
    network = start_network(config, data)
    loop = trainer.Trainer(config, data, network, tmp_path, trainer.Process(), torch.device("cpu"))
    before = network.encoder.codes.detach().clone()
    batch = next(loop.batches())
    loop.train_step(batch)
    moved = (network.encoder.codes.detach() - before).abs()
    assert torch.allclose(moved[batch.index], torch.tensor(0.01), rtol=1e-2)
    others = [i for i in range(12) if i not in batch.index.tolist()]
    assert len(others) == 7 and not moved[others].any()


def test_a_search_in_the_codes_spread_stays_among_codes_like_them() -> None:
    """Codes on a line: the axes have its length, every other direction none, and so nothing found leaves it."""
    encoder = Autodecoder(AutodecoderConfig(spread_penalty=1e-3, search_rate=0.1), latent=4)
    line, middle = torch.tensor([2.0, 0.0, 1.0, 0.0]), torch.tensor([0.5, 1.0, 0.0, -1.0])
    encoder.codes = torch.nn.Parameter(middle + torch.linspace(-1, 1, 21)[:, None] * line)
    encoder.update_distribution()
    assert torch.allclose(encoder.mean, middle, atol=1e-6)
    spread = torch.linspace(-1, 1, 21).std(correction=0) * line.norm()
    assert torch.allclose(encoder.axes.norm(dim=1).sort().values, torch.tensor([0.0, 0.0, 0.0, spread]), atol=1e-5)
    wish = middle + 0.5 * line + torch.tensor([0.0, 3.0, 0.0, 3.0])
    found = encoder.search(lambda code: code - wish, 2)
    assert torch.allclose(found, (middle + 0.5 * line).expand(2, 4), atol=0.1)
    assert torch.allclose(found[:, 1], torch.tensor(1.0)) and torch.allclose(found[:, 3], torch.tensor(-1.0))


# --- training ---------------------------------------------------------------------------------------------------------


def test_killed_and_resumed_equals_uninterrupted(dataset: Path, tmp_path: Path) -> None:
    config = replace(SMALL, batch=5, epochs=1.2, ema_decay=0.9, holdout=1)
    config = replace(config, network=config.network.changed(dropout=0.2, search_steps=3))
    assert_resumes_exactly(dataset, tmp_path, config, steps=2)


def test_the_curve_shows_a_few_held_out_examples(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "SEARCHED", 2)
    config = replace(SMALL, holdout=5)
    assert validation.held_out(data, config) == range(7, 9)
    assert validation.held_out(data, replace(config, network=NetworkConfig())) == range(7, 12)
    assert validation.held_out(data, replace(config, holdout=1)) == range(11, 12)


def test_what_cannot_train_an_autodecoder_is_refused(data: Dataset, dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the loss is 'ce', but an autodecoder finds the code .* take --loss l1, ce"):
        trainer.train(dataset, tmp_path / "run", replace(SMALL, loss="ce"))
    with pytest.raises(ValueError, match="one code per training example, and augmentation .* train without"):
        trainer.train(dataset, tmp_path / "run", replace(SMALL, augment=AugmentConfig(roll=True)))
    with pytest.raises(ValueError, match="local_neighbors is 6, but an autodecoder has no features .*-neighbors 0"):
        trainer.train(dataset, tmp_path / "run", replace(SMALL, network=SMALL.network.changed(local_neighbors=6)))
    assert not (tmp_path / "run").exists()


# --- the whole path ---------------------------------------------------------------------------------------------------


def test_reconstruct_and_evaluate(dataset: Path, model: Model) -> None:
    case = TestCase("pair", PointCloud(seen(dataset, 2)), truth_grid(truth(dataset, 2), 24))
    scores = score_cases(model, lambda _: case, 1, progress=False).scores
    assert scores.iou > 0.6 and scores.miou > 0.55
    found = reconstruct(case.cloud, model, resolution=24)
    assert [segment.name for segment in found.segments] == ["left", "right"]
    for segment, true in zip(found.segments, truth(dataset, 2).segments, strict=True):
        assert norm(segment.centroid - true.vertices.mean(axis=0)) < 0.25
    assert 0 < found.segments[1].volume < 0.5 * found.segments[0].volume


# --- recipes ----------------------------------------------------------------------------------------------------------


def test_the_papers_recipe_and_the_small_one_which_adds_nothing_to_its_network() -> None:
    """Rates, passes, widths and frequencies differ; what an observed cloud tells only the search knows."""
    recipe, paper = PRESETS["paper-autodecoder"], PRESETS["paper"]
    assert (recipe.batch, recipe.learning_rate, recipe.code_rate, recipe.epochs) == (64, 5e-4, 1e-3, 1000)
    assert recipe.network.decoder.dropout == 0.2 and recipe.network.autodecoder == AutodecoderConfig(75, 1e-3)
    network = recipe.network.changed(encoder="pointnet2", dropout=0.0)
    assert replace(recipe, batch=40, epochs=300.0, network=network) == paper
    small = PRESETS["tiny-autodecoder"]
    added = small.network.additions
    assert not (added.local_neighbors or added.sight_neighbors or added.align_points or added.rest_template)
    assert small.augment == AugmentConfig() and small.loss == "ce+l1" and small.network.autodecoder.search_steps == 75
    assert small.network.decoder == replace(PRESETS["tiny"].network.decoder, highest_exponent=1)
