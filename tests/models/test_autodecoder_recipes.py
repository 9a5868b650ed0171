"""Recipes of the autodecoder: the paper's, and the small one that learns within minutes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from toy_data import read_all

from mereo.api.generate import generate
from mereo.evaluation.metrics import confusion_matrix, intersection_over_union
from mereo.models.config import AutodecoderConfig
from mereo.models.encoders import Encoding
from mereo.models.network import Network
from mereo.synthesis.config import GenerateConfig
from mereo.training.config import PRESETS, AugmentConfig, TrainConfig
from mereo.training.dataset import Dataset
from mereo.training.run_directory import start_network
from mereo.training.trainer import train


def test_the_papers_recipe() -> None:
    recipe, paper = PRESETS["paper-autodecoder"], PRESETS["paper"]
    assert (recipe.batch, recipe.learning_rate, recipe.code_rate, recipe.epochs) == (64, 5e-4, 1e-3, 1000)
    assert recipe.network.decoder.dropout == 0.2 and recipe.network.autodecoder == AutodecoderConfig(75, 1e-3)
    network = recipe.network.changed(encoder="pointnet2", dropout=0.0)
    assert replace(recipe, batch=40, epochs=300.0, network=network) == paper


def test_the_small_recipe_adds_nothing_to_the_papers_network() -> None:
    """Rates, passes, widths and frequencies differ; what an observed cloud tells only the search knows."""
    small = PRESETS["tiny-autodecoder"]
    added = small.network.additions
    assert not (added.local_neighbors or added.sight_neighbors or added.align_points or added.rest_template)
    assert small.augment == AugmentConfig() and small.loss == "ce+l1" and small.network.autodecoder.search_steps == 75
    assert small.network.decoder == replace(PRESETS["tiny"].network.decoder, highest_exponent=1)


@pytest.mark.slow
def test_the_small_recipe_learns_what_the_published_one_has_not_begun_with(tmp_path: Path) -> None:
    """Sixteen ropes, each met 200 times: are they in their codes?"""
    folder = tmp_path / "data"
    generate("rope", folder, GenerateConfig(), examples=16, seed=710_000, workers=1)
    data = Dataset.load(folder)
    stored = read_all(data)
    paper = PRESETS["paper-autodecoder"]
    published = replace(paper, network=paper.network.changed(width=128, mlp_global=(128, 256), points=256), queries=64)
    found = []
    for name, recipe in (("small", PRESETS["tiny-autodecoder"]), ("published", published)):
        config = replace(recipe, epochs=200, batch=16, holdout=0, precision="float32", compile="off")
        train(folder, tmp_path / name, config)
        network = trained_with_codes(tmp_path / name, data, config)
        code = network.decoder.prepare(Encoding(network.encoder.codes.detach(), ()), stored.cloud, stored.viewpoint)
        with torch.inference_mode():
            guess = network.query(code, stored.positions).logits.argmax(dim=-1)
        matrix = confusion_matrix(stored.labels.numpy(), guess.numpy(), network.segments + 1)
        found.append(intersection_over_union(matrix, True).iou)
    assert found[0] > 0.5 > 0.1 > found[1]


def trained_with_codes(run: Path, data: Dataset, config: TrainConfig) -> Network:
    """The averaged network of a run, codes of its examples included, which weights do not hold."""
    state = load_file(run / "checkpoint.safetensors")
    network = start_network(config, data).eval().requires_grad_(False)
    average = {name.removeprefix("average/"): value for name, value in state.items() if name.startswith("average/")}
    network.load_state_dict(average)
    return network
