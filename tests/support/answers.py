"""Answers to clouds, and registrations."""

from typing import Any

import numpy as np
from numpy import ndarray

from mereo.fitting.problem.evidence import UNDECIDED
from mereo.fitting.problem.gauss_newton import Posed
from mereo.fitting.registration.answer import Answer
from mereo.fitting.registration.answer_frame import answer_frame, search_modes
from mereo.fitting.registration.register import CloudToFit, ModesFit, Registrar
from mereo.fitting.registration.registration import Registration
from mereo.geometry.camera import PointCloud, SightLines
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


def fit_modes(
    points: ndarray, model: StatisticalModel, unit: float, material: ndarray, lines: SightLines = UNDECIDED
) -> ModesFit:
    """Fit of the modes from the mean state where a state's material points, in scene units, are."""
    T, _ = model.project(material)
    start = Posed(T[:3, :3], T[:3, 3], np.zeros(model.count))
    return search_modes(CloudToFit(points, unit, lines=lines), model, starts=[start], everywhere=False)


def fit_cloud(points: ndarray, model: StatisticalModel, material: ndarray, unit: float = 1.0) -> Registration:
    """Registration of a cloud from there."""
    return fit_modes(points, model, unit, material).registration
