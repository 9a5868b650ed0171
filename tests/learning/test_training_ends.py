"""However a training is stopped and started again, it ends with everything, or says why it cannot."""

import errno
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_training import SMALL
from toy_data import write_toy_dataset
from training_runs import diverge_at, kill_after

from mereo import __main__ as command_line
from mereo_learning import metrics_log, trainer

BRIEF = replace(SMALL, epochs=0.6)  # five steps
FILES = ("weights.safetensors", "checkpoint.safetensors", "metrics.csv", "curves.png")


@pytest.fixture(scope="module", autouse=True)
def _quick_curves() -> Iterator[None]:
    """Curves that tell of how many rows they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics_log, "draw_curves", lambda rows, path: path.write_bytes(b"row " * len(rows)))
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("toy") / "data")


@pytest.fixture(scope="module")
def finished(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trainer.train(dataset, tmp_path_factory.mktemp("runs") / "whole", BRIEF).parent


def files(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in FILES}


@pytest.mark.parametrize("lost", ["weights.safetensors", "checkpoint.safetensors", "curves.png"])
def test_what_a_finished_run_lacks_is_written(lost: str, dataset: Path, finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run" / lost).unlink()
    trainer.train(dataset, tmp_path / "run", BRIEF)
    assert files(tmp_path / "run") == files(finished)


def test_weights_of_an_earlier_step_are_replaced(dataset: Path, finished: Path, tmp_path: Path) -> None:
    """As a run leaves them that is killed between its last checkpoint and its weights."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        kill_after(patch, 4)
        trainer.train(dataset, tmp_path / "run", BRIEF, checkpoint_every_s=0.0)
    shutil.copy(finished / "checkpoint.safetensors", tmp_path / "run")
    trainer.train(dataset, tmp_path / "run", BRIEF)
    assert (tmp_path / "run/weights.safetensors").read_bytes() == (finished / "weights.safetensors").read_bytes()


@pytest.mark.parametrize("step", ["save_model", "save_checkpoint"])
def test_a_disk_that_is_full_at_the_end_costs_nothing(
    step: str, dataset: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(trainer, step, full)
        trainer.train(dataset, tmp_path / "run", BRIEF)
    trainer.train(dataset, tmp_path / "run", BRIEF)
    assert files(tmp_path / "run") == files(finished)


def test_lost_metrics_do_not_keep_a_finished_run_from_ending(dataset: Path, finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run/metrics.csv").unlink()
    trainer.train(dataset, tmp_path / "run", BRIEF)
    assert (tmp_path / "run/metrics.csv").read_text().count("\n") == 2, "the titles and the last held-out scores"
    assert (tmp_path / "run/weights.safetensors").read_bytes() == (finished / "weights.safetensors").read_bytes()
    (tmp_path / "run/metrics.csv").write_text("step,loss\n1,high\n")
    with pytest.raises(ValueError, match=r"metrics\.csv is not the table of a run \(.*'high'\); delete it"):
        trainer.train(dataset, tmp_path / "run", BRIEF)


@pytest.mark.parametrize("often", [0.0, 1e9])
def test_a_resumed_run_leaves_the_same_files(often: float, dataset: Path, finished: Path, tmp_path: Path) -> None:
    """Metrics and curves too, however often either run saved."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        kill_after(patch, 3)
        trainer.train(dataset, tmp_path / "run", BRIEF, checkpoint_every_s=0.0)
    assert not list((tmp_path / "run").glob(".*"))  # a file being written has a hidden name
    trainer.train(dataset, tmp_path / "run", BRIEF, checkpoint_every_s=often)
    assert files(tmp_path / "run") == files(finished)


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
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    diverge_at(monkeypatch, 1, math.nan, math.nan)
    command = f"train {dataset} --output {tmp_path / 'run'} --preset tiny --batch 8 --precision float32"
    assert command_line.main(command.split()) == 2
    message = capsys.readouterr().err
    assert message.startswith("mereo: error: the loss is nan in step 1 of ") and message.count("\n") == 1
    assert "nothing is saved" in message and "--precision" not in message
    assert os.listdir(tmp_path / "run") == ["config.json"]


def test_a_checkpoint_of_a_diverged_run_is_not_continued(dataset: Path, finished: Path, tmp_path: Path) -> None:
    """Earlier versions wrote such ones."""
    shutil.copytree(finished, tmp_path / "run")
    spoil(tmp_path / "run/checkpoint.safetensors")
    with pytest.raises(ValueError, match=r"checkpoint of step 5 in .*run holds numbers that are not finite"):
        trainer.train(dataset, tmp_path / "run", BRIEF)


def spoil(path: Path) -> None:
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    tensors["network/decoder.head.bias"].fill_(math.nan)
    save_file(tensors, path, metadata=metadata)
