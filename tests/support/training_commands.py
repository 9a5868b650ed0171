"""Trainings that diverge."""

import math

import pytest
import torch

from mereo.training import trainer
from mereo.training.dataset import Batch


def diverge_at(monkeypatch: pytest.MonkeyPatch, step: int, loss: float, gradient: float) -> None:
    """From ``step`` on the loss, or its gradient, is what is given here."""
    original = trainer.Trainer._loss

    def spoilt(self: trainer.Trainer, batch: Batch) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        value, terms = original(self, batch)
        if self.step + 1 >= step:
            value = value + (loss if math.isnan(gradient) else 0.0)
            value.register_hook(lambda grad: grad * gradient if not math.isnan(gradient) else grad)
        return value, terms

    monkeypatch.setattr(trainer.Trainer, "_loss", spoilt)
