"""Gauge of the network's probabilities: temperature and biases, by the cells of the paper's metric of clean views."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mereo.evaluation.calibration_views import CalibrationView
from mereo.evaluation.ground_truth import truth_grid
from mereo.evaluation.probability_scaling import ece_of, fit_scaling
from mereo.evaluation.reliability import AskedCells
from mereo.fitting.registration.answer import Answer
from mereo.models.model import Model

CELLS = 60
"""Cells of the grid along each axis: which of them are asked is random anyway."""

ASKED = 6000
"""Cells of a view."""


class ProbabilityGauge:
    """Measurement of how probabilities must be scaled. Satisfies ``Gauge``.

    Noisy views are left out: their network sees less, and a temperature that covered it would make all others vague.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.logits: list[Float[np.ndarray, "_ c"]] = []
        self.truth: list[UInt8[np.ndarray, " _"]] = []

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Ask the network at some of a clean view's cells."""
        if not view.clean:
            return
        cells = AskedCells.of(truth_grid(view.mesh, CELLS), ASKED)
        assert answer.likelier is not None and answer.likelier.code is not None
        logits = self.model.logits(answer.likelier.code, cells.points)
        self.logits.append(logits)
        self.truth.append(np.minimum(cells.truth, logits.shape[1] - 1).astype(np.uint8))

    def add_strange(self, answer: Answer) -> None:
        """Nothing: what is not the object has no labels."""

    def fields(self) -> dict[str, Any]:
        """Temperature, biases, and the expected calibration error without and with them."""
        logits, truth = np.concatenate(self.logits), np.concatenate(self.truth)
        scaling = fit_scaling(logits, truth)
        return {
            "temperature": scaling.temperature,
            "biases": scaling.biases,
            "ece": (ece_of(logits, truth), ece_of(logits, truth, scaling)),
        }
