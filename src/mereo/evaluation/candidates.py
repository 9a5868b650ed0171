"""Answers to one test case: the network's, that of the modes, that of the scene's own draws, and which a user gets."""

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.recognition import Known
from mereo.fitting.registration.register import Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.labels import LabelGrid
from mereo.geometry.solids import label_grid
from mereo.models.trained import EncodedCloud, Trained
from mereo.reconstruction.coarse_to_fine import sample_coarse_to_fine
from mereo.reconstruction.observation import observe

AnswerName = Literal["network", "modes", "full"]
"""Who answers: the network alone, the registered modes, the better of these and the scene's own draws."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One answer to a frame.

    Attributes:
        labels: on the grid of the truth.
        seconds: from the cloud to the answer.
        registration: behind it; None for the network's.
    """

    labels: UInt8[np.ndarray, "x y z"]
    seconds: float
    registration: Registration | None = None

    def labels_on(self, grid: LabelGrid, model: Trained, code: EncodedCloud) -> UInt8[np.ndarray, "x y z"]:
        """Labels on another grid."""
        if self.registration is None:
            return network_labels(model, code, grid)
        return label_grid(self.registration.mesh, *grid.axes())


@dataclass(frozen=True, eq=False)
class Candidates:
    """All answers to a frame.

    Attributes:
        code: what the network made of the cloud.
        each: answers by who gives them.
        default: whose answer a user gets.
        known: whether the frame is said to show the object; None where no registration was asked for.
        seconds: from the cloud to the answer that a user gets, all that led to it included.
    """

    code: EncodedCloud
    each: dict[AnswerName, Candidate]
    default: AnswerName
    known: Known | None = None
    seconds: float = 0.0

    @property
    def answer(self) -> Candidate:
        """The answer that a user gets."""
        return self.each[self.default]

    @property
    def source(self) -> str:
        """Where that answer comes from: network, rest, modes or draws."""
        found = self.answer.registration
        return "network" if found is None else found.method


def network_labels(model: Trained, code: EncodedCloud, grid: LabelGrid) -> UInt8[np.ndarray, "x y z"]:
    """Labels by the network at the voxels of a grid, evaluated coarse to fine."""
    x, y, z = grid.labels.shape

    def logits(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n c"]:
        return model.logits(code, points)

    return sample_coarse_to_fine(logits, grid.origin, grid.spacing, (x, y, z)).labels


def find_candidates(
    model: Trained, cloud: PointCloud, grid: LabelGrid, registrar: Registrar | None, scene_unit: float | None
) -> Candidates:
    """Answers to a frame, scored on a grid: the one that a user gets, and all others that led to it."""
    answer = answer_frame(observe(cloud), model, registrar, scene_unit=scene_unit)
    assert answer.likelier is not None and answer.candidate is not None and answer.likelier.code is not None
    started = time.perf_counter()
    code, encoding = answer.likelier.code, answer.likelier.timings_s["encode"]
    labels = network_labels(model, code, grid)
    each: dict[AnswerName, Candidate] = {"network": Candidate(labels, encoding + time.perf_counter() - started)}
    if registrar is None:
        return Candidates(code, each, "network", seconds=each["network"].seconds)
    known, names = answer.recognition.known, names_for(registrar)
    if answer.candidate.modes is None or answer.registration is None:  # too little is found, whoever is scored
        return Candidates(code, dict.fromkeys(names, each["network"]), "network", known, answer.seconds)
    each["modes"] = _registered(answer.candidate.modes.registration(), grid, encoding)
    if "full" in names:
        each["full"] = _registered(answer.registration, grid, encoding)
    return Candidates(code, each, names[-1] if answer.taken else "network", known, answer.seconds)


def names_for(registrar: Registrar | None) -> tuple[AnswerName, ...]:
    """Names of the answers that can be had: the draws only of an object whose scene is at hand."""
    if registrar is None:
        return ("network",)
    if registrar.method == "modes" or registrar.at_hand is None:
        return ("network", "modes")
    return ("network", "modes", "full")


def _registered(registration: Registration, grid: LabelGrid, encoding: float) -> Candidate:
    labels = label_grid(registration.mesh, *grid.axes())
    return Candidate(labels, encoding + registration.seconds, registration)


@dataclass(frozen=True, eq=False)
class RegistrationErrors:
    """Distances of registered material points from where they truly are, scene units.

    Attributes:
        seen: of those near an observed point.
        hidden: of all others.
    """

    seen: Float[np.ndarray, " n"]
    hidden: Float[np.ndarray, " m"]

    @classmethod
    def of(
        cls,
        registration: Registration,
        truth: Float[np.ndarray, "m 3"],
        seen: Bool[np.ndarray, " m"],
        scene_unit: float,
    ) -> "RegistrationErrors":
        """Errors at the material points whose true places are given, the first ones, in the registration's unit.

        ``seen`` says which of these the cloud shows (``coverage.seen_points``).
        """
        error = np.linalg.norm(registration.material[: len(truth)] - truth, axis=1) / scene_unit
        return cls(error[seen], error[~seen])

    @classmethod
    def together(cls, each: list["RegistrationErrors"]) -> "RegistrationErrors":
        """Errors of several frames as one set."""
        nothing = [np.empty(0)]
        return cls(
            np.concatenate([*nothing, *(one.seen for one in each)]),
            np.concatenate([*nothing, *(one.hidden for one in each)]),
        )

    def summary(self, unit_mm: float | None) -> dict[str, dict[str, float | None]]:
        """Median and 95 % quantile of the seen and of the hidden points, in scene units, and in mm where known."""
        return {"seen": _quantiles(self.seen, unit_mm), "hidden": _quantiles(self.hidden, unit_mm)}


def _quantiles(errors: Float[np.ndarray, " n"], unit_mm: float | None) -> dict[str, float | None]:
    if len(errors) == 0:
        return {"median": None, "p95": None, "median_mm": None, "p95_mm": None}
    median, p95 = (float(value) for value in np.quantile(errors, [0.5, 0.95]))
    millimetres = [None if unit_mm is None else value * unit_mm for value in (median, p95)]
    return {"median": median, "p95": p95, "median_mm": millimetres[0], "p95_mm": millimetres[1]}
