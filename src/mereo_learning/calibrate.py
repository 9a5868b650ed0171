"""Calibration of weights on views of training seeds: what they say of these is compared with what is true.

    Model, Scene -object_views-> Answer -measured-> Calibration

Two parts are measured: the network's probabilities, and the radii of registrations.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from mereo.fitting.registration.answer import Answer, Candidate
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import Registrar, registrar_for
from mereo.fitting.registration.registration import BELIEVED, Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.metrics import truth_grid
from mereo.io.progress import progress
from mereo.models.calibration import Calibration, RadiusFactors, Scaling
from mereo.models.model import Model, scaled_array
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START, example_rng
from mereo.scenes.statistical_model import StatisticalModel
from mereo.synthesis.config import GenerateConfig
from mereo.synthesis.examples import sample_view
from mereo_learning.cases import RegistrationErrors, Reliability, nearest_truth, sample_cells, seen_points
from mereo_learning.scoring import check_names, trained_scene, true_material

SEED = 900_000
"""A training seed, whose examples no shipped weights were trained on."""

VIEWS = 24

LEAST_VIEWS = 8


def calibrate(
    model: Model,
    scene: Scene | str | None = None,
    *,
    views: int = VIEWS,
    seed: int = SEED,
    radius_views: int = 0,
    quiet: bool = True,
) -> Calibration:
    """Calibration of a model by views of its scene.

    Of noisy views a network sees less: a temperature that covered these would make all others vague.

    Args:
        model: the weights; of such without a statistical model only the probabilities are calibrated.
        scene: their scene, its name or its file; by default the built-in one that they were trained on.
        views: of the object; at least ``LEAST_VIEWS``.
        seed: a training seed other than that of the weights' examples.
        radius_views: further views for the radii alone, with the scene unit known: of a fit that ends in a wrong
            state once in twenty, a few views tell nothing.
        quiet: show no progress.

    Raises ``ValueError`` for a test seed, too few views, and another object than the model's.
    """
    if seed >= TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; calibration is part of training: take one below {TEST_SEED_START}")
    if views < LEAST_VIEWS:
        raise ValueError(f"{views} views are asked for; at least {LEAST_VIEWS} tell anything: {VIEWS} are usual")
    if scene is None or isinstance(scene, str):
        scene = load_scene(scene or trained_scene(model))
    check_names(model, scene.rest.names)
    bare = replace(model, calibration=None)
    registrar = None if model.statistical_model is None else registrar_for(bare, "modes", scene)
    more = radius_views if registrar is not None else 0
    logits, truth = [], []
    radii = ViewRadii() if registrar is None else ViewRadii(replace(registrar, method="auto"))
    with progress("calibrate", views + more, "views", quiet=quiet) as shown:
        for number, view in enumerate(object_views(scene, views, seed, more)):
            answer = answer_frame(observe(view.seen), bare, registrar, scene_unit=view.scene_unit)
            radii.add(view, answer)
            if number < views:
                assert answer.encoded.code is not None
                points, labels = sample_cells(truth_grid(view.mesh, CELLS), SAMPLED_CELLS)
                logits.append(bare.logits(answer.encoded.code, points))
                truth.append(np.minimum(labels, logits[-1].shape[1] - 1).astype(np.uint8))
            shown.advance()
    joint, labels = np.concatenate(logits), np.concatenate(truth)
    scaling = fit_scaling(joint, labels)
    return Calibration(
        seed=seed,
        views=views,
        temperature=scaling.temperature,
        biases=scaling.biases,
        ece=(ece_of(joint, labels), ece_of(joint, labels, scaling)),
        **radii.fields(),
    )


# --- views ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The object in a random state, with its truth, as the paper's camera sees it.

    Attributes:
        mesh: the true segments, camera frame, scene units.
        seen: the cloud, in the same.
        scene_unit: length of a scene unit in the cloud's unit, 1; None in every other view, which has to find it.
        material: true positions of a statistical model's material points, or of the first of them.
    """

    mesh: SegmentedMesh
    seen: PointCloud
    scene_unit: float | None
    material: Callable[[StatisticalModel], Float[np.ndarray, "m 3"]]


def object_views(scene: Scene, count: int, seed: int, more: int = 0) -> Iterator[CalibrationView]:
    """Views of a scene, then ``more`` with the unit known; view i is made from (seed, i) alone."""
    for index in range(count + more):
        scene_unit = 1.0 if index % 2 == 0 or index >= count else None
        view = sample_view(scene.for_seed(seed), GenerateConfig(), example_rng(seed, index))
        yield CalibrationView(view.mesh, view.depth.to_points(), scene_unit, partial(true_material, view))


# --- probabilities ----------------------------------------------------------------------------------------------------

CELLS = 60
"""Cells of the grid along each axis: which of them are sampled is random anyway."""

SAMPLED_CELLS = 6000
"""Cells of a view."""

# Temperature and biases that make probabilities of logits: chosen so that what happens is as likely as is said.
#
# Temperature scaling divides all logits by one number (Guo et al., ICML 2017). Training queries are not spread as space
# is, so frequencies of classes differ as well: then one bias for each class is added, which makes up for the average of
# it. Both are found by the likelihood of the true labels, whose maximum is unique. Labels are not touched.
#
# Notation: n points, c classes.

GOOD_ENOUGH = 0.02
"""Expected calibration error up to which the temperature does alone: two thirds of what is wanted of unseen views."""


def ece_of(
    logits: Float[np.ndarray, "n c"],
    truth: UInt8[np.ndarray, " n"],
    scaling: Scaling = Scaling(),  # noqa: B008 (frozen)
) -> float:
    """Expected calibration error of the scaled probability of the most likely class by the logits as they are."""
    labels = logits.argmax(axis=1)
    rows = np.arange(len(logits))
    reliability = Reliability()
    reliability.add(softmax(scaled_array(scaling, logits).astype(np.float64), axis=1)[rows, labels], labels == truth)
    return reliability.ece


def fit_scaling(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"]) -> Scaling:
    """The simplest scaling that is good enough: a temperature, or also a bias for each class."""
    alone = _most_likely(logits, truth, biased=False)
    return alone if ece_of(logits, truth, alone) <= GOOD_ENOUGH else _most_likely(logits, truth, biased=True)


def _most_likely(logits: Float[np.ndarray, "n c"], truth: UInt8[np.ndarray, " n"], biased: bool) -> Scaling:
    """Scaling under which the true labels are most likely; its logarithm is concave in 1 / temperature and biases."""
    values = logits.astype(np.float64)
    count, classes = values.shape
    hot = np.eye(classes)[truth]

    def loss(parameters: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        scale = np.exp(parameters[0])
        biases = np.concatenate([[0.0], parameters[1:]]) if biased else np.zeros(classes)
        likelihood = log_softmax(values * scale + biases, axis=1)
        residual = (np.exp(likelihood) - hot) / count
        gradient = [(residual * values).sum() * scale, *(residual.sum(axis=0)[1:] if biased else ())]
        return -float((likelihood * hot).sum()) / count, np.array(gradient)

    best = minimize(loss, np.zeros(classes if biased else 1), jac=True, method="L-BFGS-B").x
    return Scaling(float(np.exp(-best[0])), (0.0, *map(float, best[1:])) if biased else None)


# --- radii ------------------------------------------------------------------------------------------------------------

FIELDS = (
    ("radius_scale", "usual_misfit"),
    ("draws_radius_scale", "draws_usual_misfit"),
)
"""Fields of ``Calibration`` that are of fits of the modes, and of a scene's parameters."""

LEAST = 4
"""Views without which nothing is said."""


@dataclass(frozen=True, eq=False)
class MeasuredRadii:
    """Radii of one view, and what of it may make them wider.

    Attributes:
        errors: with the posterior's own radii.
        misfit: ``Problem.cloud_misfit``.
    """

    errors: RegistrationErrors
    misfit: float

    @classmethod
    def of(cls, view: CalibrationView, candidate: Candidate, registration: Registration) -> "MeasuredRadii":
        """Measurement of a registration that was made of a candidate, by weights that are not calibrated."""
        truth = nearest_truth(registration.model, registration.material, view.material(registration.model))
        raw = replace(registration, radius_scale=1.0)
        errors = RegistrationErrors.of(raw, truth, seen_points(truth, view.seen, 1.0), 1.0)
        assert registration.optimum is not None and candidate.modes is not None
        return cls(errors, candidate.modes.problem.cloud_misfit(registration.optimum.surface))

    def widened(self, factors: RadiusFactors) -> RegistrationErrors:
        """Errors with the radii that a calibration makes wider; its scale is left out."""
        return self.errors.scaled(replace(factors, scale=1.0).scale_at(self.misfit))


class ViewRadii:
    """Radii of the views whose registration is believed: of others users get none.

    Attributes:
        full: registrar that fits the scene's parameters to what the modes were fitted to; None where there is no scene.
        views: measurements of fits of the modes, and of the scene's parameters.
    """

    def __init__(self, full: Registrar | None = None) -> None:
        self.full = None if full is None or full.states_or_none is None else full
        self.views: tuple[list[MeasuredRadii], list[MeasuredRadii]] = [], []

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in a view of the object, answered by its modes."""
        candidate, registration = answer.candidate, answer.registration
        if candidate is None or candidate.modes is None or registration is None:
            return
        full = None if self.full is None else self.full.finish(candidate.modes)
        for kind, fit in enumerate((registration, full)):
            if fit is not None and fit.accepted and fit.needed >= BELIEVED and (kind == 0 or fit.method == "draws"):
                self.views[kind].append(MeasuredRadii.of(view, candidate, fit))

    def fields(self) -> dict[str, Any]:
        """Fields of the ``Calibration``: factors of both kinds of fits; none where their views are too few."""
        fields: dict[str, Any] = {}
        for (scale, misfit), views in zip(FIELDS, self.views, strict=True):
            if len(views) >= LEAST:
                factors = factors_of(views)
                fields |= {scale: factors.scale, misfit: factors.misfit}
        return fields


def factors_of(views: Sequence[MeasuredRadii]) -> RadiusFactors:
    """Factors by views, those that ended in a wrong state included: users meet them."""
    factors = RadiusFactors(None, float(np.median([view.misfit for view in views])) or None)
    scale = RegistrationErrors.together([view.widened(factors) for view in views]).scale()
    return replace(factors, scale=scale)
