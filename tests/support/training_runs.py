"""Training runs that are stopped, diverge or are shared."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from mereo_learning import trainer
from mereo_learning.config import TrainConfig
from mereo_learning.dataset import Batch


def kill_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Let training be interrupted after ``steps`` steps."""
    original = trainer.Trainer.train_step

    def step(self: trainer.Trainer, batch: object) -> None:
        if self.step == steps:
            raise KeyboardInterrupt
        original(self, batch)  # type: ignore[arg-type]

    monkeypatch.setattr(trainer.Trainer, "train_step", step)


def diverge_at(monkeypatch: pytest.MonkeyPatch, step: int, loss: float, gradient: float) -> None:
    """From ``step`` on the loss, or its gradient, is what is given here."""
    original = trainer.Trainer._loss

    def spoilt(self: trainer.Trainer, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        value, terms = original(self, batch)
        if self.step + 1 >= step:
            value = value + (loss if math.isnan(gradient) else 0.0)
            value.register_hook(lambda grad: grad * gradient if not math.isnan(gradient) else grad)
        return value, terms

    monkeypatch.setattr(trainer.Trainer, "_loss", spoilt)


def assert_resumes_exactly(dataset: Path, folder: Path, config: TrainConfig, steps: int) -> None:
    """A run that is killed after ``steps`` and started again ends with the same bits as an uninterrupted one."""
    trainer.train(dataset, folder / "whole", config, checkpoint_every_s=0.0)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        kill_after(patch, steps)
        trainer.train(dataset, folder / "parts", config, checkpoint_every_s=0.0)
    assert not list((folder / "parts").glob(".*"))  # a file being written has a hidden name
    trainer.train(dataset, folder / "parts", config, checkpoint_every_s=0.0)
    whole, parts = (load_file(folder / name / "checkpoint.safetensors") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    assert (folder / "whole" / "metrics.csv").read_text() == (folder / "parts" / "metrics.csv").read_text()
