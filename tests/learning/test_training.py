"""Training: it learns, and stopping, resuming or sharing the work changes nothing, or says why it cannot go on."""

import csv
import errno
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_contents import read_json
from numpy.random import default_rng
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_training import SMALL, TRANSFORMER
from torch import Tensor
from toy_data import NAMES, write_toy_dataset
from training_runs import diverge_at, kill_after
from two_balls import front

from mereo import __main__ as command_line
from mereo.geometry.conventions import Texts
from mereo.geometry.metrics import confusion_matrix, intersection_over_union
from mereo.models.weights import load_model
from mereo_learning import metrics_log, trainer
from mereo_learning.config import PRESETS, AugmentConfig, TrainConfig
from mereo_learning.dataset import Dataset
from mereo_learning.run_directory import claim_run, describe_seen, seen_by, seen_in_training, start_network
from mereo_learning.validation import class_offsets

BRIEF = replace(SMALL, epochs=0.6)  # five steps
DRAW = metrics_log.draw_curves


@pytest.fixture(scope="module", autouse=True)
def _quick_curves() -> Iterator[None]:
    """Curves that tell of how many rows they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics_log, "draw_curves", lambda rows, path: path.write_bytes(b"row " * len(rows)))
        yield


def last_row(run: Path) -> Texts:
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))[-1]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("toy") / "data")


@pytest.fixture(scope="module")
def finished(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has ended; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics_log, "draw_curves", DRAW)
        return trainer.train(dataset, tmp_path_factory.mktemp("finished") / "run", SMALL).parent


@pytest.fixture(scope="module")
def first(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trainer.train(dataset, tmp_path_factory.mktemp("first") / "run", replace(SMALL, epochs=0.2))


def test_a_finished_run_is_left_alone_and_not_continued_with_other_settings(dataset: Path, finished: Path) -> None:
    first = (finished / "weights.safetensors").read_bytes()
    assert trainer.train(dataset, finished, SMALL).read_bytes() == first
    with pytest.raises(ValueError, match=r"another train setting learning_rate \(0\.004 instead of 0\.1\)"):
        trainer.train(dataset, finished, replace(SMALL, learning_rate=0.1))


def test_run_directory_tells_the_story(finished: Path) -> None:
    rows = [row.split(",")[0] for row in (finished / "metrics.csv").read_text().splitlines()]
    assert rows == ["step", *map(str, range(1, 16))]  # 58 examples, batches of 8, two passes
    assert 0 <= float(last_row(finished)["val_iou"]) <= 1
    assert read_json(finished / "config.json")["train"]["batch"] == 8
    assert (finished / "curves.png").read_bytes().startswith(b"\x89PNG")
    model = load_model(finished / "weights.safetensors")
    assert model.names == NAMES
    assert model.provenance["training_seed"] == 5 and model.provenance["scene"] == "toy"
    assert model.provenance["visible_m"] is None, "the dataset states no unit"


def test_class_offsets_are_in_the_last_bias_and_nowhere_else(finished: Path) -> None:
    weights = load_model(finished / "weights.safetensors")
    offsets = weights.provenance["class_offsets"]
    assert isinstance(offsets, list) and len(offsets) == 3 and offsets[0] == 0
    average = load_file(finished / "checkpoint.safetensors")
    for name, value in weights.network.state_dict().items():
        expected = average[f"average/{name}"].clone()
        if name == "decoder.head.bias":
            expected[:3] += torch.tensor(offsets)
        assert torch.equal(value, expected), name


@pytest.mark.parametrize(
    "config, iou, miou", [(SMALL, 0.85, 0.75), pytest.param(TRANSFORMER, 0.7, 0.7, marks=pytest.mark.slow)]
)
def test_it_learns_the_two_halves(dataset: Path, tmp_path: Path, config: TrainConfig, iou: float, miou: float) -> None:
    """Twenty-four passes over 58 examples suffice to beat any constant answer by far."""
    trainer.train(dataset, tmp_path / "run", replace(config, epochs=24, augment=AugmentConfig()))
    last = last_row(tmp_path / "run")
    assert float(last["val_iou"]) > iou and float(last["val_miou"]) > miou
    assert config is TRANSFORMER or float(last["rest"]) < 0.2
    model = load_model(tmp_path / "run" / "weights.safetensors")
    center = np.array([3.0, -2.0, 150.0])
    cloud = front((3.0, -2.0, 150.0), 8.0, -1.0, 300)
    answer = model.query(model.encode(cloud), center + np.array([[-4.0, 0, 0], [4.0, 0, 0], [0, 0, 20.0]]))
    assert answer.label.tolist() == [1, 2, 0]
    assert np.allclose(answer.probability.sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("loss", ["ce", "l1", "ce+l1", "ce+l1+cd"])
def test_every_loss_variant_trains_and_answers(dataset: Path, tmp_path: Path, loss: str) -> None:
    config = replace(SMALL, loss=loss, epochs=0.2)  # type: ignore[arg-type]
    model = load_model(trainer.train(dataset, tmp_path / "run", config))
    last = last_row(tmp_path / "run")
    assert (last["ce"] == "", last["val_miou"] == "") == (loss == "l1", loss == "l1") and last["val_iou"]
    cloud = default_rng(0).normal(loc=(0.0, 0.0, 50.0), size=(80, 3))
    answer = model.query(model.encode(cloud), cloud[:7])
    assert answer.label.shape == (7,) and answer.probability.shape[1] == (2 if loss == "l1" else 3)
    # what was not trained is not answered
    assert np.isfinite(answer.distance).all() == ("l1" in loss) != np.isnan(answer.distance).all()
    assert np.isfinite(answer.direction).all() == ("cd" in loss) != np.isnan(answer.direction).all()


def test_training_starts_from_given_weights(dataset: Path, first: Path, tmp_path: Path) -> None:
    data = Dataset.load(dataset)
    config = replace(SMALL, init=str(first))
    other_counts = config.network.changed(points=48, neighbors=6)  # the same weights fit
    for settings in (config.network, other_counts):
        network = start_network(replace(config, network=settings), data)
        assert network.config == settings
        assert all(torch.equal(value, load_file(first)[key]) for key, value in network.state_dict().items())
    for changed in ({"sight_neighbors": 0}, {"width": 32}):
        with pytest.raises(ValueError, match=f"another network setting {next(iter(changed))}"):
            start_network(replace(config, network=config.network.changed(**changed)), data)
    with pytest.raises(FileNotFoundError, match="no weights 'lost'"):
        trainer.train(dataset, tmp_path / "second", replace(config, init="lost"))
    assert not (tmp_path / "second").exists()


def test_training_starts_from_another_objects_weights(dataset: Path, first: Path) -> None:
    data = Dataset.load(dataset)
    manifest = data.manifest | {"segments": [{"name": "whole", "color": [1, 2, 3]}]}
    data = replace(data, manifest=manifest, template=torch.rand(1, 64, 64, 64))
    given = load_file(first)
    random, started = (start_network(replace(SMALL, init=init), data).state_dict() for init in ("", str(first)))
    taken = {name for name in started if not torch.equal(started[name], random[name])}
    untouched = {name for name in given if "decoder.lookup" in name}
    assert all(torch.equal(started[name], random[name]) for name in untouched)
    head = started["decoder.head.weight"]
    assert torch.equal(head[[0, 2, 3, 4, 5]], given["decoder.head.weight"][[0, 3, 4, 5, 6]])
    assert torch.equal(head[1], random["decoder.head.weight"][1])
    same = taken - {"decoder.head.weight", "decoder.head.bias"}
    assert len(same) > 40 and all(torch.equal(started[name], given[name]) for name in same)


def test_only_the_first_process_claims_a_folder(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that comes while the first one writes the settings waits instead of refusing the directory."""
    data = Dataset.load(dataset)
    waited = []
    with pytest.raises(ValueError, match="batch of 8 cannot be shared by 3 processes"):
        claim_run(tmp_path / "run", SMALL, data, trainer.Process(0, 3))
    monkeypatch.setattr(torch.distributed, "get_backend", lambda: "gloo")
    monkeypatch.setattr(torch.distributed, "broadcast", lambda failed, src: waited.append(src))
    run = tmp_path / "run"
    run.mkdir()
    (run / "metrics.csv").touch()  # of a directory without settings, as it is while the first one writes them
    claim_run(run, SMALL, data, trainer.Process(1, 2))
    assert waited == [0] and not (run / "config.json").exists()
    with pytest.raises(FileExistsError, match=r"holds no config\.json"):
        claim_run(run, SMALL, data, trainer.Process(0, 2))


def test_paper_preset_is_the_papers_recipe() -> None:
    paper = PRESETS["paper"]
    assert paper == TrainConfig() and paper.augment == AugmentConfig()
    assert (paper.batch, paper.learning_rate, paper.epochs, paper.l1_weight) == (40, 5e-4, 300.0, 100.0)
    assert paper.schedule == "constant" and paper.loss == "ce+l1"
    assert [preset for preset, recipe in PRESETS.items() if not recipe.learned_box] == ["paper", "paper-autodecoder"]


def test_a_chain_of_trainings_adds_up_and_only_a_learned_box_limits_it(dataset: Path, tmp_path: Path) -> None:
    first = trainer.train(dataset, tmp_path / "1", replace(SMALL, epochs=0.3, learned_box=False))
    second = trainer.train(dataset, tmp_path / "2", replace(SMALL, epochs=0.2, init=str(first)))
    third = trainer.train(dataset, tmp_path / "3", replace(SMALL, epochs=0.1, init=str(second)))
    models = [load_model(path) for path in (first, second, third)]
    shown = [seen_in_training(model.provenance)[0] or 0 for model in models]
    assert shown == [int(str(model.provenance["steps"])) * 8 for model in models] and shown[0] > shown[2] > 0
    assert [model.provenance["examples_before"] for model in models] == [0, shown[0], shown[0] + shown[1]]
    assert seen_by(str(third)) == sum(shown)
    assert f"{sum(shown)} with those of the weights" in describe_seen(models[2].provenance)
    assert [model.domain is None for model in models] == [True, False, False]
    old = {key: value for key, value in models[2].provenance.items() if key != "examples_before"}
    assert "which do not say how many" in describe_seen(old)


def noisy_world(count: int, share: tuple[float, ...], seed: int) -> tuple[Tensor, Tensor]:
    """Labels drawn with ``share``, a noisy observation of each, and the log likelihood of every class given it."""
    rng = default_rng(seed)
    labels = rng.choice(len(share), size=count, p=share)
    seen = labels + rng.normal(scale=0.6, size=count)
    logits = -0.5 * ((seen[:, None] - np.arange(len(share))) / 0.6) ** 2
    return torch.from_numpy(logits).float(), torch.from_numpy(labels)


def miou(logits: Tensor, labels: Tensor) -> float:
    return intersection_over_union(confusion_matrix(labels.numpy(), logits.argmax(1).numpy(), logits.shape[1])).miou


def test_a_rare_class_trained_as_if_common_is_drawn_smaller_and_what_is_right_is_left_alone() -> None:
    """Likelihoods alone are what equal shares would teach; the class is really one point in a hundred."""
    share = (0.69, 0.3, 0.01)
    logits, labels = noisy_world(60_000, share, seed=0)
    offsets = class_offsets(logits, labels)
    assert offsets[0] == 0 and offsets[2] < -0.5
    fresh, truth = noisy_world(60_000, share, seed=1)
    assert miou(fresh + offsets, truth) > miou(fresh, truth) + 0.01
    labels = torch.arange(3).repeat(50)
    assert torch.equal(class_offsets(5.0 * torch.nn.functional.one_hot(labels).float(), labels), torch.zeros(3))


# --- ends and new beginnings ------------------------------------------------------------------------------------------


FILES = ("weights.safetensors", "checkpoint.safetensors", "metrics.csv", "curves.png")


@pytest.fixture(scope="module")
def brief(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of five steps that has ended; not to be changed."""
    return trainer.train(dataset, tmp_path_factory.mktemp("runs") / "whole", BRIEF).parent


def files(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in FILES}


@pytest.fixture
def run(brief: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(brief, tmp_path / "run"))


@pytest.mark.parametrize("lost", ["weights.safetensors", "checkpoint.safetensors", "curves.png"])
def test_what_a_finished_run_lacks_is_written(lost: str, dataset: Path, brief: Path, run: Path) -> None:
    (run / lost).unlink()
    trainer.train(dataset, run, BRIEF)
    assert files(run) == files(brief)


def test_weights_of_an_earlier_step_are_replaced(dataset: Path, brief: Path, first: Path, run: Path) -> None:
    """As a run leaves them that is killed between its last checkpoint and its weights."""
    shutil.copy(first, run)
    trainer.train(dataset, run, BRIEF)
    assert files(run) == files(brief)


@pytest.mark.parametrize("step", ["save_model", "save_checkpoint"])
def test_a_disk_that_is_full_at_the_end_costs_nothing(
    step: str, dataset: Path, brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(trainer, step, full)
        trainer.train(dataset, tmp_path / "run", BRIEF)
    trainer.train(dataset, tmp_path / "run", BRIEF)
    assert files(tmp_path / "run") == files(brief)


def test_lost_metrics_do_not_keep_a_finished_run_from_ending(dataset: Path, brief: Path, run: Path) -> None:
    (run / "metrics.csv").unlink()
    trainer.train(dataset, run, BRIEF)
    assert (run / "metrics.csv").read_text().count("\n") == 2, "the titles and the last held-out scores"
    assert (run / "weights.safetensors").read_bytes() == (brief / "weights.safetensors").read_bytes()
    (run / "metrics.csv").write_text("step,loss\n1,high\n")
    with pytest.raises(ValueError, match=r"metrics\.csv is not the table of a run \(.*'high'\); delete it"):
        trainer.train(dataset, run, BRIEF)


@pytest.mark.parametrize("often", [0.0, 1e9])
def test_a_resumed_run_leaves_the_same_files(often: float, dataset: Path, brief: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        kill_after(patch, 3)
        trainer.train(dataset, tmp_path / "run", BRIEF, checkpoint_every_s=0.0)
    assert not list((tmp_path / "run").glob(".*"))  # a file being written has a hidden name
    trainer.train(dataset, tmp_path / "run", BRIEF, checkpoint_every_s=often)
    assert files(tmp_path / "run") == files(brief)


@pytest.mark.parametrize(
    ("loss", "gradient", "clip", "says"),
    [
        (math.nan, math.nan, 1.0, "the loss is nan in step 4 of 5"),
        (0.0, math.inf, 0.0, "the gradient's norm is (inf|nan) in step 4 of 5"),
    ],
)
def test_a_diverged_training_stops_and_keeps_what_was_good(
    loss: float, gradient: float, clip: float, says: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(BRIEF, clip_norm=clip, precision="bfloat16")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        kill_after(patch, 2)
        trainer.train(dataset, tmp_path / "run", config, checkpoint_every_s=0.0)
    good = files(tmp_path / "run")
    diverge_at(monkeypatch, 4, loss, gradient)
    cure = "step 2 are kept: choose another --output and a --learning-rate below 0.004 or --precision float32"
    with pytest.raises(ValueError, match=rf"{says}, on the examples \d+, .*{cure}, or check these examples"):
        trainer.train(dataset, tmp_path / "run", config)
    assert files(tmp_path / "run") == good


def test_a_divergence_before_anything_is_saved_is_an_error_of_the_command(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    diverge_at(monkeypatch, 1, math.nan, math.nan)
    command = f"train {dataset} --output {tmp_path / 'run'} --preset tiny --batch 8 --precision float32"
    assert command_line.main(command.split()) == 2
    message = capsys.readouterr().err
    assert message.startswith("mereo: error: the loss is nan in step 1 of ") and message.count("\n") == 1
    assert "nothing is saved" in message and "--precision" not in message
    assert os.listdir(tmp_path / "run") == ["config.json"]


def test_a_checkpoint_of_a_diverged_run_is_not_continued(dataset: Path, run: Path) -> None:
    """Earlier versions wrote such ones."""
    path = run / "checkpoint.safetensors"
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors["network/decoder.head.bias"].fill_(math.nan)
    save_file(tensors, path, metadata=metadata)
    with pytest.raises(ValueError, match=r"checkpoint of step 5 in .*run holds numbers that are not finite"):
        trainer.train(dataset, run, BRIEF)
