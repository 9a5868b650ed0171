"""Calibration of weights on views of training seeds: what they say of these is compared with what is true.

    Model, Scene -own_views, strange_frames-> Answer -gauges-> Calibration

Each gauge measures one part. It is given every view of the object, with its fit of the modes and its truth, and every
strange frame, and says its fields of the ``Calibration`` at the end.
"""

from dataclasses import replace
from typing import Any, Protocol

from mereo.evaluation.calibration_views import (
    CalibrationView,
    clean_views,
    other_objects,
    own_views,
    strange_frames,
)
from mereo.evaluation.probability_gauge import ProbabilityGauge
from mereo.evaluation.radius_gauge import RadiusGauge
from mereo.evaluation.recognition_gauge import RecognitionGauge
from mereo.evaluation.scoring import check_names, trained_scene
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import registrar_for
from mereo.io.progress import progress
from mereo.models.calibration import Calibration
from mereo.models.model import Model
from mereo.reconstruction.observation import observe
from mereo.scenes.registry import load_scene
from mereo.scenes.scene import Scene
from mereo.scenes.seeds import TEST_SEED_START

SEED = 900_000
"""A training seed, whose examples no shipped weights were trained on."""

VIEWS = 48

RADIUS_VIEWS = 32

LEAST_VIEWS = 8


class Gauge(Protocol):
    """Measurement of one part of a calibration."""

    def add(self, view: CalibrationView, answer: Answer) -> None:
        """Take in a view of the object, answered by its modes."""

    def add_strange(self, answer: Answer) -> None:
        """Take in a frame that shows another thing than the object."""

    def fields(self) -> dict[str, Any]:
        """Fields of the ``Calibration`` that were measured."""


def calibrate(
    model: Model,
    scene: Scene | str | None = None,
    *,
    views: int = VIEWS,
    seed: int = SEED,
    strangers: bool = True,
    radius_views: int = 0,
    quiet: bool = True,
) -> Calibration:
    """Calibration of a model by views of its scene: clean ones, noisy ones, and frames of what is not its object.

    Args:
        model: the weights; of such without a statistical model only the probabilities are calibrated.
        scene: their scene, its name or its file; by default the built-in one that they were trained on.
        views: of the object, half of them clean; at least ``LEAST_VIEWS``. About as many strange frames come on top.
        seed: a training seed other than that of the weights' examples.
        strangers: take in frames of other things too, which place the second limit of recognition.
        radius_views: further clean views for the radii alone, with the scene unit known: of a fit that ends in a wrong
            state once in twenty, a few views tell nothing.
        quiet: show no progress.

    Raises ``ValueError`` for a test seed, too few views, and another object than the model's.
    """
    if seed >= TEST_SEED_START:
        raise ValueError(f"the seed is {seed}; calibration is part of training: take one below {TEST_SEED_START}")
    if views < LEAST_VIEWS:
        raise ValueError(f"{views} views are asked for; at least {LEAST_VIEWS} tell anything: 48 are usual")
    if scene is None or isinstance(scene, str):
        scene = load_scene(scene or trained_scene(model))
    check_names(model, scene.rest.names)
    bare = replace(model, calibration=None)
    registrar = None if model.statistical_model is None else registrar_for(bare, "modes", scene)
    gauges: tuple[Gauge, ...] = (ProbabilityGauge(bare),)
    radii = None if registrar is None else RadiusGauge(replace(registrar, method="auto"))
    if radii is not None:
        gauges = (*gauges, RecognitionGauge(), radii)
    more = radius_views if radii is not None else 0
    each = max(1, round(views / 24)) if strangers and registrar is not None else 0
    others = other_objects(scene) if each else []
    with progress("calibrate", views + more + each * (len(others) + 8), "views", quiet=quiet) as shown:
        for view in own_views(scene, views, seed):
            answer = answer_frame(observe(view.seen), bare, registrar, scene_unit=view.scene_unit)
            for gauge in gauges:
                gauge.add(view, answer)
            shown.advance()
        for view in clean_views(scene, more, seed, first=views):
            assert radii is not None
            radii.add(view, answer_frame(observe(view.seen), bare, registrar, scene_unit=view.scene_unit))
            shown.advance()
        for strange in strange_frames(scene, others, each, seed):
            answer = answer_frame(observe(strange.cloud), bare, registrar)
            for gauge in gauges:
                gauge.add_strange(answer)
            shown.advance()
    fields: dict[str, Any] = {}
    for gauge in gauges:
        fields |= gauge.fields()
    return Calibration(seed=seed, views=views, **fields)
