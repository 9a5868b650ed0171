"""A registered toy scene and the truth of where its material went."""

import numpy as np
from scipy.spatial.transform import Rotation
from toy_scene import toy_scene

from mereo.fitting.registration.registration import Registration
from mereo.geometry.transforms import rigid
from mereo.scenes.statistical_model import StatisticalModel

SCENE = toy_scene()


T = rigid(Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([5.0, -3.0, 90.0]))


def registered(model: StatisticalModel, material: np.ndarray, unit: float = 1.0) -> Registration:
    return Registration(model, unit * material, "modes", np.zeros(model.count), unit, True, 1.0, True, 0.0)
