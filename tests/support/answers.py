"""Answers to clouds, and registrations from given correspondences."""

from typing import Any

import numpy as np
from numpy import ndarray

from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame
from mereo.fitting.registration.register import CloudToFit, ModesFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud
from mereo.geometry.conventions import CloudAxes
from mereo.models.model import Model
from mereo.reconstruction.observation import observe
from mereo.reconstruction.pipeline import Reconstruction
from mereo.scenes.statistical_model import StatisticalModel


def answer_to(
    points: PointCloud | ndarray,
    model: Model,
    registrar: Registrar | None = None,
    resolution: int = 128,
    axes: CloudAxes = "camera",
    unit_m: float | None = None,
    **options: Any,
) -> Answer:
    """Answer to a cloud that is all the object's; without a registrar the network's."""
    cloud = points if isinstance(points, PointCloud) else PointCloud(np.asarray(points, float))
    return answer_frame(observe(cloud, axes, unit_m), model, registrar, resolution=resolution, **options)


def reconstruct(
    points: PointCloud | ndarray,
    model: Model,
    resolution: int = 128,
    axes: CloudAxes = "camera",
    label_points: bool = False,
    keep_all: bool = False,
) -> Reconstruction:
    """What the network alone finds in a cloud."""
    options = {"label_points": label_points, "keep_all": keep_all}
    return answer_to(points, model, None, resolution, axes, **options).reconstruction


def fit_correspondences(
    points: ndarray,
    correspondences: Correspondences,
    model: StatisticalModel,
    scene_unit: float | None = None,
    states: DrawnStates | None = None,
) -> Registration:
    """Registration of a cloud, with ``states`` by the scene's draws too."""
    fitted = ModesFit.of(CloudToFit(points, scene_unit), correspondences, model)
    return fitted.registration if states is None else fitted.with_draws(states)
