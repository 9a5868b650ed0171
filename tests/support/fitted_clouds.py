"""Registrations from given correspondences, without a network."""

import numpy as np

from mereo.fitting.draws.playback import DrawnStates
from mereo.fitting.problem.correspondences import Correspondences
from mereo.fitting.registration.register import CloudToFit, ModesFit
from mereo.fitting.registration.registration import Registration
from mereo.scenes.statistical_model import StatisticalModel


def fit_correspondences(
    points: np.ndarray,
    correspondences: Correspondences,
    model: StatisticalModel,
    scene_unit: float | None = None,
    states: DrawnStates | None = None,
) -> Registration:
    """Registration of a cloud, with ``states`` by the scene's draws too."""
    fitted = ModesFit.of(CloudToFit(points, scene_unit), correspondences, model)
    return fitted.registration() if states is None else fitted.with_draws(states)
